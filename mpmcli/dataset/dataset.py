"""Reads a dataset: its trajectories by number, with arrays that are read on access, and windows of their frames."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.report import MOST_NAMED, status_of
from mpmcli.dataset.shard import (
    IMAGES,
    LABELS,
    MOVING,
    SHARDS,
    SPLITS,
    SWEEP,
    TABLES,
    StoredGroup,
    group_name,
    moving_names,
    open_shard,
)
from mpmcli.errors import InputError
from mpmcli.frames.frame import ACTIVE, RETIRED, STATUS, WAITING, Frame
from mpmcli.frames.ledger import Ledger
from mpmcli.output import Result, open_result
from mpmcli.output.collider_files import as_they_moved
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import PACKED, SEGMENTS, FrameLayout
from mpmcli.output.run_record import RECORD
from mpmcli.plain_text import counted
from mpmcli.render.settings import IMAGE_DIRECTORY
from mpmcli.scene.colliders import Collider
from mpmcli.scene.problem import listed, quoted

if TYPE_CHECKING:
    from mpmcli.render.image_files import CameraMatrices

Particles = slice | np.ndarray
ALL = slice(None)
# Trajectories whose tables and labels a process keeps.
KEPT = 64


class Trajectory(ABC):
    """T frames of the same N particles. No file stays open, so that it can be copied to other processes.

    Attributes:
        number: number in the dataset; split: "train", "valid" or "test". draws: drawn values, by the key of the scene.
        header: facts about the run.
        times: (T,) float64, s.
        steps, frames: (T,) int64, time steps since the start, and number of each frame in its run.
        particle_count: N; field_names: names of the further arrays.
    """

    number: int
    split: str
    draws: dict[str, Any]
    header: RunHeader
    times: np.ndarray
    steps: np.ndarray
    frames: np.ndarray
    particle_count: int
    field_names: tuple[str, ...]
    _image_directory: Path

    def __repr__(self) -> str:
        end = f"{self.times[-1]:.4g} s" if len(self.times) else "its start"
        counts = f"{counted(self.frame_count, 'frame')} to {end}, {counted(self.particle_count, 'particle')}"
        return f"<Trajectory {self.number} ({self.split}): {', '.join((counts, *self.field_names))}>"

    @property
    def colliders(self) -> tuple[Collider, ...]:
        """The known colliders."""
        return as_they_moved(self.header.colliders, self)

    @property
    def frame_count(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @property
    def position(self) -> np.ndarray:
        """(T, N, d), m; each access reads the file."""
        return self.read("position")

    @property
    def velocity(self) -> np.ndarray:
        """(T, N, d), m/s; each access reads the file."""
        return self.read("velocity")

    @property
    def body(self) -> np.ndarray:
        """(N,) int32, index into the bodies of the header."""
        return self.read("body")

    @property
    def material(self) -> np.ndarray:
        """(N,) int32, index into the laws of the header."""
        return self.read("material")

    def field(self, name: str) -> np.ndarray:
        """Read a field, (T, N) or (T, N, ...); errors are those of `read`."""
        return self.read(name)

    def read(self, name: str, frames: slice = ALL, particles: Particles = ALL) -> np.ndarray:
        """Read some frames of some particles of an array.

        Args:
            name: "position", "velocity", a field, or "body" or "material", for which `frames` is ignored.
            frames: a slice with a positive step.
            particles: a slice, or indices.

        Returns:
            (frames, particles, ...) in the type of the file; (particles,) of "body" and "material".

        Raises:
            InputError: there is no such array, or the file is missing or damaged.
        """
        if name not in (*MOVING, *LABELS, *self.field_names):
            known = ", ".join(self.field_names) or "none"
            raise InputError(f'trajectory {self.number} holds no field "{name}": its fields are {known}.')
        array = self._read(name, frames)
        return array[particles] if name in LABELS else array[:, particles]

    @property
    def cameras(self) -> dict[str, "CameraMatrices"]:
        """The matrices of the cameras of the images by name; each access reads the file; InputError: there are none."""
        from mpmcli.render.image_files import read_matrices

        return read_matrices(self._image_directory)[0]

    def images(self, camera: str, what: str, frames: Iterable[int] | None = None) -> np.ndarray:
        """Read images of one of `cameras`: "rgb", "depth", "mask", "flow" or "normal".

        `frames` are F of the numbers `cameras[camera].frames`; by default all with such an image, as the last frame of
        a run has no flow. rgb is (F, h, w, 3) uint8; depth (F, h, w) float32, m, inf for nothing; mask (F, h, w) uint8
        or uint16; flow (F, h, w, 2) float16, pixels to the right and down; normal (F, h, w, 3) float16. InputError:
        there is no such camera, image or frame, or a file is missing or damaged.
        """
        from mpmcli.render.image_files import file_of, read_image, read_matrices

        cameras, held = read_matrices(self._image_directory)
        for key, word, known in (("camera", camera, cameras), ("kind of image", what, held)):
            if word not in known:
                it = f"the images of trajectory {self.number}"
                raise InputError(f'{it} have no {key} "{word}": give {listed(quoted(list(known)))}.')
        there = [n for n in cameras[camera].frames.tolist() if what != "flow" or n != self.frames[-1]]
        chosen = there if frames is None else list(frames)
        if not chosen or not {*chosen} <= {*there}:
            which = next((f"of frame {n}" for n in chosen if n not in there), "of no frame")
            raise InputError(f'trajectory {self.number} has no "{what}" {which}: it has those of frames {there}.')
        return np.stack([read_image(file_of(self._image_directory, camera, what, n), what) for n in chosen])

    def layout(self) -> FrameLayout:
        """Return names, types and shapes of the arrays of a frame."""
        first = slice(0, 1)
        position, velocity = (self.read(name, first)[0] for name in MOVING)
        fields = {name: self.read(name, first)[0] for name in self.field_names}
        return FrameLayout.of(Frame(0, 0.0, 0, position, velocity, self.body, self.material, fields))

    @property
    @abstractmethod
    def ledger(self) -> Ledger:
        """T rows; each access reads the file."""

    @abstractmethod
    def _read(self, name: str, frames: slice) -> np.ndarray:
        """Read some frames of all particles of an existing array."""


class StoredTrajectory(Trajectory):
    """A trajectory in a shard."""

    def __init__(self, shard: Path, number: int) -> None:
        self._shard = shard
        self._image_directory = shard.parent.parent / IMAGES / group_name(number)
        with open_shard(shard) as file:
            stored = StoredGroup(file, number)
            self.number, self.split = number, str(stored.attribute("split"))
            self.draws = stored.attribute("draws")
            self.header = RunHeader.read(stored.attribute("header"))
            self.times, self.steps, self.frames = (stored.table(name) for name in TABLES)
            self.field_names = tuple(name for name in moving_names(stored.group) if name not in MOVING)
            self.particle_count = stored.group["position"].shape[1]

    @property
    def ledger(self) -> Ledger:
        with open_shard(self._shard) as file:
            return StoredGroup(file, self.number).ledger()

    def _read(self, name: str, frames: slice) -> np.ndarray:
        with open_shard(self._shard) as file:
            stored = StoredGroup(file, self.number)
            return stored.table(name) if name in LABELS else stored.frames(name, frames)


class _ResultTrajectory(Trajectory):
    def __init__(self, result: Result) -> None:
        """Take a result as trajectory 0. Raises InputError if its particles change in number, or frames are missing."""
        counts = result.particle_counts
        if counts.min() != counts.max() and not result.header.drops:
            raise InputError(
                f"{result.path} has frames of {counts.min()} to {counts.max()} particles: "
                "a trajectory has the same ones in all frames."
            )
        if result.kind == "segments":
            told = (result.record or {}).get("frames_written")
            written = told if isinstance(told, int) else 0
            # A running simulation may have sealed further frames after they were listed.
            count = result.frame_count if result.frame_count >= written else open_result(result.path).frame_count
            if not np.array_equal(result.numbers, np.arange(len(result.numbers))) or count < written:
                raise InputError(
                    f"{result.path} lacks some of its frames: mpmcli simulate --resume computes them again."
                )
        self._result = result
        self._image_directory = result.directory / IMAGE_DIRECTORY
        self.number, self.split, self.draws = 0, SPLITS[0], {}
        self.header = result.header
        self.times, self.frames = result.times, result.numbers
        self.steps = np.cumsum([row.steps for row in result.ledger])
        self.particle_count = int(counts[0])
        self.field_names = result.field_names

    @property
    def colliders(self) -> tuple[Collider, ...]:
        return self._result.colliders

    @property
    def ledger(self) -> Ledger:
        return self._result.ledger

    def _read(self, name: str, frames: slice) -> np.ndarray:
        if name in LABELS:
            return self._array(name, 0)
        chosen = range(self.frame_count)[frames]
        return np.stack([self._array(name, k) for k in chosen]) if chosen else self._array(name, 0)[None][:0]

    def _array(self, name: str, k: int) -> np.ndarray:
        """Read an array of the k-th frame."""
        return _array_of(self._result.frame(k, [name] if name in self.field_names else []), name)


def _array_of(frame: Frame, name: str) -> np.ndarray:
    return frame.fields[name] if name in frame.fields else getattr(frame, name)


class _PresentTrajectory(_ResultTrajectory):
    """A result with only the particles present: row i is that of id i, and zeros where it is absent, but for places.

    A particle that waits is where it is first seen, and one that has gone where it is last seen.
    """

    def __init__(self, result: Result) -> None:
        """Read all frames once, for the first and the last frame of each id, its places there and its labels."""
        super().__init__(result)
        n = self.particle_count = 1 + max(int(frame.id.max(initial=-1)) for frame in result.frames([]))
        self._first, self._last = np.full(n, self.frame_count), np.full(n, -1)
        self._ends = np.zeros((2, n, result.dimension))
        self._labels = {name: np.zeros(n, np.int32) for name in LABELS}
        for k, frame in enumerate(result.frames([])):
            new = self._first[frame.id] > k
            self._first[frame.id[new]], self._last[frame.id] = k, k
            self._ends[0, frame.id[new]], self._ends[1, frame.id] = frame.position[new], frame.position
            for name, labels in self._labels.items():
                labels[frame.id] = getattr(frame, name)

    def _array(self, name: str, k: int) -> np.ndarray:
        """Return an array of frame k with a row for each id; `status` tells which particles are absent."""
        if name in LABELS:
            return self._labels[name]
        frame = self._result.frame(k, [name] if name in self.field_names else [])
        own, gone = _array_of(frame, name), self._last < k
        whole = np.zeros((self.particle_count, *own.shape[1:]), own.dtype)
        if name == "position":
            whole[:] = np.where(gone[:, None], self._ends[1], self._ends[0])
        elif name == STATUS:
            whole[:] = np.where(gone, RETIRED, WAITING)
        whole[frame.id] = own
        return whole


class Dataset:
    """Trajectories by number, made by `open_dataset`; iteration yields all of them in the order of their numbers.

    No file stays open, so that it can be copied to the workers of a data loader.

    Attributes:
        path: path as given. numbers: numbers of the trajectories, ascending.
        splits: the numbers of each split, by "train", "valid" and "test".
        missing: numbers that the manifest neither excludes nor the shards hold.
    """

    def __init__(
        self, path: Path, splits: dict[int, str], source: dict[int, Path] | Result, missing: tuple[int, ...] = ()
    ) -> None:
        self.path, self.missing = path, missing
        self.numbers = tuple(sorted(splits))
        self.splits = {split: tuple(n for n in self.numbers if splits[n] == split) for split in SPLITS}
        self._known = frozenset(splits)
        self._source = source

    @property
    def lack(self) -> str:
        """A sentence that names the missing trajectories, "" if there are none."""
        if not self.missing:
            return ""
        named = ", ".join(map(str, self.missing[:MOST_NAMED])) + ", ..." * (len(self.missing) > MOST_NAMED)
        count = counted(len(self.missing), "trajectory")
        return f"{self.path} lacks {count} of its sweep ({named}): mpmcli sweep --resume computes them."

    @cached_property
    def error(self) -> dict[str, Any] | None:
        """How wrong the simulator is, see `certify.error_of`; None without [certify] in the sweep."""
        return Manifest(self.path).facts().get("error") if (self.path / MANIFEST).exists() else None

    def __len__(self) -> int:
        return len(self.numbers)

    def __repr__(self) -> str:
        counts = ", ".join(f"{split} {len(numbers)}" for split, numbers in self.splits.items() if numbers)
        return f"<Dataset {self.path}: {counted(len(self), 'trajectory')} ({counts})>"

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[number] for number in self.numbers)

    def __getitem__(self, number: int) -> Trajectory:
        """Return a trajectory, whose arrays are read on access; InputError: there is none, or its shard is damaged."""
        if number not in self._known:
            first, last = self.numbers[0], self.numbers[-1]
            held = f"{len(self)}, from {first} to {last}" if len(self) > 1 else f"number {first} only"
            raise InputError(f"{self.path} has no trajectory {number}: it holds {held}.")
        if isinstance(self._source, Result):
            return (_PresentTrajectory if self._source.header.drops else _ResultTrajectory)(self._source)
        return StoredTrajectory(self._source[number], number)

    @cached_property
    def frame_counts(self) -> dict[int, int]:
        """The number of frames of each trajectory, by its number."""
        if isinstance(self._source, Result):
            return {0: self._source.frame_count}
        found = {}
        for shard in sorted({*self._source.values()}):
            with open_shard(shard) as file:
                found |= {int(group.attrs["number"]): len(group["time"]) for group in file.values()}
        return found

    def windows(
        self, split: str = "train", past: int = 6, future: int = 1, stride: int = 1, fields: Sequence[str] = ()
    ) -> "Windows":
        """Return all windows of consecutive frames of a split, a sequence as data loaders take it.

        Args:
            split: "train", "valid" or "test".
            past, future: numbers of frames of a window that are input and target.
            stride: number of stored frames from one frame of a window to the next; a window begins at every frame.
            fields: further arrays of the past frames, "velocity" or fields of the trajectories.

        Returns:
            Windows, each a dictionary: `position` (past, N, d) and `target` (future, N, d), m; `time` (past + future,),
            s; `body`, `material` (N,); `trajectory`, its number; each of `fields`, (past, N, ...); and `present` (past
            + future, N), bool, if particles come or go. N differs between trajectories. Reading a window raises an
            InputError for a damaged shard or an unknown field.

        Raises:
            InputError: there is no such split, or the numbers make no window.
        """
        return Windows(self, split, past, future, stride, tuple(fields))


class Windows:
    """A sequence of windows, each a dictionary of arrays; data loaders can copy it to their workers."""

    def __init__(
        self, dataset: Dataset, split: str, past: int, future: int, stride: int, fields: tuple[str, ...]
    ) -> None:
        """Count the windows of the split. Raises InputError for an unknown split, or lengths that make no window."""
        if split not in SPLITS:
            raise InputError(f'there is no split "{split}": the splits are {listed(quoted(SPLITS), "and")}.')
        if min(past, stride) < 1 or future < 0:
            raise InputError("a window has one past frame or more, 0 future frames or more, and a stride of 1 or more.")
        self.dataset, self.past, self.future, self.stride, self.fields = dataset, past, future, stride, fields
        self._numbers = dataset.splits[split]
        self._reach = (past + future - 1) * stride + 1
        counts = [max(0, dataset.frame_counts[number] - self._reach + 1) for number in self._numbers]
        # The index of the first window after each trajectory.
        self._ends = np.cumsum(counts, dtype=int)

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        """Return a window, see `Dataset.windows`; IndexError: there is none."""
        found = range(len(self))[index]
        k = int(np.searchsorted(self._ends, found, side="right"))
        trajectory, labels = _opened(self.dataset, self._numbers[k])
        first = found - (int(self._ends[k - 1]) if k else 0)
        frames = slice(first, first + self._reach, self.stride)
        position = trajectory.read("position", frames)
        window = {
            "position": position[: self.past],
            "target": position[self.past :],
            "time": trajectory.times[frames],
            **labels,
            "trajectory": np.int64(trajectory.number),
        }
        if STATUS in trajectory.field_names:
            window["present"] = trajectory.read(STATUS, frames) == ACTIVE
        before = slice(first, first + (self.past - 1) * self.stride + 1, self.stride)
        return window | {name: trajectory.read(name, before) for name in self.fields}

    def __repr__(self) -> str:
        return f"<Windows of {self.dataset.path}: {len(self)} of {self.past} and {self.future} frames>"


@lru_cache(KEPT)
def _opened(dataset: Dataset, number: int) -> tuple[Trajectory, dict[str, np.ndarray]]:
    trajectory = dataset[number]
    return trajectory, {name: trajectory.read(name) for name in LABELS}


def is_dataset(path: Path) -> bool:
    """Return whether a directory contains the shards of a dataset."""
    return (path / SHARDS).is_dir()


def open_dataset(path: Path | str) -> Dataset:
    """Open a dataset for reading, or the result of a single run as a dataset of one trajectory.

    That trajectory has the number 0 and the split "train".

    Args:
        path: the directory of a dataset, the directory of a result, or its particles.vtkhdf.

    Raises:
        InputError: there is no dataset or result, it has no trajectory, or a shard is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist: give the directory of a dataset, or a result.")
    if not is_dataset(path):
        if (path / SWEEP).exists():
            raise InputError(f"{path} is an empty dataset: it holds no trajectory yet.")
        results = (path / name for name in (PACKED, SEGMENTS, RECORD))
        if path.is_dir() and path.name != SEGMENTS and not any(result.exists() for result in results):
            raise InputError(f"{path} is not a dataset: it has no directory {SHARDS}, and it is no result either.")
        return Dataset(path, {0: SPLITS[0]}, open_result(path))
    splits: dict[int, str] = {}
    places: dict[int, Path] = {}
    for shard in sorted((path / SHARDS).glob("*.h5")):
        with open_shard(shard) as file:
            found = {int(group.attrs["number"]): str(group.attrs["split"]) for group in file.values()}
        if twice := places.keys() & found.keys():
            both = f"{places[min(twice)]} and in {shard}"
            raise InputError(f"trajectory {min(twice)} lies in {both}: remove one of them.")
        splits |= found
        places |= dict.fromkeys(found, shard)
    if not splits:
        raise InputError(f"{path} is an empty dataset: it holds no trajectory yet.")
    missing: tuple[int, ...] = ()
    if (path / MANIFEST).exists():
        status = status_of(path)
        lost = {row.number for row in status.rows if row.accepted} - splits.keys()
        missing = tuple(sorted({*status.waiting, *lost}))
    return Dataset(path, splits, places, missing)
