"""A feature of the runs of a batch: what the engine asks of walls, colliders, contact and the like."""

from collections.abc import MutableMapping

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene


class Feature:
    """A feature of the runs of a batch on the device; a scene without it has none.

    Attributes:
        noted: number of values of a run in a frame, see `note`, `read` and `name`.
    """

    noted = 0

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the constants of a run, and its state at time 0."""

    def saved(self) -> dict[str, ti.Field]:
        """Return the fields that persist between steps, by name."""
        return {}

    def fastest(self, _run: int) -> float:
        """Return the largest speed that the feature gives to anything in a run, m/s."""
        return 0.0

    def broken(self, _run: int) -> int | None:
        """Return the index of the first collider of a run whose pose is not finite, or None."""
        return None

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the values of a run in frame_stats[run, frame], from a column on, and reset them; on the CPU."""

    def read(self, _run: int) -> np.ndarray:
        """Return the values of a run, (noted,), and reset them; on a GPU."""
        return np.zeros(0)

    def name(self, values: np.ndarray, run: int, found: MutableMapping[str, np.ndarray]) -> None:
        """Add the values of some frames of a run, (frames, noted), to those found, see `Moment.loads`."""
