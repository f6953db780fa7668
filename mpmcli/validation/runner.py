"""Runs many cases side by side, each in a process of its own, so that none can harm another."""

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence

from mpmcli.processes.questions import Question, Reply, ask_as_ended
from mpmcli.validation.matrix import Run
from mpmcli.validation.run_result import RunResult, failure
from mpmcli.validation.setting import Setting

# Seconds that a run may take.
TIMEOUT = 1800.0
# Lines of stderr that are quoted on failure.
QUOTED = 3
# One thread each: numpy's own would compete.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def case_command(run: Run) -> list[str]:
    """Return the command line that carries out a run."""
    setting = json.dumps(run.setting.changed_from(Setting()))
    return [sys.executable, "-m", "mpmcli.validation.case_process", run.case, str(run.n), setting]


def carry_out_all(
    runs: Sequence[Run],
    workers: int,
    timeout: float = TIMEOUT,
    stop: Callable[[], bool] = lambda: False,
    command: Callable[[Run], list[str]] = case_command,
) -> Iterator[tuple[Run, RunResult]]:
    """Yield each run with what came of it, as they end; a run that fails says so in its result.

    Args:
        workers: how many run at a time; timeout: seconds that each may take.
        stop: asked again and again whether to end all.
        command: the command line of a run; tests replace it.

    Raises:
        KeyboardInterrupt: `stop` said so. No process is left then, nor after any other end.
    """
    # Settings of taichi from outside would change what is measured.
    environment = {**dict.fromkeys(name for name in os.environ if name.startswith("TI_")), **ONE_THREAD}
    questions = (Question(command(run), timeout, environment, follows=True) for run in runs)
    for number, reply in ask_as_ended(questions, workers, stop):
        yield runs[number], _result(reply)


def _result(reply: Reply) -> RunResult:
    """Return what a process answered, or why it did not."""
    try:
        if not reply.fault:
            return RunResult.from_dict(reply.answer)
    except (KeyError, TypeError, ValueError):
        pass
    words = reply.complaint.splitlines()[-QUOTED:]
    return failure(" ".join([f"The process of the run {reply.fault or 'gave no result'}.", *words]))
