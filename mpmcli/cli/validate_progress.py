"""Progress of a validation on stderr: a bar on a terminal, else a line per run."""

from collections.abc import Sequence
from types import TracebackType

from mpmcli.cli.progress_bar import ProgressBar
from mpmcli.plain_text import counted
from mpmcli.validation.case import Case
from mpmcli.validation.matrix import Run, label_of
from mpmcli.validation.run_result import RunResult


class ValidateProgress:
    """Follows the runs of some cases; use it as a context around them.

    Args:
        total: number of runs.
        workers: number of concurrent runs.
        quiet: print nothing.
    """

    def __init__(self, cases: Sequence[Case], total: int, workers: int, *, quiet: bool) -> None:
        self._measures = {case.name: case.measures[0] for case in cases}
        self._total = total
        self._workers = workers
        self._bar = ProgressBar(total, "runs", quiet=quiet, pause=0.0, steady=False)

    def __enter__(self) -> "ValidateProgress":
        cases = len(self._measures)
        self._bar.say(f"{counted(cases, 'case')}, {self._total} runs, {self._workers} at a time, one thread each")
        self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def resumed(self, kept: int, total: int) -> None:
        """Print the number of runs taken from the journal."""
        self._bar.say(f"{kept} of {total} runs are done already, by the same program")
        if self._bar.drawn:
            self._bar.show(kept)

    def advance(self, run: Run, result: RunResult, done: int, total: int) -> None:
        """Show one more run that has ended."""
        what = f"{run.case}, n = {run.n}, {label_of(run.setting)}"
        if result.finished:
            measure = self._measures[run.case]
            unit = f" {measure.unit}" if measure.unit else ""
            outcome = f"{measure.name} {result.values[measure.name]:.3g}{unit}, {result.seconds:.2g} s"
        else:
            outcome = f"{result.status}: {result.message}"
        if self._bar.drawn and not result.finished:
            self._bar.say(f"{what}: {outcome}")
        self._bar.show(done, what, f": {outcome}")
