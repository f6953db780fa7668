"""The store of a run: sealed files of one or more frames while it goes on, one packed VTKHDF file at the end."""

import os
import re
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from mpmcli.errors import RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.collider_files import write_collider_files
from mpmcli.output.durable import TEMPORARY_SUFFIX, Unsealed, sync_directory, temporary_of
from mpmcli.output.frame_index import FrameIndex
from mpmcli.output.layout import FrameLayout
from mpmcli.output.pack import pack_segments
from mpmcli.output.packed_beside import PackedBeside
from mpmcli.output.store import ASIDE, MOST_WAITING, Store
from mpmcli.output.vtkhdf import VtkhdfWriter
from mpmcli.output.vtkhdf_parts import file_size
from mpmcli.output.vtkhdf_reader import open_vtkhdf, read_index

PACKED = "particles.vtkhdf"
# What `mpmcli repair` calls a damaged one, and the new one before it takes its name.
DAMAGED, REPAIRED = "particles.damaged.vtkhdf", "particles.repaired.vtkhdf"
SEGMENTS = "segments"
SEGMENT_NAME = re.compile(r"frame_\d{6,}\.vtkhdf")


def segment_name(index: int) -> str:
    """Return the file name of the segment whose first frame has this number."""
    return f"frame_{index:06d}.vtkhdf"


def sealed_segments(directory: Path) -> list[Path]:
    """Return the sealed segments of a run that was not packed, in order, without unfinished files."""
    folder = directory / SEGMENTS
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if SEGMENT_NAME.fullmatch(path.name)]
    return sorted(found, key=lambda path: int(path.stem.split("_")[1]))


class SegmentStore(Store):
    """Frames in `directory`/segments while running, in `directory`/particles.vtkhdf after `finish`.

    Each segment is a complete VTKHDF file that ParaView can open while the run goes on. Segments are
    not compressed, so that writing does not hold up the run; `compress` (gzip-1 with shuffle) applies to the packed
    file. The packed file of a large run is written beside the segments (`PackedBeside`).
    """

    def __init__(
        self, directory: Path, header: dict[str, Any], *, frames_expected: int | None = None, **options: Any
    ) -> None:
        """Begin; see `Store`.

        Args:
            frames_expected: of the run, if they have the same number of particles.
        """
        super().__init__(directory, header, **options)
        self.place = self._directory / SEGMENTS
        self._sealed: set[str] = set()
        self._counts: list[int] = []
        self._expected = frames_expected or 0
        self._beside: PackedBeside | None = None

    def finish(self, stop: Callable[[], bool] = lambda: False) -> Path | None:
        """Seal the waiting frames, pack all segments, verify the packed file, and remove the segments.

        A single segment becomes the packed file as it is, unless that is compressed. The surfaces of colliders go
        beside it.

        Returns:
            The packed file; None when no frame was written.

        Raises:
            KeyboardInterrupt: `stop` returned True; the segments stay.
            RunError: the disk cannot hold the packed file or it does not read back; the segments stay.
        """
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
            # Those of an earlier process were verified when the run was resumed.
            options = {"compress": self._compress, "header": self._header, "known": True, "begun": begun}
            pack_segments(segments, packed, **options, stop=stop)
        if self._colliders:
            with closing(open_vtkhdf(packed, known=True)) as file:
                times = read_index(file).times.tolist()
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
    folder = directory / SEGMENTS
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if SEGMENT_NAME.fullmatch(path.name.removesuffix(TEMPORARY_SUFFIX)):
            path.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()
