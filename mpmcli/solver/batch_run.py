"""One run of a batch: fills its place on the device, and attends to it between launches."""

import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_constants import write_constants
from mpmcli.solver.batch_exchange import Exchange
from mpmcli.solver.batch_group import groups_of
from mpmcli.solver.batch_layout import ATTEND, BEYOND, COLLAPSED, CROWDED, GOING, IDLE, LOST, MEASURE, Row
from mpmcli.solver.batch_recorder import BatchRecorder, steps_of
from mpmcli.solver.batch_state import aim_on, read_batch, write_batch
from mpmcli.solver.batch_values import Drives
from mpmcli.solver.collider_steps import read_loads
from mpmcli.solver.external_forces import ExternalForces
from mpmcli.solver.frame_arrays import FrameArrays
from mpmcli.solver.groups import require_inside
from mpmcli.solver.launch_budget import LaunchBudget
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.run import COLLAPSE, Run
from mpmcli.solver.run_values import RunValues
from mpmcli.solver.sparse_grid import WANTED
from mpmcli.solver.state import Progress, SavedState
from mpmcli.solver.state_bounds import Measurement, entries, state_bounds_of
from mpmcli.solver.step_control import StepControl
from mpmcli.solver.sums import Sums
from mpmcli.solver.tile_reach import first_nodes_of


class BatchRun(Run):
    """A scene in one place of a batch."""

    def __init__(
        self,
        batch: Batch,
        slot: int,
        scene: Scene,
        particles: list[BodyParticles] | None = None,
        *,
        force: bool = False,
    ) -> None:
        """Fill the place.

        Args:
            slot: number of the place, whose last run has ended.
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.

        Raises:
            InputError: a particle is not in the domain.
        """
        super().__init__(scene, batch.backend, particles, force=force)
        require_inside(scene, self._particles)
        self.batch, self.slot = batch, slot
        self._observations = batch.observations
        self._begun = False
        self._numbers, self._counts = batch.numbers[slot], batch.counts[slot]
        self._real, self._count = batch.layout.real, batch.layout.count
        self._row = Row(batch.layout, self._numbers, self._counts)
        self._row.set(time=0.0, last_step=0.0)
        self._row.set_counts(records=0, arrived=0, steps=0)
        self._exchange = Exchange(batch.layout, self._numbers, self._counts)
        self.groups = groups_of(batch, slot, scene, self._particles)
        self._budget = LaunchBudget(self.particle_count)
        self._recorder = BatchRecorder(batch, slot, self.particle_count, scene.time.frames)
        entries = Drives.of(scene, [group.bodies for group in self.groups])[1]
        self._values = RunValues(batch.values.device, slot, entries, scene.time.end)
        self._tables, self._means = batch.values.tables, list(self._values.means.values())
        self._filled_since, self._coarse = -math.inf, False
        write_constants(batch, slot, scene, self._particles)
        self._row.set(horizon=-math.inf if self._means else math.inf, collider=self._collider_bound)
        self._row.set_counts(status=MEASURE, forced=self._forced)
        if batch.device.grid.sparse:
            batch.occupy(first_nodes_of(np.concatenate([body.position for body in self._particles]), scene))
        self._forget_particles()

    def _measurement(self, g: int) -> Measurement:
        first = self._real.maxima[g]
        group = self.groups[g]
        columns = slice(first, first + entries(group))
        # Internal variables by themselves are measured on a GPU only.
        return Measurement(lambda: state_bounds_of(group, self._numbers[columns].tolist()), dict)

    def events(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Yield a frame and its ledger row for each output time, as `Solver.frames`; None where the batch must launch.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        if self._begun:
            yield from self._advance()
            return
        if self.backend.on_cpu:
            self._recorder.begin(self._builder.columns)
        yield None
        self._start()
        if self.backend.on_cpu:
            yield from self._recorded(0)
            if self._row.count("recorded") == 0:
                self._stop(0.0, self._lost())
            yield from self._advance()
            return
        yield self.frame()
        count = self.scene.time.frames
        for index in range(1, count + 1):
            before = self.step_count
            for _ in self._reach(self.scene.time.end * index / count):
                yield None
            # A particle that the last step has inverted would be found in the next one only.
            if not self.state.step_control.sound():
                self._stop(self.last_step, self._lost())
            yield self.frame(index, steps_of(self._row, self.step_count - before))

    def begin(self) -> None:
        """Take the bounds of time 0, where this is the only run of its batch; a second call does nothing."""
        if not self._begun:
            self.batch.launch()
            self._start()

    def advance(self, count: int) -> tuple[int, float]:
        """Take `count` steps as large as the next one, fewer or more where it changes; see `Engine.advance`."""
        self.begin()
        self._exchange.push(self.state)
        before = self.step_count
        step = min(self.stable_step()[0], self.scene.time.end / self.scene.time.frames)
        for _ in self._reach(self.time + count * step):
            self.batch.launch()
        return self.step_count - before, self._row.number("smallest")

    def wait(self) -> None:
        """Wait until the device has taken every step; each launch waits."""

    def save(self) -> SavedState:
        """Return the state of the only run of a batch; see `Engine.save`."""
        numbers = {name: getattr(self.state, name) for name in Progress.NUMBERS}
        numbers["step_control"] = self.state.step_control.save()
        numbers["external_forces"] = self.state.external_forces.save()
        numbers["tables"] = [self._filled_since, self._coarse]
        numbers["frames"] = [self._recorder.index, self._recorder.steps, self._builder.before]
        return SavedState(numbers, read_batch(self.batch))

    def load(self, saved: SavedState) -> None:
        """Go on from a saved state of the same scene, or of one that ends earlier, as the only run of a batch.

        Raises:
            InputError: it is of another scene.
        """
        self._recorder.begin(self._builder.columns)
        write_batch(self.batch, saved.arrays)
        self._prepare()
        for name in Progress.NUMBERS:
            setattr(self.state, name, saved.numbers[name])
        self.state.step_control.load(saved.numbers["step_control"])
        self.state.external_forces.load(saved.numbers["external_forces"])
        self._filled_since, self._coarse = saved.numbers["tables"]
        if math.isfinite(self._filled_since):
            self._tables.fill(self.slot, self._means, self._filled_since, coarse=self._coarse)
        self._recorder.index, self._recorder.steps, self._builder.before = saved.numbers["frames"]
        aim_on(self._row)

    def _start(self) -> None:
        """Take the bounds of time 0 from the measurement of the first launch."""
        self.first_step_seconds = self.batch.first_seconds
        control = self._prepare()
        self._begin()
        self._row.set(
            growth_allowed=control.growth_allowed,
            collapse=COLLAPSE * self.state.first_stable_step,
        )
        self._row.set_counts(longest=control.longest)
        for g, group in enumerate(self.groups):
            self._numbers[self._real.sensitivity[g]] = group.law.sensitivity
            self._numbers[self._real.hardening[g]] = group.law.hardening
        self._exchange.push(self.state)

    def _prepare(self) -> StepControl:
        """Begin to follow the state from the measurement that the kernel made last."""
        control = StepControl(
            self.scene, self.groups, [self._measurement(g) for g in range(len(self.groups))], on_cpu=True
        )
        measures = [
            partial(push, group.first, group.count, self.slot)
            for push, group in zip(self.batch.pushes, self.groups, strict=True)
            if push is not None
        ]
        self.state = Progress(control, ExternalForces(self.scene, self._values, measures))
        self._begun = True
        return control

    def _reach(self, target: float) -> Iterator[None]:
        """Let the batch launch until the run has reached a time, s."""
        self._row.set(target=target, smallest=math.inf, largest=0.0, largest_courant=0.0)
        self._row.set_counts(arrived=0, limit=0, records=0)
        for _ in self._advance():
            yield None

    def _advance(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Let the batch launch until the run has reached its target, or its last frame where the kernel records.

        Yields:
            None where the batch must launch; and the frames that it has recorded.
        """
        while self._row.count("arrived") == 0:
            self._row.set_counts(status=GOING, budget=self._budget.steps, steps=0)
            if self._row.count("records"):
                self._recorder.make_room()
            since = self.batch.seconds
            yield None
            before = self.step_count
            self._exchange.pull(self.state)
            self._budget.took(self._row.count("steps"), self.batch.seconds - since)
            status = self._row.count("status")
            if self._row.count("records"):
                yield from self._recorded(before)
            self._attend(status)

    def _attend(self, status: int) -> None:
        """Do what a status asks for after a launch."""
        if status in (LOST, COLLAPSED):
            self._row.set_counts(status=IDLE)
        if status == LOST:
            self._stop(self.last_step, self._lost())
        if status == COLLAPSED:
            self._stop_collapsed(self.stable_step()[0])
        if status == BEYOND:
            self._fill_tables()
        if status == CROWDED:
            self.batch.grow(self.batch.device.grid.sizes[WANTED])
        if status == ATTEND:
            due = self.state.step_control.take_counters(self._exchange.counters(self.state.step_control))
            if due:
                self._measure(due)
            self._exchange.push(self.state)

    def _recorded(self, before: int) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames that the last launch has recorded; `before` are the steps taken before it."""
        began = time.perf_counter()
        built = self._recorder.read(self._builder, before)
        self.frame_seconds += time.perf_counter() - began
        yield from built

    def _measure(self, due: range | list[int]) -> None:
        """Take the measurement of some groups that the kernel has made after the last step."""
        if not self.state.step_control.measure(due):
            self._stop(self.last_step, self._lost())
        forces = self.state.external_forces
        forces.measure(self.time, self.state.step_control.longest * self.last_step)
        if self.state.step_control.fresh:
            self.state.speed = self.state.step_control.speed

    @property
    def _blocked(self) -> int:
        return self._row.count("blocked")

    def _fill_tables(self) -> None:
        """Let the kernel go on from the time that velocities have."""
        since = self.state.velocity_time
        # The same time again: the next kick takes more windows than found room.
        self._coarse, self._filled_since = since == self._filled_since, since
        self._row.set(horizon=self._tables.fill(self.slot, self._means, since, coarse=self._coarse))

    def _lost(self) -> list[int | None]:
        """Return a lost particle of each group, in solver order, None where none is known."""
        count = len(self.groups)
        found = self.batch.device.particles.lost.to_numpy()[self.slot * count :][:count]
        return [None if p == NOT_LOST else int(p) - group.first for p, group in zip(found, self.groups, strict=True)]

    def _read(self, arrays: FrameArrays) -> list[Sums]:
        sums = self._recorder.read_now(arrays)
        if sums is None:
            self._stop(self.last_step, self._lost())
        return sums

    def _loads(self) -> np.ndarray | None:
        colliders = self.batch.device.colliders
        return None if colliders is None else read_loads(colliders, self.slot, len(self.scene.colliders))

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield as `Solver.frames`, where this is the only run of its batch.

        Raises:
            UnstableRunError: see `events`.
            KeyboardInterrupt: `stop`, called before each launch but the first, returned True.
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
