"""The store of a run: sealed segments of one or more frames during the run, one packed VTKHDF file at the end.

Packing copies the segments to one file and verifies it before it takes its name.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from mpmcli.errors import DiskFullError, InputError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.checksums import damaged, open_hdf5
from mpmcli.output.collider_files import as_they_moved, write_collider_files
from mpmcli.output.durable import Unsealed, is_full, require_free_space, sealed, sync_directory, sync_file, temporary_of
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import (
    PACKED,
    SEGMENTS,
    FrameIndex,
    FrameLayout,
    remove_segments,
    sealed_segments,
    segment_name,
)
from mpmcli.output.verify import verify_file
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size, read_blocks, read_index_of
from mpmcli.scene.colliders import Collider

# Bytes of waiting frames that trigger a seal.
MOST_WAITING = 32 * 1024 * 1024
# Bytes of frames from which on a thread seals them in parallel to the run; a thread costs more than sealing fewer.
ASIDE = 4 * 1024 * 1024
# Longest time between the computation of a frame and its seal, s, unless a single step takes longer.
HOLD = 1.0


class SegmentStore:
    """Writes the frames of one run into `directory`/segments, and `directory`/particles.vtkhdf by `finish`.

    Frames are sealed in groups, since a durable file costs about 10 ms, within `hold` s of their write if `seal_due` is
    called. Only sealed frames, which survive a crash, count as `frames_written`, in `seconds` of wall time. A thread
    seals large groups, one at a time, while the system transfers them from memory to the disk. Taichi holds Python's
    lock during a launch, so that a thread could do little more.

    Segments are complete VTKHDF files, uncompressed, so that writing does not delay the run. `colliders` None means
    those of the header.
    """

    def __init__(
        self,
        directory: Path,
        header: dict[str, Any],
        *,
        compress: bool = False,
        hold: float = 0.0,
        colliders: Sequence[Collider] | None = None,
        replace_earlier: Callable[[Path], None] | None = None,
    ) -> None:
        """Begin in a directory made by `take_directory`; write nothing before the first frame.

        `replace_earlier` removes an earlier result before the first new file, its argument, takes its name.
        """
        self._replace_earlier = replace_earlier
        self._colliders = RunHeader.read(header).colliders if colliders is None else tuple(colliders)
        self._directory = Path(directory)
        self.place = self._directory / SEGMENTS
        self._header = header
        self._compress = compress
        self._hold = hold
        self._layout: FrameLayout | None = None
        self._waiting: list[tuple[Frame, LedgerRow]] = []
        self._waiting_since = 0.0
        self._sealing: _Sealing | None = None
        self.frames_written = self.bytes_written = 0
        self.seconds = 0.0
        # Frames written by an earlier process.
        self._kept = 0
        self._sealed: set[str] = set()
        self._counts: list[int] = []

    def go_on_after(self, index: FrameIndex) -> None:
        """Continue after frames written by an earlier process; they are not written again."""
        self._layout = index.layout
        self.frames_written = self._kept = len(index.times)
        self._start()
        # A process killed while packing has left one.
        temporary_of(self._directory / PACKED).unlink(missing_ok=True)
        self._sealed = {path.name for path in sealed_segments(self._directory)}
        self._counts = index.counts.tolist()

    def write(self, frame: Frame, row: LedgerRow) -> None:
        """Add the next frame, whose arrays must not change; seal when MOST_WAITING bytes or `hold` are reached.

        A frame written by an earlier process is kept as it is. RunError: a write failed, earlier frames are kept;
        InputError: the directory holds a result; ValueError: the frame is out of order, or has other arrays.
        """
        if frame.index < self._kept:
            return
        following = self.frames_written + len(self._waiting) + (self._sealing.frames if self._sealing else 0)
        if frame.index != following:
            raise ValueError(f"frame {frame.index} was given where frame {following} comes next")
        layout = FrameLayout.of(frame)
        if self._layout is None:
            there = (self._directory / PACKED).exists() or sealed_segments(self._directory)
            if there and self._replace_earlier is None:
                raise InputError(f"{self._directory} holds an earlier result: give another directory, or --overwrite.")
            self._layout = layout
            self._start()
        if layout != self._layout:
            raise ValueError(f"frame {frame.index} holds other arrays, types or shapes than the first frame")
        if not self._waiting:
            self._waiting_since = time.monotonic()
        self._waiting.append((frame, row))
        if file_size(layout, [len(waiting.position) for waiting, _ in self._waiting]) >= MOST_WAITING:
            self._begin_seal()
        self.seal_due()

    def seal_due(self) -> None:
        """Seal the waiting frames if one has waited for `hold`; cheap otherwise, for calls between slow frames."""
        if self._sealing is not None and self._sealing.done:
            self._end_seal()
        if self._waiting and time.monotonic() - self._waiting_since >= self._hold:
            self._begin_seal()

    def seal(self) -> None:
        """Write all waiting frames durably; RunError: a write failed, and the frames before them are kept."""
        self._begin_seal()
        self._end_seal()

    def finish(self, stop: Callable[[], bool] = lambda: False) -> Path | None:
        """Seal, pack and verify all frames, and return the packed file, None if there is no frame.

        The segments stay if it cannot be written (RunError) or `stop` ends packing with KeyboardInterrupt.
        """
        self.seal()
        segments = sealed_segments(self._directory)
        # An interrupt may occur between the seal and the count; every sealed frame is packed.
        if missing := self._sealed - {path.name for path in segments}:
            raise RunError(
                f"{self._directory / SEGMENTS} lacks {min(missing)}, one of the {len(self._sealed)} "
                "files written: it was removed during the run; the others are kept."
            )
        if not segments:
            return None
        packed = self._directory / PACKED
        if len(segments) == 1 and not self._compress and not self._kept:
            os.replace(segments[0], packed)
            sync_directory(self._directory)
        else:
            pack_segments(segments, packed, compress=self._compress, header=self._header, stop=stop)
        if self._colliders:
            index = read_index_of(packed)
            colliders = as_they_moved(self._colliders, index)
            write_collider_files(self._directory, self._header, index.times.tolist(), colliders)
        # The result is complete; a segment that another process holds open may remain.
        with suppress(OSError):
            remove_segments(self._directory)
        return packed

    def _start(self) -> None:
        try:
            self.place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.place} could not be made ({error.strerror}); no frame was written.") from error
        sync_directory(self._directory)

    def _begin_seal(self) -> None:
        """Write all waiting frames and begin to make them durable; all frames before them are then sealed."""
        self._end_seal()
        if not self._waiting:
            return
        frames, rows = zip(*self._waiting, strict=True)
        counts = [len(frame.position) for frame in frames]
        size = file_size(self._layout, counts)
        joined = file_size(self._layout, [*self._counts, *counts])
        began = time.perf_counter()
        purpose, kept = f"frame {frames[0].index}", _frames_kept(self.frames_written)
        try:
            require_free_space(self._directory, size, purpose, kept, joined=joined)
            seal = self._write(self._layout, frames, rows, size)
        except (OSError, RuntimeError, RunError) as error:
            raise self._failure(error, purpose) from error
        self._waiting.clear()
        aside = size >= ASIDE
        self._sealing = _Sealing(seal, purpose, len(frames), size, began, aside=aside)
        if not aside:
            self._end_seal()

    def _end_seal(self) -> None:
        if self._sealing is None:
            return
        sealing = self._sealing
        error = sealing.wait()
        self._sealing = None
        if error is not None:
            raise self._failure(error, sealing.purpose) from error
        self.frames_written += sealing.frames
        self.bytes_written += sealing.size
        self.seconds += sealing.seconds

    def _failure(self, error: Exception, purpose: str) -> Exception:
        """Drop the waiting frames, and return the error for frames that could not be written."""
        self._waiting.clear()
        if isinstance(error, RunError) or not isinstance(error, OSError | RuntimeError):
            return error
        reason = getattr(error, "strerror", None) or error
        kind, kept = DiskFullError if is_full(error) else RunError, _frames_kept(self.frames_written)
        return kind(f"{purpose} could not be written to {self.place} ({reason}); {kept}.")

    def _write(
        self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow], size: int
    ) -> Callable[[], None]:
        """Write frames to a segment; return the function that makes it durable."""
        counts = [len(frame.position) for frame in frames]
        file = Unsealed(self.place / segment_name(frames[0].index))
        with file.written(size) as temporary, VtkhdfWriter(temporary, layout, counts) as writer:
            for name, arrays in layout.stored_together(frames):
                writer.append(name, arrays)
                # Before the next one is made.
                del arrays
            tables = zip(*((frame.time, frame.index, frame.step) for frame in frames), strict=True)
            writer.finish(*tables, rows, self._header)

        # The function keeps no frame: the next ones are built meanwhile.
        def seal() -> None:
            if self._replace_earlier is not None:
                self._replace_earlier(temporary)
                self._replace_earlier = None
            file.seal()
            self._sealed.add(file.path.name)
            self._counts += counts

        return seal


class _Sealing:
    """Frames being made durable, in a thread (`aside`) or at once; `seconds` from the beginning of their write."""

    def __init__(
        self, seal: Callable[[], None], purpose: str, frames: int, size: int, began: float, *, aside: bool
    ) -> None:
        self.purpose, self.frames, self.size, self.seconds = purpose, frames, size, 0.0
        self._seal, self._began = seal, began
        self._error: Exception | None = None
        self._thread = Thread(target=self._run, name="seal") if aside else None
        if self._thread is None:
            self._run()
        else:
            self._thread.start()

    def _run(self) -> None:
        try:
            self._seal()
        except Exception as error:
            self._error = error
        self.seconds = time.perf_counter() - self._began

    @property
    def done(self) -> bool:
        """Whether `wait` returns at once."""
        return self._thread is None or not self._thread.is_alive()

    def wait(self) -> Exception | None:
        """Wait for the end, and return the error, if any."""
        if self._thread is not None:
            self._thread.join()
        return self._error


def _frames_kept(count: int) -> str:
    """Return the end of the sentence on a failed frame, about the `count` frames before it."""
    if count == 0:
        return "no frame was written before it"
    return "the frame before it is kept" if count == 1 else f"the {count} frames before it are kept"


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
    """Write all frames of sealed segments of one run to `target`, verify it, then give it its name.

    Segments are not changed; memory is that of a block of one array. "scene" of the header may differ from that of the
    segments. RunError, and no `target`: the disk is too small, segments are of several runs, or verification failed.
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
                # The data read has the checksums of the segments.
                k = 0
                for segment, index in parts:
                    differing = np.argwhere(writer.checksums[k : k + len(index.counts)] != index.checksums)
                    for frame, column in differing[:1]:
                        raise damaged(
                            str(segment), f"{list(index.layout.arrays)[column]} of frame {index.frames[frame]}"
                        )
                    k += len(index.counts)
                writer.finish(expected.times, expected.frames, expected.steps, expected.ledger, header=expected.header)
            sync_file(temporary)
            for fault in verify_file(temporary, stop=stop).faults:
                raise RunError(f"{target.name} does not read back as it was written ({fault.rstrip('.')}); {kept}.")
    except (OSError, RuntimeError, InputError) as error:
        reason = getattr(error, "strerror", None) or error
        fault = DiskFullError if is_full(error) else RunError
        raise fault(f"{target} could not be written ({reason}); {kept}.") from error


def _copy(segments: Segments, writer: VtkhdfWriter, stop: Callable[[], bool], *, by_name: bool) -> None:
    """Copy all arrays of all segments, by segment, or by array, which opens each segment once per array."""
    names = list(segments[0][1].layout.arrays)
    for group in [[name] for name in names] if by_name else [names]:
        for segment, index in segments:
            with open_hdf5(segment, "a segment") as source:
                for name in group:
                    for block in read_blocks(source, name, int(index.counts.sum())):
                        if stop():
                            raise KeyboardInterrupt
                        writer.append(name, block)
