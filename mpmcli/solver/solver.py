"""Runs a scene of any size: device state, time steps, and a frame for each output time."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.backend import Backend
from mpmcli.solver.collider_steps import read_loads
from mpmcli.solver.diagnosis import DENSER, FASTER, UnstableRunError, first_beyond
from mpmcli.solver.emission_kernels import SolverEmission
from mpmcli.solver.external_forces import drive
from mpmcli.solver.frame_arrays import FrameArrays
from mpmcli.solver.frame_reader import build_frame_reader
from mpmcli.solver.groups import build_groups
from mpmcli.solver.kernels import Kernels
from mpmcli.solver.observe import build_observation
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.run import COLLAPSE, Run
from mpmcli.solver.snapshot import read_group
from mpmcli.solver.splines import PAD
from mpmcli.solver.state import SavedState, State
from mpmcli.solver.state_bounds import build_measurement
from mpmcli.solver.step_control import StepControl
from mpmcli.solver.sums import NO_STEPS, StepsTaken, Sums

# Cells that a particle of a GPU run may move in a step beyond the estimate.
UNSEEN = 0.05


class Solver(Run):
    """A scene on a device of its own.

    Attributes:
        state: all that changes, with `save` and `load`.
    """

    state: State

    def __init__(
        self, scene: Scene, backend: Backend, particles: list[BodyParticles] | None = None, *, force: bool = False
    ) -> None:
        """Allocate and fill the device.

        Args:
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.

        Raises:
            InputError: a particle is not in the domain.
        """
        super().__init__(scene, backend, particles, force=force)
        self.groups = build_groups(scene, backend, self._particles)
        gravity, forces = drive(scene, self.groups, backend)
        self._kernels = Kernels(scene, backend, self.groups, gravity)
        self._drifts = self._kernels.particles.touches or not all(group.total for group in self.groups)
        self.grid = self._kernels.grid
        self._observations = [build_observation(group) for group in self.groups]
        self._readers = [build_frame_reader(order.group, order.buffers.real) for order in self._kernels.orders]
        measurements = [build_measurement(group, backend) for group in self.groups]
        step_control = StepControl(scene, self.groups, measurements, on_cpu=backend.on_cpu)
        self._emission = None
        if scene.emitters:
            counts = [len(b.position) for b in self._particles]
            self._emission = SolverEmission(scene, self.groups, self._kernels, counts)
        self._slowest = 0.0 if self._emission is None else self._emission.slowest
        schedule = None if self._emission is None else self._emission.schedule
        self.state = State(self.groups, self._kernels, step_control, forces, schedule)
        # The next frame, the steps since the last one, and whether frames go on from there.
        self._next, self._taken, self._goes_on = 0, NO_STEPS, False
        self._begin()

    def begin(self) -> None:
        """Take the bounds of time 0; done when the device was filled."""

    def save(self) -> SavedState:
        """Return the state, and the place among the frames; its arrays are copied when asked for, before a step."""
        saved = self.state.on_device()
        saved.numbers["frames"] = [self._next, asdict(self._taken), self._builder.before]
        return saved

    def load(self, saved: SavedState) -> None:
        """Go on from a saved state of the same scene, or of one that ends earlier.

        Raises:
            InputError: it is of another scene.
        """
        self.state.load(saved)
        self._next, taken, self._builder.before = saved.numbers["frames"]
        self._taken, self._goes_on = StepsTaken(**taken | {"smallest": tuple(taken["smallest"])}), True

    def restart(self) -> None:
        """Begin a new run at time 0 with the particles as they are on the device, set from outside."""
        self.state.step_control.measure()
        self.state.begin()
        self._begin()

    def step(self, dt: float, until: float | None = None) -> None:
        """Advance by dt (s).

        Args:
            until: the time after the step where that is known, s; a sum has rounding errors.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        began, state = time.perf_counter(), self.state
        sorts = state.drift >= self._kernels.drift_allowed
        if self._emission is not None and self._emission.schedule.next <= state.time:
            self._emission.enter(state.time)
            sorts = sorts or self._emission.sorts
        if sorts:
            self._kernels.sort()
            state.drift = 0.0
        # Velocities belong to the middle of steps. They advance from the middle of the last step to that of this one,
        # at the start by half a step, with what an earlier step had to leave: a kick beyond dt / safety might be
        # unstable (docs/theory.md, 7.1).
        due_kick, since = state.owed + 0.5 * (state.last_step + dt), state.velocity_time
        kick = min(due_kick, dt / self.scene.time.safety)
        state.owed = due_kick - kick
        state.external_forces.begin_step(since, since + kick)
        if self._kernels.colliders is not None:
            self._kernels.colliders.begin_step(state.time, dt)
        if self.grid.deterministic:
            stable = self.scene.time.safety * self.nearest_limit.value
            self.grid.fixed.set_step(max(kick, min(stable, self.scene.time.end)))
        result = self._kernels.step(dt, kick, state.relaxed_in(dt))
        state.time = state.time + dt if until is None else until
        state.last_step = dt
        state.step_count += 1
        if state.step_count == 1:
            self.first_step_seconds = time.perf_counter() - began
        if result is not None:
            if not result.speed >= 0:
                self._stop(dt, self._lost())
            state.speed = max(result.speed, self._slowest)
        else:
            # Not read back: bounded by what gravity and forces add.
            state.speed += kick * state.external_forces.pull(since, since + kick)
        state.courant = dt * (state.speed if result is None else result.speed) / self.spacing
        # On a GPU stress may double the speed; `ParticleUpdate.advance` flags particles that went further.
        unseen = 2 * state.courant + UNSEEN if result is None else 0.0
        if self._drifts:
            state.drift += max(state.courant, unseen)
        due = state.step_control.after_step(dt, state.courant, result)
        if self._drifts and unseen > 0 and state.drift + unseen >= self._kernels.drift_allowed:
            self.measure_state(dt)
        elif due:
            self.measure_state(dt, due)

    def advance(self, count: int) -> tuple[int, float]:
        """Take `count` steps, each the stable one, at most an interval between frames; see `Engine.advance`."""
        interval = self.scene.time.end / self.scene.time.frames
        smallest = math.inf
        for _ in range(count):
            dt = min(self.stable_step()[0], interval)
            self.step(dt)
            smallest = min(smallest, dt)
        return count, smallest

    def wait(self) -> None:
        """Wait until the device has taken every step; on the CPU each step waits."""
        if not self.backend.on_cpu:
            self.measure_state(self.last_step)

    def measure_state(self, dt: float, due: Sequence[int] | None = None) -> None:
        """Measure the device's state, and the limits with it.

        Args:
            dt: the step last taken, s.
            due: the groups to measure, all of them where None.

        Raises:
            UnstableRunError: a particle is lost.
        """
        # On the CPU every step reports it.
        if not self.backend.on_cpu and self._kernels.particles.any_lost():
            self._stop(dt, self._lost())
        if self.grid.deterministic:
            self._require_room(dt)
        if not self.state.step_control.measure(due):
            # A particle was crushed or inverted by the last step; the next one would not scatter it.
            self._stop(dt, self._lost())
        self.state.external_forces.measure(self.time, self.state.step_control.longest * dt)
        # Otherwise the fastest node of the last step bounds the speeds of all.
        if self.state.step_control.fresh:
            self.state.speed = self.state.step_control.speed

    def state_was_replaced(self) -> None:
        """Sort and measure particles whose state was set from outside; none of them counts as lost."""
        self._kernels.particles.lost.fill(NOT_LOST)
        self._kernels.forget_beyond()
        self.state.drift = math.inf
        self.measure_state(self.last_step)

    def frame(self, index: int = 0, taken: StepsTaken = NO_STEPS) -> tuple[Frame, LedgerRow]:
        if self._kernels.average is not None:
            self._kernels.average()
        return super().frame(index, taken)

    def _read(self, arrays: FrameArrays) -> list[Sums]:
        found = [
            reader(self.last_step, group.first, group.count, group.active, arrays)
            for reader, group in zip(self._readers, self.groups, strict=True)
        ]
        if not all(sound for _, sound in found):
            self._stop(self.last_step, self._lost())
        return [sums for sums, _ in found]

    def _loads(self) -> np.ndarray | None:
        colliders = self._kernels.colliders
        return None if colliders is None else read_loads(colliders.colliders, 0, len(self.scene.colliders))

    @property
    def _blocked(self) -> int:
        return 0 if self._emission is None else self._emission.schedule.blocked

    def _lost(self) -> list[int | None]:
        """Return a lost particle of each group, in solver order, None where none is known."""
        lost = self._kernels.particles.lost.to_numpy().tolist()
        if self.grid.deterministic:
            # There it is the id, as the order depends on atomics.
            rows = [np.flatnonzero(g.id.to_numpy() == p) for g, p in zip(self.groups, lost, strict=True)]
            return [int(found[0]) if len(found) else None for found in rows]
        return [None if p == NOT_LOST else p for p in lost]

    def _require_room(self, dt: float) -> None:
        """Stop where sums in fixed point had no room.

        Raises:
            UnstableRunError: they had none.
        """
        particle, node = self.grid.fixed.found_beyond()
        if particle is not None or node is not None:
            place = None if node is None else (np.array(np.unravel_index(node, self.grid.shape)) - PAD) * self.spacing
            snapshot, p = first_beyond([read_group(group) for group in self.groups], particle, place)
            cause = DENSER if particle is None else FASTER
            raise UnstableRunError(self._diagnose(snapshot, p, cause, dt))

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the state as it is and then one frame for each output time to come, with its ledger row.

        The time left to the next frame is split into equal steps, so that frames land on their times.

        Args:
            stop: called between steps, where `save` may be called; True ends the run there.

        Raises:
            UnstableRunError: see `step`.
            KeyboardInterrupt: `stop` returned True.
        """
        count = self.scene.time.frames
        if not self._goes_on:
            first = self.frame()
            self._next, self._taken = 1, NO_STEPS
            while self._next <= count and self.scene.time.end * self._next / count <= self.time:
                self._next += 1
            yield first
        self._goes_on = False
        while self._next <= count:
            target = self.scene.time.end * self._next / count
            while True:
                if self.step_count and stop():
                    raise KeyboardInterrupt
                largest, limit = self.stable_step()
                if largest < COLLAPSE * self.state.first_stable_step:
                    self._stop_collapsed(largest)
                left = target - self.time
                splits = max(1, math.ceil(left / largest - 1e-6))
                dt = left / splits
                self.step(dt, target if splits == 1 else None)
                self._taken = self._taken.and_one(dt, self.courant, limit.name)
                if splits == 1:
                    break
            if not self.backend.on_cpu:
                # Nothing else detects lost particles there.
                self.measure_state(dt)
            reached = self.frame(self._next, self._taken)
            self._next, self._taken = self._next + 1, NO_STEPS
            yield reached
