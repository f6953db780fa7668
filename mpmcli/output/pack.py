"""Packing: many sealed files become one file, proved equal before it takes its name."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.errors import InputError, NoRoomError, RunError
from mpmcli.output.checksums import FrameChecksums, damaged
from mpmcli.output.durable import is_full, require_free_space, sealed, sync_file
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.hdf5_items import DamageError
from mpmcli.output.vtkhdf import VtkhdfWriter
from mpmcli.output.vtkhdf_parts import CONNECTIVITY, file_size, part_tables
from mpmcli.output.vtkhdf_reader import open_vtkhdf, read_blocks, read_index

# Numbers that are compared at once.
PART = 2**17


def pack_segments(
    segments: Sequence[Path],
    target: Path,
    *,
    compress: bool = False,
    frames: int | None = None,
    header: Mapping[str, Any] | None = None,
    known: bool = False,
    begun: VtkhdfWriter | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Write all frames of `segments` into `target`, compare what it reads back, then give it its name.

    Memory is that of a block of one array. The segments are left as they are.

    Args:
        segments: sealed VTKHDF files of one run, in order.
        target: file to make; an existing one is replaced at the very end.
        compress: gzip-1 with shuffle.
        frames: how many to take, all if None.
        header: of the packed file, that of the segments by default; "scene" may differ, as a resumed run may end later.
        known: whether this process has written or verified the segments.
        begun: of the temporary file of `target`, with all arrays of all frames (`PackedBeside`); nothing is copied.
        stop: called for each block of an array; True ends the packing.

    Raises:
        KeyboardInterrupt: `stop` returned True; no `target` is made then.
        RunError: the disk cannot hold the packed file, the segments do not belong together, or the
            packed file does not read back as it was written. No `target` is made then.
    """
    try:
        indices = [_read_index(segment, known=known) for segment in segments]
    except InputError as error:
        raise RunError(f"{error} The frames in {segments[0].parent} were left unpacked.") from error
    first = indices[0]
    facts = first.header if header is None else dict(header)
    for segment, index in zip(segments, indices, strict=True):
        if index.layout != first.layout or any(index.header.get(key) != facts[key] for key in facts if key != "scene"):
            raise RunError(f"{segment} is of another run than {segments[0]}: the frames were left unpacked.")
    if frames is not None:
        indices = _first_frames(indices, frames)
        segments = segments[: len(indices)]
    expected = replace(FrameIndex.joined(indices), header=facts)
    counts = expected.counts.tolist()
    kept = f"the {len(counts)} frames written are kept in {segments[0].parent} and stay readable there"
    purpose = f"packing the frames into {target.name}"
    size = 0
    if begun is None:
        size = file_size(first.layout, counts)
        require_free_space(target.parent, size, purpose, kept)
    try:
        with sealed(target, size) as temporary:
            with begun or VtkhdfWriter(temporary, first.layout, counts, compress=compress) as writer:
                if begun is None:
                    _copy(segments, indices, writer, stop, by_name=compress)
                _require_unchanged(writer.checksums, expected, segments, indices)
                writer.finish(expected.times, expected.frames, expected.steps, expected.ledger, header=expected.header)
            sync_file(temporary)
            difference = find_difference(temporary, replace(expected, checksums=writer.checksums), stop)
            if difference:
                raise RunError(f"{target.name} does not read back as it was written ({difference}); {kept}.")
    except (OSError, RuntimeError, InputError) as error:
        reason = getattr(error, "strerror", None) or error
        fault = NoRoomError if is_full(error) else RunError
        raise fault(f"{target} could not be written ({reason}); {kept}.") from error


def _copy(
    segments: Sequence[Path],
    indices: Sequence[FrameIndex],
    writer: VtkhdfWriter,
    stop: Callable[[], bool],
    *,
    by_name: bool,
) -> None:
    """Copy all arrays of all segments, segment by segment, or array by array, which opens each segment more often."""
    names = list(indices[0].layout.arrays)
    for group in [[name] for name in names] if by_name else [names]:
        for segment, index in zip(segments, indices, strict=True):
            with closing(open_vtkhdf(segment, known=True)) as source:
                for name in group:
                    for block in read_blocks(source, name, 0, int(index.counts.sum())):
                        if stop():
                            raise KeyboardInterrupt
                        writer.append(name, block)


def _require_unchanged(
    found: np.ndarray, expected: FrameIndex, segments: Sequence[Path], indices: Sequence[FrameIndex]
) -> None:
    """Compare the checksums of what was read with those of the segments, where these have any.

    Raises:
        InputError: they differ.
    """
    k = 0
    for segment, index in zip(segments, indices, strict=True):
        if index.checksums is not None:
            differing = np.argwhere(found[k : k + len(index.counts)] != index.checksums)
            for frame, column in differing[:1]:
                name = list(expected.layout.arrays)[column]
                raise damaged(str(segment), f"{name} of frame {index.frames[frame]}")
        k += len(index.counts)


def _first_frames(indices: Sequence[FrameIndex], frames: int) -> list[FrameIndex]:
    found = []
    for index in indices:
        if frames <= 0:
            break
        found.append(index.first(frames))
        frames -= len(index.counts)
    return found


def find_difference(packed: Path, expected: FrameIndex, stop: Callable[[], bool] = lambda: False) -> str:
    """Read a packed file, and compare it with what went into it.

    Args:
        expected: its index; of the arrays of the frames, their checksums.

    Returns:
        What differs first, in words; "" when nothing does.

    Raises:
        KeyboardInterrupt: `stop` returned True.
    """
    with closing(open_vtkhdf(packed, known=True)) as file:
        try:
            index = read_index(file)
        except (DamageError, ValueError) as error:
            return str(error).rstrip(".")
        for table in ("times", "frames", "steps", "offsets", "counts", "checksums"):
            if not _same(getattr(index, table), getattr(expected, table)):
                return f"the {table} of the frames"
        # The text form compares NaN with NaN as equal.
        if repr(index.ledger) != repr(expected.ledger):
            return "the ledger"
        if index.header != expected.header or index.layout != expected.layout:
            return "the header"
        root = file["VTKHDF"]
        for name, table in part_tables(expected.counts).items():
            if not _same(root[name][...], table):
                return name
        if not _counts_up(root[CONNECTIVITY], int(expected.counts.max())):
            return CONNECTIVITY
        if root["Steps"].attrs["NSteps"] != len(expected.counts):
            return "NSteps"
        found = FrameChecksums(expected.layout.arrays, expected.counts)
        for column, name in enumerate(expected.layout.arrays):
            for block in read_blocks(file, name, 0, int(expected.counts.sum())):
                if stop():
                    raise KeyboardInterrupt
                found.add(name, block)
            for frame in np.flatnonzero(found.table[:, column] != expected.checksums[:, column])[:1]:
                return f"{name} of frame {expected.frames[frame]}"
    return ""


def _read_index(segment: Path, *, known: bool) -> FrameIndex:
    with closing(open_vtkhdf(segment, known=known)) as file:
        return read_index(file)


def _counts_up(data: h5py.Dataset, n: int) -> bool:
    """Return whether a data set holds the numbers from 0 to n - 1 as int64."""
    firsts = range(0, n, PART)
    return data.shape == (n,) and all(
        _same(data[k : k + PART], np.arange(k, min(k + PART, n), dtype=np.int64)) for k in firsts
    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal in type, shape and every bit, so that NaN equals itself and -0.0 is not 0.0."""
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return bool(np.array_equal(a.reshape(-1).view(np.uint8), b.reshape(-1).view(np.uint8)))
