"""Executes runs concurrently, each in a separate process, so that the failure of one does not affect the others."""

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence

from mpmcli.processes.questions import Question, Reply, ask_as_ended
from mpmcli.validation.matrix import Run
from mpmcli.validation.run_result import RunResult, failure
from mpmcli.validation.setting import Setting

# Default time limit of a run, s.
TIMEOUT = 1800.0
# Number of lines of stderr that the message of a failed process contains.
QUOTED = 3
# Environment that restricts numpy to one thread, so that concurrent processes do not compete for cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def case_command(run: Run) -> list[str]:
    """Return the command line of the process that executes a run."""
    setting = json.dumps(run.setting.changed_from(Setting()))
    return [sys.executable, "-m", "mpmcli.validation.case_process", run.case, str(run.n), setting]


def carry_out_all(
    runs: Sequence[Run],
    workers: int,
    timeout: float = TIMEOUT,
    stop: Callable[[], bool] = lambda: False,
    command: Callable[[Run], list[str]] = case_command,
) -> Iterator[tuple[Run, RunResult]]:
    """Yield (run, result) in the order in which the runs end. A failure is reported in the result.

    Args:
        workers: number of concurrent processes.
        timeout: time limit of a run, s.
        stop: polled while runs are in progress; True ends all of them.
        command: returns the command line of a run; tests replace it.

    Raises:
        KeyboardInterrupt: `stop` returned True. No process is left running.
    """
    # Taichi reads settings from variables TI_*, which would affect the result.
    environment = {**dict.fromkeys(name for name in os.environ if name.startswith("TI_")), **ONE_THREAD}
    questions = (Question(command(run), timeout, environment, follows=True) for run in runs)
    for number, reply in ask_as_ended(questions, workers, stop):
        yield runs[number], _result(reply)


def _result(reply: Reply) -> RunResult:
    """Return the result that a process wrote, or a failure if it wrote none."""
    try:
        if not reply.fault:
            return RunResult.from_dict(reply.answer)
    except (KeyError, TypeError, ValueError):
        pass
    words = reply.complaint.splitlines()[-QUOTED:]
    return failure(" ".join([f"The process of the run {reply.fault or 'gave no result'}.", *words]))
