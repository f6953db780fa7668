"""A process that compiles a kernel whose functions call each other in a row, and prints what it computed.

    python cached_kernel.py

Stage k raises all values by k + 1. The kernel does all stages, adds a value to the total, and does both again.
"""

import taichi as ti

from mpmcli.solver.machine.backend import start_backend

STAGES, TIMES, COUNT = 5, 3, 4
# Values are 15, 30 and 45 in turn.
TOTAL = 90


@ti.data_oriented
class Stages:
    """Values, and their total."""

    def __init__(self) -> None:
        self.values = ti.field(int, shape=COUNT)
        self.total = ti.field(int, shape=())

    @ti.func
    def raise_all(self, by: ti.template()):
        """Raise all values."""
        for i in range(COUNT):
            self.values[i] += by

    @ti.real_func
    def do(self, k: ti.template(), last: int):
        """Do stage k and the later ones up to the last."""
        if k <= last:
            self.raise_all(k + 1)
        if ti.static(k + 1 < STAGES):
            self.do(ti.static(k + 1), last)

    @ti.kernel
    def run(self, last: int):
        """Do all stages up to the last, TIMES times."""
        ti.loop_config(serialize=True)
        for _ in range(TIMES):
            self.do(0, last)
            self.total[None] += self.values[0]


if __name__ == "__main__":
    start_backend("cpu", 1)
    stages = Stages()
    stages.run(STAGES - 1)
    print(stages.total[None])
