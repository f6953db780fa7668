"""Checksums inside an HDF5 file: of each array in each frame, and of each table and attribute.

A group has a data set `checksums`, (T, A) uint32: the CRC-32 of the rows of frame t in array a. Its attribute `list`,
JSON, names the A arrays, and gives the CRC-32 of every other data set and attribute; its attribute `checksum` is the
CRC-32 of that text and of the table.
"""

import json
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from mpmcli.output.hdf5_items import DamageError, held, items

NAME = "checksums"
_LIST, _OWN = "list", "checksum"


def checksum(array: np.ndarray, before: int = 0) -> int:
    """Return the CRC-32 of the bytes of an array, after those whose CRC-32 is `before`."""
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8), before)


def frame_checksums(array: np.ndarray) -> list[int]:
    """Return the CRC-32 of each entry of an array along its first axis."""
    rows = np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8)
    return [zlib.crc32(row) for row in rows]


def damaged(path: str, what: str) -> DamageError:
    """Return the error of something that has changed since it was written."""
    return DamageError(f"{path} is damaged: {what} does not have the checksum that it was written with.")


class FrameChecksums:
    """Checksums of arrays with frames, whose rows are given a part after another.

    Attributes:
        table: (T, A) uint32, those of what was given so far.
    """

    def __init__(self, names: Collection[str], counts: Sequence[int]) -> None:
        """Begin with the first row of A arrays; `counts` of rows of each of the T frames."""
        self.table = np.zeros((len(counts), len(names)), np.uint32)
        self._ends = np.cumsum(np.asarray(counts, np.int64)).tolist()
        self._columns = {name: column for column, name in enumerate(names)}
        # Of each array: the frame of the next row, and the number of that row.
        self._places = dict.fromkeys(names, (0, 0))

    def add(self, name: str, rows: np.ndarray) -> None:
        """Add the next rows of an array, of parts of a frame or of several."""
        column, (k, row) = self._columns[name], self._places[name]
        while len(rows):
            while self._ends[k] == row:
                k += 1
            own = rows[: self._ends[k] - row]
            self.table[k, column] = checksum(own, int(self.table[k, column]))
            row, rows = row + len(own), rows[len(own) :]
        self._places[name] = k, row


@dataclass(frozen=True)
class Checksums:
    """Checksums of the frames and of the other items of a group.

    Attributes:
        file: path of the file.
        arrays: A paths from the group.
        table: (T, A) uint32.
        items: CRC-32 by path, "path" of a data set and "path@name" of an attribute.
    """

    file: str
    arrays: tuple[str, ...]
    table: np.ndarray
    items: dict[str, int]

    def require(self, key: str, found: int) -> None:
        """Compare the checksum of an item.

        Raises:
            DamageError: it differs, or the item is not known.
        """
        if self.items.get(key) != found:
            raise damaged(self.file, item_name(key))

    def require_items(self, found: Mapping[str, int]) -> None:
        """Compare the checksums of all items (`item_checksums`).

        Raises:
            DamageError: one differs, is missing, or is not known.
        """
        for error in self.differences(found):
            raise error

    def differences(self, found: Mapping[str, int]) -> list[DamageError]:
        """Return an error for each item (`item_checksums`) that differs, is missing, or is not known."""
        keys = sorted(found.keys() | self.items.keys())
        return [damaged(self.file, item_name(key)) for key in keys if found.get(key) != self.items.get(key)]

    def require_frame(self, t: int, path: str, rows: np.ndarray, number: int) -> None:
        """Compare the checksum of the rows of a frame.

        Args:
            t: place of the frame in the file; number: of the frame in its run.

        Raises:
            DamageError: it differs.
        """
        if path not in self.arrays or t >= len(self.table) or checksum(rows) != self.table[t, self.arrays.index(path)]:
            raise damaged(self.file, f"the data set {path} of frame {number}")


def store_checksums(
    root: h5py.Group, place: str, arrays: Sequence[str], table: np.ndarray, known: Mapping[str, int] | None = None
) -> None:
    """Write the checksums of all below a group.

    Args:
        root: the group; all of it has been written.
        place: path from it of the group that gets the data set.
        arrays: paths of the arrays with frames; table: (T, A) uint32.
        known: what `item_checksums` would find, None to read all items again.
    """
    path = f"{place}/{NAME}" if place else NAME
    found = item_checksums(root, arrays, path) if known is None else known
    text = json.dumps({"arrays": list(arrays), "items": found}, sort_keys=True)
    table = np.asarray(table, "<u4")
    data = root.create_dataset(path, data=table, track_times=False)
    data.attrs[_LIST] = text
    data.attrs[_OWN] = np.uint32(_own(text, table))


def load_checksums(root: h5py.Group, place: str) -> Checksums:
    """Read the checksums that `store_checksums` wrote.

    Raises:
        DamageError: they are missing or have changed.
    """
    path = f"{place}/{NAME}" if place else NAME
    file = root.file.filename
    try:
        data = held(root, path)
        table, text = data[...], str(data.attrs[_LIST])
        if int(data.attrs[_OWN]) != _own(text, table):
            raise damaged(file, "the list of its checksums")
        told = json.loads(text)
        return Checksums(file, tuple(told["arrays"]), table, told["items"])
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DamageError(f"{file} is damaged: its checksums cannot be read.") from error


def item_checksums(root: h5py.Group, arrays: Collection[str], own: str) -> dict[str, int]:
    """Return the checksums of all items below a group; of an array with frames only that of its type and shape.

    Args:
        arrays: paths of those; own: path of the checksums, which are left out.

    Raises:
        InputError: an item leads out of the file.
    """
    found = {}
    for path, item in items(root):
        if path == own:
            continue
        for name in item.attrs:
            found[f"{path}@{name}"] = attribute_checksum(item.attrs[name])
        if isinstance(item, h5py.Dataset):
            found[path] = dataset_checksum(item, bare=path in arrays)
    return found


def dataset_checksum(data: h5py.Dataset, *, bare: bool = False) -> int:
    """Return the checksum of the type, the shape and, unless `bare`, the content of a data set."""
    return kind_checksum(data.dtype, data.shape) if bare else table_checksum(data[...])


def kind_checksum(dtype: np.dtype, shape: tuple[int, ...]) -> int:
    """Return the checksum of the type and the shape of a data set."""
    return zlib.crc32(f"{dtype.str} {shape}\n".encode())


def table_checksum(array: np.ndarray) -> int:
    """Return the checksum of the type, the shape and the content of a data set that was read."""
    own = kind_checksum(array.dtype, array.shape)
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8), own)


def attribute_checksum(value: Any) -> int:
    """Return the checksum of an attribute as h5py gives it."""
    if isinstance(value, str):
        return zlib.crc32(value.encode("utf-8", "surrogateescape"))
    return table_checksum(np.asarray(value))


def item_name(key: str) -> str:
    """Return what a key of `Checksums.items` means, in words."""
    path, at, name = key.rpartition("@")
    if not at:
        return f"the data set {key}"
    return f"the attribute {name} of {path}" if path else f"the attribute {name}"


def _own(text: str, table: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(table).view(np.uint8).reshape(-1), zlib.crc32(text.encode("utf-8")))
