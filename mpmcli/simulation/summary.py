"""How a run went: its status, counts, timings and first and last ledger rows."""

from dataclasses import dataclass, field
from pathlib import Path

from mpmcli.frames.ledger import LedgerRow
from mpmcli.solver.machine.plan import Plan


@dataclass
class RunSummary:
    """How a run went.

    Attributes:
        directory: where the result is; path: the file to open, None where no frame was written.
        status: "finished", "unstable", "interrupted" by a signal, "stopped" at a limit or for want of room, "failed".
        message: why it ended early, "" where it did not.
        time: simulated so far, s. frames, steps, particles: counts; frames_expected: of the whole run; steps_before:
            those of earlier processes, where the run was resumed.
        backend: "arch", "threads" and "precision"; plan: memory and passes.
        notes: what was chosen for the user, and warnings of the check.
        outlook: the forecast of the check, a line; compiling: seconds of it to compile, None where not known.
        timings: seconds by name: start_s (load and allocate), compile_s (first step, compilation
            included), solve_s (all further steps), watch_s (of these, measuring the state for the limits), output_s
            (frames and packing), wall_s.
        first, last: ledger rows of the first and the last frame.
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

    @property
    def rate(self) -> float:
        """Particle-steps per second, compilation and output not counted."""
        seconds = self.timings.get("solve_s", 0.0)
        return self.particles * max(self.steps - self.steps_before - 1, 0) / seconds if seconds > 0 else 0.0

    def as_dict(self) -> dict:
        """Return all of it as JSON can hold it."""
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
        }

    def text(self) -> str:
        """Return it as text for people: the status, where the time went, energy, volume and the file to open."""
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
            lines.append(f"volume ratio J at the end: {last.volume_ratio_min:.4g} to {last.volume_ratio_max:.4g}")
        if self.last is not None and self.last.blocked:
            lines.append(f"blocked: {self.last.blocked} particles of emitters found their place occupied")
        if self.path is not None:
            lines.append(f"result: {self.path}")
        return "\n".join(lines)
