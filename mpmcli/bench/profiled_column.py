"""The column of a law whose phases are timed."""

import os

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.materials import Column

# Before the name of a law, in the name of a contestant.
PROFILE = "profile:"


class ProfiledColumn(Column):
    """The column of a law, whose phases Taichi's profiler times."""

    def __init__(self, law: str, case: BenchCase, **options: int | str) -> None:
        # Taichi reads it when it starts.
        os.environ["TI_KERNEL_PROFILER"] = "1"
        super().__init__([law], case, **options)

    def phases(self) -> dict[str, float]:
        """Return the time in each phase since the last call, s."""
        from mpmcli.solver.phase_times import take_phase_times

        return take_phase_times(len(self.engine.groups))
