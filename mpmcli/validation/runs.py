"""The runs of a level, each case at its resolutions with the default setting and its variants, and their results."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from mpmcli.validation.case import DEFAULT, KNOBS, Case, Level, Setting

Status = Literal["finished", "unstable", "failed"]


@dataclass(frozen=True)
class Run:
    """One case at resolution n with one setting."""

    case: str
    n: int
    setting: Setting

    @property
    def name(self) -> str:
        """File name of the result, without suffix."""
        words = [f"{knob}-{value}" for knob, value in self.setting.changed_from(Setting()).items()]
        return "_".join([self.case, f"n{self.n}", *(words or [DEFAULT])])


def variants(knob: str) -> list[Setting]:
    """Return the settings that differ from the default one in one field."""
    usual = getattr(Setting(), knob)
    return [Setting(**{knob: value}) for value in KNOBS[knob] if value != usual]


def sweep_resolution(case: Case, level: Level) -> int:
    """Return the resolution at which the Courant fraction is varied, the (lower) median."""
    resolutions = sorted(case.levels[level])
    return resolutions[(len(resolutions) - 1) // 2]


def runs_of(case: Case, level: Level) -> list[Run]:
    """Return the runs of a case at a level, the default setting first, each setting from coarse to fine.

    The level "coarse" has the default setting, and f32 at the finest resolution. Other levels vary every field in
    `case.varies` at every resolution, except for the Courant fraction, which is varied at one resolution.
    """
    resolutions = sorted(case.levels[level])
    runs = [Run(case.name, n, Setting()) for n in resolutions]
    knobs = [knob for knob in KNOBS if knob in case.varies]
    if level == "coarse":
        only = [variant for knob in knobs if knob == "precision" for variant in variants(knob)]
        return runs + [Run(case.name, resolutions[-1], variant) for variant in only]
    for knob in knobs:
        at = [sweep_resolution(case, level)] if knob == "safety" else resolutions
        runs += [Run(case.name, n, variant) for variant in variants(knob) for n in at]
    return runs


def matrix(cases: Iterable[Case], level: Level) -> list[Run]:
    """Return the runs of several cases, case by case."""
    return [run for case in cases for run in runs_of(case, level)]


@dataclass(frozen=True)
class RunResult:
    """Outcome, measures and cost of a run; times are in s."""

    status: Status  # "unstable" if the solver stopped it, "failed" for any other error
    message: str = ""
    values: dict[str, float] = field(default_factory=dict)  # the measures by name; empty if the run did not finish
    particles: int = 0
    steps: int = 0
    # Processor time of the time steps, without the first one, which compiles the kernels, and without frames and rows.
    seconds: float = 0.0
    watch_seconds: float = 0.0  # part of `seconds` spent on measuring the state for the step limits
    compile_seconds: float = 0.0  # of the first step
    frame_seconds: float = 0.0  # for building frames and ledger rows
    start_seconds: float = 0.0  # for reading the scene, sampling and allocation
    wall_seconds: float = 0.0  # wall-clock time of the process
    arch: str = ""
    precision: str = ""
    threads: int = 0

    @property
    def finished(self) -> bool:
        """Whether the run finished; only then are there values."""
        return self.status == "finished"

    @property
    def particle_steps(self) -> int:
        """Particles times steps."""
        return self.particles * self.steps

    @property
    def rate(self) -> float:
        """Particle-steps per second, without the first step; 0 if nothing was timed."""
        return self.particles * max(self.steps - 1, 0) / self.seconds if self.seconds > 0 else 0.0

    def error(self, measure: str) -> float | None:
        """Return the absolute value of a measure; None if the run did not finish."""
        return abs(self.values[measure]) if self.finished else None

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "RunResult":
        """Return the result from the dictionary of `as_dict`; TypeError or KeyError where it is none."""
        return cls(**{entry.name: data[entry.name] for entry in fields(cls)})


Results = Mapping[Run, RunResult]


def failure(message: str, status: Status = "failed", **facts: Any) -> RunResult:
    """Return the result of a run without values."""
    return RunResult(status, message, **facts)


def not_finite(values: dict[str, float]) -> str:
    """Return a message that lists the non-finite measures; "" if all are finite."""
    odd = [f"{name} is {value}" for name, value in values.items() if not math.isfinite(value)]
    return f"The run finished, but {' and '.join(odd)}." if odd else ""
