"""A run: a scene in one slot of a batch, from its particles at time 0 to its last frame."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, estimate_particles, sample_bodies
from mpmcli.scene.colliders import Collider
from mpmcli.solver.drive.expressions import RunValues
from mpmcli.solver.drive.forces import Drives, ExternalForces
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.emission import begin_emission
from mpmcli.solver.engine.refusals import require_possible
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run_group import RunGroup, groups_of, require_inside
from mpmcli.solver.engine.run_state import (
    ATTEND,
    BEYOND,
    COLLAPSED,
    CROWDED,
    GOING,
    IDLE,
    LIMITS,
    LOST,
    MEASURE,
    RunState,
)
from mpmcli.solver.engine.saved_state import SavedState, read_batch, write_batch
from mpmcli.solver.engine.step_size import StepControl
from mpmcli.solver.frames.builder import NO_STEPS, FrameBuilder, StepsTaken, Sums, sums_of_rows
from mpmcli.solver.frames.columns import FrameArrays
from mpmcli.solver.frames.diagnosis import require_sums_hold, stop, stop_collapsed
from mpmcli.solver.frames.recorder import FrameRecorder, moment_of, steps_of
from mpmcli.solver.grid.sparse_grid import WANTED, first_nodes_of
from mpmcli.solver.machine.backend import Arch, Backend, choose_backend
from mpmcli.solver.machine.costs import cheapest, useful_threads
from mpmcli.solver.particles.state_bounds import SMALLEST_J, StateBounds, state_bounds_of
from mpmcli.solver.transfer.particle_update import NOT_LOST
from mpmcli.stability.limits import Limit, collider_limit, force_limit

# Particle-steps of the first launch, target wall time of later launches, s, and largest growth of steps from one launch
# to the next. The results of a run do not depend on them.
FIRST, LAUNCH, GROWTH = 1_000_000, 0.4, 4


class LaunchBudget:
    """The number of `steps` of the next launch, such that the host regains control within some tenths of a second."""

    def __init__(self, particles: int) -> None:
        self.steps = max(1, FIRST // max(1, particles))

    def took(self, steps: int, seconds: float) -> None:
        """Update the budget from the steps and the wall time, s, of the last launch."""
        if steps > 0 and seconds > 0:
            self.steps = max(1, min(GROWTH * self.steps, int(LAUNCH * steps / seconds)))


class Run:
    """A scene in one slot of a batch.

    `frames` computes a run that is alone in its batch, `frames_of_all` several runs of a batch. All other methods that
    read or advance a run launch its batch, and must not be used with several runs.

    Attributes:
        scene: the scene.
        batch, slot: the batch, and the slot of the run in it.
        groups: the particles, one group per law.
        particle_count: number of particles.
        first_step_seconds: wall time that compiles the kernels, see `Batch`; 0 before.
        frame_seconds, frame_processor_seconds: wall and processor time spent so far on frames and ledger rows, s.
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
        """Write the scene and its particles to the slot.

        Args:
            slot: index of the slot, whose last run has ended.
            particles: one entry per source, instead of sampling the scene.
            force: use time.step even above the stable step.

        Raises:
            InputError: a particle is outside the domain.
        """
        self.scene, self.batch, self.slot, self.backend = scene, batch, slot, batch.backend
        self.forced = force and scene.time.step != "auto"
        self.first_step_seconds = self.frame_seconds = self.frame_processor_seconds = 0.0
        self.spacing = scene.domain.spacing
        self._particles = particles or sample_bodies(scene)
        self._counts_of_sources = [b.count for b in self._particles]
        self._sheets = [b.sheets for b in self._particles if b.waits]
        self.particle_count = sum(self._counts_of_sources)
        require_inside(scene, self._particles)
        self._state = batch.state(slot)
        self.groups: list[RunGroup] = groups_of(batch, slot, scene, self._particles)
        self._budget = LaunchBudget(self.particle_count)
        self._recorder = FrameRecorder(batch, slot, self.particle_count, scene.time.frames)
        self._set_up()
        if batch.device.grid.sparse:
            places = [np.empty((0, scene.dimension)), *(body.position for body in self._particles)]
            batch.occupy(first_nodes_of(np.concatenate(places), scene))
        # The builder copies the data that it needs of the initial particles, which are now on the device.
        _ = self._builder
        self._particles = []

    def _set_up(self) -> None:
        """Write the data of the scene, and let the next launch measure the state at time 0."""
        scene, batch, state = self.scene, self.batch, self._state
        drives = Drives.of(scene, [group.bodies for group in self.groups])[1]
        end = scene.time.end
        self._values = RunValues(batch.values.device, self.slot, drives, end / scene.time.frames, end)
        batch.values.of_runs[self.slot] = self._values
        self._tables, self._means = batch.values.tables, list(self._values.means.values())
        self._filled_since, self._coarse = -math.inf, False
        state.reset()
        self._write_scene()
        state.status, state.horizon = MEASURE, math.inf if self._tables is None else -math.inf
        self._begun = self._resumed = False

    def _write_scene(self) -> None:
        """Write the constants of a run: domain, walls, colliders, emitters and bounds on the step."""
        scene, device, state = self.scene, self.batch.device, self._state
        for feature in device.features:
            feature.write(scene, self.slot)
        h = scene.domain.spacing
        state.spacing, state.inverse_spacing = h, 1 / h
        state.gradient_scale = device.grid.scheme.spline.inverse_moment / h
        state.cells, state.extent = scene.domain.cells, [n * h for n in scene.domain.cells]
        state.gravity, state.wall_speed = scene.domain.gravity_at(0.0), scene.domain.wall_speed
        state.end, state.frames, state.safety = scene.time.end, scene.time.frames, scene.time.safety
        state.maximum, state.forced = math.inf if scene.time.step == "auto" else scene.time.step, self.forced
        speeds = [each.fastest(scene.domain, scene.time.end) for each in scene.colliders if not each.free]
        state.collider = collider_limit(h, max(speeds, default=0.0))
        for g, group in enumerate(self.groups):
            state.sensitivity[g], state.hardening[g] = group.law.sensitivity, group.law.hardening
        begin_emission(self.batch, self.slot, scene, self._sheets, self._counts_of_sources)

    # Properties and progress.

    @cached_property
    def _builder(self) -> FrameBuilder:
        # If the host computes the sums of the ledger, it needs all summed columns.
        columns = () if self.backend.on_cpu else ("affine", "deformation_gradient")
        return FrameBuilder(self.scene, self._particles, self.groups, columns)

    @property
    def laws(self) -> tuple[str, ...]:
        """Names of the laws, in the order of `Frame.material`."""
        return tuple(group.law.name for group in self.groups)

    @property
    def grid(self) -> object:
        """The grid of the batch."""
        return self.batch.device.grid

    @property
    def state(self) -> RunState:
        """The numbers of the run, after `begin`; changes take effect in the next step."""
        self.begin()
        return self._state

    @property
    def time(self) -> float:
        """Time of the state in double precision, s."""
        return self._state.time

    @property
    def step_count(self) -> int:
        """Number of steps taken."""
        return int(self._state.step_count)

    @property
    def last_step(self) -> float:
        """Size of the last step, s; 0 before the first step."""
        return self._state.last_step

    @property
    def courant(self) -> float:
        """Displacement of the fastest node in the last step, cells, an upper bound for all particles."""
        return self._state.courant

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on limits from measurements of the state, s."""
        return self._control.seconds if self._begun else 0.0

    # The time step.

    def limits(self) -> list[Limit]:
        """Return all bounds on the next step: that of the speed for the current state, others as last measured."""
        state, limits = self.state, self._control.limits()
        value = min(min(limit.value for limit in limits), state.held)
        limits.append(Limit(self.batch.steps.speed_limit(state, value), "speed", ""))
        if self._forces.pushes:
            limits.append(Limit(state.force, "force", ""))
        if self.scene.colliders:
            limits.append(Limit(state.collider, "collider", ""))
        return limits

    def limits_now(self) -> list[Limit]:
        """Return all bounds from the current state of the particles, without storing them."""
        self.begin()
        self._launch_alone(status=MEASURE, arrived=0)
        return self._control.limits_now()

    @property
    def nearest_limit(self) -> Limit:
        """The smallest bound on the next step."""
        return self._limit(*self.batch.steps.nearest(self.state))

    def stable_step(self) -> tuple[float, Limit]:
        """Return the next step, including the safety factor, and the bound that determines it."""
        step, code = self.batch.steps.stable_step(self.state)
        chosen = LIMITS[code] in ("maximum", "forced")
        return step, self._limit(step, code) if chosen else self.nearest_limit

    def _limit(self, value: float, code: int) -> Limit:
        """Return a bound of `StepSize` as a `Limit`."""
        by_stiffness = LIMITS[code] == self._control.stiffest.name
        return Limit(value, LIMITS[code], self._control.stiffest.body if by_stiffness else "")

    # Frames.

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the current state and then one frame for each later output time, with its ledger row.

        Each step is the time left to the next frame divided by a whole number, so that frames are exactly at their
        times. After `load` of a state saved between frames, only later frames are yielded.

        Args:
            stop: called before each launch, except that which measures the initial state; it may call `save`.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
            KeyboardInterrupt: `stop` returned True.
        """
        yield from self.begin_frames()
        while not self.ended:
            # Here frame 0 and all frames recorded so far have been yielded.
            if self._begun and stop():
                raise KeyboardInterrupt
            self.before_launch()
            self.batch.launch()
            yield from self.after_launch()

    def begin_frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the current state, unless it requires a launch first or was loaded between frames."""
        resumed, self._resumed = self._resumed, False
        if self._begun and not resumed:
            yield self.frame()
            self._recorder.index, self._recorder.steps = 1, self.step_count
            while not self.ended and self._time_of(self._recorder.index) <= self.time:
                self._recorder.index += 1
            self._set_target()
        if self.backend.on_cpu and not resumed:
            self._recorder.start(self._builder.columns)
            self._state.arrived = not self._begun or self.ended

    @property
    def ended(self) -> bool:
        """Whether the last frame was yielded."""
        return self._begun and self._recorder.index > self.scene.time.frames

    def before_launch(self) -> None:
        """Let the next launch advance the run; the first launch measures the initial state and shows it."""
        if self._begun:
            self._state.status, self._state.budget = GOING, self._budget.steps
        if self._state.records:
            self._recorder.reserve()
        self._launched = self.batch.seconds, self.step_count

    def after_launch(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames that a launch has reached, and handle its requests."""
        if not self._begun:
            self._start()
            if self.backend.on_cpu:
                yield from self._recorded()
                if self._state.recorded == 0:
                    stop(self, 0.0)
            else:
                yield self.frame()
                self._recorder.index = 1
                self._set_target()
            return
        self._note_launch()
        if self._state.records:
            yield from self._recorded()
        self._handle_status()
        if not self.backend.on_cpu and self._state.arrived:
            # A particle inverted by the last step would be detected only in the next step.
            if not self._control.sound():
                stop(self, self.last_step)
            index, taken = self._recorder.index, steps_of(self._state, self.step_count - self._recorder.steps)
            self._recorder.index, self._recorder.steps = index + 1, self.step_count
            self._set_target()
            yield self.frame(index, taken)

    def _time_of(self, index: int) -> float:
        """Return the time of a frame, s."""
        return self.scene.time.end * index / self.scene.time.frames

    def _set_target(self, *, anew: bool = True) -> None:
        """Set the target to the time of the next frame, and if `anew` reset the statistics of steps."""
        state = self._state
        state.frame = min(self._recorder.index, self.scene.time.frames)
        state.target = self._time_of(state.frame)
        if anew:
            self.batch.steps.forget_steps(state)

    def _note_launch(self) -> None:
        """Update the budget and wall times after a launch."""
        seconds, steps = self._launched
        self._budget.took(self.step_count - steps, self.batch.seconds - seconds)
        self.first_step_seconds = self.batch.first_seconds

    def _recorded(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames recorded in the last launch."""
        began, processor_began = time.perf_counter(), time.process_time()
        built = self._recorder.read(self._builder)
        self.frame_seconds += time.perf_counter() - began
        self.frame_processor_seconds += time.process_time() - processor_began
        yield from built

    def frame(self, index: int = 0, taken: StepsTaken = NO_STEPS) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and its ledger row with the steps `taken`.

        Raises:
            UnstableRunError: a particle is inverted or not finite.
        """
        state, columns = self.state, self._builder.columns
        began, processor_began = time.perf_counter(), time.process_time()
        arrays = FrameArrays(columns, np.empty((1, self.particle_count, columns.count), self.groups[0].real))
        sums, loads = self._read(arrays)
        (built,) = self._builder.build([moment_of(state, index, taken, loads)], arrays, sums)
        self.frame_seconds += time.perf_counter() - began
        self.frame_processor_seconds += time.process_time() - processor_began
        return built

    def _read(self, arrays: FrameArrays) -> tuple[list[Sums], dict[str, np.ndarray]]:
        """Fill all rows of a frame; return the sums of each group and `Moment.loads`."""
        loads: dict[str, np.ndarray] = {}
        if self.backend.on_cpu:
            sums = self._recorder.read_now(arrays, self._launch_alone)
            sound = sums is not None
            loads = self._recorder.loads(1)
        else:
            for feature in self.batch.device.features:
                feature.tell(feature.read(self.slot)[np.newaxis], self.slot, loads)
            gpu = self.batch.gpu
            gpu.begin_frame(self.batch.numbers, self.batch.counts)
            for g, group in enumerate(self.groups):
                gpu.read(g, self.slot, group.first, group.count, self.last_step, arrays.columns, arrays.reals[0])
            constants = self._builder.constants.of_rows(slice(0, self.particle_count))
            sums = sums_of_rows(arrays, constants, total=self.groups[0].total)
            sound = (arrays["J"] > SMALLEST_J).all()
        if not sound:
            stop(self, self.last_step)
        return sums, {name: values[0] for name, values in loads.items()}

    # Start, and steps on request.

    def begin(self) -> None:
        """Determine the bounds at time 0; a second call does nothing."""
        if not self._begun:
            self.batch.launch()
            self._start()

    def restart(self) -> None:
        """Restart at time 0 with the current particles on the device, which the caller has set."""
        self._forget_lost()
        self._set_up()
        self._recorder.index, self._builder.before = 0, 0.0
        self.begin()

    def _start(self) -> None:
        """Set the bounds at time 0 from the measurement of the first launch."""
        self.first_step_seconds = self.batch.first_seconds
        self._renew_control()
        self._control.begin()
        free = [each.fastest(self.scene.domain, 0.0) for each in self.scene.colliders if each.free]
        self._state.speed = max([self._control.speed, *free])
        self._measure_forces(0.0)
        # Again, because the step determines the time of the next measurement.
        self._measure_forces(self.stable_step()[0])
        self._state.first_stable_step = self.stable_step()[0]

    def _renew_control(self) -> None:
        """Create the control of the step from the last measurement of the kernel."""
        measured = [partial(self._measured, g) for g in range(len(self.groups))]
        self._control = StepControl(self.scene, self.groups, self._state, measured)
        measures = [
            partial(push, group.first, group.count, self.slot)
            for push, group in zip(self.batch.pushes, self.groups, strict=True)
            if push is not None
        ]
        self._forces = ExternalForces(self._values, measures)
        self._begun = True

    def _measured(self, g: int) -> StateBounds:
        """Return the bounds of the state of the g-th group from the last measurement of the kernel."""
        return state_bounds_of(self.groups[g], list(self._state.maxima[g]))

    def step(self, dt: float, until: float | None = None) -> None:
        """Advance by dt, s, regardless of the bounds on the step.

        Args:
            until: the time after the step, s, if known; the sum of time and step has rounding errors.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        self.state.given = dt
        try:
            self._reach(self.time + dt if until is None else until)
        finally:
            self._state.given = 0.0

    def advance(self, count: int) -> tuple[int, float]:
        """Take about `count` stable steps, regardless of the times of frames, to measure the speed.

        Returns:
            The number of steps taken, and the smallest one, s.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        step = min(self.stable_step()[0], self._time_of(1))
        before = self.step_count
        self._reach(self.time + count * step)
        return self.step_count - before, self._state.smallest

    def _reach(self, target: float) -> None:
        """Launch the batch until the run has reached a time, s."""
        state = self._state
        state.target, state.records = target, 0
        self.batch.steps.forget_steps(state)
        while not state.arrived:
            self.before_launch()
            self.batch.launch()
            self._note_launch()
            self._handle_status()

    def measure(self) -> None:
        """Measure the state of all particles and update the limits."""
        self.begin()
        self._launch_alone(status=MEASURE, arrived=0)
        self._measure(range(len(self.groups)))

    def state_was_replaced(self) -> None:
        """Sort and measure particles whose state the caller has replaced; none of them counts as lost."""
        self._forget_lost()
        self.state.drift = math.inf
        self.measure()

    def _launch_alone(self, **counts: int) -> None:
        """Launch with these counts and restore all numbers except the measurement."""
        numbers, before = self.batch.numbers.copy(), self.batch.counts.copy()
        self.batch.state(slice(None)).status = IDLE
        for name, value in counts.items():
            setattr(self._state, name, value)
        try:
            self.batch.launch()
        finally:
            measured = [list(maxima) for maxima in self._state.maxima]
            self.batch.numbers[:], self.batch.counts[:] = numbers, before
            for g, maxima in enumerate(measured):
                self._state.maxima[g] = maxima

    # Work of the host between launches.

    def _handle_status(self) -> None:
        """Handle the status of the run after a launch."""
        status = self._state.status
        if status in (LOST, COLLAPSED):
            self._state.status = IDLE
        if status == LOST:
            stop(self, self.last_step)
        if self.grid.deterministic:
            require_sums_hold(self)
        if status == COLLAPSED:
            stop_collapsed(self, self.stable_step()[0])
        if status == BEYOND:
            self._fill_tables()
        if status == CROWDED:
            self.batch.grow(self.batch.device.grid.sizes[WANTED])
        if status == ATTEND and (due := self._control.due()):
            self._measure(due)

    def _measure(self, due: Sequence[int]) -> None:
        """Update the limits from the measurement of some groups by the kernel after the last step."""
        if not self._control.measure(due):
            stop(self, self.last_step)
        self._measure_forces(self.last_step)
        if self._control.fresh:
            self._state.speed = max(
                self._control.speed, *(one.fastest(self.slot) for one in self.batch.device.features)
            )

    def _measure_forces(self, step: float) -> None:
        """Measure forces for the time until the next measurement, at most `state.longest` steps of `step`, s."""
        state, forces = self._state, self._forces
        push, slope = forces.measure(state.time, state.longest * step)
        gravity = self.scene.domain.gravity_at(0.0) if self.scene.domain.steady else [0.0]
        state.pull = float(np.linalg.norm(gravity)) + push
        if forces.pushes:
            state.force = force_limit(slope)

    def _fill_tables(self) -> None:
        """Fill the time tables from the time of the velocities on."""
        since = self._state.velocity_time
        # The same time again means that the next kick spans more windows than were stored.
        self._coarse, self._filled_since = since == self._filled_since, since
        self._state.horizon = self._tables.fill(self.slot, self._means, since, coarse=self._coarse)

    # Saved states.

    def save(self) -> SavedState:
        """Return the state of a run alone in its batch; call it from `stop` of `frames` or between steps.

        Its arrays are copied from the device one by one when accessed, and are valid until the next step.
        """
        self.begin()
        numbers = {
            "step_control": self._control.save(),
            "tables": [self._filled_since, self._coarse],
            "frames": [self._recorder.index, self._recorder.steps, self._builder.before],
        }
        return SavedState(numbers, read_batch(self.batch))

    def load(self, saved: SavedState) -> None:
        """Continue from a saved state of the same scene, or of one with an earlier end, as the only run of a batch.

        Raises:
            InputError: the state belongs to another scene or to another kind of backend.
        """
        write_batch(self.batch, saved.arrays)
        self._forget_lost()
        self._renew_control()
        self._control.load(saved.numbers["step_control"])
        self._filled_since, self._coarse = saved.numbers["tables"]
        if math.isfinite(self._filled_since):
            self._tables.fill(self.slot, self._means, self._filled_since, coarse=self._coarse)
        self._recorder.index, self._recorder.steps, self._builder.before = saved.numbers["frames"]
        self._resumed = self._recorder.index > 0
        if not self.backend.on_cpu:
            # A GPU sorts the particles again.
            self._state.drift = math.inf
        elif self._resumed:
            self._recorder.start(self._builder.columns)
        if self._resumed:
            self._set_target(anew=self._state.arrived == 1 and not self.ended)

    # Lost particles.

    def _forget_lost(self) -> None:
        """Reset the records of lost particles."""
        self.batch.device.particles.forget_lost(self.slot * len(self.groups), len(self.groups))
        if self.grid.deterministic:
            self.grid.fixed.forget(self.slot)

    def broken_body(self) -> Collider | None:
        """Return the first rigid body whose pose is not finite, or None."""
        found = [k for one in self.batch.device.features if (k := one.broken(self.slot)) is not None]
        return self.scene.colliders[found[0]] if found else None

    def lost(self) -> list[int | None]:
        """Return the solver index of a lost particle of each group, or None for a group without one."""
        count = len(self.groups)
        found = self.batch.device.particles.lost.to_numpy()[self.slot * count :][:count]
        if self.grid.deterministic:
            # The record is an id, because the order depends on atomics.
            rows = [np.flatnonzero(group.read()["id"] == p) for group, p in zip(self.groups, found, strict=True)]
            return [int(p[0]) if len(p) else None for p in rows]
        return [None if p == NOT_LOST else int(p) - group.first for p, group in zip(found, self.groups, strict=True)]


def frames_of_all(runs: Mapping[int, Run]) -> Iterator[tuple[int, tuple[Frame, LedgerRow] | Exception | None]]:
    """Yield the frames of runs that share a batch as they are computed, each with the key of its run.

    The last frame of a run is followed by None, or by the error that ended the run.
    """
    going = dict(runs)
    for key, run in runs.items():
        yield from ((key, event) for event in run.begin_frames())
    while going:
        try:
            for run in going.values():
                run.before_launch()
            next(iter(going.values())).batch.launch()
        except Exception as error:
            yield from ((key, error) for key in going)
            return
        for key, run in list(going.items()):
            try:
                yield from ((key, event) for event in run.after_launch())
            except Exception as error:
                del going[key]
                yield key, error
            if key in going and run.ended:
                del going[key]
                yield key, None


# Number of particles below which runs on a GPU are faster in a batch, where they advance concurrently.
FEW_ON_GPU = 100_000


def backend_for(
    scene: Scene | Resolved,
    expected_steps: Callable[[], int],
    arch: Arch = "auto",
    threads: int | None = None,
    *,
    compile_cache: bool = True,
) -> Backend:
    """Return the backend for a scene without starting it.

    Args:
        expected_steps: returns the expected number of steps; called only on the CPU.
        threads: number of CPU threads; None for as many as are useful.

    Raises:
        InputError: the backend cannot be used.
    """
    asked = Resolved.of(scene)
    scene, doubles = asked.scene, asked.layers.separate
    backend = choose_backend(arch, threads, scene.solver.precision, compile_cache=compile_cache, doubles=doubles)
    if not backend.on_cpu:
        return backend
    threads = threads or useful_threads(estimate_particles(scene), backend.threads)
    return replace(backend, threads=threads, optimisation=cheapest(scene, expected_steps(), threads))


def suits_batch(particles: int, backend: Backend) -> bool:
    """Return whether many runs with this number of particles are faster in one batch than one by one."""
    return backend.on_cpu or particles < FEW_ON_GPU


def build_run(
    scene: Scene | Resolved, backend: Backend, particles: list[BodyParticles] | None = None, *, force: bool = False
) -> Run:
    """Return the run of a scene, alone in a batch, on a started backend.

    Args:
        particles: one entry per source, instead of sampling the scene.
        force: use time.step even above the stable step.

    Raises:
        InputError: a particle is outside the domain, or the backend cannot compute the scene.
    """
    asked = Resolved(scene, particles) if particles else Resolved.of(scene)
    require_possible(asked, backend)
    asked = asked.sampled()
    return Run(Batch(asked.kind.padded(), backend), 0, asked.scene, asked.particles, force=force)
