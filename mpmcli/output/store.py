"""The store of a run: every frame a sealed file at once, one packed VTKHDF file at the end."""

import re
from contextlib import suppress
from pathlib import Path

from mpmcli.errors import InputError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.durable import TEMPORARY_SUFFIX, require_free_space, sealed, sync_directory
from mpmcli.output.layout import FrameLayout
from mpmcli.output.pack import pack_segments
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size

PACKED = "particles.vtkhdf"
SEGMENTS = "segments"
SEGMENT_NAME = re.compile(r"frame_\d{6,}\.vtkhdf")


def segment_name(index: int) -> str:
    """File name of the sealed frame with this number."""
    return f"frame_{index:06d}.vtkhdf"


def frames_kept(count: int) -> str:
    """Close the sentence of a failed frame: what became of the `count` frames before it."""
    if count == 0:
        return "no frame was written before it"
    return "the frame before it is kept" if count == 1 else f"the {count} frames before it are kept"


def sealed_segments(directory: Path) -> list[Path]:
    """Sealed frames of a run that was not packed, in order; unfinished files are not among them."""
    folder = directory / SEGMENTS
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if SEGMENT_NAME.fullmatch(path.name)]
    return sorted(found, key=lambda path: int(path.stem.split("_")[1]))


class SegmentStore:
    """Frames in `directory`/segments while running, in `directory`/particles.vtkhdf after `finish`.

    Each segment is a complete VTKHDF file that ParaView can open while the run goes on. Segments are
    not compressed, so that writing does not hold up the run; `compress` applies to the packed file.

    Args:
        directory: the output directory, made by `prepare_directory`.
        header: facts about the run that JSON can hold: dimension, names of bodies and laws, precision,
            "scene" (the TOML text), ...
        compress: gzip-1 with shuffle in the packed file.
    """

    def __init__(self, directory: Path, header: dict, *, compress: bool = False) -> None:
        self._directory = Path(directory)
        self._header = header
        self._compress = compress
        self._layout: FrameLayout | None = None
        self._count = 0

    @property
    def frames_written(self) -> int:
        """Number of frames that a crash can no longer harm."""
        return self._count

    def write(self, frame: Frame, row: LedgerRow) -> None:
        """Write the next frame; it is durable when this returns.

        Raises:
            RunError: the disk is full or refuses; all frames before this one are kept.
            InputError: the directory holds an earlier result.
            ValueError: the frame is out of order or has other arrays than the first one.
        """
        if frame.index != self._count:
            raise ValueError(f"frame {frame.index} was given where frame {self._count} comes next")
        folder = self._directory / SEGMENTS
        if self._layout is None:
            self._layout = FrameLayout.of(frame)
            self._start(folder)
        counts, kept = [len(frame.position)], frames_kept(self._count)
        purpose = f"frame {frame.index}"
        size = file_size(self._layout, counts)
        require_free_space(self._directory, size, purpose, kept)
        try:
            with (
                sealed(folder / segment_name(frame.index), size) as temporary,
                VtkhdfWriter(temporary, self._layout, counts) as writer,
            ):
                for name, array in self._layout.stored(frame):
                    writer.write_array(0, name, array)
                writer.finish([frame.time], [frame.index], [frame.step], [row], self._header)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(f"{purpose} could not be written to {folder} ({reason}); {kept}.") from error
        self._count += 1

    def finish(self) -> Path | None:
        """Pack the sealed frames, verify the packed file, and remove the segments.

        Returns:
            The packed file; None when no frame was written.

        Raises:
            RunError: the disk cannot hold the packed file or it does not read back; the segments stay.
        """
        segments = sealed_segments(self._directory)
        # An interrupt may fall between the seal and the count; a sealed frame is never left behind.
        if len(segments) < self._count:
            raise RunError(
                f"{self._directory / SEGMENTS} holds {len(segments)} of the {self._count} frames written: "
                "some were removed during the run; the others are kept."
            )
        if not segments:
            return None
        packed = self._directory / PACKED
        pack_segments(segments, packed, compress=self._compress)
        # The result is complete; a segment that somebody holds open may stay beside it.
        with suppress(OSError):
            remove_segments(self._directory)
        return packed

    def _start(self, folder: Path) -> None:
        if (self._directory / PACKED).exists() or sealed_segments(self._directory):
            raise InputError(f"{self._directory} holds an earlier result: give another directory, or --overwrite.")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{folder} could not be made ({error.strerror}); no frame was written.") from error
        sync_directory(self._directory)


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
