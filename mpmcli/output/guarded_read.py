"""Reading files that anybody may have changed: no link is followed, and no more memory taken than their bytes fill."""

import math
import mmap
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from mpmcli.errors import InputError
from mpmcli.plain_text import one_line

# What h5py, numpy, JSON and TOML raise where content contradicts itself. InputError: a reader has found what is wrong.
DAMAGE = (
    *(InputError, OSError, RuntimeError, ValueError, KeyError, IndexError, TypeError, AttributeError),
    *(OverflowError, RecursionError, MemoryError),
)
# What deflate makes of one byte at most, and what small tables may claim beyond that.
MOST_INFLATED, SMALL = 1100, 2**20
# Global heaps of an HDF5 file hold the texts of attributes (The HDF Group, HDF5 File Format Specification 3.0, III.E
# "Disk Format: Level 1E - Global Heap").
_HEAP_SIGNATURE, _HEAP_HEAD = b"GCOL\x01\0\0\0", 16
# Larger files are not searched, which would take seconds.
MOST_SEARCHED = 2**26


class DamageError(InputError):
    """A file that was written by mpmcli, and has changed since."""


def first_line(error: Exception) -> str:
    """Return the first line of what an exception says, without a period at its end, or its type."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def held(group: h5py.Group, path: str) -> h5py.Group | h5py.Dataset:
    """Return an item below a group; KeyError: there is none; InputError: a link, or data elsewhere or too large."""
    item = group
    for name in path.split("/"):
        link = item.get(name, getlink=True) if isinstance(item, h5py.Group) else None
        if link is None:
            raise KeyError(f"{path} is missing")
        if not isinstance(link, h5py.HardLink):
            raise InputError(
                f"{group.file.filename} holds a link to another place, {one_line(path)}; mpmcli writes none and "
                "follows none."
            )
        item = item[name]
    if isinstance(item, h5py.Dataset):
        _require_own_data(item, path)
    return item


def items(group: h5py.Group, path: str = "") -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield all that lies below a group, itself first, as `held` returns it, in the order of the names."""
    yield path, group
    for name in sorted(group):
        below, item = f"{path}/{name}" if path else name, held(group, name)
        if isinstance(item, h5py.Group):
            # Of ours no group lies in itself.
            if below.count("/") < 8:
                yield from items(item, below)
        else:
            yield below, item


def _require_own_data(data: h5py.Dataset, path: str) -> None:
    file = data.file.filename
    if data.is_virtual or data.external:
        raise InputError(f"{file} takes {path} from another file; mpmcli writes and follows no such link.")
    chunk = math.prod(data.chunks) * data.dtype.itemsize if data.chunks else 0
    if max(data.nbytes, chunk) > MOST_INFLATED * data.id.get_storage_size() + SMALL:
        raise DamageError(f"{file} is damaged: its data set {path} claims to be more than the file holds.")


def read_whole(group: h5py.Group, name: str, kinds: str = "iuf") -> np.ndarray:
    """Return all of a data set; errors are those of `require_stored`."""
    return require_stored(group, name, kinds)[...]


def read_rows(group: h5py.Group, name: str, first: int, count: int, kinds: str = "iuf") -> np.ndarray:
    """Return rows of a data set, fewer where it ends; errors are those of `require_stored`."""
    data = require_stored(group, name, kinds)
    if first < 0 or count < 0 or not data.shape:
        raise ValueError(f"{name} has no rows {first} to {first + count}")
    return data[first : first + count]


def require_stored(group: h5py.Group, name: str, kinds: str = "iuf") -> h5py.Dataset:
    """Return a data set with one of these `kinds` of numpy types; KeyError, ValueError or an error of `held` else."""
    data = held(group, name)
    if not isinstance(data, h5py.Dataset) or data.dtype.kind not in kinds or data.shape is None:
        raise ValueError(f"{name} is no array of numbers")
    return data


def require_sound_heaps(path: Path) -> None:
    """Raise OSError for a file of up to 64 MiB in which an object of a global heap does not end in its heap.

    The HDF5 library walks through a heap without end where one object has a size of 0.
    """
    size = path.stat().st_size
    if not 0 < size <= MOST_SEARCHED:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = data.find(_HEAP_SIGNATURE)
        while start >= 0:
            _require_sound_heap(data, start, size)
            start = data.find(_HEAP_SIGNATURE, start + 1)


def _require_sound_heap(data: mmap.mmap, start: int, size: int) -> None:
    end = start + int.from_bytes(data[start + 8 : start + _HEAP_HEAD], "little")
    if not start + _HEAP_HEAD < end <= size:
        raise OSError("a heap does not end in the file")
    place = start + _HEAP_HEAD
    while place + _HEAP_HEAD <= end:
        index = int.from_bytes(data[place : place + 2], "little")
        length = int.from_bytes(data[place + 8 : place + _HEAP_HEAD], "little")
        # Index 0 is the free space at the end, whose length counts its head.
        needed = _HEAP_HEAD + -(-length // 8) * 8 if index else length
        if needed < _HEAP_HEAD or place + needed > end:
            raise OSError("an object does not end in its heap")
        place += needed
