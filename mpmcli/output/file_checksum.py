"""The last bytes of a file: a checksum of all bytes before them, which no reader of HDF5 reads.

Those of arrays that have checksums for each frame are left out, so that large files are read once.
"""

import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py

_FORM = "\nmpmcli crc32 {:08x}\n"
LENGTH = len(_FORM.format(0))
_BLOCK = 2**22
Gap = tuple[int, int]


def gaps_of(arrays: Sequence[h5py.Dataset]) -> list[Gap]:
    """Return offset and length of the contiguous arrays in their file; compressed ones have none."""
    found = [(data.id.get_offset(), data.id.get_storage_size()) for data in arrays if data.chunks is None]
    return sorted((offset, length) for offset, length in found if offset is not None and length)


def append_checksum(path: Path, gaps: Sequence[Gap] = ()) -> None:
    """Append the checksum to a closed file, of all its bytes but those in `gaps`, ascending."""
    with path.open("r+b") as file:
        size = file.seek(0, 2)
        total = _checksum(file, size, gaps)
        file.seek(size)
        file.write(_FORM.format(total).encode("ascii"))


def checksum_is_right(path: Path, gaps: Sequence[Gap] = ()) -> bool:
    """Return whether the last bytes of a file are the checksum of those before."""
    with path.open("rb") as file:
        size = file.seek(0, 2) - LENGTH
        if size < 0:
            return False
        file.seek(size)
        return file.read() == _FORM.format(_checksum(file, size, gaps)).encode("ascii")


def _checksum(file: object, size: int, gaps: Sequence[Gap]) -> int:
    total = 0
    for first, end in _pieces(size, gaps):
        file.seek(first)
        while first < end and (block := file.read(min(_BLOCK, end - first))):
            total = zlib.crc32(block, total)
            first += len(block)
    return total


def _pieces(size: int, gaps: Sequence[Gap]) -> Iterator[tuple[int, int]]:
    first = 0
    for offset, length in gaps:
        yield first, min(offset, size)
        first = offset + length
    yield first, size
