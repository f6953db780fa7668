"""The store of a run: sealed files of one or more frames while it goes on, one packed VTKHDF file at the end."""

import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.errors import RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.collider_files import write_collider_files
from mpmcli.output.durable import (
    Unsealed,
    ask_for,
    numbered_files,
    remove_numbered,
    require_free_space,
    sync_directory,
    sync_file,
    temporary_of,
)
from mpmcli.output.layout import FrameIndex, FrameLayout
from mpmcli.output.pack import pack_segments
from mpmcli.output.store import ASIDE, MOST_WAITING, Store
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size, read_index_of

PACKED = "particles.vtkhdf"
SEGMENTS = "segments"
SEGMENT_NAME = re.compile(r"frame_\d{6,}\.vtkhdf")


def segment_name(index: int) -> str:
    """Return the file name of the segment whose first frame has this number."""
    return f"frame_{index:06d}.vtkhdf"


def sealed_segments(directory: Path) -> list[Path]:
    """Return the sealed segments of a run that was not packed, in order, without unfinished files."""
    return numbered_files(directory / SEGMENTS, SEGMENT_NAME)


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


class SegmentStore(Store):
    """Frames in `directory`/segments while running, in `directory`/particles.vtkhdf after `finish`; see `Store`.

    Segments are complete VTKHDF files, not compressed, so that writing does not hold up the run. The packed file of a
    large run is written beside them, if `frames_expected`, all of as many particles, is given.
    """

    def __init__(
        self, directory: Path, header: dict[str, Any], *, frames_expected: int | None = None, **options: Any
    ) -> None:
        super().__init__(directory, header, **options)
        self.place = self._directory / SEGMENTS
        self._sealed: set[str] = set()
        self._counts: list[int] = []
        self._expected = frames_expected or 0
        self._beside: PackedBeside | None = None

    def finish(self, stop: Callable[[], bool] = lambda: False) -> Path | None:
        """Seal, pack and verify all segments, then remove them; they stay where the packed file cannot be written."""
        try:
            self.seal()
            if self._beside is not None and not self._beside.whole:
                self._beside.give_up()
            return self._pack(None if self._beside is None else self._beside.writer, stop)
        finally:
            self._end_beside()

    def give_up(self) -> None:
        super().give_up()
        self._end_beside()

    def _end_beside(self) -> None:
        if self._beside is not None:
            self._beside.give_up()
            self._beside = None

    def _pack(self, begun: VtkhdfWriter | None, stop: Callable[[], bool]) -> Path | None:
        """Pack all segments; `begun` is as `pack_segments` has it."""
        segments = sealed_segments(self._directory)
        # An interrupt may fall between the seal and the count; a sealed frame is never left behind.
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
            pack_segments(segments, packed, compress=self._compress, header=self._header, begun=begun, stop=stop)
        if self._colliders:
            times = read_index_of(packed, known=True).times.tolist()
            write_collider_files(self._directory, self._header, times, self._colliders)
        # The result is complete; a segment that somebody holds open may stay beside it.
        with suppress(OSError):
            remove_segments(self._directory)
        return packed

    def go_on_after(self, index: FrameIndex) -> None:
        super().go_on_after(index)
        # A process that was killed may have left one.
        temporary_of(self._directory / PACKED).unlink(missing_ok=True)
        self._sealed = {path.name for path in sealed_segments(self._directory)}
        self._counts = index.counts.tolist()

    def _holds_result(self) -> bool:
        return (self._directory / PACKED).exists() or bool(sealed_segments(self._directory))

    def _start(self) -> None:
        try:
            self.place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.place} could not be made ({error.strerror}); no frame was written.") from error
        sync_directory(self._directory)

    def _size(self, layout: FrameLayout, counts: Sequence[int]) -> int:
        return file_size(layout, counts)

    def _joined_size(self, layout: FrameLayout, counts: Sequence[int]) -> int:
        # What was written beside is no longer free.
        before = self._counts if self._beside is None or self._beside.writer is None else []
        return file_size(layout, [*before, *counts])

    def _write(
        self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow], size: int
    ) -> Callable[[], None]:
        counts = [len(frame.position) for frame in frames]
        whole = file_size(layout, [counts[0]] * self._expected) if self._expected > 1 else 0
        if whole > MOST_WAITING and not (self._compress or self._sealed or self._beside):
            self._beside = PackedBeside(self._directory / PACKED, layout, self._expected, counts[0])
        beside = self._beside
        if beside is not None:
            beside.expect(frames[0].index, counts)
        try:
            file = self._write_segment(layout, frames, rows, size)
        except BaseException as error:
            if beside is None or beside.writer is None:
                raise
            beside.give_up()
            if not isinstance(error, OSError | RuntimeError):
                raise
            # In the room that it took.
            file = self._write_segment(layout, frames, rows, size)

        # It keeps no frame: another one is built meanwhile.
        def seal() -> None:
            # New frames find memory at once where the system need not look for it.
            file.seal(cached=beside is None or beside.writer is None)
            if beside is not None:
                beside.seal(len(counts), sync=size >= ASIDE)
            self._sealed.add(file.path.name)
            self._counts += counts

        return seal

    def _write_segment(
        self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow], size: int
    ) -> Unsealed:
        """Write frames to a segment, and to the packed file where that is written beside it."""
        counts = [len(frame.position) for frame in frames]
        file = Unsealed(self.place / segment_name(frames[0].index))
        with file.written(size) as temporary, VtkhdfWriter(temporary, layout, counts) as writer:
            for name, arrays in layout.stored_together(frames):
                writer.append(name, arrays)
                if self._beside is not None:
                    self._beside.append(name, arrays)
                # Before the next one is made.
                del arrays
            tables = zip(*((frame.time, frame.index, frame.step) for frame in frames), strict=True)
            writer.finish(*tables, rows, self._header)
        return file


def remove_segments(directory: Path) -> None:
    """Remove sealed and unfinished segments, and their folder unless something else lies in it."""
    remove_numbered(directory / SEGMENTS, SEGMENT_NAME)
