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

import h5py
import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.guarded_read import read_rows, read_whole
from mpmcli.output.hdf5_heaps import require_sound_heaps
from mpmcli.output.layout import POSITION, FrameLayout
from mpmcli.output.ledger_table import ledger_columns, read_ledger

# A newer upper bound makes files that no VTK can open ("bad version number for layout message").
LIBVER = ("v110", "v110")
FORMAT = 1
CONNECTIVITY = "Vertices/Connectivity"
UNUSED_CELLS = ("Lines", "Polygons", "Strips")
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
    """

    def __init__(self, path: Path, layout: FrameLayout, counts: Sequence[int], *, compress: bool = False) -> None:
        self._layout = layout
        self._counts = np.asarray(counts, dtype=np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(self._counts)])
        self._compress = compress
        self._file = h5py.File(path, "w", libver=LIBVER, locking="best-effort", rdcc_nbytes=8 * CHUNK_BYTES)
        root = self._root = self._file.create_group("VTKHDF")
        root.attrs["Version"] = [2, 0]
        root.attrs["Type"] = np.bytes_("PolyData")
        # Kept open to the end: closing a dataset empties its cache, and a chunk shared by two frames
        # would be compressed and stored twice.
        self._datasets = {}
        for name, array in layout.arrays.items():
            shape = array.stored_shape(int(self._offsets[-1]))
            options = self._storage(shape, array.bytes_per_particle)
            self._datasets[name] = root.create_dataset(_path(name), shape, array.dtype, **options)
        for name, table in part_tables(self._counts).items():
            options = self._storage(table.shape, table.itemsize) if name == CONNECTIVITY else {}
            root.create_dataset(name, data=table, **options)

    def __enter__(self) -> "VtkhdfWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write_array(self, k: int, name: str, stored: np.ndarray, frames: int = 1) -> None:
        """Write one array of `frames` frames from the k-th on, in the form of the file (see `ArrayLayout.pad`)."""
        self._datasets[name][self._offsets[k] : self._offsets[k + frames]] = stored

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
        ledger = self._file.create_group("ledger")
        for name, column in ledger_columns(rows).items():
            ledger.create_dataset(name, data=column)
        group = self._file.create_group("mpmcli")
        group["frame"] = np.asarray(frames, dtype=np.int64)
        group["step"] = np.asarray(steps, dtype=np.int64)
        group.attrs["format"] = FORMAT
        group.attrs["version"] = __version__
        group.attrs["dimension"] = self._layout.dimension
        group.attrs["layout"] = json.dumps(self._layout.to_dict())
        if "scene" in header:
            group.attrs["scene"] = header["scene"]
        group.attrs["header"] = json.dumps({key: value for key, value in header.items() if key != "scene"})
        steps_group = self._root["Steps"]
        steps_group["Values"] = np.asarray(times, dtype=np.float64)
        steps_group.attrs["NSteps"] = len(self._counts)

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


def part_tables(counts: np.ndarray) -> dict[str, np.ndarray]:
    """Everything under /VTKHDF that follows from the (T,) particle counts alone, by path.

    Each frame is one part with one poly-vertex cell, or none where it has no particles.
    """
    number = len(counts)
    cells = (counts > 0).astype(np.int64)
    zeros, cell_offsets = np.zeros(number, np.int64), np.zeros((number, 4), np.int64)
    cell_offsets[:, 0] = np.cumsum(cells) - cells
    tables = {
        "NumberOfPoints": counts,
        "Vertices/NumberOfCells": cells,
        "Vertices/NumberOfConnectivityIds": counts,
        "Vertices/Offsets": np.concatenate([[0, n] if n else [0] for n in counts]).astype(np.int64),
        CONNECTIVITY: np.arange(counts.max(), dtype=np.int64),
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
        form = file["mpmcli"].attrs.get("format") if "VTKHDF" in file and "mpmcli" in file else None
        known = isinstance(form, np.integer) and isinstance(file["VTKHDF"], h5py.Group)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        file.close()
        raise InputError(f"{path} is damaged: its group /mpmcli cannot be read.") from error
    if known and form == FORMAT:
        return file
    file.close()
    if known and form > FORMAT:
        raise InputError(f"{path} was written by a newer version of mpmcli; update mpmcli to read it.")
    raise InputError(f"{path} is an HDF5 file, but mpmcli did not write it: its group /mpmcli is missing.")


def read_index(file: h5py.File) -> FrameIndex:
    """Read everything but the particles.

    Raises:
        Exception: what h5py, numpy and JSON raise, and ValueError, where the file contradicts itself.
    """
    group, steps = file["mpmcli"], file["VTKHDF/Steps"]
    header = dict(json.loads(group.attrs["header"]))
    if "scene" in group.attrs:
        header["scene"] = group.attrs["scene"]
    return FrameIndex(
        layout=FrameLayout.from_dict(json.loads(group.attrs["layout"])),
        header=header,
        times=read_whole(steps, "Values", "f"),
        frames=read_whole(group, "frame", "iu"),
        steps=read_whole(group, "step", "iu"),
        offsets=read_whole(steps, "PointOffsets", "iu"),
        counts=read_whole(file, "VTKHDF/NumberOfPoints", "iu"),
        ledger=read_ledger(file["ledger"]),
    ).checked()


def read_array(file: h5py.File, name: str, offset: int, count: int) -> np.ndarray:
    """Read one array of one frame, in the form of the file."""
    return read_rows(file["VTKHDF"], _path(name), offset, count)


def _path(name: str) -> str:
    return name if name == POSITION else f"PointData/{name}"
