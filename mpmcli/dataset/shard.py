"""A shard: one HDF5 file with some trajectories of a dataset, whose bytes depend on its content alone.

/                     format = "mpmcli-dataset", version = 2
/000007               number, split, draws (JSON), header (JSON, see `RunHeader`)
/000007/position      (T, N, d) m; velocity (T, N, d) m/s; each output field (T, N) or (T, N, ...)
/000007/body          (N,) int32; material (N,) int32, index into the laws of the header
/000007/time          (T,) float64, s; step (T,) int64; frame (T,) int64
/000007/ledger/mass   and every other column of the ledger, T rows
/000007/checksums     of each frame and of all else, see `output/checksums.py`; not in version 1

The last bytes of the file are a checksum of all before (`output/file_checksum.py`).
"""

import json
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
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import NAME as CHECKSUMS
from mpmcli.output.checksums import (
    attribute_checksum,
    frame_checksums,
    kind_checksum,
    store_checksums,
    table_checksum,
)
from mpmcli.output.damage import DAMAGE
from mpmcli.output.guarded_read import read_whole, require_stored
from mpmcli.output.hdf5_heaps import require_sound_heaps
from mpmcli.output.hdf5_items import held, items
from mpmcli.output.ledger_table import ledger_columns

FORMAT, VERSION = "mpmcli-dataset", 2
SPLITS = ("train", "valid", "test")
MOVING, LABELS, TABLES = ("position", "velocity"), ("body", "material"), ("time", "step", "frame")
LEDGER = "ledger"
# Of HDF5 for a data set and for a group, at most.
TABLE_BYTES, GROUP_BYTES = 1024, 16 * 1024
# Of a compressed chunk: as much as HDF5 caches of a dataset.
CHUNK_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class TrajectoryData:
    """One trajectory of T frames with N particles each.

    Attributes:
        number: in the dataset, from 0.
        split: "train", "valid" or "test".
        draws: what was drawn for it, by the key of the scene; JSON can hold it.
        header: `RunHeader.stored`.
        position, velocity: (T, N, d) float32 or float64, m and m/s.
        body, material: (N,), indices into the bodies and laws of the header.
        time: (T,), s.
        step, frame: (T,), time steps since the start, and number of the frame.
        ledger: T rows.
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
        """All arrays as they are stored, by their path in the group."""
        arrays = {"position": self.position, "velocity": self.velocity, **self.fields}
        arrays |= {name: np.asarray(getattr(self, name), np.int32) for name in LABELS}
        for name, dtype in (("time", np.float64), ("step", np.int64), ("frame", np.int64)):
            arrays[name] = np.asarray(getattr(self, name), dtype)
        return arrays | {f"{LEDGER}/{name}": column for name, column in ledger_columns(self.ledger).items()}


def group_name(number: int) -> str:
    """Return the name of a trajectory's group."""
    return f"{number:06d}"


def write_trajectory(file: h5py.File, data: TrajectoryData, *, compress: bool = False) -> None:
    """Add a trajectory to a shard that is open for writing.

    The bytes of the file depend on the trajectories and their order alone, not on when or where it is written.

    Args:
        compress: gzip-1 with shuffle, for what moves.

    Raises:
        ValueError: the split or the name of a field is not possible, shapes contradict each other, or the shard
            holds the trajectory already.
    """
    if fault := _fault(data):
        raise ValueError(f"trajectory {data.number}: {fault}")
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    # Fields keep their order.
    group = file.create_group(group_name(data.number), track_order=True)
    attributes, arrays = _attributes(data), data.arrays
    group.attrs.update(attributes)
    for name, array in arrays.items():
        moves = name in (*MOVING, *data.fields)
        options = _storage(array) if compress and moves and array.size else {}
        group.create_dataset(name, data=array, track_times=False, **options)
    names = [*MOVING, *data.fields]
    known = {f"@{name}": attribute_checksum(value) for name, value in attributes.items()}
    for name, array in arrays.items():
        known[name] = kind_checksum(array.dtype, array.shape) if name in names else table_checksum(array)
    store_checksums(group, "", names, _table([arrays[name] for name in names]), known)


def add_checksums(group: h5py.Group) -> None:
    """Write the checksums of a trajectory that an older version has written."""
    names = moving_names(group)
    store_checksums(group, "", names, _table([held(group, name)[...] for name in names]))


def _table(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return the checksums of arrays of T frames, (T, A) uint32."""
    columns = [frame_checksums(array) for array in arrays]
    return np.array(columns, np.uint32).reshape(len(arrays), len(arrays[0])).T


def moving_names(group: h5py.Group) -> list[str]:
    """Return the names of the arrays that have frames, in their order."""
    return [name for name in group if name not in (*LABELS, *TABLES, LEDGER, CHECKSUMS)]


def _attributes(data: TrajectoryData) -> dict[str, int | str]:
    draws, header = json.dumps(dict(data.draws)), json.dumps(dict(data.header))
    return {"number": data.number, "split": data.split, "draws": draws, "header": header}


def stored_bytes(data: TrajectoryData) -> int:
    """Return the bytes of a shard that holds this trajectory alone, without compression, rounded up."""
    attributes = sum(len(str(value)) for value in _attributes(data).values())
    return sum(array.nbytes + TABLE_BYTES for array in data.arrays.values()) + attributes + GROUP_BYTES


def checksum_of(data: TrajectoryData) -> str:
    """Return the checksum that the group of a trajectory will have."""
    return _checksum(_attributes(data), sorted(data.arrays.items()))


def checksum(group: h5py.Group) -> str:
    """Return the SHA-256, hexadecimal, of all that a trajectory's group holds, compressed or not."""
    names = [name for name, item in items(group) if isinstance(item, h5py.Dataset) and name != CHECKSUMS]
    return _checksum(group.attrs, ((name, read_whole(group, name, "iufS")) for name in sorted(names)))


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
    """Open a sealed shard for reading.

    Raises:
        InputError: it is missing, no shard, of a newer mpmcli, or damaged; also where what is read from it is.
    """
    if not path.exists():
        raise InputError(f"{path} is missing: the dataset is not complete.")
    try:
        require_sound_heaps(path)
        # A sealed shard never changes, so no lock is taken.
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs.get("format") != FORMAT:
                raise InputError(f"{path} is no shard of a dataset of mpmcli: its format is not {FORMAT}.")
            if file.attrs["version"] < 1:
                raise ValueError("there is no such version")
            if file.attrs["version"] > VERSION:
                raise InputError(f"{path} was written by a newer version of mpmcli; update mpmcli to read it.")
            yield file
    except DAMAGE as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is damaged: what it should hold cannot be read.") from error


def shard_splits(path: Path) -> dict[int, str]:
    """Return the split of each trajectory in a shard, by number.

    Raises:
        InputError: as `open_shard`.
    """
    with open_shard(path) as file:
        splits = {}
        for name in file:
            group = held(file, name)
            number = int(group.attrs["number"])
            if group_name(number) != name:
                raise ValueError("a trajectory has the name of another")
            splits[number] = str(group.attrs["split"])
        if not set(splits.values()) <= set(SPLITS):
            raise ValueError("a split has another name")
        return splits


def particles_of(group: h5py.Group, d: int, names: Sequence[str]) -> int:
    """Return N, the number of particles of a trajectory in d dimensions with fields of these names.

    Raises:
        KeyError, ValueError: its arrays are not of T frames and N particles, or of other types.
    """
    shapes = {name: require_stored(group, name).shape for name in (*MOVING, *LABELS, *TABLES, *names)}
    frames, particles, axes = shapes["position"]
    right = {name: (particles,) for name in LABELS} | {name: (frames,) for name in TABLES}
    right |= {name: (frames, particles, *shapes[name][2:]) for name in names}
    right |= {name: (frames, particles, d) for name in MOVING}
    kinds = {group[name].dtype.kind for name in MOVING}, {group[name].dtype.kind for name in LABELS}
    if right != shapes or axes != d or not frames or kinds[0] != {"f"} or not kinds[1] <= {"i", "u"}:
        raise ValueError("the arrays of a trajectory have different shapes")
    return particles


def _fault(data: TrajectoryData) -> str:
    """Return what is wrong with a trajectory, "" where nothing is."""
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
