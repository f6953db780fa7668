"""Frames that the kernel of a batch records of one run while the run goes on, some in each launch."""

import math
from collections.abc import Callable

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.solver.contact.body_contact import EXTREMES
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.run_numbers import LIMITS, MOST_FRAMES, NOTES, Row
from mpmcli.solver.frames.builder import FrameBuilder, Moment
from mpmcli.solver.frames.columns import FrameArrays, FrameColumns
from mpmcli.solver.frames.ledger_sums import NO_STEPS, StepsTaken, Sums
from mpmcli.solver.frames.reader import CHOSEN, chosen_columns, sum_entries, sums_of
from mpmcli.stability.limits import collider_limit

# Bytes that the frames of a run may take in one launch.
ROOM = 16_000_000


def steps_of(row: Row, count: int) -> StepsTaken:
    """Return the steps since the last frame, so many, as a kernel has booked them."""
    smallest = row.number("smallest"), row.number("smallest_courant"), LIMITS[row.count("limit")]
    return StepsTaken(count, smallest, row.number("largest"), row.number("largest_courant"))


class FrameRecorder:
    """The place of a run in `Batch.shown` and `Batch.notes`.

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
        self.resume(columns, 0, 0)
        self._row.set_counts(arrived=1, frame=0)
        self.make_room()

    def go_on(self, columns: FrameColumns, index: int, steps: int) -> None:
        """Let the kernel record the frames from number `index` on, of a run that has taken so many steps."""
        self.resume(columns, index, steps)
        self._row.set_counts(frame=index, arrived=int(index > self._frames), limit=0)
        self._row.set(smallest=math.inf, largest=0.0, largest_courant=0.0)
        self._row.set(target=self._row.number("end") * index / self._frames)

    def resume(self, columns: FrameColumns, index: int, steps: int) -> None:
        """Let the kernel record the frames that it was about to record when its numbers were saved."""
        self._columns = columns
        size = self._particles * columns.count * self._batch.shown.itemsize
        self._room = min(max(1, ROOM // size), MOST_FRAMES, self._frames)
        self._row.set_counts(records=1, frames=self._frames)
        self.index, self.steps = index, steps

    def make_room(self) -> None:
        """Let the next launch record as many frames as there is room for."""
        self._row.set_counts(**self._room_for(self._room, self._columns))

    def _room_for(self, frames: int, columns: FrameColumns) -> dict[str, int]:
        """Make room for frames in the next launch; return the counts that tell it so."""
        self._batch.make_room(frames * self._particles, columns.count)
        return {"room": frames, **dict(zip(CHOSEN, chosen_columns(columns), strict=True))}

    def read(self, builder: FrameBuilder, before: int) -> list[tuple[Frame, LedgerRow]]:
        """Return the frames of the last launch, which began after `before` steps of the run."""
        count = self._row.count("recorded")
        if count == 0:
            return []
        moments = []
        loads = self.loads(count)
        for n, note in enumerate(self._batch.notes[self._slot, :count, : len(NOTES)].tolist()):
            now, last_step, smallest, courant, largest, largest_courant, limit, steps, blocked = note
            step = before + int(steps)
            taken = NO_STEPS
            if step > self.steps:
                taken = StepsTaken(step - self.steps, (smallest, courant, LIMITS[int(limit)]), largest, largest_courant)
            own = {name: values[n] for name, values in loads.items()}
            moments.append(Moment(self.index, now, step, last_step, taken, own, int(blocked)))
            self.index, self.steps = self.index + 1, step
        rows = self._batch.shown[self._batch.first_row(self._slot) :][: count * self._particles]
        arrays = FrameArrays(builder.columns, rows.reshape(count, self._particles, -1))
        return builder.build(moments, arrays, self._sums(count)[0])

    def read_now(self, arrays: FrameArrays, launch: Callable[..., None]) -> list[Sums] | None:
        """Fill the rows of one frame with the state as it is; return the sums, None where a particle is not sound."""
        launch(records=1, arrived=1, frame=0, frames=0, **self._room_for(1, arrays.columns))
        sums, sound = self._sums(1)
        rows = self._batch.shown[self._batch.first_row(self._slot) :][: self._particles]
        arrays.reals[0] = rows[:, : arrays.columns.count]
        return sums if sound else None

    def loads(self, count: int) -> dict[str, np.ndarray]:
        """Return what was taken up to the first frames of the last launch, (count, ...), see `Moment.loads`."""
        device, kind = self._batch.device, self._batch.kind
        first, found = len(NOTES) + len(kind.members) * sum_entries(kind.dimension), {}
        rest = self._batch.notes[self._slot, :count, first:].copy()
        for name, takers in (("collider", device.colliders), ("contact", device.contact)):
            if takers is not None:
                size = takers.loads.room * takers.loads.width
                number = kind.layers.pairs if name == "contact" else takers.count[self._slot]
                found[name] = rest[:, :size].reshape(count, -1, takers.loads.width)[:, :number]
                rest = rest[:, size:]
        if device.rigid is not None:
            size = device.rigid.width + device.rigid.loads
            found["rigid"] = rest[:, : device.rigid.count * size].reshape(count, -1, size)
        return found if device.contact is None else found | dict(zip(EXTREMES, rest.T, strict=True))

    def _sums(self, count: int) -> tuple[list[Sums], bool]:
        """Return the sums of each group at the first frames of the last launch, and whether all were sound."""
        d = self._batch.kind.dimension
        groups = len(self._batch.kind.members)
        own = self._batch.notes[self._slot, :count, len(NOTES) :][:, : groups * sum_entries(d)].copy()
        parts = np.split(own, groups, axis=1)
        found = [sums_of(part, d) for part in parts]
        return [sums for sums, _ in found], all(sound.all() for _, sound in found)


def collider_bound(scene: Scene) -> float:
    """Return the step in which no collider of a scene moves more than half a cell, s, those that move freely aside."""
    speeds = [each.fastest(scene.domain, scene.time.end) for each in scene.colliders if not each.free]
    return collider_limit(scene.domain.spacing, max(speeds, default=0.0))
