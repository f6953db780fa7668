"""What came of one run of a case."""

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

Status = Literal["finished", "unstable", "failed"]


@dataclass(frozen=True)
class RunResult:
    """How a run ended, what it measured and what that cost.

    Attributes:
        status: "finished", "unstable" (the solver stopped it) or "failed" (anything else); message: why, in a sentence.
        values: every measure of the case, by its name; empty where the run did not finish.
        particles, steps: counts.
        seconds: processor time of stepping, without the first step, which compiles, and without building frames: on
            one thread the time that it takes where nothing else runs.
        watch_seconds: of measuring the state for the limits, a part of stepping.
        compile_seconds: the first step; frame_seconds: building frames and ledger rows.
        start_seconds: reading the scene, sampling and allocating; wall_seconds: of the whole process.
        arch, precision, threads: what it ran on.
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
        """Whether there are values."""
        return self.status == "finished"

    @property
    def particle_steps(self) -> int:
        """Particles times steps."""
        return self.particles * self.steps

    @property
    def rate(self) -> float:
        """Particle-steps per second of stepping; 0 where nothing was timed."""
        return self.particles * max(self.steps - 1, 0) / self.seconds if self.seconds > 0 else 0.0

    def error(self, measure: str) -> float | None:
        """Return the size of a measure, None where the run did not finish."""
        return abs(self.values[measure]) if self.finished else None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON can hold it."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "RunResult":
        """Make one of what `as_dict` returned.

        Raises:
            TypeError, KeyError: it is not that.
        """
        return cls(**{entry.name: data[entry.name] for entry in fields(cls)})


def failure(message: str, status: Status = "failed", **facts: Any) -> RunResult:
    """Return the result of a run that has no values."""
    return RunResult(status, message, **facts)


def not_finite(values: dict[str, float]) -> str:
    """Return a sentence about the measures that are no finite numbers, "" where all are."""
    odd = [f"{name} is {value}" for name, value in values.items() if not math.isfinite(value)]
    return f"The run came to its end, but {' and '.join(odd)}." if odd else ""
