"""Sends tasks to the workers of a Dask cluster, its own or one that runs already."""

import os
import queue
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

from mpmcli.dataset.compute import Task, compute
from mpmcli.dataset.manifest import Row
from mpmcli.errors import InputError, RunError

if TYPE_CHECKING:
    from distributed import LocalCluster

# Tasks under way for each worker: one to compute, and one that waits for it.
AHEAD = 2
# Workers that a task may lose before it counts as failed.
LOSSES = 5
# Of the status pages that Dask serves: this machine only, on a free port.
LOCAL = "127.0.0.1:0"
# Attempts to start a cluster.
STARTS = 3
# Seconds between looks at `stop`.
PATIENCE = 0.2

Outcome = tuple[Task, list[Row] | None]


class Workers:
    """Workers that compute tasks, as `local_workers` and `joined_workers` give them.

    Attributes:
        count: number of workers.
    """

    def __init__(self, client: object) -> None:
        self._client = client
        self.count = len(client.scheduler_info(n_workers=-1)["workers"])

    def outcomes(self, tasks: Iterable[Task], stop: Callable[[], bool]) -> Iterator[Outcome]:
        """Yield each task with its rows as it ends; with None where every worker that took it was lost.

        Raises:
            RunError: a file could not be written, or the cluster is gone.
            KeyboardInterrupt: `stop` returned True; what is under way is abandoned.
        """
        from distributed import Future
        from distributed.scheduler import KilledWorker

        ended: queue.Queue[tuple[Task, Future]] = queue.Queue()
        waiting = iter(tasks)
        under_way = 0

        def send() -> bool:
            task = next(waiting, None)
            if task is None:
                return False
            future = self._client.submit(compute, task, pure=False, retries=0)
            future.add_done_callback(lambda done, task=task: ended.put((task, done)))
            return True

        while under_way < AHEAD * self.count and send():
            under_way += 1
        while under_way:
            if stop():
                raise KeyboardInterrupt
            try:
                task, future = ended.get(timeout=PATIENCE)
            except queue.Empty:
                continue
            if not send():
                under_way -= 1
            if future.status == "cancelled":
                raise RunError("the cluster has ended; the trajectories that are done are kept, and --resume goes on.")
            error = future.exception()
            if error is None:
                yield task, future.result()
            elif not isinstance(error, KilledWorker):
                raise error
            elif len(task.numbers) > 1:
                # One of them takes its worker with it; which one, the next tries tell.
                yield from self.outcomes([replace(task, numbers=(number,)) for number in task.numbers], stop)
            else:
                yield task, None


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Start workers on this machine, one process each, that end with the block.

    Raises:
        RunError: they do not start.
    """
    import dask
    from distributed import Client

    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        cluster = stack.enter_context(_local_cluster(count))
        workers = Workers(stack.enter_context(Client(cluster)))
        try:
            yield workers
        except BaseException:
            _kill(cluster)
            raise


def _local_cluster(count: int) -> "LocalCluster":
    """Start a cluster; again, where a worker was killed before it had started, which Dask does not forgive."""
    from distributed import LocalCluster

    for left in reversed(range(STARTS)):
        try:
            with _interrupts_blocked():
                return LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=None,
                    dashboard_address=LOCAL,
                    silence_logs="CRITICAL",
                )
        except (RuntimeError, OSError) as error:
            if not left:
                raise RunError(f"the workers do not start ({error}); --resume goes on with what is done.") from error
    raise AssertionError


def _kill(cluster: "LocalCluster") -> None:
    """End the worker processes, which hear of nothing while a kernel runs; what they write is whole or absent."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        with suppress(OSError, AttributeError, TypeError):
            os.kill(nanny.pid, signal.SIGKILL)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT for this thread and for what it starts, threads and processes, which keep it blocked.

    Ctrl-C reaches every process of a terminal. Workers would end with a traceback; this process ends them.
    """
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


@contextmanager
def joined_workers(address: str) -> Iterator[Workers]:
    """Use the workers of a running scheduler; they see the dataset at the same path.

    Raises:
        InputError: there is no scheduler at the address, or it has no worker.
    """
    import dask
    from distributed import Client

    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        try:
            client = stack.enter_context(Client(address, timeout=10))
        except (OSError, ValueError) as error:
            raise InputError(f"--scheduler {address}: no scheduler answers there; give tcp://HOST:PORT.") from error
        workers = Workers(client)
        if workers.count == 0:
            raise InputError(f"--scheduler {address}: this scheduler has no worker; start dask worker {address}.")
        yield workers


_SETTINGS = {
    "distributed.scheduler.allowed-failures": LOSSES,
    # A step of a large scene holds the interpreter for longer than Dask expects.
    "distributed.admin.tick.limit": "1h",
    "distributed.comm.timeouts.connect": "30s",
    # Samples of every thread, a hundred a second, which nobody sees.
    "distributed.worker.profile.enabled": False,
}
