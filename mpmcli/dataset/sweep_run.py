"""Runs a sweep: sends what is missing to workers, keeps the manifest, and seals shards."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext

from mpmcli.cores import available_cores
from mpmcli.dataset.card import write_card
from mpmcli.dataset.cluster import Workers, joined_workers, local_workers
from mpmcli.dataset.compute import Task
from mpmcli.dataset.folder import Folder
from mpmcli.dataset.manifest import Manifest, Row
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_folder import taken_folder
from mpmcli.dataset.sweep_state import SweepSettings, SweepState

# Most trajectories of a task, and tasks per worker below which they become shorter.
TASK, GPU_TASK, ROUNDS = 8, 128, 8
# Why a trajectory has failed that no worker survived.
LOST = "every worker that computed it was killed, perhaps for want of memory."


def run_sweep(
    sweep: Sweep,
    settings: SweepSettings,
    on_progress: Callable[[SweepState], None] = lambda state: None,
    stop: Callable[[], bool] = lambda: False,
) -> SweepState:
    """Compute the trajectories of a sweep that are not there yet.

    The files of the dataset do not depend on workers, on their order, or on interrupts between.

    Args:
        on_progress: called with the state after each task.
        stop: called often; True ends the sweep, which --resume continues.

    Raises:
        InputError: the directory, the settings or the disk do not suit; nothing was written.
        RunError: a file could not be written; what was done is kept.
    """
    began = time.perf_counter()
    with ExitStack() as stack:
        # Nothing is written where there is no scheduler.
        joined = stack.enter_context(joined_workers(settings.scheduler)) if settings.scheduler else None
        folder, manifest = stack.enter_context(taken_folder(sweep, settings))
        return _run(sweep, settings, folder, manifest, joined, began, on_progress, stop)


def _run(
    sweep: Sweep,
    settings: SweepSettings,
    folder: Folder,
    manifest: Manifest,
    joined: Workers | None,
    began: float,
    on_progress: Callable[[SweepState], None],
    stop: Callable[[], bool],
) -> SweepState:
    rows = {row.number: row for row in manifest.rows() if folder.is_kept(row)}
    state = SweepState(settings.directory, sum(len(folder.numbers(shard)) for shard in folder.shards), len(rows))
    for row in rows.values():
        state.count(row)
    numbers = [n for shard in folder.shards for n in folder.numbers(shard) if n not in rows]
    keeper = _Keeper(folder, manifest, rows)
    keeper.seal_complete(folder.shards)
    try:
        if numbers:
            count = min(settings.workers or available_cores(), len(numbers))
            with nullcontext(joined) if joined else local_workers(count) as workers:
                state.start_seconds = time.perf_counter() - began
                since = time.perf_counter()
                outcomes = workers.outcomes(_tasks(sweep, settings, numbers, workers.count), stop)
                for ended, (task, found) in enumerate(outcomes, 1):
                    new = [Row.failed(n, sweep.split_of(n), LOST) for n in task.numbers] if found is None else found
                    keeper.take(new)
                    for row in new:
                        state.count(row)
                        state.particle_steps += row.particles * row.steps
                    state.seconds = time.perf_counter() - since
                    if ended == workers.count:
                        state.settled = state.done, state.seconds
                    on_progress(state)
        if settings.part == (1, 1):
            write_card(settings.directory)
        folder.close()
        state.status = "finished"
    except KeyboardInterrupt:
        state.status = "interrupted"
    return state


class _Keeper:
    """Enters rows into the manifest, and seals each shard when its last row has come."""

    def __init__(self, folder: Folder, manifest: Manifest, rows: dict[int, Row]) -> None:
        self._folder, self._manifest, self._rows = folder, manifest, rows

    def take(self, new: Sequence[Row]) -> None:
        self._manifest.put(new)
        self._rows.update((row.number, row) for row in new)
        self.seal_complete(sorted({self._folder.shard_of(row.number) for row in new}))

    def seal_complete(self, shards: Sequence[int]) -> None:
        for shard in shards:
            own = [self._rows.get(number) for number in self._folder.numbers(shard)]
            if None in own or all(row.file == self._folder.shard_file(shard) for row in own if row.accepted):
                continue
            changed = self._folder.seal(shard, self._rows)
            self._manifest.put(changed)
            self._rows.update((row.number, row) for row in changed)
            self._folder.clear(changed)


def _tasks(sweep: Sweep, settings: SweepSettings, numbers: Sequence[int], workers: int) -> list[Task]:
    """Split the work: tasks of several trajectories, so that sending takes no time, but enough for all workers."""
    # A GPU computes the trajectories of a task at once.
    most = GPU_TASK if settings.arch not in ("auto", "cpu") else TASK
    size = max(1, min(most, len(numbers) // (ROUNDS * workers)))
    directory = settings.directory.resolve()
    plugins = tuple(path.resolve() for path in settings.plugins)
    return [
        Task(directory, sweep, tuple(numbers[i : i + size]), settings.arch, settings.threads, plugins)
        for i in range(0, len(numbers), size)
    ]
