"""Temporal VTKHDF PolyData: one HDF5 file that VTK, ParaView and plain h5py read alike.

Source: VTK file formats, "VTKHDF file format", version 2.0 (PolyData, temporal); Kitware/VTK,
Documentation/docs/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.md. Top-level groups
other than /VTKHDF are ignored by VTK: /ledger and /mpmcli live there.

Particles of frame k are rows `Steps/PointOffsets[k]` to `+ NumberOfPoints[k]` of `Points` and of every
array in `PointData`. Each frame is drawn as one poly-vertex cell, and all frames share one list of
point numbers, so that the cells cost 8 bytes per particle once and not for every frame.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import (
    Checksums,
    attribute_checksum,
    checksum,
    kind_checksum,
    load_checksums,
    store_checksums,
    table_checksum,
)
from mpmcli.output.file_checksum import append_checksum, gaps_of
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.guarded_read import read_rows, read_whole
from mpmcli.output.hdf5_heaps import require_sound_heaps
from mpmcli.output.hdf5_items import held
from mpmcli.output.layout import POSITION, FrameLayout
from mpmcli.output.ledger_table import ledger_columns, read_ledger
from mpmcli.output.vtkhdf_parts import CONNECTIVITY, part_tables

# A newer upper bound makes files that no VTK can open ("bad version number for layout message").
LIBVER = ("v110", "v110")
# 1 has no checksums.
FORMAT = 2
OLDEST = 1
CHUNK_BYTES = 2**20
# Size without the particles: headers, tables of the steps, ledger. Used to reserve disk space.
OVERHEAD_BYTES = 64 * 1024
OVERHEAD_BYTES_PER_FRAME = 1024


def file_size(layout: FrameLayout, counts: Sequence[int]) -> int:
    """Bytes of an uncompressed file with frames of `counts` particles, rounded up."""
    particles = sum(counts) * layout.bytes_per_particle + 8 * max(counts, default=0)
    return particles + OVERHEAD_BYTES + OVERHEAD_BYTES_PER_FRAME * len(counts)


class VtkhdfWriter:
    """Write one file of T frames whose particle counts are known beforehand.

    Arrays are contiguous on disk: no chunk is padded, and a reader may map them. With `compress` they
    are gzip-1 with shuffle, the one filter that every VTK has, in chunks of about 1 MiB.

    The bytes of a file depend on its content alone, if arrays are written from the first frame to the last, and
    compressed ones one after the other; not on how many frames are written at once.
    """

    def __init__(self, path: Path, layout: FrameLayout, counts: Sequence[int], *, compress: bool = False) -> None:
        self._layout = layout
        self._counts = np.asarray(counts, dtype=np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(self._counts)])
        self._compress = compress
        self._checksums = np.zeros((len(counts), len(layout.arrays)), np.uint32)
        self._columns = {name: column for column, name in enumerate(layout.arrays)}
        # Of compressed arrays, rows that do not fill a chunk yet.
        self._waiting: dict[str, np.ndarray] = {}
        self._path, self._finished = path, False
        self._file = h5py.File(path, "w", libver=LIBVER, locking="best-effort", rdcc_nbytes=8 * CHUNK_BYTES)
        # Checksums of all items but the arrays of the frames, noted as they are written.
        self._items: dict[str, int] = {}
        root = self._file.create_group("VTKHDF")
        self._put_attribute("VTKHDF", "Version", np.array([2, 0]))
        self._put_attribute("VTKHDF", "Type", np.bytes_("PolyData"))
        # Kept open to the end: closing a dataset empties its cache, and a chunk shared by two frames
        # would be compressed and stored twice.
        self._datasets = {}
        for name, array in layout.arrays.items():
            shape = array.stored_shape(int(self._offsets[-1]))
            options = self._storage(shape, array.bytes_per_particle)
            self._datasets[name] = root.create_dataset(_path(name), shape, array.dtype, **options)
            self._items[f"VTKHDF/{_path(name)}"] = kind_checksum(np.dtype(array.dtype), shape)
        for name, table in part_tables(self._counts).items():
            options = self._storage(table.shape, table.itemsize) if name == CONNECTIVITY else {}
            self._put(f"VTKHDF/{name}", table, **options)

    def __enter__(self) -> "VtkhdfWriter":
        return self

    def __exit__(self, *_: object) -> None:
        gaps = gaps_of(list(self._datasets.values())) if self._finished else []
        self._file.close()
        if self._finished:
            append_checksum(self._path, gaps)

    def write_array(self, k: int, name: str, stored: np.ndarray, frames: int = 1) -> None:
        """Write one array of `frames` frames from the k-th on, in the form of the file (see `ArrayLayout.pad`)."""
        data, first = self._datasets[name], self._offsets[k]
        rows = np.ascontiguousarray(stored, data.dtype)
        for j in range(k, k + frames):
            frame = rows[self._offsets[j] - first : self._offsets[j + 1] - first]
            self._checksums[j, self._columns[name]] = checksum(frame)
        if data.chunks is None:
            data[first : self._offsets[k + frames]] = rows
        else:
            self._write_chunks(name, rows, int(self._offsets[k + frames]))

    @property
    def checksums(self) -> np.ndarray:
        """Those of the frames written so far, (T, arrays of the layout) uint32."""
        return self._checksums

    def _write_chunks(self, name: str, rows: np.ndarray, end: int) -> None:
        """Write whole chunks, each at once; those of the last rows of the array whole or not."""
        data = self._datasets[name]
        if name in self._waiting:
            rows = np.concatenate([self._waiting.pop(name), rows])
        first, size = end - len(rows), data.chunks[0]
        while len(rows) >= size or (len(rows) and end == len(data)):
            data[first : first + len(rows[:size])] = rows[:size]
            first, rows = first + len(rows[:size]), rows[size:]
        if len(rows):
            self._waiting[name] = rows

    def finish(
        self,
        times: Sequence[float],
        frames: Sequence[int],
        steps: Sequence[int],
        rows: Sequence[LedgerRow],
        header: dict,
    ) -> None:
        """Write what describes the frames; to be called once, after the last array.

        Args:
            times: s, one per frame.
            frames, steps: frame number and time steps since the start, one per frame.
            rows: the ledger, one row per frame.
            header: facts about the run that JSON can hold; its "scene", the TOML text, becomes an attribute.
        """
        for name, column in ledger_columns(rows).items():
            self._put(f"ledger/{name}", column)
        self._put("mpmcli/frame", np.asarray(frames, dtype=np.int64))
        self._put("mpmcli/step", np.asarray(steps, dtype=np.int64))
        facts = {
            "format": np.int64(FORMAT),
            "version": __version__,
            "dimension": np.int64(self._layout.dimension),
            "layout": json.dumps(self._layout.to_dict()),
            **({"scene": header["scene"]} if "scene" in header else {}),
            "header": json.dumps({key: value for key, value in header.items() if key != "scene"}),
        }
        for name, value in facts.items():
            self._put_attribute("mpmcli", name, value)
        self._put("VTKHDF/Steps/Values", np.asarray(times, dtype=np.float64))
        self._put_attribute("VTKHDF/Steps", "NSteps", np.int64(len(self._counts)))
        arrays = [f"VTKHDF/{_path(name)}" for name in self._columns]
        store_checksums(self._file, "mpmcli", arrays, self._checksums, self._items)
        self._finished = True

    def _put(self, path: str, table: np.ndarray, **options: Any) -> None:
        self._file.create_dataset(path, data=table, **options)
        self._items[path] = table_checksum(table)

    def _put_attribute(self, path: str, name: str, value: Any) -> None:
        if isinstance(value, str):
            # What a damaged file holds may be no text.
            value = value.encode("utf-8", "replace").decode("utf-8")
        self._file[path].attrs[name] = value
        self._items[f"{path}@{name}"] = attribute_checksum(value)

    def _storage(self, shape: tuple[int, ...], row_bytes: int) -> dict:
        if not self._compress or shape[0] == 0:
            return {}
        # A chunk holds whole frames, or a whole number of chunks makes a frame, when counts are equal.
        rows, n = max(1, CHUNK_BYTES // row_bytes), max(1, int(self._counts.max()))
        chunk = n * (rows // n) if rows >= n else -(-n // -(-n // rows))
        return {
            "chunks": (min(chunk, shape[0]), *shape[1:]),
            "compression": "gzip",
            "compression_opts": 1,
            "shuffle": True,
        }


def open_vtkhdf(path: Path) -> h5py.File:
    """Open a sealed file for reading; it never changes again, so no lock is taken.

    Raises:
        InputError: the file is missing, damaged, or was not written by mpmcli.
    """
    try:
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
    return checksums.table[:, [checksums.arrays.index(f"VTKHDF/{_path(name)}") for name in layout.arrays]]


def read_array(file: h5py.File, name: str, offset: int, count: int) -> np.ndarray:
    """Read one array of one frame, in the form of the file; its checksum is not compared."""
    return read_rows(file, f"VTKHDF/{_path(name)}", offset, count)


def _path(name: str) -> str:
    return name if name == POSITION else f"PointData/{name}"
