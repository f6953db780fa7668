"""A trajectory as an export takes it: every K-th frame, and at most M particles."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from mpmcli.dataset.dataset import ALL, Particles, Trajectory
from mpmcli.dataset.walls import WallParticles, Walls
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.layout import FrameLayout

# Of the random choice of particles, together with the number of the trajectory.
SEED = 0
BLOCK_BYTES = 64 * 2**20


class ThinnedTrajectory:
    """Every `stride`-th frame from the first on, and at most `most` particles of a trajectory, all of them if None.

    The particles are the same ones in all frames, and the same ones in every export: of each body its share,
    drawn at random. The ledger stays that of all particles.

    Attributes:
        source: the whole trajectory.
        particle_count: after thinning.
        walls: particles on walls, which are not among these.
    """

    def __init__(
        self,
        source: Trajectory,
        stride: int = 1,
        most: int | None = None,
        walls: Walls = "none",
        wall_spacing: float | None = None,
    ) -> None:
        """Thin a trajectory; nothing is read.

        Args:
            walls: which have particles.
            wall_spacing: between these, m; that of the particles at the start if None.
        """
        self.source = source
        self._stride, self._most = stride, most
        self.times, self.steps, self.frames = (table[::stride] for table in (source.times, source.steps, source.frames))
        self.particle_count = source.particle_count if most is None else min(source.particle_count, most)
        spacing = wall_spacing or self.spacing
        self.walls = WallParticles(source.header, source.colliders, walls if spacing else "none", spacing or 1.0)

    @property
    def frame_count(self) -> int:
        """Number of frames after thinning."""
        return len(self.times)

    @property
    def whole_count(self) -> int:
        """Number of particles, those on walls included."""
        return self.particle_count + self.walls.count

    @property
    def particles(self) -> Particles:
        """Which particles are taken: all, or ascending indices."""
        if self.particle_count == self.source.particle_count:
            return ALL
        return chosen_particles(self.source.body, self.particle_count, self.source.number)

    @property
    def spacing(self) -> float | None:
        """Distance between neighbours at the start, m: the largest of all bodies; None where it is not known.

        Thinned particles are further apart, as those of a coarser lattice.
        """
        header = self.source.header
        if header.spacing is None or not header.bodies:
            return None
        fewest = min(body.particles_per_cell for body in header.bodies)
        share = self.particle_count / max(self.source.particle_count, 1)
        return header.spacing / (fewest * share) ** (1 / header.dimension)

    @cached_property
    def layout(self) -> FrameLayout:
        """Names, types and shapes of the arrays of a frame."""
        return self.source.layout()

    def label(self, name: str) -> np.ndarray:
        """Read "body" or "material" of the particles, (N,) int32."""
        return self.source.read(name, particles=self.particles)

    def read(self, name: str) -> np.ndarray:
        """Read "position", "velocity" or a field, (T, N, ...)."""
        return np.concatenate(list(self.blocks(name)))

    def blocks(self, name: str) -> Iterator[np.ndarray]:
        """Read the same as consecutive blocks of (t, N, ...), each from about 64 MB of the file or from one frame."""
        arrays = self.layout.arrays
        layout = arrays["Points" if name == "position" else name]
        row = np.dtype(layout.dtype).itemsize * int(np.prod(layout.shape)) * max(self.source.particle_count, 1)
        step, particles = self._stride, self.particles
        reach = max(1, BLOCK_BYTES // row) * step
        for first in range(0, self.source.frame_count, reach):
            yield self.source.read(name, slice(first, first + reach, step), particles)

    def whole_blocks(self) -> Iterator[np.ndarray]:
        """Read the positions of all particles, then of those on walls, as blocks of (t, N + W, d)."""
        first = 0
        for block in self.blocks("position"):
            walls = self.walls.positions(self.times[first : first + len(block)])
            yield np.concatenate([block, walls.astype(block.dtype)], axis=1)
            first += len(block)

    def ledger(self) -> list[LedgerRow]:
        """Return a row for each frame: what is counted since the frame before is that of all frames between them."""
        rows = self.source.ledger
        found = []
        for k in range(0, len(rows), self._stride):
            first = max(k - self._stride + 1, 0)
            found.append(joined_row(rows[first : k + 1], rows[max(first - 1, 0)].time))
        return found


def joined_row(rows: Sequence[LedgerRow], before: float) -> LedgerRow:
    """Return the row of the last of consecutive frames, as if those before it had not been stored.

    Args:
        before: time of the frame before the first, s.
    """
    if len(rows) == 1:
        return rows[0]
    spans = np.diff([before, *(row.time for row in rows)])

    def mean(vectors: Sequence[tuple[tuple[float, ...], ...]]) -> tuple[tuple[float, ...], ...]:
        return tuple(map(tuple, np.average(np.array(vectors), axis=0, weights=spans).tolist()))

    smallest = min(rows, key=lambda row: row.step_min)
    return replace(
        rows[-1],
        steps=sum(row.steps for row in rows),
        step_min=smallest.step_min,
        step_max=max(row.step_max for row in rows),
        limit=smallest.limit,
        courant_max=max(row.courant_max for row in rows),
        collider_force=mean([row.collider_force for row in rows]),
        collider_torque=mean([row.collider_torque for row in rows]),
    )


def chosen_particles(body: np.ndarray, most: int, number: int) -> np.ndarray:
    """Choose particles at random, of each body its share; the same arguments always give the same ones.

    Args:
        body: (N,) labels.
        most: how many, 1 to N.
        number: of the trajectory; others draw other particles.

    Returns:
        (most,) int64, ascending.
    """
    # In order of random keys, the k-th of n particles of a body stands at (k + 1/2) / n of the way. The first ones of
    # all bodies by that place are as many of each as its share, to less than one.
    keys = np.random.default_rng([SEED, number]).random(len(body))
    order = np.lexsort((keys, body))
    counts = np.unique(body, return_counts=True)[1]
    sizes = np.repeat(counts, counts)
    rank = np.arange(len(body)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = (rank + 0.5) / sizes
    return np.sort(order[np.argsort(place, kind="stable")[:most]])
