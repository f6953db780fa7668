"""What every store of frames does: frames in order, room on the disk first, one sentence where writing fails."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Thread
from typing import Any

from mpmcli.errors import InputError, NoRoomError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.durable import is_full, require_free_space
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import FrameIndex, FrameLayout
from mpmcli.scene.colliders import Collider

# Bytes of waiting frames above which they are sealed.
MOST_WAITING = 32 * 1024 * 1024
# Bytes of frames that a thread seals beside the run; fewer are sealed sooner than a thread is begun.
ASIDE = 4 * 1024 * 1024
# Longest time between the computation of a frame of a run and its seal, s, unless a single step takes longer.
HOLD = 1.0


class Store(ABC):
    """Writes the frames of one run into `directory`, which `prepare_directory` made.

    Frames are sealed in groups, since a durable file costs about 10 ms, within `hold` s of their write if `seal_due` is
    called. Only sealed ones, which no crash harms, count as `frames_written`, in `seconds` of wall time. Large groups
    are sealed by a thread, one at a time: they lie in the memory of the system then, and the disk takes its time.
    Taichi holds Python's lock during a launch, so that a thread could do little more. `colliders` are None for those
    that the header tells.
    """

    # Whether frames that are sealed together have a file each.
    several = False

    def __init__(
        self,
        directory: Path,
        header: dict[str, Any],
        *,
        compress: bool = False,
        hold: float = 0.0,
        colliders: Sequence[Collider] | None = None,
    ) -> None:
        self._colliders = RunHeader.read(header).colliders if colliders is None else tuple(colliders)
        self._directory = self.place = Path(directory)
        self._header = header
        self._compress = compress
        self._hold = hold
        self._layout: FrameLayout | None = None
        self._waiting: list[tuple[Frame, LedgerRow]] = []
        self._waiting_since = 0.0
        self._sealing: _Sealing | None = None
        self.frames_written = self.bytes_written = 0
        self.seconds = 0.0
        # Frames that an earlier process has written.
        self._kept = 0

    def go_on_after(self, index: FrameIndex) -> None:
        """Go on after frames that an earlier process has written here; they are not written again."""
        self._layout = index.layout
        self.frames_written = self._kept = len(index.times)
        self._start()

    def write(self, frame: Frame, row: LedgerRow) -> None:
        """Take the next frame, whose arrays must not change; seal when MOST_WAITING bytes or `hold` are reached.

        One that an earlier process has written is left as it is. RunError: the disk refuses, earlier frames are kept;
        InputError: the directory holds a result; ValueError: the frame is out of order, or has other arrays.
        """
        if frame.index < self._kept:
            return
        following = self.frames_written + len(self._waiting) + (self._sealing.frames if self._sealing else 0)
        if frame.index != following:
            raise ValueError(f"frame {frame.index} was given where frame {following} comes next")
        layout = FrameLayout.of(frame)
        if self._layout is None:
            self._layout = layout
            if self._holds_result():
                raise InputError(f"{self._directory} holds an earlier result: give another directory, or --overwrite.")
            self._start()
        if layout != self._layout:
            raise ValueError(f"frame {frame.index} holds other arrays, types or shapes than the first frame")
        if not self._waiting:
            self._waiting_since = time.monotonic()
        self._waiting.append((frame, row))
        size = self._size(layout, [len(waiting.position) for waiting, _ in self._waiting])
        if size >= MOST_WAITING:
            self._begin_seal()
        self.seal_due()

    def seal_due(self) -> None:
        """Seal the waiting frames if one has waited for `hold`; cheap otherwise, for calls between slow frames."""
        if self._sealing is not None and self._sealing.done:
            self._end_seal()
        if self._waiting and time.monotonic() - self._waiting_since >= self._hold:
            self._begin_seal()

    def seal(self) -> None:
        """Write all waiting frames durably; RunError: the disk refuses, and the frames before them are kept."""
        self._begin_seal()
        self._end_seal()

    def _begin_seal(self) -> None:
        """Write all waiting frames, and begin to make them durable; those before are sealed then."""
        self._end_seal()
        if not self._waiting:
            return
        frames, rows = zip(*self._waiting, strict=True)
        counts = [len(frame.position) for frame in frames]
        size = self._size(self._layout, counts)
        began = time.perf_counter()
        purpose, kept = f"frame {frames[0].index}", _frames_kept(self.frames_written)
        try:
            joined = self._joined_size(self._layout, counts)
            require_free_space(self._directory, size, purpose, kept, joined=joined, several=self.several)
            seal = self._write(self._layout, frames, rows, size)
        except (OSError, RuntimeError, RunError) as error:
            raise self._failure(error, purpose) from error
        self._waiting.clear()
        # Files of a series are made by Python, which a thread does not get beside a launch.
        aside = size >= ASIDE and not self.several
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
        """Give up the waiting frames, and return the error of frames that could not be written."""
        self._waiting.clear()
        if isinstance(error, RunError) or not isinstance(error, OSError | RuntimeError):
            return error
        reason = getattr(error, "strerror", None) or error
        kind, kept = NoRoomError if is_full(error) else RunError, _frames_kept(self.frames_written)
        return kind(f"{purpose} could not be written to {self.place} ({reason}); {kept}.")

    @abstractmethod
    def finish(self, stop: Callable[[], bool] = lambda: False) -> Path | None:
        """Complete the result and return the file to open, None without one; `stop` ends it with KeyboardInterrupt."""

    def give_up(self) -> None:
        """Forget waiting frames, and remove what is of no use without `finish`; sealed frames stay."""
        self._waiting.clear()

    @abstractmethod
    def _holds_result(self) -> bool:
        """Return whether an earlier result lies in the directory."""

    @abstractmethod
    def _start(self) -> None:
        """Make the folder of the frames."""

    @abstractmethod
    def _size(self, layout: FrameLayout, counts: Sequence[int]) -> int:
        """Return the bytes of frames of `counts` particles."""

    def _joined_size(self, layout: FrameLayout, counts: Sequence[int]) -> int:
        """Return the bytes that `finish` needs beside the sealed frames, if frames of `counts` particles follow."""
        return 0

    @abstractmethod
    def _write(
        self, layout: FrameLayout, frames: Sequence[Frame], rows: Sequence[LedgerRow], size: int
    ) -> Callable[[], None]:
        """Write frames, and return what makes them durable."""


class _Sealing:
    """Frames that become durable, `aside` in a thread or at once; seconds from the beginning of their write."""

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
        """Wait for the end, and return the error of what failed."""
        if self._thread is not None:
            self._thread.join()
        return self._error


def _frames_kept(count: int) -> str:
    """Return the end of the sentence on a failed frame: what became of the `count` frames before it."""
    if count == 0:
        return "no frame was written before it"
    return "the frame before it is kept" if count == 1 else f"the {count} frames before it are kept"
