"""Packing: many sealed files become one file, proved equal before it takes its name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.errors import InputError, NoRoomError, RunError
from mpmcli.output.checksums import damaged
from mpmcli.output.durable import is_full, require_free_space, sealed, sync_file
from mpmcli.output.layout import FrameIndex
from mpmcli.output.reading import open_hdf5
from mpmcli.output.verify import verify_file
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size, read_blocks, read_index_of

# Segments with their indices.
Segments = Sequence[tuple[Path, FrameIndex]]


def pack_segments(
    segments: Sequence[Path],
    target: Path,
    *,
    compress: bool = False,
    header: Mapping[str, Any],
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Write all frames of sealed segments of one run into `target`, prove it equal, then give it its name.

    Segments stay as they are; memory is that of a block of one array. "scene" of the header may differ from that of the
    segments.
    RunError, and no `target`: the disk is too small, segments are of several runs, or it does not read back.
    """
    try:
        parts = [(segment, read_index_of(segment)) for segment in segments]
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
    size = file_size(first.layout, counts)
    require_free_space(target.parent, size, purpose, kept)
    try:
        with sealed(target, size) as temporary:
            with VtkhdfWriter(temporary, first.layout, counts, compress=compress) as writer:
                _copy(parts, writer, stop, by_name=compress)
                _require_unchanged(writer.checksums, parts)
                writer.finish(expected.times, expected.frames, expected.steps, expected.ledger, header=expected.header)
            sync_file(temporary)
            for fault in verify_file(temporary, stop=stop).faults:
                raise RunError(f"{target.name} does not read back as it was written ({fault.rstrip('.')}); {kept}.")
    except (OSError, RuntimeError, InputError) as error:
        reason = getattr(error, "strerror", None) or error
        fault = NoRoomError if is_full(error) else RunError
        raise fault(f"{target} could not be written ({reason}); {kept}.") from error


def _copy(segments: Segments, writer: VtkhdfWriter, stop: Callable[[], bool], *, by_name: bool) -> None:
    """Copy all arrays of all segments, segment by segment, or array by array, which opens each segment more often."""
    names = list(segments[0][1].layout.arrays)
    for group in [[name] for name in names] if by_name else [names]:
        for segment, index in segments:
            with open_hdf5(segment, "a segment") as source:
                for name in group:
                    for block in read_blocks(source, name, 0, int(index.counts.sum())):
                        if stop():
                            raise KeyboardInterrupt
                        writer.append(name, block)


def _require_unchanged(checksums: np.ndarray, segments: Segments) -> None:
    """Raise DamageError where the checksums of what was read are not those of the segments."""
    k = 0
    for segment, index in segments:
        differing = np.argwhere(checksums[k : k + len(index.counts)] != index.checksums)
        for frame, column in differing[:1]:
            raise damaged(str(segment), f"{list(index.layout.arrays)[column]} of frame {index.frames[frame]}")
        k += len(index.counts)
