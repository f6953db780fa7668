"""Runs the matrix of a level and returns its report. Results in the journal are reused."""

import subprocess
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from mpmcli.bench.report import describe_machine
from mpmcli.errors import InputError
from mpmcli.validation.case import Case, Level
from mpmcli.validation.journal import PACKAGE, Journal, run_key
from mpmcli.validation.report import Report
from mpmcli.validation.runner import TIMEOUT, carry_out_all, case_command
from mpmcli.validation.runs import Run, RunResult, matrix

# Called with each finished run, its result, the number of finished runs and the number of all runs.
OnRun = Callable[[Run, RunResult, int, int], None]


def study(
    cases: Sequence[Case],
    level: Level,
    workers: int,
    *,
    journal: Journal | None = None,
    timeout: float = TIMEOUT,
    on_run: OnRun = lambda run, result, done, total: None,
    resumed: Callable[[int, int], None] = lambda kept, total: None,
    stop: Callable[[], bool] = lambda: False,
    command: Callable[[Run], list[str]] = case_command,
) -> Report:
    """Run the cases at a level and return the report.

    Args:
        workers: number of concurrent runs, of one thread each.
        journal: stores every result, and provides results of earlier calls. None stores nothing.
        timeout: time limit of a run, s.
        on_run: called after each run, see `OnRun`.
        resumed: called once with the number of runs taken from the journal and the number of all runs.
        stop: polled while runs are in progress; True ends them.
        command: command line of a run, see `carry_out_all`.

    Raises:
        KeyboardInterrupt: `stop` returned True. The journal holds the results of finished runs.
    """
    environment = describe_environment(workers)
    runs = matrix(cases, level)
    named = {case.name: case for case in cases}
    keys, done = {}, {}
    for run in runs if journal is not None else ():
        try:
            keys[run] = run_key(named[run.case], run, environment["processor"])
        except InputError:
            # The run itself reports the error. Without a key its result is never reused.
            keys[run] = ""
        kept = journal.find(run, keys[run])
        if kept is not None:
            done[run] = kept
    if done:
        resumed(len(done), len(runs))
    left = [run for run in runs if run not in done]
    for run, result in carry_out_all(left, workers, timeout, stop, command):
        done[run] = result
        if journal is not None:
            journal.keep(run, keys[run], result)
        on_run(run, result, len(done), len(runs))
    return Report(level, environment, tuple(cases), {run: done[run] for run in runs})


def describe_environment(workers: int) -> dict:
    """Return the machine, versions, commit and date of a report of so many concurrent runs, of one thread each."""
    return {
        **describe_machine(),
        "commit": commit(),
        "arch": "cpu",
        "threads": 1,
        "workers": workers,
        "date": datetime.now(UTC).date().isoformat(),
    }


def commit() -> str | None:
    """Return the commit of the package, with "+" if files are modified; None outside a git repository of mpmcli."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(PACKAGE), *words], capture_output=True, text=True)
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # The package may be installed within another repository.
    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = git("rev-parse", "--short=12", "HEAD")
    return head and head + ("+" if git("status", "--porcelain", "--", ".") else "")
