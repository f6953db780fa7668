"""Reading the VTKHDF files of `output/vtkhdf.py`, which anybody may have changed."""

import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.checksums import Checksums, attribute_checksum, load_checksums, table_checksum
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.guarded_read import read_rows, read_whole, require_stored
from mpmcli.output.hdf5_heaps import require_sound_heaps
from mpmcli.output.hdf5_items import held
from mpmcli.output.layout import FrameLayout
from mpmcli.output.ledger_table import read_ledger
from mpmcli.output.vtkhdf import FORMAT
from mpmcli.output.vtkhdf_parts import BLOCK_BYTES, array_path

OLDEST = 1


def open_vtkhdf(path: Path, *, known: bool = False) -> h5py.File:
    """Open a sealed file for reading; it never changes again, so no lock is taken.

    Args:
        known: whether this process has written or opened it before: its heaps, which take a look at every byte, are
            not searched again.

    Raises:
        InputError: the file is missing, damaged, or was not written by mpmcli.
    """
    try:
        if not known:
            require_sound_heaps(path)
        try:
            file = h5py.File(path, "r", locking=False)
        except OSError:
            # This process has the file open with locking; HDF5 requires one setting for all handles.
            file = h5py.File(path, "r")
    except OSError as error:
        reason = "is not an HDF5 file, or a damaged one" if path.exists() else "does not exist"
        raise InputError(f"{path} {reason}; give a particles.vtkhdf of mpmcli or its directory.") from error
    try:
        form = _format(file)
    except BaseException:
        file.close()
        raise
    if form is not None and OLDEST <= form <= FORMAT:
        return file
    file.close()
    if form is not None and form > FORMAT:
        raise InputError(f"{path} was written by a newer version of mpmcli; update mpmcli to read it.")
    raise InputError(f"{path} is an HDF5 file, but mpmcli did not write it: its group /mpmcli is missing.")


def _format(file: h5py.File) -> int | None:
    """Return the format of a file, None where it is not of mpmcli."""
    try:
        form = held(file, "mpmcli").attrs["format"]
        ours = isinstance(form, np.integer) and isinstance(held(file, "VTKHDF"), h5py.Group)
        return int(form) if ours else None
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return None


def read_index(file: h5py.File) -> FrameIndex:
    """Read everything but the particles.

    Raises:
        DamageError: it has changed since it was written.
        InputError: a link in the file leads elsewhere.
        Exception: what h5py, numpy and JSON raise, and ValueError, where the file contradicts itself.
    """
    checksums = load_checksums(file, "mpmcli") if _format(file) > 1 else None

    def table(path: str, kinds: str = "iu") -> np.ndarray:
        found = read_whole(file, path, kinds)
        if checksums is not None:
            checksums.require(path, table_checksum(found))
        return found

    def attribute(name: str) -> str:
        found = group.attrs[name]
        if checksums is not None:
            checksums.require(f"mpmcli@{name}", attribute_checksum(found))
        return found

    group = held(file, "mpmcli")
    header = dict(json.loads(attribute("header")))
    if "scene" in group.attrs:
        header["scene"] = attribute("scene")
    layout = FrameLayout.from_dict(json.loads(attribute("layout")))
    return FrameIndex(
        layout=layout,
        header=header,
        times=table("VTKHDF/Steps/Values", "f"),
        frames=table("mpmcli/frame"),
        steps=table("mpmcli/step"),
        offsets=table("VTKHDF/Steps/PointOffsets"),
        counts=table("VTKHDF/NumberOfPoints"),
        ledger=read_ledger(held(file, "ledger"), lambda name, kinds: table(f"ledger/{name}", kinds)),
        checksums=checksums and _columns_of(checksums, layout),
    ).checked()


def _columns_of(checksums: Checksums, layout: FrameLayout) -> np.ndarray:
    """Return the checksums of the frames, (T, A) uint32, in the order of the arrays of the layout."""
    return checksums.table[:, [checksums.arrays.index(f"VTKHDF/{array_path(name)}") for name in layout.arrays]]


def read_array(file: h5py.File, name: str, offset: int, count: int) -> np.ndarray:
    """Read one array of one frame, in the form of the file; its checksum is not compared."""
    return read_rows(file, f"VTKHDF/{array_path(name)}", offset, count)


def read_blocks(file: h5py.File, name: str, offset: int, count: int) -> Iterator[np.ndarray]:
    """Yield rows of one array as `read_array`, BLOCK_BYTES at a time."""
    data = require_stored(file, f"VTKHDF/{array_path(name)}")
    size = max(1, BLOCK_BYTES * len(data) // max(1, data.nbytes))
    for first in range(offset, offset + count, size):
        yield data[first : min(first + size, offset + count)]
