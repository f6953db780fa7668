"""Workers of a sweep, which draw, run and store trajectories: processes of this machine, or those of a Dask cluster."""

import hashlib
import json
import logging
import queue
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.certify import certify, write_certificate
from mpmcli.dataset.draw import Draw, draw
from mpmcli.dataset.folder import Row
from mpmcli.dataset.images import draw_images
from mpmcli.dataset.shard import LABELS, MOVING, PENDING, QUARANTINE, TrajectoryData, file_name, write_single
from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError, RunError
from mpmcli.extras import imported
from mpmcli.materials.registry import load_plugins
from mpmcli.output.checksums import path_digest
from mpmcli.output.durable import writing
from mpmcli.processes.pool import Fault, Workers
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.simulation.engine import Arch
from mpmcli.simulation.runner import Recording, Runner

# Number of retries of a trajectory, each with half the step of the previous run.
RETRIES = 2
# Trajectories that a worker draws before its first run, to determine the particle capacity.
LOOK_AHEAD = 32
# Tasks in flight per worker of a cluster: one being computed and one waiting.
AHEAD = 2
# Workers that a trajectory may lose before it counts as failed.
ATTEMPTS = 3
# Seconds between calls of `stop`.
PATIENCE = 0.2
_SETTINGS = {
    "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
    # A step of a large scene blocks the interpreter for longer than Dask expects.
    "distributed.admin.tick.limit": "1h",
    "distributed.comm.timeouts.connect": "30s",
    # Dask's profiler samples every thread a hundred times a second; its result is not used.
    "distributed.worker.profile.enabled": False,
}


@dataclass(frozen=True)
class Task:
    """Trajectories of the dataset in a directory, for a worker with this backend and plugin laws from files.

    sources: absolute path and digest of each file that scenes read. certified, imaged: the row of one trajectory in a
    shard, for which a certificate is computed, or whose images are drawn, instead.
    """

    directory: Path
    sweep: Sweep
    numbers: tuple[int, ...]
    arch: Arch = "auto"
    threads: int | None = 1
    plugins: tuple[Path, ...] = ()
    sources: tuple[tuple[Path, str], ...] = ()
    certified: Row | None = None
    imaged: Row | None = None


def compute(task: Task) -> list[Row]:
    """Compute trajectories, and return their rows for the manifest; RunError: a file could not be written.

    Taichi must stay in the thread that started it, but Dask's threads come and go.
    """
    return _thread().submit(_compute, task).result()


_thread = cache(partial(ThreadPoolExecutor, 1))
_kept = threading.local()


def _runner(task: Task) -> Runner:
    """Return the runner of this process, whose kernels are kept between tasks."""
    known = (task.sweep.key, task.arch, task.threads, task.plugins, task.sources)
    if getattr(_kept, "known", None) != known:
        for path, digest in task.sources:
            if not path.is_file() or path_digest(path) != digest:
                what = "another" if path.is_file() else "no"
                raise InputError(
                    f"{path}: a worker on {socket.gethostname()} finds {what} file there than the sweep has; let all "
                    "workers see the same files."
                )
        _kept.laws = load_plugins(task.plugins)
        _kept.runner = Runner(task.arch, task.threads)
        scenes = []
        for number in range(min(task.sweep.count, LOOK_AHEAD)):
            # A trajectory that cannot be drawn gets its row in its turn.
            with suppress(InputError):
                scenes.append(draw(task.sweep, number).scene(_kept.laws).scene)
        _kept.runner.expect(scenes)
        _kept.known = known
    return _kept.runner


@dataclass
class _Trial:
    """A trajectory in progress: its row as far as known, its draw, and its scene."""

    row: Row
    drawn: Draw
    scene: Scene


def _compute(task: Task) -> list[Row]:
    """Draw trajectories, run each until its verdict is accepted or no retry can change it, and store them."""
    if row := task.imaged:
        draw_images(task.directory, row, task.sweep)
        return [row]
    began = time.perf_counter()
    # A missing backend ends the sweep, not only a trajectory.
    runner = _runner(task)
    if row := task.certified:
        drawn = draw(task.sweep, row.number)
        scene = _with_step(drawn.scene(_kept.laws).scene, 0.5**row.retries)
        shard = task.directory / row.file
        write_certificate(task.directory, certify(scene, drawn.directory, _kept.laws, shard, row.number, runner))
        return [row]
    rows: dict[int, Row] = {}
    waiting: list[_Trial] = []
    for number in task.numbers:
        row = Row.failed(number, task.sweep.split_of(number))
        try:
            drawn = draw(task.sweep, number)
            row = replace(row, draws=json.dumps(drawn.values, sort_keys=True))
            loaded = drawn.scene(_kept.laws)
            if fault := scene_fault(loaded):
                raise InputError(fault)
        except Exception as error:
            rows[number] = _failed(row, error)
        else:
            waiting.append(_Trial(row, drawn, loaded.scene))
    retries = 0
    while waiting:
        scenes = [_with_step(trial.scene, 0.5**retries) for trial in waiting]
        ended: set[int] = set()
        for place, outcome in _runner(task).run_all(scenes):
            trial = waiting[place]
            now = time.perf_counter()
            # Trajectories computed together share the time equally.
            trial.row = replace(trial.row, seconds=trial.row.seconds + now - began)
            began = now
            if isinstance(outcome, Recording):
                accepted = outcome.verdict in ("stable", task.sweep.accept)
                if not accepted and outcome.of_step and retries < RETRIES:
                    continue
                try:
                    trial.row = _stored(task, trial.row, trial.drawn, scenes[place], outcome, retries, accepted)
                except RunError:
                    raise
                except Exception as error:
                    outcome = error
            ended.add(place)
            if isinstance(outcome, Exception):
                trial.row = _failed(trial.row, outcome)
            rows[trial.row.number] = trial.row
            if isinstance(outcome, Exception) and not isinstance(outcome, InputError):
                break
        else:
            retries += 1
        waiting = [trial for place, trial in enumerate(waiting) if place not in ended]
    return [rows[number] for number in task.numbers]


def _failed(row: Row, error: Exception) -> Row:
    """Return the row of a failed trajectory, so that others continue; after a fault of mpmcli, clear the device."""
    if isinstance(error, InputError):
        return replace(row, reason=str(error))
    _kept.known = None
    return replace(row, reason=f"{type(error).__name__}: {error} (a fault of mpmcli).")


def scene_fault(loaded: LoadedScene) -> str:
    """Return the first error that a check finds in a scene, "" if there is none."""
    return next((finding.what for finding in check_scene(loaded).findings if finding.severity == "error"), "")


def _with_step(scene: Scene, factor: float) -> Scene:
    if factor == 1:
        return scene
    step = scene.time.step if scene.time.step == "auto" else factor * scene.time.step
    shorter = scene.time.model_copy(update={"safety": factor * scene.time.safety, "step": step})
    return scene.model_copy(update={"time": shorter})


def _stored(task: Task, row: Row, drawn: Draw, scene: Scene, run: Recording, retries: int, accepted: bool) -> Row:
    """Write the frames of a run, if there are any, and return its row."""
    backend = run.header.backend
    drawn = replace(drawn, split=task.sweep.split_of(row.number, run.particles))
    file = checksum = ""
    if run.frames:
        folder = PENDING if accepted else QUARANTINE
        path = task.directory / folder / file_name(row.number)
        path.parent.mkdir(parents=True, exist_ok=True)
        with writing(f"trajectory {row.number}", to=path, faults=(RuntimeError,)):
            checksum = write_single(path, trajectory_data(drawn, run), compress=scene.output.compress)
        file = f"{folder}/{path.name}"
    facts = {name: getattr(run, name) for name in ("verdict", "reason", "steps", "particles")}
    facts |= {"arch": backend["arch"], "precision": backend["precision"], "file": file, "checksum": checksum}
    facts["split"] = drawn.split
    digest = hashlib.sha256(scene_to_toml(scene).encode()).hexdigest()
    return replace(row, scene=digest, accepted=int(accepted), retries=retries, frames=len(run.frames), **facts)


def trajectory_data(drawn: Draw, run: Recording) -> TrajectoryData:
    """Return the frames of a run, at least one, as arrays over time."""
    frames, first = run.frames, run.frames[0]
    return TrajectoryData(
        number=drawn.number,
        split=drawn.split,
        draws=drawn.values,
        header=run.header.stored,
        **{name: np.stack([getattr(frame, name) for frame in frames]) for name in MOVING},
        **{name: getattr(first, name) for name in LABELS},
        **{name: np.array([getattr(frame, name) for frame in frames]) for name in ("time", "step")},
        frame=np.array([frame.index for frame in frames]),
        ledger=run.ledger,
        fields={name: np.stack([frame.fields[name] for frame in frames]) for name in first.fields},
    )


class LocalWorkers:
    """Processes of this machine, `count`, that compute tasks in turn, over pipes that no other process can open."""

    def __init__(self, workers: Workers[Task]) -> None:
        self._workers, self.count = workers, workers.count

    def outcomes(self, tasks: Iterable[Task], stop: Callable[[], bool]) -> Iterator[tuple[Task, list[Row] | None]]:
        """Yield each task with its rows as it ends, None if no worker survived; RunError: a write failed.

        A task whose worker is killed is tried again, its trajectories one by one.
        """
        waiting, lost = deque(tasks), Counter[tuple[int, ...]]()
        for task, answer in self._workers.outcomes(waiting, stop):
            if isinstance(answer, Exception):
                raise answer
            if not isinstance(answer, Fault):
                yield task, answer
                continue
            lost[task.numbers] += 1
            if len(task.numbers) > 1:
                waiting.extendleft(replace(task, numbers=(number,)) for number in reversed(task.numbers))
            elif lost[task.numbers] < ATTEMPTS:
                waiting.appendleft(task)
            else:
                yield task, None


def _begin() -> Callable[[Task], list[Row]]:
    return _compute


@contextmanager
def local_workers(count: int) -> Iterator[LocalWorkers]:
    """Use workers on this machine, one process each; they end with the block."""
    with Workers(count, _begin) as workers:
        yield LocalWorkers(workers)


class ClusterWorkers:
    """Workers of a Dask cluster."""

    def __init__(self, client: object) -> None:
        self._client = client
        self.count = len(client.scheduler_info(n_workers=-1)["workers"])

    def outcomes(self, tasks: Iterable[Task], stop: Callable[[], bool]) -> Iterator[tuple[Task, list[Row] | None]]:
        """Yield each task as `LocalWorkers.outcomes` does; RunError: the cluster has ended."""
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
                # One of the trajectories kills its worker; separate attempts find it.
                yield from self.outcomes([replace(task, numbers=(number,)) for number in task.numbers], stop)
            else:
                yield task, None


SweepWorkers = LocalWorkers | ClusterWorkers


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Silence Dask, which logs a traceback for a closed connection even after the cluster has ended."""
    import dask

    for name in ("distributed", "distributed.client"):
        for handler in logging.getLogger(name).handlers:
            handler.setLevel(logging.CRITICAL)
    with dask.config.set(_SETTINGS):
        yield


@contextmanager
def joined_workers(address: str) -> Iterator[ClusterWorkers]:
    """Use the workers of a running scheduler; they must see the dataset at the same path.

    For addresses tls:// the certificates are those of Dask's configuration.
    """
    distributed = imported("distributed", "cluster", "--scheduler")
    with _quiet_dask():
        try:
            client = distributed.Client(address, timeout=10)
        except (OSError, ValueError) as error:
            raise InputError(f"--scheduler {address}: no scheduler answers there; give tcp://HOST:PORT.") from error
        with client:
            workers = ClusterWorkers(client)
            if workers.count == 0:
                raise InputError(f"--scheduler {address}: this scheduler has no worker; start dask worker {address}.")
            yield workers
