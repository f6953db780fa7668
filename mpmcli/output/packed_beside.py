"""The packed file of a large run, which is written beside its segments while the run goes on."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from mpmcli.errors import RunError
from mpmcli.output.durable import ask_for, require_free_space, sync_file, temporary_of
from mpmcli.output.layout import FrameLayout
from mpmcli.output.vtkhdf import VtkhdfWriter, file_size


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
