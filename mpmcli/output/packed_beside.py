"""The packed file of a run, written beside its segments while the run goes on, so that its end copies nothing."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from mpmcli.errors import RunError
from mpmcli.output.durable import ask_for, require_free_space, sync_file, temporary_of
from mpmcli.output.layout import FrameLayout
from mpmcli.output.vtkhdf import VtkhdfWriter
from mpmcli.output.vtkhdf_parts import file_size


class PackedBeside:
    """The temporary file of a packed result, which gets the arrays of all frames of a run in order.

    It is worth nothing until it is whole. Where it cannot be written, or frames are missing at the end, it is given up,
    and the segments are packed.

    Attributes:
        writer: of the file, None once it was given up.
    """

    def __init__(self, target: Path, layout: FrameLayout, frames: int, particles: int) -> None:
        """Begin the temporary file of `target`, if the disk has room for all frames twice."""
        self._temporary, self._missing = temporary_of(target), frames
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
        return self.writer is not None and self._missing == 0

    def append(self, name: str, stored: np.ndarray) -> None:
        """Write the next rows of an array, as `VtkhdfWriter.append`."""
        try:
            if self.writer is not None:
                self.writer.append(name, stored)
        except (OSError, RuntimeError, TypeError, ValueError):
            self.give_up()

    def count(self, frames: int) -> None:
        """Note that all arrays of so many more frames were written."""
        self._missing -= frames

    def sync(self) -> None:
        """Force what was written to the disk, so that little is left for the end."""
        if self.writer is not None:
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
