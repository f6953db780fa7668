"""The particles of one law of one run of a batch."""

from collections.abc import Iterable

import numpy as np

from mpmcli.materials.law import Law
from mpmcli.solver.batch import Batch


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
