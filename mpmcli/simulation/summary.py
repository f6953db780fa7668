"""Summary of a run: status, counts, first and last ledger rows, and timings."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mpmcli.check.finding import merged
from mpmcli.check.result_check import ResultCheck
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.solver.engine.plan import Plan

# J of a liquid above which it has come apart.
APART = 1.1


@dataclass
class RunSummary:
    """Summary of a run.

    Attributes:
        directory: the output directory; path: the file to open, None if no frame was written.
        status: "finished", "unstable", "interrupted" by a signal, "stopped" at a limit or for lack of space, "failed".
        message: reason of an early end, else "".
        time: simulated so far, s. frames, steps, particles: counts; frames_expected: frames of the whole run;
            steps_before: steps of earlier processes of a resumed run.
        backend: "arch", "threads" and "precision"; plan: memory and passes.
        notes: automatic choices, and warnings of the check. outlook: the forecast of the check, one line; compiling:
            its seconds of compilation, None if unknown.
        timings: seconds by name: start_s (load and allocate), compile_s (first step, compilation
            included), solve_s (all further steps), watch_s (of these, measuring the state for the limits), output_s
            (frames and packing), wall_s.
        first, last: ledger rows of the first and the last frame.
        check: that of the files of a finished run, None if there is none.
    """

    directory: Path
    particles: int
    frames_expected: int
    backend: dict
    notes: tuple[str, ...]
    plan: Plan
    status: str = "running"
    message: str = ""
    path: Path | None = None
    outlook: str = ""
    compiling: float | None = None
    time: float = 0.0
    frames: int = 0
    steps: int = 0
    steps_before: int = 0
    timings: dict[str, float] = field(default_factory=dict)
    first: LedgerRow | None = None
    last: LedgerRow | None = None
    check: ResultCheck | None = None

    @property
    def rate(self) -> float:
        """Particle-steps per second, compilation and output not counted."""
        seconds = self.timings.get("solve_s", 0.0)
        return self.particles * max(self.steps - self.steps_before - 1, 0) / seconds if seconds > 0 else 0.0

    def as_dict(self) -> dict:
        """Return it for JSON."""
        return {
            "status": self.status,
            "message": self.message,
            "path": None if self.path is None else str(self.path),
            "directory": str(self.directory),
            **{name: getattr(self, name) for name in ("frames", "steps", "particles")},
            "particle_steps_per_s": self.rate,
            "backend": self.backend,
            "bytes_per_particle": self.plan.bytes_per_particle,
            "plan": self.plan.as_dict(),
            "timings": self.timings,
            "energy": None
            if self.first is None or self.last is None
            else {"first": self.first.energy, "last": self.last.energy},
            "notes": list(self.notes),
            "check": None if self.check is None else self.check.as_dict(),
        }

    def text(self) -> str:
        """Return it as text: status, timings, energy, volume and the file to open."""
        times = self.timings
        rate = f", {self.rate / 1e6:.1f} M particle-steps/s" if self.rate else ""
        lines = [
            f"{self.status}: {self.frames} of {self.frames_expected} frames, {self.steps} steps in "
            f"{times['wall_s']:.1f} s{rate}",
            f"seconds: start {times['start_s']:.1f}, compile {times['compile_s']:.1f}, "
            f"solve {times['solve_s']:.1f}, output {times['output_s']:.1f}",
        ]
        if self.first is not None and self.last is not None and self.frames > 1:
            first, last = self.first, self.last
            lines.append(
                f"energy: {first.energy:.5g} -> {last.energy:.5g} J (kinetic {last.kinetic:.4g}, elastic "
                f"{last.elastic:.4g}, potential {last.potential + 0.0:.4g})"
            )
            wide = last.volume_ratio_max > APART and all(laws()[one.law].deformation == "J" for one in self.plan.laws)
            apart = ", above 1 where liquid has come apart, as in spray" if wide else ""
            lines.append(
                f"volume ratio J at the end: {last.volume_ratio_min:.4g} to {last.volume_ratio_max:.4g}{apart}"
            )
        if self.last is not None and self.last.blocked:
            lines.append(f"blocked: {self.last.blocked} particles of emitters found their place occupied")
        if self.path is not None:
            lines.append(f"result: {self.path}")
        if self.check is not None:
            told = [one.line for one in merged(self.check.findings) if one.severity != "note"]
            lines += [f"check: {self.check.verdict}", *told]
        return "\n".join(lines)


class Stopwatch:
    """Adds the wall time of parts of a run to the `timings` of a `RunSummary`, in place, since `began`."""

    def __init__(self, timings: dict[str, float], began: float) -> None:
        self._timings = timings
        self._began = self._since = began
        self._key = "start_s"
        self._booked: dict[str, float] = {}
        timings.update(start_s=0.0, compile_s=0.0, solve_s=0.0, output_s=0.0, wall_s=0.0)
        self._add_time("")

    @contextmanager
    def adding(self, key: str) -> Iterator[None]:
        """Add the time of a with block to an entry, without nested blocks, which count for their own entries."""
        outer = self._key
        self._add_time(key)
        try:
            yield
        finally:
            self._add_time(outer)

    def _add_time(self, following: str) -> None:
        """Add the time since the last call to the current entry, if there is one; another follows."""
        now = time.perf_counter()
        if self._key:
            self._timings[self._key] += now - self._since
        self._timings["wall_s"] = now - self._began
        self._key, self._since = following, now

    def book(self, total: float, key: str) -> None:
        """Move seconds that the solver has spent on another task from solve_s to that task's entry."""
        seconds = total - self._booked.get(key, 0.0)
        self._booked[key] = total
        self._timings["solve_s"] -= seconds
        self._timings[key] += seconds
