"""The layout of frames in files: names and types of arrays, padding of 2D to 3D for VTK, and the list of frames.

Also the ledger as columns, for HDF5, and as CSV text, for the VTK series; and the names of the files of frames:
segments during a run, and one packed file at its end.
"""

import csv
import io
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LOADS, RIGID, Ledger, LedgerRow
from mpmcli.output.durable import numbered_files, remove_numbered

POSITION = "Points"  # VTK's name; every other array keeps its own
STANDARD = ("id", "body", "material", "velocity")
# 2D is plane strain: out of the plane F is the identity, and every other tensor is stored as zero.
OUT_OF_PLANE = {"deformation_gradient": 1.0}
# Types that both VTK and meshio read back without conversion.
DTYPES = tuple(np.dtype(code) for code in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"))


@dataclass(frozen=True)
class ArrayLayout:
    """One array over particles in d dimensions: its name in the file, numpy type, and shape (), (k,) or (d, d)."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    dimension: int

    @property
    def is_tensor(self) -> bool:
        """Whether it is a d x d tensor, given as (d, d) or flat, rows first."""
        d = self.dimension
        return self.shape in ((d, d), (d * d,))

    @property
    def components(self) -> int | None:
        """Numbers per particle in the file, None for a scalar: 3 for vectors and 9 for tensors, in 2D too."""
        if self.shape == ():
            return None
        if self.is_tensor:
            return 9
        return 3 if self.shape == (self.dimension,) else self.shape[0]

    @property
    def bytes_per_particle(self) -> int:
        """Bytes in the file for each particle of a frame."""
        return np.dtype(self.dtype).itemsize * (self.components or 1)

    def stored_shape(self, n: int) -> tuple[int, ...]:
        """Shape in the file for n particles."""
        return (n,) if self.components is None else (n, self.components)

    def pad(self, array: np.ndarray) -> np.ndarray:
        """Convert an array of a Frame, (n, *shape), to the form in the file, (n,) or (n, components)."""
        n, d = len(array), self.dimension
        if self.is_tensor:
            tensor = array.reshape(n, d, d)
            if d == 2:
                tensor = np.pad(tensor, ((0, 0), (0, 1), (0, 1)))
                tensor[:, 2, 2] = OUT_OF_PLANE.get(self.name, 0.0)
            return np.ascontiguousarray(tensor).reshape(n, 9)
        if self.shape == (d,) and d == 2:
            return np.ascontiguousarray(np.pad(array, ((0, 0), (0, 1))))
        return np.ascontiguousarray(array)

    def unpad(self, stored: np.ndarray) -> np.ndarray:
        """Inverse of `pad`, exact to the bit."""
        n, d = len(stored), self.dimension
        if self.is_tensor:
            return np.ascontiguousarray(stored.reshape(n, 3, 3)[:, :d, :d]).reshape(n, *self.shape)
        if self.shape == (d,):
            return np.ascontiguousarray(stored[:, :d])
        return stored


@dataclass(frozen=True)
class FrameLayout:
    """All arrays of a frame, the same for every frame of a run: `Points`, the standard ones, then the output fields."""

    dimension: int
    arrays: dict[str, ArrayLayout] = field(default_factory=dict)

    @classmethod
    def of(cls, frame: Frame) -> "FrameLayout":
        """Return the layout of a frame; ValueError: a file cannot store the shape, type or name of an array."""
        if frame.position.ndim != 2 or frame.position.shape[1] not in (2, 3):
            raise ValueError(f"position must be (n, 2) or (n, 3), not {frame.position.shape}")
        n, d = frame.position.shape
        if frame.position.dtype not in DTYPES[:2]:
            raise ValueError(f"position must be float32 or float64, not {frame.position.dtype}")
        if frame.velocity.shape != (n, d) or frame.body.shape != (n,) or frame.material.shape != (n,):
            raise ValueError(f"velocity, body, material must be (n, d), (n,), (n,) in frame {frame.index}")
        arrays = {}
        for name, array in _named_arrays(frame):
            shape = array.shape[1:]
            fits = shape in ((), (d, d)) or (len(shape) == 1 and shape[0] > 0)
            if array.dtype not in DTYPES or len(array) != n or not fits:
                raise ValueError(
                    f"{name} is {array.shape} of {array.dtype}: a field must be (n,), (n, k) or (n, d, d) "
                    f"with n = {n} and d = {d}, of whole or 32 or 64 bit floating numbers"
                )
            arrays[name] = ArrayLayout(name, array.dtype.name, shape, d)
        return cls(d, arrays)

    @property
    def bytes_per_particle(self) -> int:
        """Bytes in the file for each particle of a frame, without VTK's connectivity."""
        return sum(array.bytes_per_particle for array in self.arrays.values())

    def stored(self, frame: Frame) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every array in the form in the file, one at a time; ValueError: the layout differs."""
        if FrameLayout.of(frame) != self:
            raise ValueError(f"frame {frame.index} holds other arrays, types or shapes than the first frame")
        for name, array in _named_arrays(frame):
            yield name, self.arrays[name].pad(array)

    def stored_together(self, frames: Sequence[Frame]) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every array of several frames, joined along the rows, as `stored` does."""
        if len(frames) == 1:
            yield from self.stored(frames[0])
            return
        arrays = [dict(self.stored(frame)) for frame in frames]
        for name in self.arrays:
            yield name, np.concatenate([stored.pop(name) for stored in arrays])

    def frame(self, index: int, time: float, step: int, stored: Mapping[str, np.ndarray]) -> Frame:
        """Return a Frame from arrays in the form in the file; `stored` may lack fields."""
        arrays = {name: self.arrays[name].unpad(array) for name, array in stored.items()}
        standard = {name: arrays.pop(name, None) for name in STANDARD}
        return Frame(index, time, step, position=arrays.pop(POSITION), fields=arrays, **standard)

    def to_dict(self) -> dict:
        """Return a form for JSON."""
        shapes = {name: [a.dtype, list(a.shape)] for name, a in self.arrays.items()}
        return {"dimension": self.dimension, "arrays": shapes}

    @classmethod
    def from_dict(cls, plain: dict) -> "FrameLayout":
        """Inverse of `to_dict`."""
        d = plain["dimension"]
        arrays = {name: ArrayLayout(name, dtype, tuple(shape), d) for name, (dtype, shape) in plain["arrays"].items()}
        return cls(d, arrays)


def _named_arrays(frame: Frame) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays of a frame by name, in the order of the file. Raises ValueError for an invalid name."""
    n = len(frame.position)
    yield POSITION, frame.position
    # Row i is particle i, so most Frames store no ids; in the file, ids let ParaView follow a particle.
    whole = np.int32 if n < 2**31 else np.int64
    yield "id", np.arange(n, dtype=whole) if frame.id is None else frame.id.astype(whole)
    for name in STANDARD[1:]:
        yield name, getattr(frame, name)
    for name, array in frame.fields.items():
        # VTK's reader takes "/" and "." as parts of a path (VTKHDF specification).
        if not name or "/" in name or "." in name or name == POSITION or name in STANDARD:
            raise ValueError(f'"{name}" cannot name an output field: it is taken, or holds "/" or "."')
        yield name, array


@dataclass(frozen=True)
class FrameIndex:
    """Where T frames are stored, and what is known of each without reading its particles.

    Attributes:
        layout: the arrays of every frame.
        header: metadata of the run.
        times: (T,) float64, s.
        frames, steps: (T,) frame number, and time steps since the start.
        offsets, counts: (T,) first row and number of rows of each frame in its file.
        ledger: T rows.
        checksums: (T, A) uint32, CRC-32 of each array of the layout in each frame; None if the frames are in no file.
    """

    layout: FrameLayout
    header: dict[str, Any]
    times: np.ndarray
    frames: np.ndarray
    steps: np.ndarray
    offsets: np.ndarray
    counts: np.ndarray
    ledger: Ledger
    checksums: np.ndarray | None = None

    def __post_init__(self) -> None:
        tables = (self.frames, self.steps, self.offsets, self.counts, self.ledger)
        if not len(self.times) or any(len(table) != len(self.times) for table in tables):
            raise ValueError("the tables of the frames have different lengths")

    @staticmethod
    def joined(indices: Sequence["FrameIndex"]) -> "FrameIndex":
        """Return the index of one file with the frames of all indices, in order."""
        names = ("times", "frames", "steps", "counts", "checksums")
        tables = {name: np.concatenate([getattr(index, name) for index in indices]) for name in names}
        return replace(
            indices[0],
            **tables,
            offsets=np.cumsum(tables["counts"]) - tables["counts"],
            ledger=Ledger(row for index in indices for row in index.ledger),
        )


COLUMNS = tuple(f.name for f in fields(LedgerRow))
# A row for each collider, pair or body.
PER_PART = (*LOADS, *RIGID)
VECTORS = ("linear_momentum", "angular_momentum")
# Columns that some scenes and older results lack: None, and not stored.
OPTIONAL = ("emitted", "emitted_mass", "nozzle_mass", "retired", "retired_mass", "blocked")
OPTIONAL += ("collider_work", "contact_work", "contact_overlap")
INTEGERS = ("steps", "emitted", "retired", "blocked")
TEXT = "limit"
# Values for columns that a file lacks.
MISSING = {**dict.fromkeys(PER_PART, ()), **dict.fromkeys(OPTIONAL)}
# Columns of each frame in the CSV: its number, time steps since the start, particles.
FRAME_COLUMNS = ("frame", "step", "particles")


def ledger_columns(rows: Sequence[LedgerRow]) -> dict[str, np.ndarray]:
    """Return columns of T rows; momenta are (T, components), loads (T, count, components), `limit` is UTF-8."""
    columns = {}
    for name in _stored(rows):
        values = [getattr(row, name) for row in rows]
        if name in PER_PART and not any(values):
            continue
        if name == TEXT:
            texts = [text.encode("utf-8") for text in values]
            columns[name] = np.array(texts, dtype=h5py.string_dtype("utf-8", max([1, *map(len, texts)])))
        else:
            columns[name] = np.array(values, dtype=np.int64 if name in INTEGERS else np.float64)
    return columns


def _stored(rows: Sequence[LedgerRow]) -> tuple[str, ...]:
    """Return the names of the columns of rows of one run."""
    return tuple(name for name in COLUMNS if name not in OPTIONAL or (rows and getattr(rows[0], name) is not None))


def read_ledger(group: h5py.Group, read: Callable[[str], np.ndarray]) -> Ledger:
    """Read the ledger in a group, each column by `read`."""
    return ledger_rows({name: read(name) for name in COLUMNS if name in group})


def ledger_rows(columns: Mapping[str, np.ndarray]) -> Ledger:
    """Inverse of `ledger_columns`; a column of `MISSING` may be absent."""
    lists = []
    for name in COLUMNS:
        if name in MISSING and name not in columns:
            lists.append([MISSING[name]] * len(columns["time"]))
            continue
        values = np.asarray(columns[name]).tolist()
        if name == TEXT:
            values = [text.decode("utf-8") for text in values]
        elif name in VECTORS:
            values = [tuple(value) for value in values]
        elif name in PER_PART:
            values = [tuple(map(tuple, value)) for value in values]
        lists.append(values)
    return Ledger(LedgerRow(*values) for values in zip(*lists, strict=True))


def ledger_csv(rows: Sequence[LedgerRow], frames: Sequence[tuple[int, ...]]) -> str:
    """Write T rows as CSV with a header line, after `FRAME_COLUMNS`; numbers read back exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, row in enumerate(rows):
        record: dict[str, object] = dict(zip(FRAME_COLUMNS, frames[i], strict=True))
        for name in _stored(rows):
            value = getattr(row, name)
            if name in VECTORS:
                record |= {f"{name}_{axis}": repr(float(v)) for axis, v in enumerate(value)}
            elif name in PER_PART:
                entries = [(k, axis, v) for k, vector in enumerate(value) for axis, v in enumerate(vector)]
                record |= {f"{name}_{k}_{axis}": repr(float(v)) for k, axis, v in entries}
            else:
                record[name] = value if name == TEXT or name in INTEGERS else repr(float(value))
        if i == 0:
            writer.writerow(record)
        writer.writerow(record.values())
    return text.getvalue()


PACKED = "particles.vtkhdf"
# A damaged segment keeps this name until it has been computed again.
DAMAGED = "particles.vtkhdf.damaged"
SEGMENTS = "segments"
SEGMENT_NAME = re.compile(r"frame_\d{6,}\.vtkhdf")


def segment_name(index: int) -> str:
    """Return the file name of the segment whose first frame has this number."""
    return f"frame_{index:06d}.vtkhdf"


def sealed_segments(directory: Path) -> list[Path]:
    """Return the sealed segments of an unpacked run, in order, without unfinished files."""
    return numbered_files(directory / SEGMENTS, SEGMENT_NAME)


def remove_segments(directory: Path, spared: Collection[Path] = ()) -> None:
    """Remove sealed and unfinished segments but `spared` ones, and their folder unless it contains other files."""
    remove_numbered(directory / SEGMENTS, SEGMENT_NAME, spared)
