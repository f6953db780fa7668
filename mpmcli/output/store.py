"""What every store of frames does: frames in order, room on the disk first, one sentence where writing fails."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.durable import require_free_space
from mpmcli.output.layout import FrameLayout


class Store(ABC):
    """Writes the frames of one run, each durable before the next one is computed.

    Args:
        directory: the output directory, made by `prepare_directory`.
        header: entries of a `RunHeader` that JSON can hold.
        compress: whether the result is compressed.

    Attributes:
        place: where frames are written.
        frames_written: number of frames that a crash can no longer harm.
    """

    def __init__(self, directory: Path, header: dict[str, Any], *, compress: bool = False) -> None:
        self._directory = self.place = Path(directory)
        self._header = header
        self._compress = compress
        self._layout: FrameLayout | None = None
        self.frames_written = 0

    def write(self, frame: Frame, row: LedgerRow) -> None:
        """Write the next frame; it is durable when this returns.

        Raises:
            RunError: the disk is full or refuses; all frames before this one are kept.
            InputError: the directory holds an earlier result.
            ValueError: the frame is out of order or has other arrays than the first one.
        """
        if frame.index != self.frames_written:
            raise ValueError(f"frame {frame.index} was given where frame {self.frames_written} comes next")
        if self._layout is None:
            self._layout = FrameLayout.of(frame)
            if self._holds_result():
                raise InputError(f"{self._directory} holds an earlier result: give another directory, or --overwrite.")
            self._start()
        purpose, kept = f"frame {frame.index}", _frames_kept(self.frames_written)
        size = self._size(self._layout, len(frame.position))
        require_free_space(self._directory, size, purpose, kept)
        try:
            self._write(self._layout, frame, row, size)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(f"{purpose} could not be written to {self.place} ({reason}); {kept}.") from error
        self.frames_written += 1

    @abstractmethod
    def finish(self) -> Path | None:
        """Complete the result and return the file to open; None where no frame was written.

        Raises:
            RunError: it could not be completed; what was written stays.
        """

    @abstractmethod
    def _holds_result(self) -> bool:
        """Return whether an earlier result lies in the directory."""

    @abstractmethod
    def _start(self) -> None:
        """Make the folder of the frames."""

    @abstractmethod
    def _size(self, layout: FrameLayout, count: int) -> int:
        """Return the bytes of a frame of `count` particles."""

    @abstractmethod
    def _write(self, layout: FrameLayout, frame: Frame, row: LedgerRow, size: int) -> None:
        """Write a frame, durably."""


def _frames_kept(count: int) -> str:
    """Return the end of the sentence on a failed frame: what became of the `count` frames before it."""
    if count == 0:
        return "no frame was written before it"
    return "the frame before it is kept" if count == 1 else f"the {count} frames before it are kept"
