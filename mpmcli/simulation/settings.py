"""Settings of a run that are not part of its scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mpmcli.simulation.limits import Limits
from mpmcli.solver.backend import Arch


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that are not part of its scene.

    Attributes:
        directory: where the result goes.
        arch: backend to use; threads: CPU threads, where None one for few particles and otherwise all.
        form: "vtkhdf" for one packed file, "vtk" for a .vtu series.
        overwrite: whether an earlier result in the directory may be replaced.
        resume: whether to go on with the run in the directory, where there is one.
        checkpoint_every: s between two checkpoints; None for as often as costs less than 1 %.
        force: whether to run although the check finds errors, and to take time.step above the stable step too.
        compile_cache: whether compiled kernels are kept for the next start.
        limits: on time and memory.
        command: the command line, for the record.
    """

    directory: Path
    arch: Arch = "auto"
    threads: int | None = None
    form: Literal["vtkhdf", "vtk"] = "vtkhdf"
    overwrite: bool = False
    resume: bool = False
    checkpoint_every: float | None = None
    force: bool = False
    compile_cache: bool = True
    limits: Limits = field(default_factory=Limits)
    command: Sequence[str] = ()
