"""A shard: one HDF5 file with several trajectories of a dataset; its bytes depend on the content alone.

/                     format = "mpmcli-dataset", version = 2
/000007               number, split, draws (JSON), header (JSON, see `RunHeader`)
/000007/position      (T, N, d) m; velocity (T, N, d) m/s; each output field (T, N) or (T, N, ...)
/000007/body          (N,) int32; material (N,) int32, index into the laws of the header
/000007/time          (T,) float64, s; step (T,) int64; frame (T,) int64
/000007/ledger/mass   and every other column of the ledger, T rows
/000007/checksums     of each frame and of all else, see `output/checksums.py`

The last bytes of the file are a checksum of all bytes before them (`output/checksums.py`).
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.ledger import Ledger, LedgerRow
from mpmcli.output import checksums
from mpmcli.output.checksums import NAME as CHECKSUMS
from mpmcli.output.checksums import (
    Checksums,
    append_checksum,
    attribute_checksum,
    opened,
    require_format,
    store_checksums,
    table_checksum,
)
from mpmcli.output.durable import sealed
from mpmcli.output.layout import ledger_columns, read_ledger

FORMAT, VERSION = "mpmcli-dataset", 2
SPLITS = ("train", "valid", "test")
MOVING, LABELS, TABLES = ("position", "velocity"), ("body", "material"), ("time", "step", "frame")
LEDGER = "ledger"
# The files of a dataset, and its directories.
SWEEP, BASE = "sweep.toml", "base.toml"
SHARDS, PENDING, QUARANTINE, CERTIFICATES, IMAGES = "shards", "pending", "quarantine", "certify", "images"
NUMBERED = re.compile(r"\d{5,}\.h5")
# Largest overhead of HDF5 for a data set and for a group, bytes.
TABLE_BYTES, GROUP_BYTES = 1024, 16 * 1024
# Bytes of a compressed chunk: the size of HDF5's cache of a data set.
CHUNK_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class TrajectoryData:
    """One trajectory of T frames with N particles each.

    Attributes:
        number: number in the dataset, from 0; split: "train", "valid" or "test". draws: drawn values, by the key of the
            scene; header: `RunHeader.stored`. Both are valid JSON. position, velocity: (T, N, d) float32 or float64, m
            and m/s. body, material: (N,), indices into the bodies and laws of the header.
        time: (T,), s; step, frame: (T,), time steps since the start, and number of the frame; ledger: T rows.
        fields: further arrays of `output.fields`, (T, N) or (T, N, ...), by name.
    """

    number: int
    split: str
    draws: Mapping[str, Any]
    header: Mapping[str, Any]
    position: np.ndarray
    velocity: np.ndarray
    body: np.ndarray
    material: np.ndarray
    time: np.ndarray
    step: np.ndarray
    frame: np.ndarray
    ledger: Sequence[LedgerRow]
    fields: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays as stored, by their path in the group."""
        arrays = {"position": self.position, "velocity": self.velocity, **self.fields}
        arrays |= {name: np.asarray(getattr(self, name), np.int32) for name in LABELS}
        for name, dtype in (("time", np.float64), ("step", np.int64), ("frame", np.int64)):
            arrays[name] = np.asarray(getattr(self, name), dtype)
        return arrays | {f"{LEDGER}/{name}": column for name, column in ledger_columns(self.ledger).items()}


def group_name(number: int) -> str:
    """Return the name of a trajectory's group."""
    return f"{number:06d}"


def file_name(number: int) -> str:
    """Return the file name of a single trajectory, before it enters a shard, or in quarantine."""
    return f"{group_name(number)}.h5"


def write_trajectory(file: h5py.File, data: TrajectoryData, *, compress: bool = False) -> None:
    """Add a trajectory to an open shard; ValueError: it is inconsistent, or already present."""
    if fault := _fault(data):
        raise ValueError(f"trajectory {data.number}: {fault}")
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    # Fields keep their order.
    group = file.create_group(group_name(data.number), track_order=True)
    attributes, arrays, names = _attributes(data), data.arrays, [*MOVING, *data.fields]
    group.attrs.update(attributes)
    known = {f"@{name}": attribute_checksum(value) for name, value in attributes.items()}
    for name, array in arrays.items():
        moves = name in names
        options = _storage(array) if compress and moves and array.size else {}
        group.create_dataset(name, data=array, track_times=False, **options)
        known[name] = checksums.kind_checksum(array.dtype, array.shape) if moves else table_checksum(array)
    table = [[checksums.checksum(row) for row in arrays[name]] for name in names]
    store_checksums(group, "", names, np.array(table, np.uint32).reshape(len(names), len(data.time)).T, known)


def join_trajectories(files: Mapping[int, Path], path: Path) -> None:
    """Write a shard of trajectories by number, each from its single file."""
    with h5py.File(path, "w") as joined:
        joined.attrs["format"], joined.attrs["version"] = FORMAT, VERSION
        for number, file in files.items():
            with h5py.File(file, "r") as source:
                source.copy(group_name(number), joined)
    append_checksum(path)


def moving_names(group: h5py.Group) -> list[str]:
    """Return the names of the arrays that have frames, in their order."""
    return [name for name in group if name not in (*LABELS, *TABLES, LEDGER, CHECKSUMS)]


def _attributes(data: TrajectoryData) -> dict[str, int | str]:
    draws, header = json.dumps(dict(data.draws)), json.dumps(dict(data.header))
    return {"number": data.number, "split": data.split, "draws": draws, "header": header}


def write_single(path: Path, data: TrajectoryData, *, compress: bool) -> str:
    """Write a shard with this trajectory alone, in one durable step, and return the checksum of the trajectory."""
    attributes = sum(len(str(value)) for value in _attributes(data).values())
    # Without compression, rounded up.
    size = sum(array.nbytes + TABLE_BYTES for array in data.arrays.values()) + attributes + GROUP_BYTES
    with sealed(path, size) as temporary:
        with h5py.File(temporary, "w") as file:
            write_trajectory(file, data, compress=compress)
        append_checksum(temporary)
    return _checksum(_attributes(data), sorted(data.arrays.items()))


def checksum(group: h5py.Group) -> str:
    """Return the SHA-256, hexadecimal, of the content of a trajectory's group, independent of compression."""
    names: list[str] = []
    group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return _checksum(group.attrs, ((name, group[name][...]) for name in sorted(names) if name != CHECKSUMS))


def _checksum(attributes: Mapping[str, Any], arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    total = sha256()
    for name in sorted(attributes):
        total.update(f"{name} = {attributes[name]}\n".encode())
    for name, array in arrays:
        total.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        total.update(np.ascontiguousarray(array).data)
    return total.hexdigest()


@contextmanager
def open_shard(path: Path) -> Iterator[h5py.File]:
    """Open a sealed shard for reading; InputError: the shard or an item in it is missing or damaged."""
    if not path.exists():
        raise InputError(f"{path} is missing: the dataset is not complete.")
    with opened(path, "a whole copy of the dataset") as file:
        if file.attrs.get("format") != FORMAT:
            raise InputError(f"{path} is not a shard of a dataset of mpmcli: its format is not {FORMAT}.")
        require_format(path, file.attrs["version"], VERSION)
        yield file


def _fault(data: TrajectoryData) -> str:
    """Return why data cannot be stored as a trajectory, "" if it can."""
    if data.split not in SPLITS:
        return f'its split is "{data.split}", and not one of {", ".join(SPLITS)}'
    if data.position.ndim != 3 or data.velocity.shape != data.position.shape:
        return "position and velocity must both be (T, N, d)"
    frames, particles = data.position.shape[:2]
    for name, array in data.fields.items():
        if name in (*MOVING, *LABELS, *TABLES, LEDGER) or "/" in name:
            return f'"{name}" cannot name a field'
        if array.shape[:2] != (frames, particles):
            return f"{name} must be (T, N, ...) with T = {frames} and N = {particles}, not {array.shape}"
    if any(len(getattr(data, name)) != particles for name in LABELS):
        return f"body and material must have {particles} entries"
    if any(len(getattr(data, name)) != frames for name in (*TABLES, LEDGER)):
        return f"time, step, frame and ledger must have {frames} entries"
    return ""


def _storage(array: np.ndarray) -> dict[str, Any]:
    row = array.itemsize * int(np.prod(array.shape[2:]))
    particles = min(array.shape[1], max(1, CHUNK_BYTES // row))
    frames = min(array.shape[0], max(1, CHUNK_BYTES // (row * particles)))
    chunks = (frames, particles, *array.shape[2:])
    return {"chunks": chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True}


class StoredGroup:
    """A trajectory's group, verified by checksums as it is read; KeyError: there is none; InputError: it changed."""

    def __init__(self, file: h5py.File, number: int) -> None:
        self.group: h5py.Group = file[group_name(number)]
        self._checksums: Checksums = checksums.load_checksums(self.group, "")

    def attribute(self, name: str) -> Any:
        """Read an attribute."""
        found = self.group.attrs[name]
        self._checksums.require(f"@{name}", attribute_checksum(found))
        return json.loads(found) if name in ("draws", "header") else found

    def table(self, path: str) -> np.ndarray:
        """Read all of an array without frames."""
        found = self.group[path][...]
        self._checksums.require(path, table_checksum(found))
        return found

    def frames(self, name: str, chosen: slice) -> np.ndarray:
        """Read some frames of an array."""
        data = self.group[name]
        found = data[chosen]
        for t, rows in zip(range(len(data))[chosen], found, strict=True):
            self._checksums.require_frame(t, name, rows, t)
        return found

    def require_all(self) -> None:
        """Compare the checksums of all items of the group."""
        for name in self._checksums.arrays:
            self.frames(name, slice(None))
        items = checksums.item_checksums(self.group, self._checksums.arrays, CHECKSUMS)
        for error in self._checksums.differences(items):
            raise error

    def ledger(self) -> Ledger:
        """Read the ledger."""
        return read_ledger(self.group[LEDGER], lambda name: self.table(f"{LEDGER}/{name}"))
