"""One snapshot of all particles, in their original order."""

from dataclasses import dataclass, field, replace

import numpy as np

STATUS = "status"


@dataclass(frozen=True)
class Frame:
    """State of all n particles at one output time; row i is always particle i, but where others are dropped.

    Attributes:
        index: number of the frame, 0 for the initial state.
        time: s.
        step: number of time steps taken so far.
        position: (n, d) float32 or float64, m, in the coordinates of the scene.
        velocity: (n, d), m/s.
        body: (n,) int32, index into the scene's bodies.
        material: (n,) int32, index into the run's list of laws.
        fields: further arrays of the scene's `output.fields`, (n,) or (n, k), by name; and where particles come and
            go `STATUS`, (n,) int8: 0 waiting, 1 there, 2 gone, 3 kept out.
        id: (n,), number of each particle where only some are in the frame; None where row i is particle i.
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
        """Which particles are there, neither waiting nor gone, (n,) bool; None where all always are."""
        return self.fields[STATUS] == 1 if STATUS in self.fields else None

    @property
    def of_present(self) -> "Frame":
        """The frame of those that are there alone."""
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
