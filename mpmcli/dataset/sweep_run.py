"""Runs a sweep: makes or resumes its directory and sends missing trajectories to workers; or rehearses it."""

import math
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps, layout_of, seconds_of_one
from mpmcli.cores import available_cores
from mpmcli.dataset.certify import NAMES, certificates, certify_plan, cost_of_one, plan_text
from mpmcli.dataset.compute import SweepWorkers, Task, joined_workers, local_workers, scene_fault
from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import (
    MANIFEST,
    SHARD_BYTES,
    VERDICTS,
    Folder,
    Manifest,
    Row,
    copied_files,
    copy_sources,
    is_beginning,
    program,
    require_empty,
    require_same_program,
    source_digests,
    source_files,
    standing_alone,
)
from mpmcli.dataset.image_folder import image_faults, image_frames, images_plan, remove_images
from mpmcli.dataset.images import ImageCost, image_cost
from mpmcli.dataset.report import final_rows, remove_card, require_own_tables, write_card
from mpmcli.dataset.shard import BASE, CERTIFICATES, LABELS, NUMBERED, PENDING, QUARANTINE, SHARDS, SWEEP, file_name
from mpmcli.dataset.sweep import Sweep
from mpmcli.errors import InputError, RunError
from mpmcli.materials.registry import load_plugins
from mpmcli.output.checksums import path_digest
from mpmcli.output.durable import SPACE_MARGIN, remove_numbered, write_text
from mpmcli.output.lock import LOCK, refuse_locked, take_lock
from mpmcli.plain_text import counted, duration_text, size_text, text_table
from mpmcli.scene import Scene, estimate_particles
from mpmcli.scene.sampling import count_sources
from mpmcli.simulation.engine import Arch

# Trajectories from which the size of all is estimated.
SAMPLE = 16
# Bytes of a trajectory in addition to its arrays: headers of HDF5 and the scene; times and ledger of a frame.
HEADER_BYTES, FRAME_BYTES = 11_000, 200
# Largest number of trajectories of a task, and number of tasks per worker below which tasks become shorter.
TASK, GPU_TASK, ROUNDS = 8, 128, 8
# Trajectories after which no split is empty, unless its fraction is less than one trajectory.
SURE = 1000
# Reason of failure of a trajectory that killed every worker.
LOST = "every worker that computed it was killed, perhaps for lack of memory."
# Largest numbers of rows in the table of a rehearsal, and of faults below it.
MOST_ROWS, MOST_FAULTS = 20, 10


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep that are not part of its file.

    `workers` is the number of local processes, None for as many as cores have threads for, unless a Dask `scheduler` at
    an address has them; `part` (i, n) is every n-th shard from the i-th on; `overwrite` replaces a dataset that is
    there; arch and threads are for each worker, and small trajectories take one thread.
    """

    directory: Path
    workers: int | None = None
    scheduler: str = ""
    part: tuple[int, int] = (1, 1)
    resume: bool = False
    overwrite: bool = False
    arch: Arch = "auto"
    threads: int = 1
    plugins: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.resume and self.overwrite:
            raise InputError("--resume keeps an earlier dataset, and --overwrite removes it: give one of them.")

    @property
    def processes(self) -> int:
        """Number of processes on this machine."""
        return self.workers or max(1, available_cores() // self.threads)


@dataclass
class SweepState:
    """The progress of a sweep.

    Of `expected` trajectories, `kept` were done by an earlier command; counts, seconds and `particle_steps` are of this
    command. `settled` (done, seconds) is set when each worker has ended a task; before, kernels compile. The status is
    "running", "finished" or "interrupted".
    """

    directory: Path
    expected: int
    kept: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    accepted: int = 0
    particle_steps: float = 0.0
    seconds: float = 0.0
    start_seconds: float = 0.0
    settled: tuple[int, float] | None = None
    certified: int = 0
    imaged: int = 0
    status: str = "running"

    @property
    def done(self) -> int:
        """Trajectories that have a verdict."""
        return self.verdicts.total()

    @property
    def steady(self) -> bool:
        """Whether `per_hour` is without the compilation of kernels."""
        return self.settled is not None and self.done > self.settled[0]

    @property
    def per_hour(self) -> float:
        """Trajectories per hour of this command, counted since `settled` if set."""
        done, seconds = self.settled if self.steady else (self.kept, 0.0)
        return 3600 * (self.done - done) / (self.seconds - seconds) if self.seconds > seconds else 0.0

    def count(self, row: Row) -> None:
        """Count a row."""
        self.verdicts[row.verdict] += 1
        self.accepted += row.accepted

    def as_dict(self) -> dict:
        """Return it for JSON."""
        return {
            "status": self.status,
            "directory": str(self.directory),
            "trajectories": self.expected,
            **{name: getattr(self, name) for name in ("done", "kept", "accepted", "certified", "imaged")},
            "verdicts": {verdict: self.verdicts[verdict] for verdict in VERDICTS},
            **{name: getattr(self, name) for name in ("per_hour", "seconds", "start_seconds", "particle_steps")},
        }


@contextmanager
def taken_folder(sweep: Sweep, settings: SweepSettings) -> Iterator[tuple[Folder, Manifest]]:
    """Make or open a dataset's directory and lock it: only one process writes manifest and shards."""
    directory = settings.directory
    if directory.is_dir():
        refuse_locked(directory)
        if settings.resume:
            with take_lock(directory):
                yield open_folder(sweep, settings)
            return
    with ExitStack() as held:
        yield open_folder(sweep, settings, lambda: held.enter_context(take_lock(directory)))


def open_folder(
    sweep: Sweep, settings: SweepSettings, take: Callable[[], object] = lambda: None
) -> tuple[Folder, Manifest]:
    """Make or resume a dataset's directory; call `take` before the first file; InputError: it is unsuitable."""
    directory = settings.directory
    manifest = Manifest(directory)
    require_own_tables(directory)
    if settings.resume and (directory / MANIFEST).exists():
        facts = manifest.facts()
        i, n = facts["part"]
        if facts["key"] != sweep.key:
            raise InputError(
                f"{directory} holds the dataset of another sweep, or of another count: give another directory with "
                f"-o, or go on with the sweep {directory / SWEEP}."
            )
        if (i, n) != settings.part:
            raise InputError(f"{directory} holds part {i}/{n} of the sweep; resume it with --shard {i}/{n}.")
        now, plan = source_digests(sweep, settings.plugins), images_plan(sweep)
        if facts.get("images") not in (None, plan):
            raise InputError(
                f"{directory} has images of another [images] than the sweep: put that table back as it was, or give "
                "another directory with -o."
            )
        before = facts["files"]
        if plan and "images" not in facts:
            before = {name: digest for name, digest in now.items() if name == plan["cameras"]} | before
        if changed := sorted(name for name in {*before, *now} if before.get(name) != now.get(name)):
            raise InputError(
                f"{changed[0]} has changed since {directory} was begun, which cannot be resumed with it: put it back "
                "as it was, or give another directory with -o."
            )
        require_same_program(directory, facts, manifest.rows(), {**program(), "arch": settings.arch})
        if sweep.certify or sweep.images:
            write_text(directory / SWEEP, standing_alone(sweep))
        if sweep.certify:
            manifest.tell("certify", certify_plan(sweep))
        if plan:
            copy_sources(source_files(sweep, ()), directory)
            for name, told in (("images", plan), ("files", now)):
                manifest.tell(name, told)
        return Folder(directory, sweep.count, facts["per_shard"], settings.part), manifest
    replaces = settings.overwrite and directory.is_dir() and any(path.name != LOCK for path in directory.iterdir())
    if replaces and not (directory / MANIFEST).exists():
        raise InputError(f"{directory} holds no dataset, and --overwrite replaces nothing else.")
    if not replaces and (directory / MANIFEST).exists():
        raise InputError(f"{directory} holds a dataset: --resume goes on with it, and --overwrite replaces it.")
    if not (replaces or (settings.resume and is_beginning(directory))):
        require_empty(directory)
    earlier = manifest.facts().get("files", {}) if replaces else {}
    texts, digests = {SWEEP: standing_alone(sweep), BASE: sweep.base_text}, source_digests(sweep, settings.plugins)
    _spare_files(sweep, directory, texts, digests, earlier)
    size = _bytes_of_trajectories(sweep, settings)
    per_shard = _per_shard(size)
    folder = Folder(directory, sweep.count, per_shard, settings.part)
    if not folder.expected:
        i, n = settings.part
        shards = math.ceil(sweep.count / per_shard)
        raise InputError(f"--shard {i}/{n} is empty: {sweep.count} trajectories fill {counted(shards, 'shard')}.")
    if sweep.images:
        laws = load_plugins(settings.plugins)
        frames = len(image_frames(sweep, draw(sweep, 0).scene(laws).scene))
        size += image_cost(sweep, laws).bytes * frames
    # While a shard is sealed, its trajectories are on disk twice.
    needed = size * folder.expected + SHARD_BYTES + SPACE_MARGIN
    free = shutil.disk_usage(next(p for p in (directory, *directory.resolve().parents) if p.exists())).free
    if replaces:
        free += sum(path.stat().st_size for name in (SHARDS, QUARANTINE) for path in (directory / name).glob("*.h5"))
    if needed > free:
        raise InputError(
            f"the disk of {directory} has {size_text(free)} left, but the dataset needs about {size_text(needed)}: "
            "give another place with -o, or a smaller --count."
        )
    directory.mkdir(parents=True, exist_ok=True)
    take()
    if replaces:
        # Last, because it cannot be undone; the manifest of the removed dataset stays until that of the new one comes.
        _remove_trajectories(directory, earlier, _inputs(sweep))
    elif not settings.resume:
        # Another sweep may have started and ended meanwhile.
        require_empty(directory, locked=True)
    facts = {"key": sweep.key, "count": sweep.count, "seed": sweep.seed, "accept": sweep.accept, "files": digests}
    facts |= {"hold_out": sweep.split.rules} if sweep.split.rules else {}
    facts |= {"certify": certify_plan(sweep)} if sweep.certify else {}
    facts |= {"images": images_plan(sweep)} if sweep.images else {}
    for name, text in texts.items():
        write_text(directory / name, text)
    manifest.create({**facts, "per_shard": per_shard, "part": list(settings.part), **program()})
    copy_sources(source_files(sweep, settings.plugins), directory)
    return folder, manifest


def _inputs(sweep: Sweep) -> set[Path]:
    """Return the files that a sweep reads, which are neither changed nor removed."""
    return {path.resolve() for path in (sweep.path, sweep.base, *source_files(sweep, ()).values())}


def _spare_files(
    sweep: Sweep, directory: Path, texts: Mapping[str, str], digests: Mapping[str, str], earlier: Mapping[str, str]
) -> None:
    """Refuse a directory with a file that the new dataset would change, other than copies of the `earlier` one."""
    inputs = _inputs(sweep)
    for name, text in texts.items():
        path = directory / name
        if path.resolve() in inputs and path.read_text(encoding="utf-8") != text:
            raise InputError(f"{path} is read by this sweep, which would change it: give another directory with -o.")
    for name in copied_files(digests):
        path, known = directory / name, (earlier.get(name), digests[name])
        if path.exists() and path.resolve() not in inputs and path_digest(path) not in known:
            raise InputError(f"{path} would be replaced by a file of the sweep: give another directory with -o.")


def _remove_trajectories(directory: Path, copied: Mapping[str, str], spared: Collection[Path]) -> None:
    """Remove the files of a dataset but its manifest and sweep, and unchanged copies of files by name and digest."""
    remove_card(directory)
    for name in (PENDING, QUARANTINE, SHARDS):
        remove_numbered(directory / name, NUMBERED)
    remove_numbered(directory / CERTIFICATES, NAMES)
    remove_images(directory)
    for name in copied_files(copied):
        path = directory / name
        if path.is_file() and path.resolve() not in spared and path_digest(path) == copied[name]:
            path.unlink()
            for parent in list(Path(name).parents)[:-1]:
                with suppress(OSError):
                    (directory / parent).rmdir()


def discard_beginning(sweep: Sweep, directory: Path, made: Sequence[Path]) -> None:
    """Remove a dataset without finished trajectories, and the directories `made` for it, outermost first."""
    manifest, inputs = Manifest(directory), _inputs(sweep)
    if not manifest.path.exists() or manifest.rows():
        return
    with take_lock(directory):
        _remove_trajectories(directory, manifest.facts().get("files", {}), inputs)
        for path in (directory / name for name in (SWEEP, BASE, MANIFEST)):
            if path.resolve() not in inputs:
                path.unlink(missing_ok=True)
    for path in reversed(made):
        with suppress(OSError):
            path.rmdir()


def trajectory_bytes(scene: Scene, particles: int) -> int:
    """Return the bytes of a trajectory without compression."""
    arrays = [array for name, array in layout_of(scene).arrays.items() if name not in ("id", *LABELS)]
    each = sum(np.dtype(array.dtype).itemsize * math.prod(array.shape) for array in arrays)
    return (scene.time.frames + 1) * (particles * each + FRAME_BYTES) + HEADER_BYTES


def _per_shard(size: float) -> int:
    return max(1, math.floor(SHARD_BYTES / size))


def _bytes_of_trajectories(sweep: Sweep, settings: SweepSettings) -> float:
    """Return the mean bytes of a trajectory without compression, from the first trajectories that can be drawn."""
    laws = load_plugins(settings.plugins)
    sizes, fault = [], None
    for number in range(min(SAMPLE, sweep.count)):
        try:
            scene = draw(sweep, number).scene(laws).scene
            sizes.append(trajectory_bytes(scene, estimate_particles(scene)))
        except InputError as error:
            fault = error
    if not sizes:
        raise fault
    return sum(sizes) / len(sizes)


def run_sweep(
    sweep: Sweep,
    settings: SweepSettings,
    on_progress: Callable[[SweepState], None] = lambda state: None,
    stop: Callable[[], bool] = lambda: False,
) -> SweepState:
    """Compute the missing trajectories of a sweep; the files do not depend on workers, their order, or interrupts.

    `on_progress` is called after each task; `stop` is called often, and True ends the sweep. InputError, nothing
    written: directory, settings or disk are unsuitable. RunError: a file could not be written; finished trajectories
    are kept.
    """
    began = time.perf_counter()
    with ExitStack() as stack:
        # Without a scheduler nothing is written.
        joined = stack.enter_context(joined_workers(settings.scheduler)) if settings.scheduler else None
        run = _Run(sweep, settings, *stack.enter_context(taken_folder(sweep, settings)))
        run.seal_complete(run.folder.shards)
        try:
            run.compute_missing(joined, began, on_progress, stop)
            if settings.part == (1, 1):
                write_card(settings.directory)
            remove_numbered(settings.directory / PENDING, NUMBERED)
            run.state.status = "finished"
        except KeyboardInterrupt:
            run.state.status = "interrupted"
        return run.state


class _Run:
    """Enters rows into the manifest, and seals each shard after its last row."""

    def __init__(self, sweep: Sweep, settings: SweepSettings, folder: Folder, manifest: Manifest) -> None:
        self.sweep, self.folder, self.manifest = sweep, folder, manifest
        self.rows = {row.number: row for row in final_rows(folder.path, manifest.rows())}
        # A dataset is computed on one backend, that of its first trajectories.
        arch = next((row.arch for row in self.rows.values() if row.arch), settings.arch)
        self.settings = replace(settings, arch=arch)
        self.state = SweepState(settings.directory, folder.expected, len(self.rows))
        for row in self.rows.values():
            self.state.count(row)

    def compute_missing(
        self,
        joined: SweepWorkers | None,
        began: float,
        on_progress: Callable[[SweepState], None],
        stop: Callable[[], bool],
    ) -> None:
        """Compute trajectories without a row, then certificates and images; `began` is when the sweep began, s."""
        state, missing = self.state, [n for n in self.folder.all_numbers() if n not in self.rows]
        chosen = {*certify_plan(self.sweep)["numbers"]} - certificates(self.folder.path)[0].keys()
        chosen &= {n for n in self.folder.all_numbers() if n not in self.rows or self.rows[n].accepted}
        drawn: set[int] = set()
        if self.sweep.images:
            drawn = {*missing, *image_faults(self.folder.path, self.rows.values())}
        if not missing and not chosen and not drawn:
            return
        count = min(self.settings.processes, max(len(missing), len(chosen), len(drawn)))
        with nullcontext(joined) if joined else local_workers(count) as workers:
            since = time.perf_counter()
            state.start_seconds = since - began
            outcomes = workers.outcomes(_tasks(self.sweep, self.settings, missing, workers.count), stop)
            for ended, (task, found) in enumerate(outcomes, 1):
                self.take(found or [Row.failed(n, self.sweep.split_of(n), LOST) for n in task.numbers])
                state.seconds = time.perf_counter() - since
                if ended == workers.count:
                    state.settled = state.done, state.seconds
                on_progress(state)
            for _, found in workers.outcomes(self._later_tasks(chosen, "certified"), stop):
                state.certified += found is not None
                on_progress(state)
            for task, found in workers.outcomes(self._later_tasks(drawn, "imaged"), stop):
                if found is None:
                    raise RunError(f"The images of trajectory {task.numbers[0]} could not be drawn: {LOST}")
                state.imaged += 1
                on_progress(state)

    def _later_tasks(self, numbers: Collection[int], key: str) -> list[Task]:
        """Return a task for each included trajectory of some, with its row as `key` of the task."""
        # The largest first: the device is allocated once.
        rows = sorted((self.rows[n] for n in numbers if self.rows[n].accepted), key=lambda row: -row.particles)
        tasks = _tasks(self.sweep, self.settings, [row.number for row in rows], max(1, len(rows)))
        return [replace(task, **{key: row}) for task, row in zip(tasks, rows, strict=True)]

    def take(self, rows: Sequence[Row]) -> None:
        self._put(rows)
        self.seal_complete(sorted({row.number // self.folder.per_shard for row in rows}))
        for row in rows:
            self.state.count(row)
            self.state.particle_steps += row.particles * row.steps

    def seal_complete(self, shards: Sequence[int]) -> None:
        for shard in shards:
            rows = [self.rows.get(number) for number in self.folder.numbers(shard)]
            if None in rows or all(row.file == self.folder.shard_file(shard) for row in rows if row.accepted):
                continue
            changed = self.folder.seal(shard, self.rows)
            self._put(changed)
            # They are in the shard now.
            for row in changed:
                (self.folder.path / PENDING / file_name(row.number)).unlink(missing_ok=True)

    def _put(self, rows: Sequence[Row]) -> None:
        self.manifest.put(rows)
        self.rows.update((row.number, row) for row in rows)


def _tasks(sweep: Sweep, settings: SweepSettings, numbers: Sequence[int], workers: int) -> list[Task]:
    """Split the work into tasks of several trajectories, to reduce the cost of sending, but enough for all workers."""
    # A GPU computes the trajectories of a task together.
    most = GPU_TASK if settings.arch not in ("auto", "cpu") else TASK
    size = max(1, min(most, len(numbers) // (ROUNDS * workers)))
    directory = settings.directory.resolve()
    plugins = tuple(path.resolve() for path in settings.plugins)
    # A worker may have another working directory with a file of the same name.
    sweep = replace(sweep, base=sweep.base.absolute())
    sources = tuple((path, path_digest(path)) for path in source_files(sweep, plugins).values())
    return [
        Task(directory, sweep, tuple(numbers[i : i + size]), settings.arch, settings.threads, plugins, sources)
        for i in range(0, len(numbers), size)
    ]


@dataclass(frozen=True)
class Rehearsed:
    """One trajectory: values by key, counts, bytes without compression, seconds, and its fault, if any.

    Seconds are those of one thread from the table of costs, 0 if the trajectory cannot be computed; `certify_seconds`
    those of its siblings, 0 if it has none; `image_frames` the number of frames with images.
    """

    number: int
    split: str
    values: dict[str, Any]
    particles: int
    steps: int
    bytes: int
    seconds: float
    fault: str
    certify_seconds: float = 0.0
    image_frames: int = 0


@dataclass(frozen=True)
class Rehearsal:
    """Trajectories of a part, number of workers, splits without any, `plan_text` if certified, and cost of images."""

    trajectories: tuple[Rehearsed, ...]
    workers: int
    empty: tuple[str, ...] = ()
    plan: str = ""
    image_cost: ImageCost | None = None

    @property
    def passes(self) -> bool:
        """Whether every trajectory can be computed."""
        return not any(one.fault for one in self.trajectories)

    @property
    def bytes(self) -> int:
        """Bytes of the dataset, its shards without compression."""
        return round(sum(one.bytes for one in self.trajectories) + self._images("bytes"))

    def _images(self, what: str) -> float:
        """Return the bytes, or the seconds of one worker, of all images."""
        of_one = getattr(self.image_cost, what, 0.0)
        return of_one * sum(one.image_frames for one in self.trajectories)

    @property
    def seconds(self) -> float | None:
        """Expected wall time, None if no trajectory can be computed."""
        computed = sum(one.seconds + one.certify_seconds for one in self.trajectories)
        return (computed + self._images("seconds")) / self.workers or None

    def as_dict(self) -> dict:
        """Return it for JSON."""
        whole = {"ok": self.passes, "trajectories": [vars(one) for one in self.trajectories], "bytes": self.bytes}
        images = {f"image_{what}": self._images(what) for what in ("bytes", "seconds")}
        return {**whole, "seconds": self.seconds, "workers": self.workers, "certify": self.plan, **images}

    def text(self) -> str:
        """Return it as text: the first draws, the faults, and the forecast."""
        shown = self.trajectories[:MOST_ROWS]
        keys = list(dict.fromkeys(key for one in shown for key in one.values))
        rows = []
        for one in shown:
            values = (_short(one.values.get(key)) for key in keys)
            rows.append((str(one.number), one.split, *values, f"{one.particles:,}", f"{one.steps:,}"))
        names = [key.removeprefix("bodies.") for key in keys]
        lines = [text_table(("number", "split", *names, "particles", "steps"), rows, {1})]
        if len(self.trajectories) > MOST_ROWS:
            lines.append(f"and {len(self.trajectories) - MOST_ROWS} more; --json lists all")
        faults = [one for one in self.trajectories if one.fault]
        lines += [f"error: trajectory {one.number}: {one.fault}" for one in faults[:MOST_FAULTS]]
        if len(faults) > MOST_FAULTS:
            lines.append(f"error: {len(faults) - MOST_FAULTS} more cannot be computed; --json has the reasons")
        time_text = "" if self.seconds is None else f", about {duration_text(self.seconds)}"
        total, workers = counted(len(self.trajectories), "trajectory"), counted(self.workers, "worker")
        lines += [f'note: no trajectory is in the split "{name}": raise count' for name in self.empty]
        if self.plan:
            more, every = (
                sum(getattr(one, name) for one in self.trajectories) for name in ("certify_seconds", "seconds")
            )
            numbers = ", ".join(str(one.number) for one in self.trajectories if one.certify_seconds) or "none here"
            share = f"about {duration_text(more)}, {more / (every or 1.0):.0%} of the time of the trajectories"
            lines.append(f"certify: {self.plan}: {numbers}; {share}")
        if self.image_cost:
            lines += [f"note: {note}" for note in self.image_cost.notes]
            frames, size = sum(one.image_frames for one in self.trajectories), size_text(self._images("bytes"))
            each = duration_text(self._images("seconds") / self.workers)
            lines.append(f"images: of {counted(frames, 'frame')}, {size}, about {each} in the workers")
        lines.append(f"{total}: {size_text(self.bytes)}{time_text} with {workers}, compilation apart")
        return "\n".join(lines)


def rehearse(sweep: Sweep, settings: SweepSettings) -> Rehearsal:
    """Draw and check the trajectories of a part, and forecast their cost; InputError: none can be drawn."""
    laws = load_plugins(settings.plugins)
    per_shard = _per_shard(_bytes_of_trajectories(sweep, settings))
    folder = Folder(settings.directory, sweep.count, per_shard, settings.part)
    found, plan, cost = [], certify_plan(sweep), image_cost(sweep, laws) if sweep.images else None
    for number in folder.all_numbers():
        values, fault, counts, frames = {}, "", (0, 0, 0, 0.0), 0
        try:
            drawn = draw(sweep, number)
            values = drawn.values
            loaded = drawn.scene(laws)
            fault, particles = scene_fault(loaded), sum(count_sources(loaded.scene))
            steps = expected_steps(SceneFacts(loaded.scene))
            seconds = 0.0 if fault else seconds_of_one(loaded.scene, steps)
            counts = particles, steps, trajectory_bytes(loaded.scene, particles), seconds
            frames = len(image_frames(sweep, loaded.scene)) if cost else 0
        except InputError as error:
            fault = str(error)
        siblings = counts[-1] * cost_of_one(sweep) if number in plan["numbers"] else 0.0
        found.append(
            Rehearsed(number, sweep.split_of(number, counts[0] or None), values, *counts, fault, siblings, frames)
        )
    used = {sweep.split_of(number) for number in range(min(sweep.count, SURE))}
    empty = tuple(name for name, share in sweep.split.shares.items() if share > 0 and name not in used)
    text = plan_text(sweep.count, **plan) if sweep.certify else ""
    return Rehearsal(tuple(found), settings.processes, empty, text, cost)


def _short(value: Any) -> str:
    """Write a drawn value with few digits, or the number of placed bodies."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return str(len(value))
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
