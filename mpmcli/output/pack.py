"""Packing: many sealed files become one file, proved equal before it takes its name."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.errors import InputError, NoRoomError, RunError
from mpmcli.output.checksums import FrameChecksums, damaged
from mpmcli.output.durable import ask_for, is_full, require_free_space, sealed, sync_file, temporary_of
from mpmcli.output.guarded_read import DamageError
from mpmcli.output.layout import FrameIndex, FrameLayout
from mpmcli.output.vtkhdf import (
    CONNECTIVITY,
    VtkhdfWriter,
    file_size,
    open_vtkhdf,
    part_tables,
    read_blocks,
    read_index,
    read_index_of,
)

# Numbers that are compared at once.
PART = 2**17
# Segments with their indices.
Segments = Sequence[tuple[Path, FrameIndex]]


class PackedBeside:
    """The temporary file of a packed result, which gets all frames of a run in order.

    It is given up, its writer is None, where it cannot be written or other frames come; then segments are packed.
    """

    def __init__(self, target: Path, layout: FrameLayout, frames: int, particles: int) -> None:
        """Begin the temporary file of `target`, if the disk has room for all frames twice."""
        self._temporary, self._frames, self._particles = temporary_of(target), frames, particles
        # Frames whose arrays it has, and those of them whose segments are sealed.
        self._written = self._sealed = 0
        self.writer: VtkhdfWriter | None = None
        counts = [particles] * frames
        size = file_size(layout, counts)
        with suppress(OSError, RuntimeError, RunError):
            require_free_space(target.parent, size, "the packed file", "", joined=size)
            ask_for(self._temporary, size)
            self.writer = VtkhdfWriter(self._temporary, layout, counts)

    @property
    def whole(self) -> bool:
        """Whether it has all frames."""
        return self.writer is not None and self._sealed == self._frames

    def expect(self, first: int, counts: Sequence[int]) -> None:
        """Give it up unless frames with so many particles, from number `first` on, are the next ones."""
        fit = first == self._written and first + len(counts) <= self._frames
        if not fit or any(count != self._particles for count in counts):
            self.give_up()
        self._written += len(counts)

    def append(self, name: str, stored: np.ndarray) -> None:
        """Write the rows of an array of all frames that were expected last, as `VtkhdfWriter.append`."""
        try:
            if self.writer is not None:
                self.writer.append(name, stored)
        except (OSError, RuntimeError, TypeError, ValueError):
            self.give_up()

    def seal(self, frames: int, *, sync: bool) -> None:
        """Note that so many more frames are sealed; `sync` what was written, so that little is left for the end."""
        self._sealed += frames
        if sync and self.writer is not None:
            with suppress(OSError):
                sync_file(self._temporary)

    def give_up(self) -> None:
        """Close and remove the file."""
        writer, self.writer = self.writer, None
        with suppress(OSError, RuntimeError):
            if writer is not None:
                writer.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)


def pack_segments(
    segments: Sequence[Path],
    target: Path,
    *,
    compress: bool = False,
    header: Mapping[str, Any],
    begun: VtkhdfWriter | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Write all frames of sealed segments of one run into `target`, prove it equal, then give it its name.

    Segments stay as they are; memory is that of a block of one array. "scene" of the header may differ from that of the
    segments. `begun` has all arrays already (`PackedBeside`).
    RunError, and no `target`: the disk is too small, segments are of several runs, or it does not read back.
    """
    try:
        parts = [(segment, read_index_of(segment, known=True)) for segment in segments]
    except InputError as error:
        raise RunError(f"{error} The frames in {segments[0].parent} were left unpacked.") from error
    first = parts[0][1]
    facts = dict(header)
    for segment, index in parts:
        if index.layout != first.layout or any(index.header.get(key) != facts[key] for key in facts if key != "scene"):
            raise RunError(f"{segment} is of another run than {segments[0]}: the frames were left unpacked.")
    expected = replace(FrameIndex.joined([index for _, index in parts]), header=facts)
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
                    _copy(parts, writer, stop, by_name=compress)
                _require_unchanged(writer.checksums, parts)
                writer.finish(expected.times, expected.frames, expected.steps, expected.ledger, header=expected.header)
            sync_file(temporary)
            difference = find_difference(temporary, replace(expected, checksums=writer.checksums), stop)
            if difference:
                raise RunError(f"{target.name} does not read back as it was written ({difference}); {kept}.")
    except (OSError, RuntimeError, InputError) as error:
        reason = getattr(error, "strerror", None) or error
        fault = NoRoomError if is_full(error) else RunError
        raise fault(f"{target} could not be written ({reason}); {kept}.") from error


def _copy(segments: Segments, writer: VtkhdfWriter, stop: Callable[[], bool], *, by_name: bool) -> None:
    """Copy all arrays of all segments, segment by segment, or array by array, which opens each segment more often."""
    names = list(segments[0][1].layout.arrays)
    for group in [[name] for name in names] if by_name else [names]:
        for segment, index in segments:
            with closing(open_vtkhdf(segment, known=True)) as source:
                for name in group:
                    for block in read_blocks(source, name, 0, int(index.counts.sum())):
                        if stop():
                            raise KeyboardInterrupt
                        writer.append(name, block)


def _require_unchanged(checksums: np.ndarray, segments: Segments) -> None:
    """Raise DamageError where the checksums of what was read are not those of the segments that have any."""
    k = 0
    for segment, index in segments:
        if index.checksums is not None:
            differing = np.argwhere(checksums[k : k + len(index.counts)] != index.checksums)
            for frame, column in differing[:1]:
                raise damaged(str(segment), f"{list(index.layout.arrays)[column]} of frame {index.frames[frame]}")
        k += len(index.counts)


def find_difference(packed: Path, expected: FrameIndex, stop: Callable[[], bool] = lambda: False) -> str:
    """Return in words the first difference of a packed file from its `expected` index and checksums, "" if none."""
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


def _counts_up(data: h5py.Dataset, n: int) -> bool:
    """Return whether a data set holds the numbers from 0 to n - 1 as int64."""
    firsts = range(0, n, PART)
    return data.shape == (n,) and all(
        _same(data[k : k + PART], np.arange(k, min(k + PART, n), dtype=np.int64)) for k in firsts
    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal in type, shape and every bit, so that NaN equals itself and -0.0 is not 0.0."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
