"""Checksums of written data: of the parts of an HDF5 file, of a whole file, and of the files of a directory.

A group of an HDF5 file has a data set `checksums`, (T, A) uint32: the CRC-32 of the rows of frame t in array a. Its
attribute `list`, JSON, names the A arrays, and gives the CRC-32 of every other data set and attribute; its attribute
`checksum` is the CRC-32 of that text and of the table. The last bytes of the file, which readers of HDF5 ignore, are a
CRC-32 of all bytes before them except those of the A arrays, so that large files are read only once.

A directory has a file checksums.sha256, as `sha256sum -c` reads it.

Exceptions of readers at a damaged or foreign HDF5 file become one sentence.
"""

import json
import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import file_digest
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from pydantic import ValidationError

from mpmcli.errors import InputError

# Exceptions of h5py, numpy, JSON, TOML and pydantic at inconsistent content. InputError: a reader has named the fault.
DAMAGE = (InputError, OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, MemoryError)


class DamageError(InputError):
    """A file written by mpmcli has changed since."""


def first_line(error: Exception) -> str:
    """Return the first line of an exception's message, without a period at its end, or its type."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return (str(error).splitlines() or [type(error).__name__])[0].strip("'\"").rstrip(".")


def open_hdf5(path: Path, wanted: str) -> h5py.File:
    """Open a sealed file for reading, without a lock; InputError: it is no HDF5 file; `wanted` names the right one."""
    try:
        try:
            return h5py.File(path, "r", locking=False)
        except OSError:
            # This process has the file open with locking; HDF5 requires one setting for all handles.
            return h5py.File(path, "r")
    except OSError as error:
        reason = "is not an HDF5 file, or a damaged one" if path.exists() else "does not exist"
        if path.suffix == ".toml" and path.exists():
            reason = "is a scene, not a result of `mpmcli simulate`"
        raise InputError(f"{path} {reason}; give {wanted}.") from error


@contextmanager
def opened(path: Path, wanted: str) -> Iterator[h5py.File]:
    """Open a file as `open_hdf5` does; errors while reading it become a DamageError."""
    with open_hdf5(path, wanted) as file:
        try:
            yield file
        except InputError:
            raise
        except DAMAGE as error:
            what = first_line(error)
            raise DamageError(f"{path} is damaged: its content cannot be read ({what}).") from error


def require_format(path: Path, found: object, ours: int) -> None:
    """Raise an InputError for a file of a format other than `ours`."""
    if found != ours:
        raise InputError(
            f"{path} has format {found}, and this version of mpmcli reads format {ours}: use the version that wrote it."
        )


NAME = "checksums"
_LIST, _OWN = "list", "checksum"
_FILE_END = "\nmpmcli crc32 {:08x}\n"
_BLOCK = 2**22
SUMS = "checksums.sha256"
# Files written by mpmcli have plain names.
_SUMS_LINE = re.compile(r"([0-9a-f]{64})  (\w[\w.-]*(?:/\w[\w.-]*)*)\n")
Gap = tuple[int, int]


def checksum(array: np.ndarray, before: int = 0) -> int:
    """Return the CRC-32 of the bytes of an array, continued from the CRC-32 `before`."""
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8), before)


def kind_checksum(dtype: np.dtype, shape: tuple[int, ...]) -> int:
    """Return the checksum of the type and the shape of a data set."""
    return zlib.crc32(f"{dtype.str} {shape}\n".encode())


def table_checksum(array: np.ndarray) -> int:
    """Return the checksum of the type, the shape and the content of a data set that was read."""
    return checksum(array, kind_checksum(array.dtype, array.shape))


def attribute_checksum(value: Any) -> int:
    """Return the checksum of an attribute as h5py returns it."""
    if isinstance(value, str):
        return zlib.crc32(value.encode("utf-8", "surrogateescape"))
    return table_checksum(np.asarray(value))


def item_checksums(root: h5py.Group, arrays: Collection[str], own: str) -> dict[str, int]:
    """Return the checksums of all items below a group except `own`; of `arrays`, which have frames, type and shape."""
    sums = {}

    def note(path: str, item: h5py.Group | h5py.Dataset) -> None:
        if path == own:
            return
        for name in item.attrs:
            sums[f"{path}@{name}"] = attribute_checksum(item.attrs[name])
        if isinstance(item, h5py.Dataset):
            sums[path] = kind_checksum(item.dtype, item.shape) if path in arrays else table_checksum(item[...])

    note("", root)
    root.visititems(note)
    return sums


def damaged(path: str, what: str) -> DamageError:
    """Return the error for an item that has changed since it was written."""
    return DamageError(f"{path} is damaged: {what} does not have the checksum that it was written with.")


class FrameChecksums:
    """The checksums of arrays with frames, computed from consecutive parts of their rows: a table, (T, A) uint32."""

    def __init__(self, names: Collection[str], counts: Sequence[int]) -> None:
        """Begin with the first row of A arrays; `counts` of rows of each of the T frames."""
        self.table = np.zeros((len(counts), len(names)), np.uint32)
        self._ends = np.cumsum(np.asarray(counts, np.int64)).tolist()
        self._columns = {name: column for column, name in enumerate(names)}
        # For each array: the frame of the next row, and the number of that row.
        self._places = dict.fromkeys(names, (0, 0))

    def add(self, name: str, rows: np.ndarray) -> None:
        """Add the next rows of an array: part of a frame, or several frames."""
        column, (k, row) = self._columns[name], self._places[name]
        while len(rows):
            while self._ends[k] == row:
                k += 1
            of_frame = rows[: self._ends[k] - row]
            self.table[k, column] = checksum(of_frame, int(self.table[k, column]))
            row, rows = row + len(of_frame), rows[len(of_frame) :]
        self._places[name] = k, row

    def frame(self, name: str) -> int:
        """Return the frame of the next row of an array."""
        return self._places[name][0]


@dataclass(frozen=True)
class Checksums:
    """Checksums of A arrays with frames, (T, A) uint32, and of other items by "path" or "path@attribute" in a file."""

    file: str
    arrays: tuple[str, ...]
    table: np.ndarray
    items: dict[str, int]

    def require(self, key: str, found: int) -> None:
        """Compare the checksum of an item; DamageError: it differs or is unknown."""
        if self.items.get(key) != found:
            raise damaged(self.file, _item_name(key))

    def differences(self, found: Mapping[str, int]) -> list[DamageError]:
        """Return an error for each item (`item_checksums`) that differs, is missing, or is unknown."""
        keys = sorted(found.keys() | self.items.keys())
        return [damaged(self.file, _item_name(key)) for key in keys if found.get(key) != self.items.get(key)]

    def require_frame(self, t: int, path: str, rows: np.ndarray, number: int) -> None:
        """Compare the checksum of the rows of the t-th frame of the file, which is frame `number` of the run."""
        if path not in self.arrays or t >= len(self.table) or checksum(rows) != self.table[t, self.arrays.index(path)]:
            raise damaged(self.file, f"the data set {path} of frame {number}")


def store_checksums(
    root: h5py.Group, place: str, arrays: Sequence[str], table: np.ndarray, known: Mapping[str, int] | None = None
) -> None:
    """Write the checksums of all items below a complete group, at `place` in it.

    `table`, (T, A) uint32, has those of the frames of `arrays`; `known` are `item_checksums`, None to read all again.
    """
    path = f"{place}/{NAME}" if place else NAME
    sums = item_checksums(root, arrays, path) if known is None else known
    text = json.dumps({"arrays": list(arrays), "items": sums}, sort_keys=True)
    table = np.asarray(table, "<u4")
    data = root.create_dataset(path, data=table, track_times=False)
    data.attrs[_LIST] = text
    data.attrs[_OWN] = np.uint32(checksum(table, zlib.crc32(text.encode("utf-8"))))


def load_checksums(root: h5py.Group, place: str) -> Checksums:
    """Read the checksums that `store_checksums` wrote; DamageError: they have changed; KeyError: there are none."""
    data = root[f"{place}/{NAME}" if place else NAME]
    table, text = data[...], str(data.attrs[_LIST])
    if int(data.attrs[_OWN]) != checksum(table, zlib.crc32(text.encode("utf-8"))):
        raise damaged(root.file.filename, "the list of its checksums")
    told = json.loads(text)
    return Checksums(root.file.filename, tuple(told["arrays"]), table, told["items"])


def _item_name(key: str) -> str:
    """Return a key of `Checksums.items` in words."""
    path, at, name = key.rpartition("@")
    if not at:
        return f"the data set {key}"
    return f"the attribute {name} of {path}" if path else f"the attribute {name}"


def gaps_of(arrays: Sequence[h5py.Dataset]) -> list[Gap]:
    """Return offset and length of each contiguous array in its file; compressed arrays are left out."""
    places = [(data.id.get_offset(), data.id.get_storage_size()) for data in arrays if data.chunks is None]
    return sorted((offset, length) for offset, length in places if offset is not None and length)


def append_checksum(path: Path, gaps: Sequence[Gap] = ()) -> None:
    """Append to a closed file the checksum of all its bytes except those in `gaps`, ascending."""
    with path.open("r+b") as file:
        size = file.seek(0, 2)
        end = _file_end(file, size, gaps)
        file.seek(size)
        file.write(end)


def checksum_is_right(path: Path, gaps: Sequence[Gap] = ()) -> bool:
    """Return whether the last bytes of a file are the checksum of the bytes before."""
    with path.open("rb") as file:
        size = file.seek(0, 2) - len(_FILE_END.format(0))
        if size < 0:
            return False
        file.seek(size)
        return file.read() == _file_end(file, size, gaps)


def _file_end(file: BinaryIO, size: int, gaps: Sequence[Gap]) -> bytes:
    """Return the last bytes of a file, after its first `size` bytes."""
    total = 0
    starts, ends = [offset for offset, _ in gaps], [offset + length for offset, length in gaps]
    for first, end in zip([0, *ends], [*(min(start, size) for start in starts), size], strict=True):
        file.seek(first)
        while first < end and (block := file.read(min(_BLOCK, end - first))):
            total = zlib.crc32(block, total)
            first += len(block)
    return _FILE_END.format(total).encode("ascii")


def path_digest(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def sums_text(sums: Mapping[str, str]) -> str:
    """Return the text of checksums.sha256, from digests by the names of files."""
    return "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))


def sums_faults(directory: Path) -> tuple[int, list[str]]:
    """Return the number of files that checksums.sha256 lists, and a sentence for each that is missing or changed."""
    try:
        lines = (directory / SUMS).read_bytes().decode("ascii").splitlines(keepends=True)
    except (OSError, ValueError):
        return 0, [f"{directory / SUMS} is missing or damaged: the files beside it have no checksums."]
    matches = [_SUMS_LINE.fullmatch(line) for line in lines]
    if None in matches:
        return 0, [f"{directory / SUMS} is damaged: a line of it is not a checksum and the name of a file."]
    sums, faults = {match[2]: match[1] for match in matches}, []
    for name, digest in sums.items():
        path = directory / name
        try:
            if path_digest(path) != digest:
                faults.append(f"{path} has changed since it was written: its checksum differs.")
        except OSError as error:
            faults.append(f"{path} cannot be read ({error.strerror or error}).")
    return len(sums), faults
