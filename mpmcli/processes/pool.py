"""Tasks in child processes: one process per task, or processes that compute the tasks of one job in turn.

A crash or a timeout of a task does not affect the others. Executors of concurrent.futures and loky lose all tasks with
one process and end none that takes too long; pools with shared pipes (pebble) stop if a process is killed while it
holds their lock. Here each process has a pipe of its own.
"""

import math
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.pool import ExceptionWithTraceback
from typing import Any, Generic, Protocol, Self, TypeVar

from mpmcli.cores import available_cores
from mpmcli.errors import RunError

T = TypeVar("T")
# Taichi is initialized once in a process, in one precision, and must not be forked.
SPAWN = get_context("spawn")
# Interval of polling `stop`, s.
LOOK = 0.1
# Time in which a process at work may clean up before it is killed, and in which an idle one may end, s.
GRACE, IDLE_GRACE = 2.0, 10.0
# Variables with the number of threads of the software renderer, NumPy, splashsurf and VTK.
THREADS = (
    "LP_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "VTK_SMP_MAX_THREADS",
)


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


class Workers(Generic[T]):
    """Processes that compute tasks in turn; none is left when the context ends.

    They share the cores, see `sharing_cores`, ignore Ctrl-C, and end with this process. Output of libraries there is
    discarded.
    """

    def __init__(
        self,
        count: int,
        begin: Callable[[], Callable[[T], Any]],
        *,
        fresh: bool = False,
        timeout: float = math.inf,
    ) -> None:
        """Start no process yet.

        Args:
            count: largest number of processes at a time.
            begin: called once in each process; returns the function of a task. It is pickled.
            fresh: whether each task gets a process of its own.
            timeout: time limit of a task, s.
        """
        self.count, self._begin, self._fresh, self._timeout = count, begin, fresh, timeout
        self._idle: list[_Child] = []
        self._going: dict[connection.Connection, tuple[T, _Child, float]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End idle processes, which may store what they keep, and terminate those at work."""
        busy = [child for _, child, _ in self._going.values()]
        try:
            for child in busy:
                child.process.terminate()
            for child in self._idle:
                child.pipe.close()
            for child in busy:
                child.process.join(GRACE)
            for child in self._idle:
                child.process.join(IDLE_GRACE)
        finally:
            for child in busy + self._idle:
                child.kill()

    def outcomes(self, tasks: deque[T], stop: Callable[[], object] = lambda: False) -> Iterator[tuple[T, Any]]:
        """Yield tasks, as they end, each with its answer, the Exception that it raised, or the Fault of its process.

        Tasks are taken from the left of the deque, to which the caller may add. `stop` is polled; if it returns True,
        KeyboardInterrupt is raised. RunError: a process does not start.
        """
        while tasks or self._going:
            self._hand_out(tasks)
            ready = connection.wait(self._going, LOOK)
            if stop():
                raise KeyboardInterrupt
            now = time.monotonic()
            ended = [pipe for pipe, (*_, end) in self._going.items() if pipe in ready or now > end]
            answers = [self._answer(pipe, arrived=pipe in ready) for pipe in ended]
            # The processes go on while the caller stores what was found.
            self._hand_out(tasks)
            yield from answers

    def _hand_out(self, tasks: deque[T]) -> None:
        """Give each idle process a task, and start others up to the largest number."""
        while tasks and len(self._going) < self.count:
            child = self._idle.pop() if self._idle else _Child.start(self._begin, self.count)
            task = tasks.popleft()
            self._going[child.pipe] = task, child, time.monotonic() + self._timeout
            # A process that was killed is found when it is read from.
            with suppress(OSError):
                child.pipe.send(task)

    def _answer(self, pipe: connection.Connection, *, arrived: bool) -> tuple[T, Any]:
        """Return a task with its outcome, and keep its process if it can compute another."""
        task, child, _ = self._going.pop(pipe)
        lost = True
        try:
            answer = pipe.recv() if arrived else Fault(f"it took longer than {self._timeout:g} s")
            lost = not arrived
        except (EOFError, OSError):
            child.process.join()
            answer = Fault(f"its process ended with exit code {child.process.exitcode}")
        if lost or self._fresh:
            child.kill()
        else:
            self._idle.append(child)
        return task, answer


@dataclass(frozen=True)
class _Child:
    """A process, and this end of its pipe."""

    pipe: connection.Connection
    process: multiprocessing.Process

    @classmethod
    def start(cls, begin: Callable[[], Callable[[Any], Any]], count: int) -> "_Child":
        """Start one of `count` processes."""
        pipe, theirs = SPAWN.Pipe()
        process = SPAWN.Process(target=_serve, args=(theirs, begin), daemon=True)
        try:
            with interrupts_blocked(), sharing_cores(count):
                process.start()
        except OSError as error:
            raise RunError(f"A process does not start ({error}).") from error
        theirs.close()
        return cls(pipe, process)

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: connection.Connection, begin: Callable[[], Callable[[Any], Any]]) -> None:
    """Compute the tasks of a pipe until its other end is closed."""
    silence()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # SIGTERM raises KeyboardInterrupt, which handlers of errors do not catch.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_follow_parent, daemon=True).start()
    work = None
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            work = work or begin()
            answer = work(task)
        except Exception as error:
            answer = ExceptionWithTraceback(error, error.__traceback__)
        pipe.send(answer)


def silence() -> None:
    """Discard the output of this process, including that of libraries."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)


def _follow_parent() -> None:
    """End this process when its parent ends, which may be killed."""
    connection.wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def in_processes(
    tasks: Sequence[T],
    workers: int,
    work: Callable[[T], Any],
    timeout: float,
    stop: Callable[[], object] = lambda: False,
) -> Iterator[tuple[T, Any]]:
    """Yield (task, work(task) or a Fault) as processes end, one per task and `workers` at a time; see `Workers`.

    `work` must be picklable; `timeout` is in s. If the polled `stop` is true, KeyboardInterrupt is raised.
    """
    with Workers(workers, partial(_same, work), fresh=True, timeout=timeout) as processes:
        for task, answer in processes.outcomes(deque(tasks), stop):
            if isinstance(answer, Exception):
                answer = Fault(f"{type(answer).__name__}: {answer}")
            yield task, answer


def _same(work: Callable[[T], Any]) -> Callable[[T], Any]:
    return work


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
    """Render frames, in this process for one worker or one frame, otherwise in child processes; see `Workers`.

    Finished frames are kept.

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
    if count <= 1:
        render = job.start() if ks else None
        for k in ks:
            if stop():
                raise KeyboardInterrupt
            watch(k, render(k))
        return
    with Workers(count, job.start) as processes:
        for k, outcome in processes.outcomes(deque(ks), stop):
            if isinstance(outcome, Fault):
                if stop():
                    raise KeyboardInterrupt
                raise RunError(
                    "A process that rendered frames was killed or crashed. Finished frames are kept; fewer --workers "
                    "need less memory."
                )
            if isinstance(outcome, Exception):
                raise outcome
            watch(k, outcome)
