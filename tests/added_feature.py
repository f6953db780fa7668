"""A feature of the solver in one file, as docs/architecture.md says: nodes slow down, the more the longer it lasts."""

import numpy as np

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene


@ti.func
def slow(at: ti.template(), node: ti.template(), kick: float):
    """Slow a node: v <- v / (1 + c s kick), with the time s that the drag has lasted, s."""
    (drag,) = ti.static((at.features.drag,))
    index, rate = at.grid.linear_index(node), drag.rate[at.w] * drag.spent[at.w]
    for a in ti.static(range(at.grid.dimension)):
        at.grid.nodes[index][a] = at.grid.nodes[index][a] / (1.0 + rate * kick)


@ti.data_oriented
class Drag(Feature):
    """A drag c s per time, 1/s: c is the last word of the title of a scene, 1/s^2, and s the time of all its steps.

    Attributes:
        rate, spent: c and s of each run.
    """

    begins, noted = True, 1

    def __init__(self, runs: int) -> None:
        self.rate, self.spent = (ti.field(float, shape=runs) for _ in range(2))
        self._rows = Rows(self.rate, self.spent)

    def write(self, scene: Scene, run: int = 0) -> None:
        self._rows.write(run, [float(scene.title.split()[-1])], [0.0])

    def saved(self) -> dict[str, ti.Field]:
        return {"drag.spent": self.spent}

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        return (Phase("drag", "nodes", "update", body=slow, words="slow nodes"),)

    @ti.func
    def begin_step(self, _phases: ti.template(), run: ti.template(), step: ti.template()):
        self.spent[run.w] += step.kick

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        frame_stats[run, frame, column] = ti.cast(self.spent[run], ti.f64)

    def read(self, run: int) -> np.ndarray:
        return self.spent.to_numpy()[run : run + 1].astype(float)

    def tell(self, values: np.ndarray, _run: int, found: dict[str, np.ndarray]) -> None:
        # A column of the ledger that this scene has no other use for; a new one is a line of `LedgerRow`.
        found["contact_overlap"] = values[:, 0]
