"""Reads results: a packed file, or the directory of a finished, running or interrupted run."""

import io
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mpmcli.errors import InputError
from mpmcli.extras import imported
from mpmcli.frames.frame import ACTIVE, STATUS, Frame
from mpmcli.output.checksums import DamageError, checksum, damaged, first_line
from mpmcli.output.collider_files import as_they_moved, read_stored_surfaces
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import PACKED, POSITION, SEGMENTS, STANDARD, FrameIndex, ledger_csv, sealed_segments
from mpmcli.output.run_record import read_record, run_status
from mpmcli.output.vtkhdf import array_path, open_vtkhdf, read_index_of
from mpmcli.plain_text import counted
from mpmcli.scene.colliders import Collider

if TYPE_CHECKING:
    import pandas
    import pyvista

Kind = Literal["packed", "segments"]


class Result(ABC):
    """The frames of one run, read one at a time; made by `open_result`.

    No file stays open, so a Result can be copied to other processes.

    Attributes:
        path: the packed file, or the directory of the segments; directory: that of the result.
        kind: "packed", or "segments" (running, or ended before packing).
        times: (T,) float64, s.
        numbers: (T,) frame numbers.
        particle_counts: (T,) particles of each frame.
        ledger: T rows; by the name of a quantity an array over the frames, as `ledger["kinetic"]`.
        header: facts about the run.
        dimension: 2 or 3.
        field_names: the fields of each Frame, without position, velocity, body and material.
        record: content of run.json, None if there is none.
        index: tables of all frames, as stored.
        status: status of the run, see `run_status`.
        collider_frames: for each collider the number of the only frame with it; None if all frames have all.
    """

    kind: Kind
    collider_frames: tuple[int, ...] | None = None

    def __init__(self, path: Path, index: FrameIndex) -> None:
        """Take tables of all frames, and read header and record. Raises DamageError if the header cannot be read."""
        self.path = path
        self.index = index
        self.times = index.times
        self.numbers = index.frames
        self.particle_counts = index.counts
        self.ledger = index.ledger
        try:
            self.header = RunHeader.read(index.header)
        except ValueError as error:
            raise DamageError(f"{path} is damaged: its header cannot be read ({first_line(error)}).") from error
        self.dimension = index.layout.dimension
        names = [name for name in index.layout.arrays if name not in (POSITION, *STANDARD)]
        self.field_names: tuple[str, ...] = tuple(names)
        self.directory = path if path.is_dir() else path.parent
        self.record = read_record(self.directory)
        self.status = run_status(self.directory, self.record)

    @cached_property
    def colliders(self) -> tuple[Collider, ...]:
        """The colliders of the scene; one whose mesh is neither found nor stored with the frames is left out."""
        found = self.header.read_colliders(read_stored_surfaces(self.directory))
        found = as_they_moved(found, self)
        return tuple(collider for collider in found if collider is not None)

    @property
    def frame_count(self) -> int:
        """Number of frames that can be read."""
        return len(self.times)

    def frame(self, k: int, fields: Sequence[str] | None = None) -> Frame:
        """Read the k-th frame with some or all fields, unchanged; InputError: no such frame or field, or no file."""
        if not 0 <= k < self.frame_count:
            raise InputError(f"{self.path} has no frame {k}: it holds frames 0 to {self.frame_count - 1}.")
        # Row i is particle i unless only those present are stored.
        names = [POSITION, *STANDARD[not self.header.drops :], *(self.field_names if fields is None else fields)]
        for name in names:
            if name not in self.index.layout.arrays:
                known = ", ".join(self.field_names) or "none"
                raise InputError(f'{self.path} holds no field "{name}": its fields are {known}.')
        index = self.index
        stored = self._read(k, names)
        return index.layout.frame(int(index.frames[k]), float(self.times[k]), int(index.steps[k]), stored)

    def present_frame(self, k: int, fields: Sequence[str] | None = None) -> Frame:
        """Read the k-th frame as `frame` does, with only the particles present if particles come or go."""
        if STATUS in self.field_names and fields is not None and STATUS not in fields:
            fields = (*fields, STATUS)
        return self.frame(k, fields).of_present

    def stored(self, k: int) -> dict[str, np.ndarray]:
        """Read all arrays of the k-th frame in the form in the file, (n,) or (n, components)."""
        return self._read(k, [POSITION, *STANDARD, *self.field_names])

    def frames(self, fields: Sequence[str] | None = None) -> Iterator[Frame]:
        """Read all frames, one at a time."""
        for k in range(self.frame_count):
            yield self.frame(k, fields)

    def __repr__(self) -> str:
        count = int(self.particle_counts.max())
        times = f"{counted(self.frame_count, 'frame')} from {self.times[0]:.4g} to {self.times[-1]:.4g} s"
        what = f"{self.dimension}D, {times}, {counted(count, 'particle')}"
        return f"<Result {self.path}: {', '.join((what, *self.field_names))}; {self.status}>"

    def dataframe(self) -> "pandas.DataFrame":
        """Return the ledger as a pandas table with a row for each frame; InputError: pandas is not installed."""
        table = imported("pandas", "pandas", "a ledger as a table")
        index = zip(self.numbers.tolist(), self.index.steps.tolist(), self.particle_counts.tolist(), strict=True)
        return table.read_csv(io.StringIO(ledger_csv(self.ledger, list(index))))

    def to_pyvista(self, k: int) -> "pyvista.PolyData":
        """Return the particles present in the k-th frame as points with their arrays, z = 0 in 2D."""
        import pyvista

        arrays = self.stored(k)
        if STATUS in arrays:
            present = arrays[STATUS] == ACTIVE
            arrays = {name: array[present] for name, array in arrays.items()}
        cloud = pyvista.PolyData(arrays.pop(POSITION))
        # PyVista has no empty arrays.
        for name, array in arrays.items() if cloud.n_points else ():
            cloud.point_data[name] = array
        return cloud

    @abstractmethod
    def _read(self, k: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Read arrays of the k-th frame in the form in the file."""


class _StoredResult(Result):
    def __init__(self, path: Path, kind: Kind, files: Sequence[Path]) -> None:
        self.kind = kind
        indices = [read_index_of(file) for file in files]
        # For each frame: its file, and its first row there.
        self._places = [
            (file, int(offset)) for file, index in zip(files, indices, strict=True) for offset in index.offsets
        ]
        super().__init__(path, indices[0] if len(indices) == 1 else FrameIndex.joined(indices))

    def _read(self, k: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        file, offset = self._places[k]
        try:
            return self._read_arrays(file, k, names, offset)
        except InputError:
            packed = self.path / PACKED
            if file.exists() or not packed.exists():
                raise
            # The run has ended since, and its frames were packed: the same frames, perhaps more.
            return self._read_arrays(packed, k, names, int(self.index.offsets[k]))

    def _read_arrays(self, path: Path, k: int, names: Sequence[str], offset: int) -> dict[str, np.ndarray]:
        """Read arrays of the k-th frame, which begins at row `offset` of a file, and compare their checksums."""
        with open_vtkhdf(path) as file:
            end = offset + int(self.particle_counts[k])
            stored = {name: file[f"VTKHDF/{array_path(name)}"][offset:end] for name in names}
        columns = list(self.index.layout.arrays)
        for name, array in stored.items():
            if checksum(array) != self.index.checksums[k, columns.index(name)]:
                raise damaged(str(path), f"{name} of frame {self.numbers[k]}")
        return stored


def result_place(path: Path) -> Path:
    """Return the file or the directory of frames for a path to the folder of segments, or to a file of a series."""
    path = Path(path)
    if path.name == SEGMENTS and path.is_dir():
        return path.parent
    # A series written by mpmcli has the frames of the packed file next to it.
    return path.with_name(PACKED) if path.suffix in (".pvd", ".vtu") else path


def open_result(path: Path) -> Result:
    """Open the result of a run that has ended, was interrupted, or is still running.

    Args:
        path: a packed file, its directory, the directory of a run that was not packed (its sealed
            frames are read, unfinished files are ignored), or a file of the series beside the packed file.

    Raises:
        InputError: `path` does not exist, was not written by mpmcli, or has no frame yet.
    """
    path = result_place(path)
    packed = path / PACKED if path.is_dir() else path
    if path.is_dir() and not packed.exists() and (segments := sealed_segments(path)):
        try:
            return _StoredResult(path, "segments", segments)
        except InputError:
            # The run may have ended and packed its frames while they were listed.
            if not packed.exists():
                raise
    if packed.exists():
        return _StoredResult(packed, "packed", [packed])
    if not path.is_dir():
        raise InputError(f"{path} does not exist: give a {PACKED} or its directory.")
    record = read_record(path)
    if record is None:
        raise InputError(f"{path} holds no result of mpmcli: no {PACKED} and no {SEGMENTS}.")
    status = run_status(path, record)
    raise InputError(f'{path} holds no frame yet: its run is "{status}" and has written none.')
