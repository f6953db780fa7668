"""Temporal VTKHDF PolyData: one HDF5 file that VTK, ParaView and plain h5py read alike.

Source: VTK file formats, "VTKHDF file format", version 2.0 (PolyData, temporal); Kitware/VTK,
Documentation/docs/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.md. Top-level groups
other than /VTKHDF are ignored by VTK: /ledger and /mpmcli live there.

Particles of frame k are rows `Steps/PointOffsets[k]` to `+ NumberOfPoints[k]` of `Points` and of every
array in `PointData`. Each frame is drawn as one poly-vertex cell, and all frames share one list of
point numbers, so that the cells cost 8 bytes per particle once and not for every frame.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import (
    FrameChecksums,
    append_checksum,
    attribute_checksum,
    checksum,
    gaps_of,
    kind_checksum,
    load_checksums,
    opened,
    require_format,
    store_checksums,
    table_checksum,
)
from mpmcli.output.layout import POSITION, FrameIndex, FrameLayout, ledger_columns, read_ledger

# A newer upper bound produces files that no VTK can open ("bad version number for layout message").
LIBVER = ("v110", "v110")
FORMAT = 2
CHUNK_BYTES = 2**20
# Size without particles: headers, tables of the steps, ledger. Used to reserve disk space.
OVERHEAD_BYTES = 64 * 1024
OVERHEAD_BYTES_PER_FRAME = 1024
# Size of a copied block, which fits into a cache of the processor.
BLOCK_BYTES = 2**20
# The numbers of the particles of the largest frame, from 0 on.
CONNECTIVITY = "Vertices/Connectivity"
UNUSED_CELLS = ("Lines", "Polygons", "Strips")


def array_path(name: str) -> str:
    """Return the path of an array of frames under /VTKHDF."""
    return name if name == POSITION else f"PointData/{name}"


def file_size(layout: FrameLayout, counts: Sequence[int]) -> int:
    """Bytes of an uncompressed file with frames of `counts` particles, rounded up."""
    particles = sum(counts) * layout.bytes_per_particle + 8 * max(counts, default=0)
    return particles + OVERHEAD_BYTES + OVERHEAD_BYTES_PER_FRAME * len(counts)


def part_tables(counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return the items of /VTKHDF, except CONNECTIVITY, that follow from (T,) particle counts: one cell per frame."""
    number = len(counts)
    cells = (counts > 0).astype(np.int64)
    zeros, cell_offsets = np.zeros(number, np.int64), np.zeros((number, 4), np.int64)
    cell_offsets[:, 0] = np.cumsum(cells) - cells
    tables = {
        "NumberOfPoints": counts,
        "Vertices/NumberOfCells": cells,
        "Vertices/NumberOfConnectivityIds": counts,
        "Vertices/Offsets": np.concatenate([[0, n] if n else [0] for n in counts]).astype(np.int64),
        "Steps/PartOffsets": np.arange(number, dtype=np.int64),
        "Steps/NumberOfParts": np.ones(number, np.int64),
        "Steps/PointOffsets": np.cumsum(counts) - counts,
        "Steps/CellOffsets": cell_offsets,
        # Point numbers count from the frame's first particle, so every frame uses the same list.
        "Steps/ConnectivityIdOffsets": np.zeros((number, 4), np.int64),
    }
    for name in UNUSED_CELLS:
        # The reader opens all four kinds of cells, used or not.
        tables[f"{name}/NumberOfCells"] = tables[f"{name}/NumberOfConnectivityIds"] = zeros
        tables[f"{name}/Connectivity"], tables[f"{name}/Offsets"] = zeros[:0], zeros
    return tables


class VtkhdfWriter:
    """Writes one file of T frames whose particle counts are known beforehand.

    Arrays are contiguous; with `compress` they use gzip-1 with shuffle, the only filter of every VTK, in chunks of
    about 1 MiB. The bytes depend on the content alone if each array is written from the first frame to the last, and
    compressed arrays one after the other.
    """

    def __init__(self, path: Path, layout: FrameLayout, counts: Sequence[int], *, compress: bool = False) -> None:
        """Create the file and its datasets, and write all that follows from the counts."""
        self._layout = layout
        self._counts = np.asarray(counts, dtype=np.int64)
        self._compress = compress
        self._checksums = FrameChecksums(layout.arrays, self._counts)
        # Number of rows written of each array.
        self._rows = dict.fromkeys(layout.arrays, 0)
        # For compressed arrays, rows that do not yet fill a chunk.
        self._waiting: dict[str, np.ndarray] = {}
        self._path, self._finished = path, False
        self._file = h5py.File(path, "w", libver=LIBVER, locking="best-effort", rdcc_nbytes=8 * CHUNK_BYTES)
        # Checksums of all items except the arrays of the frames, recorded as they are written.
        self._items: dict[str, int] = {}
        root = self._file.create_group("VTKHDF")
        self._put_attribute("VTKHDF", "Version", np.array([2, 0]))
        self._put_attribute("VTKHDF", "Type", np.bytes_("PolyData"))
        # Kept open to the end: closing a dataset empties its cache, and a chunk shared by two frames
        # would be compressed and stored twice.
        self._datasets = {}
        for name, array in layout.arrays.items():
            shape = array.stored_shape(int(self._counts.sum()))
            options = self._storage(shape, array.bytes_per_particle)
            self._datasets[name] = root.create_dataset(array_path(name), shape, array.dtype, **options)
            self._items[f"VTKHDF/{array_path(name)}"] = kind_checksum(np.dtype(array.dtype), shape)
        for name, table in part_tables(self._counts).items():
            self._put(f"VTKHDF/{name}", table)
        # The numbers of the particles, written at once if compressed, because chunks cannot be divided.
        n, path = int(self._counts.max()), f"VTKHDF/{CONNECTIVITY}"
        size = max(1, n if compress else BLOCK_BYTES // 8)
        data = self._file.create_dataset(path, (n,), np.int64, **self._storage((n,), 8))
        self._items[path] = kind_checksum(data.dtype, data.shape)
        for first in range(0, n, size):
            numbers = np.arange(first, min(first + size, n), dtype=np.int64)
            data[first : first + size] = numbers
            self._items[path] = checksum(numbers, self._items[path])

    def __enter__(self) -> "VtkhdfWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; an unfinished file is unusable."""
        if not self._file:
            return
        gaps = gaps_of(list(self._datasets.values())) if self._finished else []
        self._file.close()
        if self._finished:
            append_checksum(self._path, gaps)

    def append(self, name: str, stored: np.ndarray) -> None:
        """Write the next rows of an array, part of a frame or several frames, as returned by `ArrayLayout.pad`."""
        data, first = self._datasets[name], self._rows[name]
        rows = np.ascontiguousarray(stored, data.dtype)
        self._rows[name] = end = first + len(rows)
        self._checksums.add(name, rows)
        if data.chunks is None:
            data[first:end] = rows
            return
        # Write whole chunks, each at once; the last chunk of the array may be partial.
        if name in self._waiting:
            rows = np.concatenate([self._waiting.pop(name), rows])
        first, size = end - len(rows), data.chunks[0]
        while len(rows) >= size or (len(rows) and end == len(data)):
            data[first : first + len(rows[:size])] = rows[:size]
            first, rows = first + len(rows[:size]), rows[size:]
        if len(rows):
            self._waiting[name] = rows

    @property
    def checksums(self) -> np.ndarray:
        """Checksums of the frames written so far, (T, arrays of the layout) uint32."""
        return self._checksums.table

    def finish(
        self,
        times: Sequence[float],
        frames: Sequence[int],
        steps: Sequence[int],
        rows: Sequence[LedgerRow],
        header: dict,
    ) -> None:
        """Write the description of the frames, once, after the last array; the header's scene becomes an attribute."""
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
        arrays = [f"VTKHDF/{array_path(name)}" for name in self._layout.arrays]
        store_checksums(self._file, "mpmcli", arrays, self.checksums, self._items)
        self._finished = True

    def _put(self, path: str, table: np.ndarray) -> None:
        self._file.create_dataset(path, data=table)
        self._items[path] = table_checksum(table)

    def _put_attribute(self, path: str, name: str, value: Any) -> None:
        self._file[path].attrs[name] = value
        self._items[f"{path}@{name}"] = attribute_checksum(value)

    def _storage(self, shape: tuple[int, ...], row_bytes: int) -> dict:
        """Return the arguments of h5py for a dataset of rows of this size: none, or chunks and compression."""
        if not self._compress or shape[0] == 0:
            return {}
        # With equal counts, a chunk contains whole frames, or a frame is a whole number of chunks.
        rows, n = max(1, CHUNK_BYTES // row_bytes), max(1, int(self._counts.max()))
        chunk = n * (rows // n) if rows >= n else -(-n // -(-n // rows))
        return {
            "chunks": (min(chunk, shape[0]), *shape[1:]),
            "compression": "gzip",
            "compression_opts": 1,
            "shuffle": True,
        }


@contextmanager
def open_vtkhdf(path: Path) -> Iterator[h5py.File]:
    """Open a sealed file for reading as `opened` does; InputError: it is not of mpmcli, or of another format."""
    with opened(path, "a particles.vtkhdf of mpmcli or its directory") as file:
        if "mpmcli" not in file or "VTKHDF" not in file:
            raise InputError(f"{path} is an HDF5 file, but mpmcli did not write it: its group /mpmcli is missing.")
        require_format(path, file["mpmcli"].attrs["format"], FORMAT)
        yield file


def read_index(file: h5py.File) -> FrameIndex:
    """Read everything except particles; DamageError: a checksum differs; errors of h5py or ValueError: other faults."""
    checksums = load_checksums(file, "mpmcli")

    def table(path: str) -> np.ndarray:
        found = file[path][...]
        checksums.require(path, table_checksum(found))
        return found

    def attribute(name: str) -> str:
        found = file["mpmcli"].attrs[name]
        checksums.require(f"mpmcli@{name}", attribute_checksum(found))
        return found

    header = json.loads(attribute("header"))
    if "scene" in file["mpmcli"].attrs:
        header["scene"] = attribute("scene")
    layout = FrameLayout.from_dict(json.loads(attribute("layout")))
    columns = [checksums.arrays.index(f"VTKHDF/{array_path(name)}") for name in layout.arrays]
    return FrameIndex(
        layout=layout,
        header=header,
        times=table("VTKHDF/Steps/Values"),
        frames=table("mpmcli/frame"),
        steps=table("mpmcli/step"),
        offsets=table("VTKHDF/Steps/PointOffsets"),
        counts=table("VTKHDF/NumberOfPoints"),
        ledger=read_ledger(file["ledger"], lambda name: table(f"ledger/{name}")),
        checksums=checksums.table[:, columns],
    )


def read_index_of(path: Path) -> FrameIndex:
    """Return the index of a file; errors are those of `open_vtkhdf`."""
    with open_vtkhdf(path) as file:
        return read_index(file)


def read_blocks(file: h5py.File, name: str, count: int) -> Iterator[np.ndarray]:
    """Yield the first rows of an array, in the form in the file, BLOCK_BYTES at a time; no checksum is compared."""
    data = file[f"VTKHDF/{array_path(name)}"]
    size = max(1, BLOCK_BYTES * len(data) // max(1, data.nbytes))
    for first in range(0, count, size):
        yield data[first : min(first + size, count)]
