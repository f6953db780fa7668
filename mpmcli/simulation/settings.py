"""Settings of a run that are not part of its scene, and the conditions that end it early."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import psutil

from mpmcli.errors import InputError
from mpmcli.plain_text import size_text
from mpmcli.solver.engine.plan import Plan
from mpmcli.solver.machine.backend import Arch

# Time reserved for the last records and the end of the process, s; and time reserved for the next check, as a multiple
# of the longest interval between two checks.
RESERVE, PAUSES = 2.0, 1.5
# Packing reads, writes and compares the data once each; bytes/s of compression.
PACKING, COMPRESSION = 3.0, 30e6
# Wall time that packing may take after a signal, s.
PACKING_LEFT = 1.5
# Time between two measurements of the memory, s.
MEMORY_LOOKS = 0.1


@dataclass(frozen=True)
class Limits:
    """Limits of one run, None for no limit: wall time of the process, s, and its resident memory, bytes."""

    max_time: float | None = None
    max_memory: int | None = None

    def require_memory(self, plan: Plan) -> None:
        """Raise an InputError if a plan, in addition to the memory in use, exceeds the limit."""
        if self.max_memory is None:
            return
        need = resident_bytes() + plan.machine_bytes
        if need > self.max_memory:
            raise InputError(
                f"the run needs {size_text(need)} of memory, and --max-memory is {size_text(self.max_memory)}: raise "
                "it, or take a larger domain.spacing or fewer particles_per_cell."
            )


class StopCondition:
    """Decides whether to end a run: "interrupted" by `signal`, or "stopped" at a limit; `message` has the reason."""

    def __init__(self, stop: Callable[[], bool | str], limits: Limits, *, compress: bool = False) -> None:
        """Begin; `stop` returns whether to interrupt the run, or the name of the requesting signal."""
        self._stop, self._limits, self._compress = stop, limits, compress
        self._end = None if limits.max_time is None else limits.max_time + _process_began()
        self._asked: float | None = None
        self._pause = 0.0
        self._looked = 0.0
        self._written, self._seconds = 0, 0.0
        self.status: Literal["", "interrupted", "stopped"] = ""
        self.message = self.signal = ""

    def wrote(self, size: int, seconds: float) -> None:
        """Record the bytes sealed so far, and the wall time spent on them, s."""
        self._written, self._seconds = size, seconds

    def __call__(self) -> bool:
        """Return whether to end the run: asked by a signal, or close to the limit of time or memory."""
        if self.status:
            return True
        now = time.monotonic()
        if self._asked is not None:
            self._pause = max(self._pause, now - self._asked)
        self._asked = now
        if self._ask_signal():
            return True
        packing = PACKING * self._seconds + (self._written / COMPRESSION if self._compress else 0.0)
        if self._end is not None and now + PAUSES * self._pause + packing > self._end - RESERVE:
            return self._stop_for(f"the run stopped before its --max-time of {_clock(self._limits.max_time)}")
        return self._limits.max_memory is not None and self._exceeds_memory(now)

    def packing(self) -> bool:
        """Return whether to end the packing of a result; its frames then stay as they are."""
        if self.status != "interrupted" and self._ask_signal():
            return True
        if self.status == "interrupted":
            return time.monotonic() > self._asked + PACKING_LEFT
        return self._end is not None and time.monotonic() > self._end - RESERVE

    def interrupted(self) -> None:
        """Record a KeyboardInterrupt that no signal announced, if there is no other reason."""
        if not self._ask_signal() and not self.status:
            self.status, self.message = "interrupted", "the run was interrupted"
            self._asked = time.monotonic()

    def _ask_signal(self) -> bool:
        if said := self._stop():
            self.signal = said if isinstance(said, str) else ""
            how = f" ({self.signal})" if self.signal else ""
            self.status, self.message = "interrupted", f"the run was interrupted{how}"
            self._asked = time.monotonic()
        return bool(said)

    def _exceeds_memory(self, now: float) -> bool:
        if now - self._looked < MEMORY_LOOKS:
            return False
        self._looked = now
        size = resident_bytes()
        if size <= self._limits.max_memory:
            return False
        return self._stop_for(
            f"the run takes {size_text(size)} of memory and stopped at its --max-memory of "
            f"{size_text(self._limits.max_memory)}"
        )

    def _stop_for(self, message: str) -> bool:
        self.status, self.message = "stopped", message
        return True


def resident_bytes() -> int:
    """Return the resident memory of this process, bytes."""
    return psutil.Process().memory_info().rss


def _process_began() -> float:
    """Return the start of this process in the time of `time.monotonic`, s."""
    age = time.time() - psutil.Process().create_time()
    # The clock may have been set since.
    return time.monotonic() - min(max(age, 0.0), 60.0)


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}" if whole >= 60 else f"{seconds:g} s"


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that are not part of its scene.

    `threads` None means one for few particles, else all. `checkpoint_every` is in s, None for the rate that costs less
    than 1 %. `force` runs despite errors of the check, and permits time.step above the stable step; `compile_cache`
    keeps compiled kernels for the next start; `command` is the command line for the record.
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

    def __post_init__(self) -> None:
        if self.resume and self.overwrite:
            raise InputError("--resume keeps an earlier result, and --overwrite removes it: give one of them.")
