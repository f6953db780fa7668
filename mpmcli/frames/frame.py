"""One snapshot of all particles, in their original order."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Frame:
    """State of all n particles at one output time; row i is always particle i.

    Attributes:
        index: number of the frame, 0 for the initial state.
        time: s.
        step: number of time steps taken so far.
        position: (n, d) float32 or float64, m, in the coordinates of the scene.
        velocity: (n, d), m/s.
        body: (n,) int32, index into the scene's bodies.
        material: (n,) int32, index into the run's list of laws.
        fields: further arrays of the scene's `output.fields`, (n,) or (n, k), by name.
    """

    index: int
    time: float
    step: int
    position: np.ndarray
    velocity: np.ndarray
    body: np.ndarray
    material: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)
