"""A run of a batch step by step: fills its place on the device, and attends to it between launches."""

import math
import time
from collections.abc import Iterator, Sequence
from functools import cached_property, partial

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.drive.expressions import RunValues
from mpmcli.solver.drive.forces import Drives, ExternalForces
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.exchange import Exchange, LaunchBudget, write_constants
from mpmcli.solver.engine.failure import require_room, stop, stop_collapsed
from mpmcli.solver.engine.run_group import RunGroup, groups_of, require_inside
from mpmcli.solver.engine.run_numbers import ATTEND, BEYOND, COLLAPSED, CROWDED, GOING, IDLE, LOST, MEASURE, Row
from mpmcli.solver.engine.saved_state import Progress, SavedState, aim_on, read_batch, write_batch
from mpmcli.solver.engine.step_control import StepControl
from mpmcli.solver.frames.builder import FrameBuilder
from mpmcli.solver.frames.recorder import FrameRecorder, collider_bound
from mpmcli.solver.grid.sparse_grid import WANTED, first_nodes_of
from mpmcli.solver.particles.state_bounds import StateBounds, entries, state_bounds_of
from mpmcli.solver.transfer.particle_update import NOT_LOST
from mpmcli.stability.limits import Limit, force_limit, speed_limit

# Ratio of the stable step to the first one at which a run stops: steps that small do not recover.
COLLAPSE = 1e-4


class SteppedRun:
    """A scene in one place of a batch, step by step.

    What reads or steps a run alone launches its batch: of several runs of a batch only `events` may be used.

    Attributes:
        scene: what is computed.
        batch, slot: where.
        groups: the particles, a group for each law.
        particle_count: number of particles.
        first_step_seconds: wall time of the first launch, which compiles the kernels; 0 before it.
        frame_seconds, frame_processor_seconds: wall and processor time spent so far on frames and ledger rows.
    """

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
        self.scene, self.batch, self.slot, self.backend = scene, batch, slot, batch.backend
        self.forced = force and scene.time.step != "auto"
        self.first_step_seconds = self.frame_seconds = self.frame_processor_seconds = 0.0
        self.spacing = scene.domain.spacing
        self._particles = particles or sample_bodies(scene)
        self._counts_of_sources = [len(b.position) for b in self._particles]
        self.particle_count = sum(self._counts_of_sources)
        require_inside(scene, self._particles)
        self._numbers, self._counts = batch.numbers[slot], batch.counts[slot]
        self._real = batch.layout.real
        self._row = Row(batch.layout, self._numbers, self._counts)
        self._exchange = Exchange(batch.layout, self._numbers, self._counts)
        self.groups: list[RunGroup] = groups_of(batch, slot, scene, self._particles)
        self._budget = LaunchBudget(self.particle_count)
        self._recorder = FrameRecorder(batch, slot, self.particle_count, scene.time.frames)
        self._place()
        if batch.device.grid.sparse:
            batch.occupy(first_nodes_of(np.concatenate([body.position for body in self._particles]), scene))
        # Frames keep what they show of the particles at the start, which are on the device.
        _ = self._builder
        self._particles = []

    def _place(self) -> None:
        """Write what belongs to the scene, and let the next launch measure the state at time 0."""
        scene, batch = self.scene, self.batch
        drives = Drives.of(scene, [group.bodies for group in self.groups])[1]
        end = scene.time.end
        self._values = RunValues(batch.values.device, self.slot, drives, end / scene.time.frames, end)
        batch.values.of_runs[self.slot] = self._values
        self._tables, self._means = batch.values.tables, list(self._values.means.values())
        self._filled_since, self._coarse = -math.inf, False
        self._collider_bound = collider_bound(scene)
        write_constants(batch, self.slot, scene, self._counts_of_sources)
        self._row.set(time=0.0, last_step=0.0, given=0.0)
        self._row.set(horizon=math.inf if self._tables is None else -math.inf, collider=self._collider_bound)
        self._row.set_counts(status=MEASURE, records=0, arrived=0, steps=0, forced=self.forced)
        self._begun = self._resumed = False

    # What a run is, and how far it has come.

    @cached_property
    def _builder(self) -> FrameBuilder:
        # Where the host forms the sums of the ledger it needs all that is summed.
        columns = () if self.backend.on_cpu else ("affine", "deformation_gradient")
        return FrameBuilder(self.scene, self._particles, self.groups, columns)

    @property
    def laws(self) -> tuple[str, ...]:
        """Names of the laws, in the order of `Frame.material`."""
        return tuple(group.law.name for group in self.groups)

    @property
    def grid(self) -> object:
        """The nodes of the batch, see `Grid`."""
        return self.batch.device.grid

    @property
    def state(self) -> Progress:
        """What changes in the run beside its particles; changes of it count from the next step on."""
        self.begin()
        return self._state

    @property
    def time(self) -> float:
        """Time of the state, s, in double precision."""
        return self._state.time if self._begun else 0.0

    @property
    def step_count(self) -> int:
        """Steps taken."""
        return self._state.step_count if self._begun else 0

    @property
    def last_step(self) -> float:
        """Size of the last step, s, 0 before the first."""
        return self._state.last_step if self._begun else 0.0

    @property
    def courant(self) -> float:
        """Cells that the fastest node moved in the last step, which no particle exceeds."""
        return self._state.courant if self._begun else 0.0

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on the limits that follow from measurements of the state, s."""
        return self._state.step_control.seconds if self._begun else 0.0

    # The time step.

    def limits(self) -> list[Limit]:
        """Return every bound on the next step: of the speed as it is, of the rest as last measured."""
        return [*self._fast_limits(), *self.state.step_control.limits()]

    def limits_now(self) -> list[Limit]:
        """Return every bound that follows from the state of the particles as it is, without storing it."""
        control = self.state.step_control
        self._launch_alone(status=MEASURE, arrived=0)
        return control.limits_now()

    @property
    def nearest_limit(self) -> Limit:
        """The smallest bound on the next step."""
        return min(self.state.step_control.nearest, *self._fast_limits())

    def stable_step(self) -> tuple[float, Limit]:
        """Return the step to take, safety included, and the bound that sets it."""
        limit = self.nearest_limit
        step = self.scene.time.safety * limit.value
        maximum = self.scene.time.step
        if maximum != "auto" and maximum < step:
            return maximum, Limit(maximum, "maximum", "")
        if self.forced:
            return maximum, Limit(maximum, "forced", "")
        return step, limit

    def _fast_limits(self) -> list[Limit]:
        state, domain = self.state, self.scene.domain
        forces = state.external_forces
        ahead = 0.0
        if not domain.steady:
            # The next kick ends in the middle of a step that is no longer than the other bounds allow.
            ahead = min(self.scene.time.safety * state.step_control.nearest.value, self.scene.time.end)
        pull = forces.pull(state.velocity_time, state.time + ahead)
        limits = [Limit(speed_limit(self.spacing, max(state.speed, domain.wall_speed), pull), "speed", "")]
        if forces.pushes:
            limits.append(Limit(force_limit(forces.slope), "force", ""))
        if self.scene.colliders:
            limits.append(Limit(self._collider_bound, "collider", ""))
        return limits

    # Beginning, and going on.

    def begin(self) -> None:
        """Take the bounds of time 0; a second call does nothing."""
        if not self._begun:
            self.batch.launch()
            self._start()

    def restart(self) -> None:
        """Begin anew at time 0 with the particles as they are on the device, set from outside."""
        self._forget_lost()
        self._place()
        self._recorder.index, self._builder.before = 0, 0.0
        self.begin()

    def _start(self) -> None:
        """Take the bounds of time 0 from the measurement of the first launch."""
        self.first_step_seconds = self.batch.first_seconds
        control = self._prepare()
        free = [each.fastest(self.scene.domain, 0.0) for each in self.scene.colliders if each.free]
        self._state.speed = max([self._state.speed, *free])
        forces = self._state.external_forces
        forces.measure(0.0, 0.0)
        # Once more, with the step that says how far ahead the next measurement is.
        forces.measure(0.0, control.longest * self.stable_step()[0])
        self._state.first_stable_step = self.stable_step()[0]
        self._row.set(growth_allowed=control.growth_allowed, collapse=COLLAPSE * self._state.first_stable_step)
        self._row.set_counts(longest=control.longest)
        for g, group in enumerate(self.groups):
            self._numbers[self._real.sensitivity[g]] = group.law.sensitivity
            self._numbers[self._real.hardening[g]] = group.law.hardening
        self._exchange.push(self._state)

    def _prepare(self) -> StepControl:
        """Begin to follow the state from the measurement that the kernel made last."""
        control = StepControl(self.scene, self.groups, [partial(self._measured, g) for g in range(len(self.groups))])
        measures = [
            partial(push, group.first, group.count, self.slot)
            for push, group in zip(self.batch.pushes, self.groups, strict=True)
            if push is not None
        ]
        self._state = Progress(control, ExternalForces(self.scene, self._values, measures))
        self._begun = True
        return control

    def _measured(self, g: int) -> StateBounds:
        """Return the bounds of the state of the g-th group as the kernel has measured them last."""
        first = self._real.maxima[g]
        return state_bounds_of(self.groups[g], self._numbers[first : first + entries(self.groups[g])].tolist())

    def step(self, dt: float, until: float | None = None) -> None:
        """Advance by dt (s), whatever the bounds on the step.

        Args:
            until: the time after the step where that is known, s; a sum has rounding errors.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        self._exchange.push(self.state)
        self._row.set(given=dt)
        try:
            for _ in self._reach(self.time + dt if until is None else until):
                self.batch.launch()
        finally:
            self._row.set(given=0.0)

    def advance(self, count: int) -> tuple[int, float]:
        """Take about `count` stable steps, whatever the times of frames are, for a measurement of speed.

        Returns:
            The number of steps taken, and the smallest one, s.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        self._exchange.push(self.state)
        before = self.step_count
        step = min(self.stable_step()[0], self.scene.time.end / self.scene.time.frames)
        for _ in self._reach(self.time + count * step):
            self.batch.launch()
        return self.step_count - before, self._row.number("smallest")

    def measure(self) -> None:
        """Measure the state of all particles, and take the limits that follow."""
        _ = self.state
        self._launch_alone(status=MEASURE, arrived=0)
        self._measure(range(len(self.groups)))
        self._exchange.push(self._state)

    def state_was_replaced(self) -> None:
        """Sort and measure particles whose state was set from outside; none of them counts as lost."""
        self._forget_lost()
        self.state.drift = math.inf
        self.measure()

    def _launch_alone(self, **counts: int) -> None:
        """Launch with these counts, and leave all numbers as they were but what was measured."""
        numbers, before = self.batch.numbers.copy(), self.batch.counts.copy()
        self.batch.counts[:, self.batch.layout.count.status] = IDLE
        self._row.set_counts(**counts)
        try:
            self.batch.launch()
        finally:
            measured = self._numbers[self._real.maxima[0] :].copy()
            self.batch.numbers[:], self.batch.counts[:] = numbers, before
            self._numbers[self._real.maxima[0] :] = measured

    def _reach(self, target: float, *, anew: bool = True) -> Iterator[None]:
        """Let the batch launch until the run has reached a time, s; `anew` begins to book steps for a frame."""
        self._row.set(target=target)
        self._row.set_counts(arrived=0, records=0)
        if anew:
            self._row.set(smallest=math.inf, largest=0.0, largest_courant=0.0)
            self._row.set_counts(limit=0)
        for _ in self._advance():
            yield None

    def _advance(self) -> Iterator[tuple[Frame, LedgerRow] | None]:
        """Let the batch launch until the run has reached its target, or its last frame where the kernel records.

        Yields None where the batch must launch; and the frames that it has recorded.
        """
        while self._row.count("arrived") == 0:
            self._row.set_counts(status=GOING, budget=self._budget.steps, steps=0)
            if self._row.count("records"):
                self._recorder.make_room()
            since = self.batch.seconds
            yield None
            before = self.step_count
            self._exchange.pull(self._state)
            self._budget.took(self._row.count("steps"), self.batch.seconds - since)
            status = self._row.count("status")
            if self._row.count("records"):
                yield from self.recorded(before)
            self._attend(status)

    def _attend(self, status: int) -> None:
        """Do what a status asks for after a launch."""
        if status in (LOST, COLLAPSED):
            self._row.set_counts(status=IDLE)
        if status == LOST:
            stop(self, self.last_step)
        if self.grid.deterministic:
            require_room(self)
        if status == COLLAPSED:
            stop_collapsed(self, self.stable_step()[0])
        if status == BEYOND:
            self._fill_tables()
        if status == CROWDED:
            self.batch.grow(self.batch.device.grid.sizes[WANTED])
        if status == ATTEND:
            due = self._state.step_control.take_counters(self._exchange.counters(self._state.step_control))
            if due:
                self._measure(due)
            self._exchange.push(self._state)

    def _measure(self, due: Sequence[int]) -> None:
        """Take the measurement of some groups that the kernel has made after the last step."""
        control, forces = self._state.step_control, self._state.external_forces
        if not control.measure(due):
            stop(self, self.last_step)
        forces.measure(self.time, control.longest * self.last_step)
        if control.fresh:
            self._state.speed = control.speed

    def _fill_tables(self) -> None:
        """Let the kernel go on from the time that velocities have."""
        since = self._state.velocity_time
        # The same time again: the next kick takes more windows than found room.
        self._coarse, self._filled_since = since == self._filled_since, since
        self._row.set(horizon=self._tables.fill(self.slot, self._means, since, coarse=self._coarse))

    def recorded(self, before: int) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames that the last launch has recorded; `before` are the steps taken before it."""
        began, processor_began = time.perf_counter(), time.process_time()
        built = self._recorder.read(self._builder, before)
        self.frame_seconds += time.perf_counter() - began
        self.frame_processor_seconds += time.process_time() - processor_began
        yield from built

    # States.

    def save(self) -> SavedState:
        """Return the state of the only run of a batch, where `stop` of `frames` is called, or between steps.

        Its arrays are copied from the device one by one as they are asked for, which is over when the next step begins.
        """
        state = self.state
        numbers = {name: getattr(state, name) for name in Progress.NUMBERS}
        numbers["step_control"] = state.step_control.save()
        numbers["external_forces"] = state.external_forces.save()
        numbers["tables"] = [self._filled_since, self._coarse]
        numbers["frames"] = [self._recorder.index, self._recorder.steps, self._builder.before]
        return SavedState(numbers, read_batch(self.batch))

    def load(self, saved: SavedState) -> None:
        """Go on from a saved state of the same scene, or of one that ends earlier, as the only run of a batch.

        Raises:
            InputError: it is of another scene, or of another kind of backend.
        """
        write_batch(self.batch, saved.arrays)
        self._forget_lost()
        self._prepare()
        for name in Progress.NUMBERS:
            setattr(self._state, name, saved.numbers[name])
        self._state.step_control.load(saved.numbers["step_control"])
        self._state.external_forces.load(saved.numbers["external_forces"])
        self._filled_since, self._coarse = saved.numbers["tables"]
        if math.isfinite(self._filled_since):
            self._tables.fill(self.slot, self._means, self._filled_since, coarse=self._coarse)
        if not self.backend.on_cpu:
            # There particles are sorted anew.
            self._state.drift = math.inf
            self._row.set(drift=math.inf)
        index, steps, self._builder.before = saved.numbers["frames"]
        self._recorder.index, self._recorder.steps, self._resumed = index, steps, index > 0
        if self._resumed and self.backend.on_cpu:
            self._recorder.resume(self._builder.columns, index, steps)
            aim_on(self._row)

    # How a run ends before its time.

    def _forget_lost(self) -> None:
        """Let no particle count as lost."""
        lost, first = self.batch.device.particles.lost, self.slot * len(self.groups)
        for g in range(len(self.groups)):
            lost[first + g] = NOT_LOST
        if self.grid.deterministic:
            self.grid.fixed.forget(self.slot)

    def lost(self) -> list[int | None]:
        """Return a lost particle of each group, in solver order, None where none is known."""
        count = len(self.groups)
        found = self.batch.device.particles.lost.to_numpy()[self.slot * count :][:count]
        if self.grid.deterministic:
            # There it is the id, as the order depends on atomics.
            rows = [np.flatnonzero(group.read()["id"] == p) for group, p in zip(self.groups, found, strict=True)]
            return [int(p[0]) if len(p) else None for p in rows]
        return [None if p == NOT_LOST else int(p) - group.first for p, group in zip(found, self.groups, strict=True)]
