"""The global heaps of an HDF5 file, where texts of attributes are: the library walks through them without end where one
object has a size of 0.

Source: The HDF Group, HDF5 File Format Specification 3.0, III.E "Disk Format: Level 1E - Global Heap".
"""

import mmap
from pathlib import Path

_SIGNATURE = b"GCOL\x01\0\0\0"
_HEAD = 16
# Larger files are not searched, which would take seconds.
MOST_SEARCHED = 2**26


def require_sound_heaps(path: Path) -> None:
    """Refuse a file of up to 64 MiB in which an object of a global heap does not end in its heap.

    Raises:
        OSError: it does not, or the file cannot be read.
    """
    size = path.stat().st_size
    if not 0 < size <= MOST_SEARCHED:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(_SIGNATURE)
        while at >= 0:
            _require_sound(data, at, size)
            at = data.find(_SIGNATURE, at + 1)


def _require_sound(data: mmap.mmap, start: int, size: int) -> None:
    end = start + int.from_bytes(data[start + 8 : start + _HEAD], "little")
    if not start + _HEAD < end <= size:
        raise OSError("a heap does not end in the file")
    at = start + _HEAD
    while at + _HEAD <= end:
        index = int.from_bytes(data[at : at + 2], "little")
        length = int.from_bytes(data[at + 8 : at + _HEAD], "little")
        # Index 0 is the free space at the end, whose length counts its head.
        needed = _HEAD + -(-length // 8) * 8 if index else length
        if needed < _HEAD or at + needed > end:
            raise OSError("an object does not end in its heap")
        at += needed
