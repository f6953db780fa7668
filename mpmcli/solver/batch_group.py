"""The particles of one law of one run of a batch."""

from collections.abc import Iterable, Sequence

import numpy as np

from mpmcli.materials.law import Law
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.batch import Batch
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.particles import initial_states, table_of
from mpmcli.solver.plan import members_of
from mpmcli.solver.state_bounds import floor_of


class BatchGroup:
    """The particles of one law of one run; attributes as of `ParticleGroup`, and its first particle and table row."""

    def __init__(
        self, batch: Batch, g: int, slot: int, law: Law, bodies: list[int], rows: np.ndarray, count: int, active: int
    ):
        self.law, self.bodies, self.count = law, tuple(bodies), count
        self.arrays = batch.device.groups[g]
        self.total = self.arrays.total
        self.dimension, self.real, self.internal = self.arrays.dimension, self.arrays.real, self.arrays.internal
        self.rows = rows.astype(self.real)
        self.first = slot * batch.kind.particles[g]
        self.row = slot * batch.kind.bodies[g]
        self.floor: np.ndarray | None = None
        self._counts, self._column = batch.counts[slot], batch.layout.count.particles[g]
        self._counts[self._column], self._counts[batch.layout.count.capacity[g]] = active, count

    @property
    def active(self) -> int:
        """Particles that take part, which come first."""
        return int(self._counts[self._column])

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), in the solver's order."""
        return self.arrays.read(self.first, self.count, self.bodies, self.row)

    def write(self, states: Iterable[tuple[int, dict[str, np.ndarray], np.ndarray]]) -> None:
        """Fill the device with particles, see `initial_states`."""
        for first, found, row in states:
            self.arrays.write(self.first + first, found, self.row + row)
        for i, row in enumerate(self.rows):
            self.arrays.table[self.row + i] = row.tolist()


def groups_of(batch: Batch, slot: int, scene: Scene, particles: Sequence[BodyParticles]) -> list[BatchGroup]:
    """Put the particles of a run, one entry per source, on the device; return its groups, one for each law."""
    first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in particles])])
    lost, groups = batch.device.particles.lost, []
    for g, shared in enumerate(batch.kind.members):
        bodies = members_of(scene, shared.name)
        own = [particles[i] for i in bodies]
        law = type(shared)([scene.sources[i].material for i in bodies], scene.dimension)
        count = sum(len(b.position) for b in own)
        active = sum(len(b.position) for b in own if not b.waits)
        group = BatchGroup(batch, g, slot, law, bodies, table_of(law, own), count, active)
        group.floor = floor_of(scene, law, bodies)
        group.write(initial_states(law, own, [int(first_ids[i]) for i in bodies], np.array(scene.domain.origin)))
        groups.append(group)
        if lost[slot * len(batch.kind.members) + g] != NOT_LOST:
            lost[slot * len(batch.kind.members) + g] = NOT_LOST
    return groups
