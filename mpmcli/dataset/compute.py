"""What a worker of a sweep does: draws trajectories, runs them, and stores each in a file of its own."""

import hashlib
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from mpmcli.check.finding import passes
from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.draw import Draw, draw
from mpmcli.dataset.manifest import Row
from mpmcli.dataset.paths import PENDING, QUARANTINE, file_name
from mpmcli.dataset.shard import TrajectoryData, checksum_of, stored_bytes, write_trajectory
from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError, RunError
from mpmcli.materials.registry import load_plugins
from mpmcli.output.durable import sealed
from mpmcli.output.file_checksum import append_checksum
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.simulation.engine import Arch
from mpmcli.simulation.recording import Recording
from mpmcli.simulation.runner import Runner

# Runs of a trajectory with half the step of the one before, after the first.
RETRIES = 2
# Trajectories that a worker draws before its first run, to know how many particles it needs room for.
LOOK_AHEAD = 32


@dataclass(frozen=True)
class Task:
    """Trajectories for a worker.

    Attributes:
        directory: of the dataset.
        numbers: of the trajectories.
        arch, threads: backend of each worker.
        plugins: files with further laws.
    """

    directory: Path
    sweep: Sweep
    numbers: tuple[int, ...]
    arch: Arch = "auto"
    threads: int | None = 1
    plugins: tuple[Path, ...] = ()


def compute(task: Task) -> list[Row]:
    """Compute trajectories, and return their rows for the manifest.

    Taichi belongs to the thread that started it, and Dask's threads come and go.

    Raises:
        RunError: a file could not be written.
    """
    return _thread().submit(_compute, task).result()


@cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1)


_kept = threading.local()


def _runner(task: Task) -> Runner:
    """Return the runner of this process, whose kernels outlive a task."""
    known = (task.sweep.key, task.arch, task.threads, task.plugins)
    if getattr(_kept, "known", None) != known:
        _kept.laws = load_plugins(task.plugins)
        _kept.runner = Runner(task.arch, task.threads)
        scenes = []
        for number in range(min(task.sweep.count, LOOK_AHEAD)):
            # One that cannot be drawn gets its row when its turn comes.
            with suppress(InputError):
                scenes.append(draw(task.sweep, number).scene(_kept.laws).scene)
        _kept.runner.expect(scenes)
        _kept.known = known
    return _kept.runner


@dataclass
class _Trial:
    """A trajectory under way: its row as far as known, its draw, and its scene."""

    row: Row
    drawn: Draw
    scene: Scene


def _compute(task: Task) -> list[Row]:
    """Draw trajectories, run each until its verdict is accepted or no retry is left, and store them."""
    began = time.perf_counter()
    # A backend that is not there ends the sweep, not a trajectory.
    _runner(task)
    rows: dict[int, Row] = {}
    waiting: list[_Trial] = []
    for number in task.numbers:
        row = Row.failed(number, task.sweep.split_of(number))
        try:
            drawn = draw(task.sweep, number)
            row = replace(row, draws=json.dumps(drawn.values, sort_keys=True))
            loaded = drawn.scene(_kept.laws)
            _require_sound(loaded)
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
            # Of several at once each has its share.
            trial.row = replace(trial.row, seconds=trial.row.seconds + now - began)
            began = now
            if isinstance(outcome, Recording):
                accepted = outcome.verdict in ("stable", task.sweep.accept)
                if not accepted and retries < RETRIES:
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
    """Return the row of a trajectory that has none, for want of a scene or by a fault.

    One trajectory must not end thousands. What a fault has left on the device is dropped.
    """
    if isinstance(error, InputError):
        return replace(row, reason=str(error))
    _kept.known = None
    return replace(row, reason=f"{type(error).__name__}: {error} (a fault of mpmcli).")


def _require_sound(loaded: LoadedScene) -> None:
    findings = check_scene(loaded).findings
    if not passes(findings):
        raise InputError(next(finding.what for finding in findings if finding.severity == "error"))


def _with_step(scene: Scene, factor: float) -> Scene:
    """Return a scene whose steps are shorter by a factor."""
    if factor == 1:
        return scene
    step = scene.time.step if scene.time.step == "auto" else factor * scene.time.step
    time_settings = scene.time.model_copy(update={"safety": factor * scene.time.safety, "step": step})
    return scene.model_copy(update={"time": time_settings})


def _stored(task: Task, row: Row, drawn: Draw, scene: Scene, run: Recording, retries: int, accepted: bool) -> Row:
    """Write the frames of a run, if there are any, and return its row."""
    backend = run.header.backend
    file, found = "", ""
    if run.frames:
        folder = PENDING if accepted else QUARANTINE
        path = task.directory / folder / file_name(row.number)
        path.parent.mkdir(parents=True, exist_ok=True)
        data = trajectory_data(drawn, run)
        try:
            with sealed(path, stored_bytes(data)) as temporary:
                with h5py.File(temporary, "w") as opened:
                    write_trajectory(opened, data, compress=scene.output.compress)
                append_checksum(temporary)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(f"trajectory {row.number} could not be written to {path} ({reason}).") from error
        file, found = f"{folder}/{path.name}", checksum_of(data)
    return replace(
        row,
        scene=hashlib.sha256(scene_to_toml(scene).encode()).hexdigest(),
        verdict=run.verdict,
        reason=run.reason,
        accepted=int(accepted),
        retries=retries,
        steps=run.steps,
        frames=len(run.frames),
        particles=run.particles,
        arch=backend["arch"],
        precision=backend["precision"],
        file=file,
        checksum=found,
    )


def trajectory_data(drawn: Draw, run: Recording) -> TrajectoryData:
    """Return the frames of a run, which has at least one, as arrays over time."""
    frames, first = run.frames, run.frames[0]
    return TrajectoryData(
        number=drawn.number,
        split=drawn.split,
        draws=drawn.values,
        header=run.header.stored,
        position=np.stack([frame.position for frame in frames]),
        velocity=np.stack([frame.velocity for frame in frames]),
        body=first.body,
        material=first.material,
        time=np.array([frame.time for frame in frames]),
        step=np.array([frame.step for frame in frames]),
        frame=np.array([frame.index for frame in frames]),
        ledger=run.ledger,
        fields={name: np.stack([frame.fields[name] for frame in frames]) for name in first.fields},
    )
