"""Tasks in other processes: each in one of its own, or many of one job, such as the frames of a film, in a few.

In a process of its own the crash of one task, or its being late, is that of no other.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, get_context, resource_tracker
from typing import Any, Protocol, TypeVar

from mpmcli.cores import available_cores
from mpmcli.errors import RunError

T = TypeVar("T")
# Taichi starts once in a process, in one precision, and must not be forked.
SPAWN = get_context("spawn")
# Between two looks at which tasks have ended, s.
LOOK = 0.1


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT for all that is started here: Ctrl-C reaches all processes, and this one ends the others."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first process starts this, which unblocks the signal.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
            ready = connection.wait(going, LOOK)
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
                _end_one(answers, process)
                yield task, answer
    finally:
        for answers, (_, process, _) in going.items():
            _end_one(answers, process)


def _started(work: Callable[[T], Any], task: T) -> tuple[connection.Connection, SPAWN.Process]:
    answers, theirs = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=_answer, args=(work, task, theirs), daemon=True)
    with interrupts_blocked():
        process.start()
    theirs.close()
    return answers, process


def _end_one(answers: connection.Connection, process: SPAWN.Process) -> None:
    process.kill()
    process.join()
    answers.close()


def silence() -> None:
    """Let nothing of what libraries print in this process appear."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)


def _answer(work: Callable[[T], Any], task: T, answers: connection.Connection) -> None:
    silence()
    try:
        answer = work(task)
    except Exception as error:
        answer = Fault(f"{type(error).__name__}: {error}")
    answers.send(answer)


# Seconds between two looks at whether to stop.
PAUSE = 0.05
# Seconds in which a process may clean up before it is killed.
GRACE = 2.0
# How many threads the software renderer, numpy, splashsurf and VTK take.
THREADS = (
    "LP_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "VTK_SMP_MAX_THREADS",
)


class Job(Protocol):
    """What is rendered: of a module that can be imported, since it is pickled."""

    def start(self) -> Callable[[int], Any]:
        """Return what renders one frame and writes it; called once in each process."""
        ...


def render_frames(
    job: Job,
    ks: Sequence[int],
    workers: int,
    *,
    watch: Callable[[int, Any], None] = lambda k, outcome: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Render frames, in this process where one is asked for or one frame is left, and otherwise in others.

    The processes share the cores: each gets its part in the variables of THREADS that the environment does not set.
    What libraries print there appears nowhere, and Ctrl-C at the terminal does not reach them. None is left when this
    returns or raises; frames that are done stay.

    Args:
        ks: the frames, begun in this order.
        workers: processes at a time, each with one frame.
        watch: called with each frame as it is done, and what the job returned for it, which can be pickled.
        stop: called again and again; returns whether to end.

    Raises:
        KeyboardInterrupt: `stop` returned True.
        RunError: a process was ended from outside, or crashed.
        Exception: whatever the job raises, as itself.
    """
    count = min(workers, len(ks))
    if count > 1:
        _render_beside(job, ks, count, watch, stop)
    elif ks:
        render = job.start()
        for k in ks:
            if stop():
                raise KeyboardInterrupt
            watch(k, render(k))


def _render_beside(
    job: Job, ks: Sequence[int], count: int, watch: Callable[[int, Any], None], stop: Callable[[], bool]
) -> None:
    others = set(multiprocessing.active_children())
    # Libraries read these where they are loaded, which the job is with.
    share = str(max(1, available_cores() // count))
    threads = {name: share for name in THREADS if name not in os.environ}
    pool = ProcessPoolExecutor(count, SPAWN, _begin, (job,))
    try:
        os.environ.update(threads)
        try:
            with interrupts_blocked():
                waiting = {pool.submit(_render, k): k for k in ks}
        finally:
            for name in threads:
                del os.environ[name]
        while waiting:
            if stop():
                raise KeyboardInterrupt
            for future in wait(waiting, PAUSE, FIRST_COMPLETED).done:
                watch(waiting.pop(future), future.result())
    except BrokenProcessPool:
        if stop():
            raise KeyboardInterrupt from None
        raise RunError(
            "A process that rendered frames was ended, or crashed; frames that are done are kept, and fewer --workers "
            "need less memory."
        ) from None
    finally:
        _end([process for process in multiprocessing.active_children() if process not in others])
        pool.shutdown(cancel_futures=True)


def _end(processes: Sequence[multiprocessing.Process]) -> None:
    """End all processes, whatever they are doing."""
    try:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(GRACE)
    finally:
        for process in processes:
            process.kill()


# Of a process: its job, and what that starts.
_job: Job
_render_frame: Callable[[int], Any] | None = None


def _begin(job: Job) -> None:
    """Prepare a process."""
    global _job
    _job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # KeyboardInterrupt, as no handler of errors must stop it.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    silence()
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the process that started this one: it may be killed."""
    connection.wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def _render(k: int) -> Any:
    global _render_frame
    try:
        if _render_frame is None:
            _render_frame = _job.start()
        return _render_frame(k)
    except KeyboardInterrupt:
        # What was unfinished is removed; the pool would go on with the next frame.
        os._exit(1)
