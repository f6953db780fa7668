"""Tasks in processes of their own: the crash of one, or its being late, is that of no other."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, get_context
from typing import Any, TypeVar

from mpmcli.processes.interrupts import interrupts_blocked

T = TypeVar("T")
# Taichi starts once in a process, in one precision, and must not be forked.
SPAWN = get_context("spawn")
# Between two looks at what has ended, s.
PAUSE = 0.1


@dataclass(frozen=True)
class Fault:
    """Why there is no answer, such as "its process ended with exit code 3"."""

    words: str


def in_processes(
    tasks: Sequence[T],
    workers: int,
    work: Callable[[T], Any],
    timeout: float,
    stop: Callable[[], object] = lambda: False,
) -> Iterator[tuple[T, Any]]:
    """Yield (task, work(task) or a Fault) as processes end, `workers` at a time. None is left when this ends.

    Args:
        work: what a process does, a function of a module; what libraries print there appears nowhere.
        timeout: of a task, s.
        stop: polled; where it returns True, KeyboardInterrupt is raised.
    """
    waiting, going = list(reversed(tasks)), {}
    try:
        while waiting or going:
            while waiting and len(going) < workers:
                task = waiting.pop()
                answers, process = _started(work, task)
                going[answers] = task, process, time.monotonic() + timeout
            ready = connection.wait(going, PAUSE)
            if stop():
                raise KeyboardInterrupt
            now = time.monotonic()
            for answers in [answers for answers, (*_, end) in going.items() if answers in ready or now > end]:
                task, process, _ = going.pop(answers)
                try:
                    answer = answers.recv() if answers in ready else Fault(f"it took longer than {timeout:g} s")
                except EOFError:
                    process.join()
                    answer = Fault(f"its process ended with exit code {process.exitcode}")
                _end(answers, process)
                yield task, answer
    finally:
        for answers, (_, process, _) in going.items():
            _end(answers, process)


def _started(work: Callable[[T], Any], task: T) -> tuple[connection.Connection, SPAWN.Process]:
    answers, theirs = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=_answer, args=(work, task, theirs), daemon=True)
    with interrupts_blocked():
        process.start()
    theirs.close()
    return answers, process


def _end(answers: connection.Connection, process: SPAWN.Process) -> None:
    process.kill()
    process.join()
    answers.close()


def _answer(work: Callable[[T], Any], task: T, answers: connection.Connection) -> None:
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    try:
        answer = work(task)
    except Exception as error:
        answer = Fault(f"{type(error).__name__}: {error}")
    answers.send(answer)
