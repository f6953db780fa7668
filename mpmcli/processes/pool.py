"""Tasks in child processes: one process per task, or a pool for the tasks of one job, such as the frames of a film.

With one process per task, a crash or a timeout of a task does not affect the others.
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
# Taichi is initialized once in a process, in one precision, and must not be forked.
SPAWN = get_context("spawn")
# Interval of polling for tasks that have ended, s.
LOOK = 0.1


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in processes started in this context: Ctrl-C reaches all, and this process ends the others."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first process would start the tracker, which unblocks the signal.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def sharing_cores(count: int) -> Iterator[None]:
    """Give `count` processes started in this context their share of the cores, unless the environment says otherwise.

    Libraries read the variables of THREADS when they are loaded.
    """
    share = str(max(1, available_cores() // count))
    threads = {name: share for name in THREADS if name not in os.environ}
    os.environ.update(threads)
    try:
        yield
    finally:
        for name in threads:
            del os.environ[name]


@dataclass(frozen=True)
class Fault:
    """The reason of a missing result, such as "its process ended with exit code 3"."""

    words: str


def in_processes(
    tasks: Sequence[T],
    workers: int,
    work: Callable[[T], Any],
    timeout: float,
    stop: Callable[[], object] = lambda: False,
) -> Iterator[tuple[T, Any]]:
    """Yield (task, work(task) or a Fault) as processes end, `workers` at a time. No process is left when this ends.

    Args:
        work: function of a module that each process calls; output of libraries there is discarded.
        timeout: time limit of a task, s.
        stop: polled; if it returns True, KeyboardInterrupt is raised.
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
    """Discard the output of this process, including that of libraries."""
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


# Interval of polling `stop`, s.
PAUSE = 0.05
# Time in which a process may clean up before it is killed, s.
GRACE = 2.0
# Variables with the number of threads of the software renderer, NumPy, splashsurf and VTK.
THREADS = (
    "LP_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "VTK_SMP_MAX_THREADS",
)


class Job(Protocol):
    """A rendering job. Its class must be importable, because jobs are pickled."""

    def start(self) -> Callable[[int], Any]:
        """Return a function that renders and writes one frame; called once in each process."""
        ...


def render_frames(
    job: Job,
    ks: Sequence[int],
    workers: int,
    *,
    watch: Callable[[int, Any], None] = lambda k, outcome: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Render frames, in this process for one worker or one frame, otherwise in child processes.

    The processes share the cores: each gets its share in the variables of THREADS that the environment does not set.
    Output of libraries there is discarded, and the processes ignore Ctrl-C. No process is left when this returns or
    raises; finished frames are kept.

    Args:
        ks: the frames, which are started in this order.
        workers: processes at a time, each with one frame.
        watch: called with each finished frame and the result of the job for it, which must be picklable.
        stop: polled; returns whether to end.

    Raises:
        KeyboardInterrupt: `stop` returned True.
        RunError: a process was killed or crashed.
        Exception: any exception of the job.
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
    """Render frames in `count` processes, and hand each to `watch`. Raises RunError if a process dies."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(count, SPAWN, _begin, (job,))
    try:
        with interrupts_blocked(), sharing_cores(count):
            waiting = {pool.submit(_render, k): k for k in ks}
        while waiting:
            if stop():
                raise KeyboardInterrupt
            for future in wait(waiting, PAUSE, FIRST_COMPLETED).done:
                watch(waiting.pop(future), future.result())
    except BrokenProcessPool:
        if stop():
            raise KeyboardInterrupt from None
        raise RunError(
            "A process that rendered frames was killed or crashed. Finished frames are kept; fewer --workers need "
            "less memory."
        ) from None
    finally:
        _end([process for process in multiprocessing.active_children() if process not in others])
        pool.shutdown(cancel_futures=True)


def _end(processes: Sequence[multiprocessing.Process]) -> None:
    """Terminate all processes, and kill those that have not ended after GRACE."""
    try:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(GRACE)
    finally:
        for process in processes:
            process.kill()


# State of a child process: its job, and the function that `Job.start` returned.
_job: Job
_render_frame: Callable[[int], Any] | None = None


def _begin(job: Job) -> None:
    """Prepare a child process."""
    global _job
    _job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # SIGTERM raises KeyboardInterrupt, which handlers of errors do not catch.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    silence()
    threading.Thread(target=follow_parent, daemon=True).start()


def follow_parent() -> None:
    """End this process when its parent ends, which may be killed."""
    connection.wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def _render(k: int) -> Any:
    global _render_frame
    try:
        if _render_frame is None:
            _render_frame = _job.start()
        return _render_frame(k)
    except KeyboardInterrupt:
        # Unfinished files have been removed; the pool would continue with the next frame.
        os._exit(1)
