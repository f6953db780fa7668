"""Carries out the matrix of a level, keeping and taking up what is done, and reports what was found."""

from collections.abc import Callable, Sequence

from mpmcli.errors import InputError
from mpmcli.validation.case import Case, Level
from mpmcli.validation.environment import describe_environment
from mpmcli.validation.fingerprint import run_key
from mpmcli.validation.journal import Journal
from mpmcli.validation.matrix import Run, matrix
from mpmcli.validation.report import Report
from mpmcli.validation.run_result import RunResult
from mpmcli.validation.runner import TIMEOUT, carry_out_all, case_command

# Told of each run as it ends, and how many of how many have.
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
        workers: runs at a time, of one thread each.
        journal: keeps every result, and has those that are not computed again; None keeps nothing.
        timeout: seconds that a run may take.
        on_run: see `OnRun`; resumed: told how many of all runs are taken from the journal.
        stop: asked again and again whether to end; command: see `carry_out_all`.

    Raises:
        KeyboardInterrupt: `stop` said so; what is done is in the journal.
    """
    environment = describe_environment(workers)
    runs = matrix(cases, level)
    named = {case.name: case for case in cases}
    keys, done = {}, {}
    for run in runs:
        if journal is None:
            continue
        try:
            keys[run] = run_key(named[run.case], run, environment["processor"])
        except InputError:
            # It will say so itself, and is no result to be kept for another program.
            keys[run] = ""
        found = journal.find(run, keys[run])
        if found is not None:
            done[run] = found
    if done:
        resumed(len(done), len(runs))
    left = [run for run in runs if run not in done]
    for run, result in carry_out_all(left, workers, timeout, stop, command):
        done[run] = result
        if journal is not None:
            journal.keep(run, keys[run], result)
        on_run(run, result, len(done), len(runs))
    return Report(level, environment, tuple(cases), {run: done[run] for run in runs})
