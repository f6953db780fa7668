"""Executes runs concurrently, each in a separate process, so that the failure of one does not affect the others.

    python -m mpmcli.validation.runner CASE N '{"precision": "f32"}'

is such a process: it writes the result of one run to stdout as one line of JSON. It exits when its standard input is
closed, that is, when the parent process ends.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence

from mpmcli.processes.questions import Question, Reply, answering, ask_as_ended, end_with_parent
from mpmcli.validation.carry_out import carry_out
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import Run, RunResult, failure

# Default time limit of a run, s.
TIMEOUT = 1800.0
# Number of lines of stderr that the message of a failed process contains.
QUOTED = 3
# Environment that restricts numpy to one thread, so that concurrent processes do not compete for cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def case_command(run: Run) -> list[str]:
    """Return the command line of the process that executes a run."""
    setting = json.dumps(run.setting.changed_from(Setting()))
    return [sys.executable, "-m", "mpmcli.validation.runner", run.case, str(run.n), setting]


def carry_out_all(
    runs: Sequence[Run],
    workers: int,
    timeout: float = TIMEOUT,
    stop: Callable[[], bool] = lambda: False,
    command: Callable[[Run], list[str]] = case_command,
) -> Iterator[tuple[Run, RunResult]]:
    """Yield (run, result) in the order in which the runs end. A failure, or being late, is reported in the result.

    `stop` is polled while runs are in progress: where it returns True, all are ended and KeyboardInterrupt is raised.
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


def main() -> None:
    """Execute one run. Output of Taichi to stdout is redirected to stderr."""
    began = time.perf_counter()
    case, n, setting = sys.argv[1:]
    end_with_parent()
    with answering() as answer:
        result = carry_out(all_cases()[case], int(n), Setting(**json.loads(setting)))
        answer(**{**result.as_dict(), "wall_seconds": time.perf_counter() - began})


if __name__ == "__main__":
    main()
