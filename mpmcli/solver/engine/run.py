"""A run of a batch frame by frame."""

import time
from collections.abc import Callable, Iterator

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.solver.engine.failure import stop
from mpmcli.solver.engine.stepped_run import SteppedRun
from mpmcli.solver.frames.builder import Moment
from mpmcli.solver.frames.columns import FrameArrays
from mpmcli.solver.frames.ledger_sums import NO_STEPS, StepsTaken, Sums, sums_of_rows
from mpmcli.solver.frames.recorder import steps_of
from mpmcli.solver.transfer.particle_update import SMALLEST_J


class Run(SteppedRun):
    """A scene in one place of a batch; of several runs of a batch only `events` may be used."""

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the state as it is and then one frame for each output time to come, with its ledger row.

        The time left to the next frame is split into equal steps, so that frames land on their times. After `load` of
        a state that was saved between frames, the frames that follow are yielded.

        Args:
            stop: called before each launch but the first, where `save` may be called; True ends the run there.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
            KeyboardInterrupt: `stop` returned True.
        """
        for event in self.events():
            if event is not None:
                yield event
                continue
            # Frame 0 is always there, and what a launch has recorded is yielded before.
            if self._begun and stop():
                raise KeyboardInterrupt
            self.batch.launch()
            self.first_step_seconds = self.first_step_seconds or self.batch.first_seconds

    def events(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Yield as `frames` does, and None where the batch must launch."""
        if self.backend.on_cpu:
            yield from self._recorded_events()
            return
        if not self._begun:
            yield None
            self._start()
        resumed, self._resumed = self._resumed, False
        if not resumed:
            yield self.frame()
            self._recorder.index, self._recorder.steps = self._next_frame(), self.step_count
        count = self.scene.time.frames
        while (index := self._recorder.index) <= count:
            for _ in self._reach(self.scene.time.end * index / count, anew=not resumed):
                yield None
            resumed = False
            # A particle that the last step has inverted would be found in the next one only.
            if not self._state.step_control.sound():
                stop(self, self.last_step)
            taken = steps_of(self._row, self.step_count - self._recorder.steps)
            self._recorder.index, self._recorder.steps = index + 1, self.step_count
            yield self.frame(index, taken)

    def _recorded_events(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Yield as `events` on the CPU, where the kernel records frames while it goes on."""
        if not self._begun:
            self._recorder.begin(self._builder.columns)
            yield None
            self._start()
            yield from self.recorded(0)
            if self._row.count("recorded") == 0:
                stop(self, 0.0)
        elif not self._resumed:
            yield self.frame()
            self._recorder.go_on(self._builder.columns, self._next_frame(), self.step_count)
            self._exchange.push(self._state)
        self._resumed = False
        yield from self._advance()

    def _next_frame(self) -> int:
        """Return the number of the first frame after the time of the state."""
        count, index = self.scene.time.frames, 1
        while index <= count and self.scene.time.end * index / count <= self.time:
            index += 1
        return index

    def frame(self, index: int = 0, taken: StepsTaken = NO_STEPS) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps taken.

        Raises:
            UnstableRunError: a particle is inverted or not finite.
        """
        state, columns = self.state, self._builder.columns
        began, processor_began = time.perf_counter(), time.process_time()
        arrays = FrameArrays(columns, np.empty((1, self.particle_count, columns.count), self.groups[0].real))
        sums, loads = self._read(arrays)
        blocked = self._row.count("blocked")
        moment = Moment(index, state.time, state.step_count, state.last_step, taken, loads, blocked)
        (built,) = self._builder.build([moment], arrays, sums)
        self.frame_seconds += time.perf_counter() - began
        self.frame_processor_seconds += time.process_time() - processor_began
        return built

    def _read(self, arrays: FrameArrays) -> tuple[list[Sums], dict[str, np.ndarray]]:
        """Fill all rows of a frame; return the sums of each group, and `Moment.loads`."""
        loads, colliders = {}, self.batch.device.colliders
        if self.backend.on_cpu:
            sums = self._recorder.read_now(arrays, self._launch_alone)
            sound = sums is not None
            loads = {name: values[0] for name, values in self._recorder.loads(1).items()}
        else:
            if colliders is not None:
                loads["collider"] = colliders.loads.read(self.slot, len(self.scene.colliders))
            gpu = self.batch.gpu
            gpu.begin_frame(self.batch.numbers, self.batch.counts)
            for g, group in enumerate(self.groups):
                gpu.read(g, self.slot, group.first, group.count, self.last_step, arrays.columns, arrays.reals[0])
            constants = self._builder.constants.of_rows(slice(0, self.particle_count))
            sums = sums_of_rows(arrays, constants, total=self.groups[0].total)
            sound = (arrays["J"] > SMALLEST_J).all()
        if not sound:
            stop(self, self.last_step)
        return sums, loads
