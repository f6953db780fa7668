"""Carries out many tasks of one job, such as the frames of a film, in several processes at once."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any, Protocol

from mpmcli.cores import available_cores
from mpmcli.errors import RunError
from mpmcli.processes.each import SPAWN
from mpmcli.processes.interrupts import interrupts_blocked

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
    signal.signal(signal.SIGTERM, _leave)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the process that started this one: it may be killed."""
    connection.wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


def _leave(*_: object) -> None:
    # The base class, as no handler of errors must stop it.
    raise KeyboardInterrupt


def _render(k: int) -> Any:
    global _render_frame
    try:
        if _render_frame is None:
            _render_frame = _job.start()
        return _render_frame(k)
    except KeyboardInterrupt:
        # What was unfinished is removed; the pool would go on with the next frame.
        os._exit(1)
