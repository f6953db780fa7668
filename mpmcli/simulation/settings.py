"""Settings of a run that are not part of its scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mpmcli.simulation.limits import Limits
from mpmcli.solver.machine.backend import Arch


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that are not part of its scene.

    Of `threads`, None is one for few particles and otherwise all. `checkpoint_every` is in s, None for as often as
    costs less than 1 %. `force` runs although the check finds errors, and takes time.step above the stable step;
    `compile_cache` keeps compiled kernels for the next start; `command` is the command line, for the record.
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
