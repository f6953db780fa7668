"""A trajectory as exported: every K-th frame, at most M particles, and particles on walls."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from mpmcli.dataset.dataset import ALL, Particles, Trajectory
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.frames.ledger import LOADS, Ledger, LedgerRow
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import FrameLayout
from mpmcli.scene.colliders import Collider, Motion
from mpmcli.scene.primitives import Box
from mpmcli.scene.rigid import Path
from mpmcli.scene.surface import collider_surface, form_surface, surface_points

# Walls with particles: none, colliders, or colliders and the domain.
WallChoice = Literal["none", "colliders", "all"]
# Kinds of wall of a particle: at rest, with prescribed motion, or moving freely.
KINDS = ("wall", "moving_wall", "rigid_body")
# Number of the walls of the domain, in place of that of a collider.
DOMAIN = -1
# Distance in spacings up to which a point is on a surface.
ON_SURFACE = 0.01
# Seed of the random choice of particles, together with the number of the trajectory.
SEED = 0
BLOCK_BYTES = 64 * 2**20


@dataclass(frozen=True, eq=False)
class WallParticles:
    """Particles on some of the walls of a run; neighbours are `spacing` apart, m."""

    header: RunHeader
    colliders: tuple[Collider, ...]
    walls: WallChoice
    spacing: float

    @cached_property
    def _parts(self) -> list[tuple[int, np.ndarray, Motion | Path | None]]:
        """Number, initial points (n, d) and motion of each wall; the motion is None for a wall at rest."""
        found: list[tuple[int, np.ndarray, Motion | Path | None]] = []
        header = self.header
        if self.walls == "none" or header.origin is None:
            return found
        names = header.collider_names
        for collider in self.colliders:
            motion = collider.motion
            points = surface_points(collider_surface(collider, header.origin, header.upper), self.spacing)
            points = points if motion.moves else motion.placed(points, 0.0)
            found.append((names.index(collider.name), points, motion if motion.moves else None))
        if self.walls == "all":
            box = form_surface(Box.model_construct(min=tuple(header.origin), max=tuple(header.upper)))
            points = surface_points(box, self.spacing)
            # Periodic faces are not walls.
            on_face = np.isclose(points, header.origin) | np.isclose(points, header.upper)
            found.append((DOMAIN, points[(on_face & ~header.periodic).any(axis=1)], None))
        return [
            (number, self._seen(number, points) if motion is None else points, motion)
            for number, points, motion in found
        ]

    def _seen(self, number: int, points: np.ndarray) -> np.ndarray:
        """Remove points (n, d) of a wall at rest that lie inside another collider at rest."""
        seen = np.ones(len(points), bool)
        for other in self.colliders:
            if not other.motion.moves and self.header.collider_names.index(other.name) != number:
                seen &= other.signed_distance(points) >= -ON_SURFACE * self.spacing
        return points[seen]

    @cached_property
    def _sizes(self) -> np.ndarray:
        return np.array([len(points) for _, points, _ in self._parts], int)

    @property
    def count(self) -> int:
        """Number of particles."""
        return int(self._sizes.sum())

    @property
    def numbers(self) -> np.ndarray:
        """Number in the scene of the collider of each particle, (W,) int32; -1 for the domain."""
        return np.repeat(np.array([number for number, _, _ in self._parts], np.int32), self._sizes)

    @property
    def kinds(self) -> np.ndarray:
        """Kind of wall of each particle, an index into KINDS, (W,) int."""
        kinds = [0 if motion is None else 2 if isinstance(motion, Path) else 1 for _, _, motion in self._parts]
        return np.repeat(np.array(kinds, int), self._sizes)

    def positions(self, times: Sequence[float]) -> np.ndarray:
        """Return the positions at some times, s: (T, W, d) float64, m."""
        found = np.empty((len(times), self.count, self.header.dimension))
        first = 0
        for _, points, motion in self._parts:
            for k, time in enumerate(times):
                found[k, first : first + len(points)] = points if motion is None else motion.placed(points, time)
            first += len(points)
        return found


class SubsampledTrajectory:
    """Every `stride`-th frame, and at most `most` particles, of a `source`, not counting those on `walls`.

    The particles are chosen at random, in proportion for each body, and are the same in all frames and exports. The
    ledger is of all particles.
    """

    def __init__(
        self,
        source: Trajectory,
        stride: int = 1,
        most: int | None = None,
        walls: WallChoice = "none",
        wall_spacing: float | None = None,
        *,
        always: bool = False,
    ) -> None:
        """Thin a trajectory. `wall_spacing` is that of the particles at the start if None.

        With `always` only those particles are taken that are active in all its frames; else nothing is read.
        """
        self.source, self.always = source, always
        self._there = _always_there(source, stride) if always and STATUS in source.field_names else None
        self.stride, self._most = stride, most
        self.times, self.steps, self.frames = (table[::stride] for table in (source.times, source.steps, source.frames))
        self.there_count = source.particle_count if self._there is None else len(self._there)
        self.particle_count = self.there_count if most is None else min(self.there_count, most)
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
        there = np.arange(self.source.particle_count) if self._there is None else self._there
        return there[chosen_particles(self.source.body[there], self.particle_count, self.source.number)]

    @property
    def spacing(self) -> float | None:
        """Largest initial distance of neighbours, m, as of a coarser lattice if thinned; None: unknown."""
        header = self.source.header
        if header.spacing is None or self.particle_count == 0 or not header.bodies:
            return None
        fewest = min(body.particles_per_cell for body in header.bodies)
        share = self.particle_count / max(self.there_count, 1)
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
        step, particles = self.stride, self.particles
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

    def ledger(self) -> Ledger:
        """Return a row for each frame; counts since the previous frame include the omitted frames between them."""
        rows = self.source.ledger
        found = Ledger()
        for k in range(0, len(rows), self.stride):
            first = max(k - self.stride + 1, 0)
            found.append(joined_row(rows[first : k + 1], rows[max(first - 1, 0)].time))
        return found


def _always_there(source: Trajectory, stride: int) -> np.ndarray:
    """Return the ascending indices of the particles that are active in every `stride`-th frame."""
    there = np.ones(source.particle_count, bool)
    block = max(1, BLOCK_BYTES // max(source.particle_count, 1)) * stride
    for first in range(0, source.frame_count, block):
        there &= (source.read(STATUS, slice(first, first + block, stride)) == ACTIVE).all(axis=0)
    return np.flatnonzero(there)


def joined_row(rows: Sequence[LedgerRow], before: float) -> LedgerRow:
    """Return the row of the last of consecutive frames, as if the others had not been stored; `before` in s."""
    if len(rows) == 1:
        return rows[0]
    spans = np.diff([before, *(row.time for row in rows)])

    def mean(vectors: Sequence[tuple[tuple[float, ...], ...]]) -> tuple[tuple[float, ...], ...]:
        return tuple(map(tuple, np.average(np.array(vectors), axis=0, weights=spans).tolist()))

    smallest, works = min(rows, key=lambda row: row.step_min), ("collider_work", "contact_work")
    return replace(
        rows[-1],
        steps=sum(row.steps for row in rows),
        step_min=smallest.step_min,
        step_max=max(row.step_max for row in rows),
        limit=smallest.limit,
        courant_max=max(row.courant_max for row in rows),
        contact_overlap=max(row.contact_overlap for row in rows) if rows[0].contact_overlap is not None else None,
        **{name: sum(getattr(row, name) for row in rows) for name in works if getattr(rows[0], name) is not None},
        **{name: mean([getattr(row, name) for row in rows]) for name in LOADS},
    )


def chosen_particles(body: np.ndarray, most: int, number: int) -> np.ndarray:
    """Choose `most` of N labels at random, in proportion for each body: ascending indices, (most,); deterministic."""
    # Labels at equal distances in the order of the bodies, random within each: every body, and every run of consecutive
    # bodies, gets its share to less than one.
    keys = np.random.default_rng([SEED, number]).random(len(body))
    order = np.lexsort((keys, body))
    return np.sort(order[((np.arange(most) + 0.5) * len(body) / most).astype(int)])
