"""Progress of a validation for people, on stderr: a bar on a terminal, a line per run elsewhere."""

from collections.abc import Sequence
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from mpmcli.validation.case import Case
from mpmcli.validation.matrix import Run, label_of
from mpmcli.validation.run_result import RunResult


class ValidateProgress:
    """Follows the runs of some cases; use it as a context around them.

    Args:
        total: number of runs; workers: how many go on at a time.
        quiet: print nothing.
    """

    def __init__(self, cases: Sequence[Case], total: int, workers: int, *, quiet: bool) -> None:
        self._measures = {case.name: case.measures[0] for case in cases}
        self._total = total
        self._workers = workers
        self._quiet = quiet
        self._console = Console(stderr=True)
        self._bar: Bar | None = None
        self._task: Any = None

    def __enter__(self) -> "ValidateProgress":
        cases = len(self._measures)
        self._say(
            f"{cases} case{'s' if cases > 1 else ''}, {self._total} runs, {self._workers} at a time, one thread each"
        )
        if not self._quiet and self._console.is_terminal:
            self._bar = Bar(
                BarColumn(),
                TextColumn("{task.completed:.0f}/{task.total:.0f} runs"),
                TimeElapsedColumn(),
                TextColumn("{task.description}"),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task("", total=self._total)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def resumed(self, kept: int, total: int) -> None:
        """Say how many runs were done before."""
        self._say(f"{kept} of {total} runs are done already, by the same program")
        if self._bar is not None:
            self._bar.update(self._task, completed=kept)

    def advance(self, run: Run, result: RunResult, done: int, total: int) -> None:
        """Show one more run that has ended."""
        what = f"{run.case}, n = {run.n}, {label_of(run.setting)}"
        if result.finished:
            measure = self._measures[run.case]
            unit = f" {measure.unit}" if measure.unit else ""
            outcome = f"{measure.name} {result.values[measure.name]:.3g}{unit}, {result.seconds:.2g} s"
        else:
            outcome = f"{result.status}: {result.message}"
        if self._bar is None:
            self._say(f"{done}/{total} {what}: {outcome}")
            return
        self._bar.update(self._task, completed=done, description=what)
        if not result.finished:
            self._say(f"{what}: {outcome}")

    def _say(self, line: str) -> None:
        if self._quiet:
            return
        try:
            self._console.print(line, markup=False, highlight=False, soft_wrap=not self._console.is_terminal)
        except (OSError, SystemExit):
            # Nobody reads along any more (rich exits on a broken pipe): no reason to end the runs.
            self._quiet = True
