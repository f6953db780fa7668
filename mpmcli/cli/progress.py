"""Progress of a long command on stderr: a bar on a terminal, else plain lines."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mpmcli.plain_text import counted

if TYPE_CHECKING:
    from mpmcli.frames.ledger import LedgerRow
    from mpmcli.simulation.summary import RunSummary
    from mpmcli.validation.case import Case
    from mpmcli.validation.runs import CaseRun, RunResult


class ProgressBar:
    """A progress bar of `total` units ("frames") with messages above it, as a context; `quiet` prints nothing.

    `pause` is the shortest time between plain lines, s; `steady` units show the time left, others the time elapsed.
    """

    def __init__(self, total: int, unit: str, *, quiet: bool, pause: float = 5.0, steady: bool = True) -> None:
        """Make the bar; `__enter__` shows it on a terminal."""
        self._total = total
        self._unit = unit
        self._quiet = quiet
        self._pause = pause
        self._console = Console(stderr=True)
        self._bar = Progress(
            BarColumn(),
            TextColumn(f"{{task.completed:.0f}}/{total} {unit}"),
            TimeRemainingColumn() if steady else TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._spoke = time.perf_counter()

    @property
    def drawn(self) -> bool:
        """Whether a bar is drawn; else `show` prints plain lines."""
        return self._task is not None

    def __enter__(self) -> Self:
        if not self._quiet and self._console.is_terminal and not self._console.is_dumb_terminal:
            self._task = self._bar.add_task("", total=self._total)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.drawn:
            self._bar.stop()

    def show(self, done: int, text: str = "", more: str = "") -> None:
        """Show the count and the current unit; `more` appears in plain lines only."""
        if self._task is not None:
            self._bar.update(self._task, completed=done, description=text)
        elif time.perf_counter() - self._spoke >= self._pause:
            self._spoke = time.perf_counter()
            said = text + more
            self.say(f"{done}/{self._total} {self._unit}" + (f": {said}" if said else ""))

    def say(self, line: str) -> None:
        """Print a line; on a terminal it is wrapped between words."""
        if self._quiet:
            return
        try:
            self._console.print(line, markup=False, highlight=False, soft_wrap=not self._console.is_terminal)
        except (OSError, SystemExit):
            # stderr is closed (rich exits on a broken pipe). The work continues.
            self._quiet = True


class SimulateProgress(ProgressBar):
    """Follows one run of `simulate`, whose simulated time is `end`, s, and which stores `frames` frames."""

    def __init__(self, end: float, frames: int, *, quiet: bool) -> None:
        super().__init__(frames, "frames", quiet=quiet)
        self._end = end

    def __enter__(self) -> Self:
        super().__enter__()
        if self.drawn:
            self.show(0, "compiling")
        return self

    def start(self, summary: "RunSummary") -> None:
        """Print automatic choices, warnings of the check, and the size of the run."""
        for note in summary.notes:
            self.say(note)
        backend, plan = summary.backend, summary.plan
        threads = f", {counted(backend['threads'], 'thread')}" if backend["arch"] == "cpu" else ""
        self.say(
            f"{counted(summary.particles, 'particle')} on {backend['arch']}{threads}, {backend['precision']}; "
            f"{plan.device_bytes / 1e6:.3g} MB on the device "
            f"({plan.bytes_per_particle} B per particle, {plan.bytes_per_node} B per node)"
        )
        if summary.outlook:
            self.say(summary.outlook)
        if self.drawn and summary.compiling:
            self.show(0, f"compiling, up to about {summary.compiling:.0f} s")

    def advance(self, row: "LedgerRow", summary: "RunSummary") -> None:
        """Show one more stored frame."""
        done = summary.steps - summary.steps_before
        if summary.frames < 2 or done < 1:
            return  # the kernels compile in the first step, or the frame is of an earlier process
        taken = summary.timings["solve_s"] + summary.timings["output_s"]
        steps_left = max(self._end - summary.time, 0.0) / row.step_max
        left = taken / done * steps_left
        self.show(
            summary.frames,
            f"t = {row.time:.4g} of {self._end:.4g} s, {summary.rate / 1e6:.1f} M particle-steps/s",
            f", step {row.step_min:.3g} s ({row.limit}), {left:.0f} s left",
        )


class ValidateProgress(ProgressBar):
    """Follows the runs of some cases, `workers` at a time: a bar on a terminal, else a line per run."""

    def __init__(self, cases: "Sequence[Case]", total: int, kept: int, workers: int, *, quiet: bool) -> None:
        super().__init__(total, "runs", quiet=quiet, pause=0.0, steady=False)
        self._measures = {case.name: case.measures[0] for case in cases}
        self._kept = kept
        self._workers = workers

    def __enter__(self) -> Self:
        cases = counted(len(self._measures), "case")
        self.say(f"{cases}, {self._total} runs, {self._workers} at a time, one thread each")
        if self._kept:
            self.say(f"{self._kept} of {self._total} runs are done already, by the same program")
        return super().__enter__()

    def advance(self, run: "CaseRun", result: "RunResult", done: int) -> None:
        """Show another finished run."""
        what = f"{run.case}, n = {run.n}, {run.setting.label}"
        if result.finished:
            measure = self._measures[run.case]
            outcome = f"{measure.name} {result.values[measure.name]:.3g}{measure.unit_suffix}, {result.seconds:.2g} s"
        else:
            outcome = f"{result.status}: {result.message}"
        if self.drawn and not result.finished:
            self.say(f"{what}: {outcome}")
        self.show(done, what, f": {outcome}")
