"""Frames that the kernel of a batch records of one run while the run goes on, some in each launch."""

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_layout import IDLE, LIMITS, MOST_FRAMES, NOTES, Row
from mpmcli.solver.frame_arrays import FrameArrays, FrameColumns
from mpmcli.solver.frame_builder import FrameBuilder, Moment
from mpmcli.solver.frame_reader import CHOSEN, chosen_columns, sum_entries, sums_of
from mpmcli.solver.sums import NO_STEPS, StepsTaken, Sums

# Bytes that the frames of a run may take in one launch.
ROOM = 16_000_000


def steps_of(row: Row, count: int) -> StepsTaken:
    """Return the steps since the last frame, so many, as a kernel has booked them."""
    smallest = row.number("smallest"), row.number("smallest_courant"), LIMITS[row.count("limit")]
    return StepsTaken(count, smallest, row.number("largest"), row.number("largest_courant"))


class BatchRecorder:
    """The place of a run in `Batch.shown` and `Batch.notes`.

    Attributes:
        index: the next frame to be read; steps: those of the run up to the last one.
    """

    def __init__(self, batch: Batch, slot: int, particles: int, frames: int) -> None:
        self._batch, self._slot, self._particles, self._frames = batch, slot, particles, frames
        self._row = Row(batch.layout, batch.numbers[slot], batch.counts[slot])
        self._room = 0
        self._columns: FrameColumns | None = None
        self.index = self.steps = 0

    def begin(self, columns: FrameColumns) -> None:
        """Let the kernel record frame 0 in the next launch, and then all others."""
        self._columns = columns
        size = self._particles * columns.count * self._batch.shown.itemsize
        self._room = min(max(1, ROOM // size), MOST_FRAMES, self._frames)
        self._row.set_counts(records=1, arrived=1, frame=0, frames=self._frames)
        self.index = self.steps = 0
        self.make_room()

    def make_room(self) -> None:
        """Let the next launch record as many frames as there is room for."""
        columns = self._columns
        self._batch.make_room(self._room * self._particles, columns.count)
        places = dict(zip(CHOSEN, chosen_columns(columns), strict=True))
        self._row.set_counts(room=self._room, **places)

    def read(self, builder: FrameBuilder, before: int) -> list[tuple[Frame, LedgerRow]]:
        """Return the frames of the last launch, which began after `before` steps of the run."""
        count = self._row.count("recorded")
        if count == 0:
            return []
        moments = []
        loads = self._loads(count)
        for n, note in enumerate(self._batch.notes[self._slot, :count, : len(NOTES)].tolist()):
            now, last_step, smallest, courant, largest, largest_courant, limit, steps, blocked = note
            step = before + int(steps)
            taken = NO_STEPS
            if step > self.steps:
                taken = StepsTaken(step - self.steps, (smallest, courant, LIMITS[int(limit)]), largest, largest_courant)
            own = None if loads is None else loads[n]
            moments.append(Moment(self.index, now, step, last_step, taken, own, int(blocked)))
            self.index, self.steps = self.index + 1, step
        rows = self._batch.shown[self._batch.first_row(self._slot) :][: count * self._particles]
        arrays = FrameArrays(builder.columns, rows.reshape(count, self._particles, -1))
        return builder.build(moments, arrays, self._sums(count)[0])

    def read_now(self, arrays: FrameArrays) -> list[Sums] | None:
        """Fill the rows of one frame with the state as it is; return the sums, None where a particle is not sound."""
        numbers, counts = self._batch.numbers.copy(), self._batch.counts.copy()
        room, self._room, columns, self._columns = self._room, 1, self._columns, arrays.columns
        try:
            self._batch.counts[:, self._batch.layout.count.status] = IDLE
            self._row.set_counts(records=1, arrived=1, frame=0, frames=0)
            self.make_room()
            self._batch.launch()
        finally:
            self._batch.numbers[:], self._batch.counts[:] = numbers, counts
            self._room, self._columns = room, columns
        sums, sound = self._sums(1)
        rows = self._batch.shown[self._batch.first_row(self._slot) :][: self._particles]
        arrays.reals[0] = rows[:, : arrays.columns.count]
        return sums if sound else None

    def _loads(self, count: int) -> np.ndarray | None:
        """Return what each collider took up to the first frames of the last launch, (count, colliders, k)."""
        colliders = self._batch.device.colliders
        if colliders is None:
            return None
        first = len(NOTES) + len(self._batch.kind.members) * sum_entries(self._batch.kind.dimension)
        own = self._batch.notes[self._slot, :count, first:].reshape(count, colliders.room, colliders.loads)
        return own[:, : colliders.count[self._slot]].copy()

    def _sums(self, count: int) -> tuple[list[Sums], bool]:
        """Return the sums of each group at the first frames of the last launch, and whether all were sound."""
        d = self._batch.kind.dimension
        groups = len(self._batch.kind.members)
        own = self._batch.notes[self._slot, :count, len(NOTES) :][:, : groups * sum_entries(d)].copy()
        parts = np.split(own, groups, axis=1)
        found = [sums_of(part, d) for part in parts]
        return [sums for sums, _ in found], all(sound.all() for _, sound in found)
