"""The index of the frames of an output: times and ledger, without the particles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.layout import FrameLayout

# Particles, more than any file holds.
_MOST = 2**53


@dataclass(frozen=True)
class FrameIndex:
    """Tables of T frames.

    Attributes:
        layout: the arrays of every frame.
        header: facts about the run.
        times: (T,) float64, s.
        frames, steps: (T,) frame number, and time steps since the start.
        offsets, counts: (T,) first row and number of rows of each frame in its file.
        ledger: T rows.
        checksums: (T, A) uint32, CRC-32 of each array of the layout in each frame; None where the file has none.
    """

    layout: FrameLayout
    header: dict[str, Any]
    times: np.ndarray
    frames: np.ndarray
    steps: np.ndarray
    offsets: np.ndarray
    counts: np.ndarray
    ledger: list[LedgerRow]
    checksums: np.ndarray | None = None

    def first(self, count: int) -> "FrameIndex":
        """The index of at most `count` frames from the first on."""
        tables = {
            name: getattr(self, name)[:count] for name in ("times", "frames", "steps", "offsets", "counts", "ledger")
        }
        return replace(self, **tables, checksums=None if self.checksums is None else self.checksums[:count])

    def checked(self) -> "FrameIndex":
        """Return this index, with tables of int64 and float64.

        Raises:
            ValueError: the tables of a file contradict each other, or the file lists no frame.
        """
        tables = self.frames, self.steps, self.offsets, self.counts
        # A series whose ledger is cut off lists fewer frames than its .pvd.
        if any(table.ndim != 1 or not 0 < len(table) <= len(self.times) for table in (self.times, *tables)):
            raise ValueError("the tables of the frames have different lengths")
        if any(table.min() < 0 or table.max() > _MOST for table in tables):
            raise ValueError("a frame has no place in the file")
        d = self.layout.dimension
        for row in self.ledger:
            loads = [len(vector) for load in (row.collider_force, row.collider_torque) for vector in load]
            angles = 1 if d == 2 else 3
            if len(row.linear_momentum) != d or len(row.angular_momentum) != angles or {*loads} - {d, angles}:
                raise ValueError("a vector of the ledger has another number of components")
        frames, steps, offsets, counts = (table.astype(np.int64) for table in tables)
        return replace(
            self, times=self.times.astype(np.float64), frames=frames, steps=steps, offsets=offsets, counts=counts
        )

    @classmethod
    def joined(cls, indices: Sequence["FrameIndex"]) -> "FrameIndex":
        """The index that one file with the frames of all these, one after the other, has."""
        counts = np.concatenate([index.counts for index in indices])
        checksums = [index.checksums for index in indices]
        return cls(
            layout=indices[0].layout,
            header=indices[0].header,
            times=np.concatenate([index.times for index in indices]),
            frames=np.concatenate([index.frames for index in indices]),
            steps=np.concatenate([index.steps for index in indices]),
            offsets=np.cumsum(counts) - counts,
            counts=counts,
            ledger=[row for index in indices for row in index.ledger],
            checksums=None if any(table is None for table in checksums) else np.concatenate(checksums),
        )
