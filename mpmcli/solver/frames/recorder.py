"""Frames of one run that the kernel of a batch records during a launch."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.run_state import FRAME_NUMBERS, LIMITS, MOST_FRAMES, RunState
from mpmcli.solver.frames.builder import NO_STEPS, FrameBuilder, Moment, StepsTaken, Sums
from mpmcli.solver.frames.columns import FrameArrays, FrameColumns
from mpmcli.solver.frames.reader import CHOSEN, chosen_columns, sum_entries, sums_of

# Largest number of bytes of the frames of a run in one launch.
ROOM = 16_000_000


def steps_of(run: RunState | SimpleNamespace, count: int) -> StepsTaken:
    """Return the `count` steps since the last frame as recorded by a kernel."""
    smallest = run.smallest, run.smallest_courant, LIMITS[int(run.limit)]
    return StepsTaken(count, smallest, run.largest, run.largest_courant)


def moment_of(
    run: RunState | SimpleNamespace, index: int, taken: StepsTaken, loads: Mapping[str, np.ndarray]
) -> Moment:
    """Return the moment of a frame, from the current numbers of a run or from those stored with the frame."""
    return Moment(index, run.time, int(run.step_count), run.last_step, taken, loads, int(run.blocked))


class FrameRecorder:
    """Access to the frames of a run in `Batch.frame_buffer` and `Batch.frame_stats`.

    Attributes:
        index: index of the next frame to be read.
        steps: number of steps of the run up to the last frame read.
    """

    def __init__(self, batch: Batch, slot: int, particles: int, frames: int) -> None:
        self._batch, self._slot, self._particles, self._frames = batch, slot, particles, frames
        self._state = batch.state(slot)
        self._capacity = 0
        self._columns: FrameColumns | None = None
        self.index = self.steps = 0

    def start(self, columns: FrameColumns) -> None:
        """Start recording frames with the next launch."""
        self._columns = columns
        size = self._particles * columns.count * self._batch.frame_buffer.itemsize
        self._capacity = min(max(1, ROOM // max(1, size)), MOST_FRAMES, self._frames)
        self._state.records = 1

    def reserve(self) -> None:
        """Let the next launch record as many frames as fit."""
        for name, value in self._reserved(self._capacity, self._columns).items():
            setattr(self._state, name, value)

    def _reserved(self, frames: int, columns: FrameColumns) -> dict[str, int]:
        """Allocate space for frames in the next launch; return the counts that it requires."""
        self._batch.reserve(frames * self._particles, columns.count)
        return {"frame_capacity": frames, **dict(zip(CHOSEN, chosen_columns(columns), strict=True))}

    def read(self, builder: FrameBuilder) -> list[tuple[Frame, LedgerRow]]:
        """Return the frames of the last launch."""
        count = self._state.recorded
        if count == 0:
            return []
        moments = []
        loads = self.loads(count)
        for n, note in enumerate(self._batch.frame_stats[self._slot, :count, : len(FRAME_NUMBERS)].tolist()):
            now = SimpleNamespace(**dict(zip(FRAME_NUMBERS, note, strict=True)))
            step = int(now.step_count)
            taken = steps_of(now, step - self.steps) if step > self.steps else NO_STEPS
            own = {name: values[n] for name, values in loads.items()}
            moments.append(moment_of(now, self.index, taken, own))
            self.index, self.steps = self.index + 1, step
        rows = self._batch.frame_buffer[self._batch.first_row(self._slot) :][: count * self._particles]
        arrays = FrameArrays(builder.columns, rows.reshape(count, self._particles, builder.columns.count))
        return builder.build(moments, arrays, self._sums(count)[0])

    def read_now(self, arrays: FrameArrays, launch: Callable[..., None]) -> list[Sums] | None:
        """Fill the rows of one frame with the current state; return the sums, or None if a particle is not sound."""
        launch(records=1, arrived=1, frame=0, frames=0, **self._reserved(1, arrays.columns))
        sums, sound = self._sums(1)
        rows = self._batch.frame_buffer[self._batch.first_row(self._slot) :][: self._particles]
        arrays.reals[0] = rows[:, : arrays.columns.count]
        return sums if sound else None

    def loads(self, count: int) -> dict[str, np.ndarray]:
        """Return the loads up to the first `count` frames of the last launch, (count, ...), see `Moment.loads`."""
        kind, found = self._batch.kind, {}
        first = len(FRAME_NUMBERS) + len(kind.members) * sum_entries(kind.dimension)
        rest = self._batch.frame_stats[self._slot, :count, first:].copy()
        for feature in self._batch.device.features:
            own, rest = np.split(rest, [feature.noted], axis=1)
            feature.tell(own, self._slot, found)
        return found

    def _sums(self, count: int) -> tuple[list[Sums], bool]:
        """Return the sums of each group at the first `count` frames of the last launch, and whether all were sound."""
        d = self._batch.kind.dimension
        groups = len(self._batch.kind.members)
        own = self._batch.frame_stats[self._slot, :count, len(FRAME_NUMBERS) :][:, : groups * sum_entries(d)].copy()
        parts = np.split(own, groups, axis=1)
        found = [sums_of(part, d) for part in parts]
        return [sums for sums, _ in found], all(sound.all() for _, sound in found)
