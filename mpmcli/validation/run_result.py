"""The result of one run of a case."""

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

Status = Literal["finished", "unstable", "failed"]


@dataclass(frozen=True)
class RunResult:
    """Outcome, measures and cost of a run.

    Attributes:
        status: "finished", "unstable" (stopped by the solver) or "failed" (any other error).
        message: the reason, in one sentence; "" if the run finished.
        values: the measures of the case by name; empty if the run did not finish.
        particles, steps: counts.
        seconds: processor time of the time steps, s. Excluded are the first step, which compiles the kernels, and the
            construction of frames.
        watch_seconds: part of `seconds` spent on measuring the state for the step limits, s.
        compile_seconds: duration of the first step, s.
        frame_seconds: time for building frames and ledger rows, s.
        start_seconds: time for reading the scene, sampling and allocation, s.
        wall_seconds: wall-clock time of the process, s.
        arch, precision, threads: backend of the run.
    """

    status: Status
    message: str = ""
    values: dict[str, float] = field(default_factory=dict)
    particles: int = 0
    steps: int = 0
    seconds: float = 0.0
    watch_seconds: float = 0.0
    compile_seconds: float = 0.0
    frame_seconds: float = 0.0
    start_seconds: float = 0.0
    wall_seconds: float = 0.0
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
        """Return the result from the dictionary of `as_dict`.

        Raises:
            TypeError, KeyError: `data` does not have the fields of a result.
        """
        return cls(**{entry.name: data[entry.name] for entry in fields(cls)})


def failure(message: str, status: Status = "failed", **facts: Any) -> RunResult:
    """Return the result of a run without values."""
    return RunResult(status, message, **facts)


def not_finite(values: dict[str, float]) -> str:
    """Return a message that lists the non-finite measures; "" if all are finite."""
    odd = [f"{name} is {value}" for name, value in values.items() if not math.isfinite(value)]
    return f"The run finished, but {' and '.join(odd)}." if odd else ""
