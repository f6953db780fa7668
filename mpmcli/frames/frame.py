"""One snapshot of all particles, in their original order."""

from dataclasses import dataclass, field, replace

import numpy as np

STATUS = "status"
# Status of a particle: waiting for its emitter, active, retired beyond an open face, or permanently blocked.
WAITING, ACTIVE, RETIRED, BLOCKED = range(4)


@dataclass(frozen=True)
class Frame:
    """State of all n particles at one output time; row i is particle i unless absent particles are dropped.

    Attributes:
        index: number of the frame, 0 for the initial state.
        time: s.
        step: number of time steps taken so far.
        position: (n, d) float32 or float64, m, in the coordinates of the scene.
        velocity: (n, d), m/s.
        body: (n,) int32, index into the scene's bodies.
        material: (n,) int32, index into the run's list of laws.
        fields: further arrays of the scene's `output.fields`, (n,) or (n, k), by name; and if particles come and go,
            `STATUS`, (n,) int8: WAITING, ACTIVE, RETIRED or BLOCKED.
        id: (n,), number of each particle if only some are in the frame; None if row i is particle i.
    """

    index: int
    time: float
    step: int
    position: np.ndarray
    velocity: np.ndarray
    body: np.ndarray
    material: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    id: np.ndarray | None = None

    @property
    def present(self) -> np.ndarray | None:
        """Whether each particle is present, neither waiting nor gone, (n,) bool; None if all always are."""
        return self.fields[STATUS] == ACTIVE if STATUS in self.fields else None

    @property
    def of_present(self) -> "Frame":
        """Return the frame of the particles present."""
        rows = self.present
        if rows is None:
            return self
        return replace(
            self,
            position=self.position[rows],
            velocity=self.velocity[rows],
            body=self.body[rows],
            material=self.material[rows],
            fields={name: array[rows] for name, array in self.fields.items()},
            id=np.flatnonzero(rows) if self.id is None else self.id[rows],
        )
