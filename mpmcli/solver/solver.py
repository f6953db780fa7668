"""Runs a scene: device state, time steps, and a frame for each output time."""

import math
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.backend import Backend
from mpmcli.solver.diagnosis import Diagnosis, UnstableRunError, cause_of, diagnose, first_unsound, rate_of_change
from mpmcli.solver.external_forces import ExternalForces
from mpmcli.solver.groups import build_groups
from mpmcli.solver.kernels import Kernels
from mpmcli.solver.observe import build_observation
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.snapshot import STRESSES, Snapshot, build_frame, ledger_row, measure, read_group
from mpmcli.solver.state import State
from mpmcli.solver.step_control import StepControl
from mpmcli.stability.limits import Limit, force_limit, speed_limit
from mpmcli.stability.transfer_factors import affine_moment

# Largest rounding of a stored position, in cells.
POSITION_ERROR = 1e-3
# Cells that a particle of a GPU run may move in a step beyond the estimate.
UNSEEN = 0.05
# Ratio of the stable step to the first one at which a run stops: steps that small do not recover.
COLLAPSE = 1e-4


class Solver:
    """A scene on a device.

    Attributes:
        scene: what is computed.
        state: all that changes, with `save` and `load`.
        particle_count: number of particles.
        laws: names of the laws, in the order of `Frame.material`.
        first_step_seconds: wall time of the first step, which compiles the kernels; 0 before it.
        frame_seconds: wall time spent so far on building frames and ledger rows.
    """

    def __init__(
        self,
        scene: Scene,
        backend: Backend,
        particles: list[BodyParticles] | None = None,
        *,
        force: bool = False,
    ) -> None:
        """Allocate and fill the device.

        Args:
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step as it is, above the stable step too.

        Raises:
            InputError: a particle is not in the domain.
        """
        self.scene = scene
        self.backend = backend
        self._forced = force and scene.time.step != "auto"
        self.first_step_seconds = 0.0
        self.frame_seconds = 0.0
        self.spacing = scene.domain.spacing
        self._origin = np.array(scene.domain.origin)
        # Far from zero single precision cannot tell neighbours apart, though the solver, which counts from the
        # origin of the domain, can.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * self.spacing
        self._position_type = np.float64 if coarse or backend.precision == "f64" else np.float32

        particles = particles or sample_bodies(scene)
        self.particle_count = sum(len(b.position) for b in particles)
        self.groups = build_groups(scene, backend, particles)
        self.laws = tuple(group.law.name for group in self.groups)
        self._initial = None
        if "initial_position" in scene.output.fields:
            self._initial = np.concatenate([b.position if b.initial is None else b.initial for b in particles])
        forces = ExternalForces(scene, self.groups, backend)
        self._kernels = Kernels(scene, backend, self.groups, forces.gravity)
        self.grid = self._kernels.grid
        self._observe = [build_observation(group) for group in self.groups]
        self.state = State(self.groups, self._kernels, StepControl(scene, self.groups, backend), forces)
        self._begin()

    def restart(self) -> None:
        """Begin a new run at time 0 with the particles as they are on the device, set from outside."""
        self.state.step_control.measure()
        self.state.begin()
        self._begin()

    def _begin(self) -> None:
        self.state.external_forces.measure(0.0, 0.0)
        # Once more, with the step that says how far ahead the next measurement is.
        self.state.external_forces.measure(0.0, self.state.step_control.longest * self.stable_step()[0])
        self.state.first_stable_step = self.stable_step()[0]

    @property
    def time(self) -> float:
        """Time of the state, s, in double precision."""
        return self.state.time

    @property
    def step_count(self) -> int:
        """Steps taken."""
        return self.state.step_count

    @property
    def last_step(self) -> float:
        """Size of the last step, s, 0 before the first."""
        return self.state.last_step

    @property
    def courant(self) -> float:
        """Cells that the fastest node moved in the last step, which no particle exceeds; an estimate on a GPU."""
        return self.state.courant

    def limits(self) -> list[Limit]:
        """Return every bound on the next step: of the speed as it is, of the rest as last measured."""
        return [*self._fast_limits(), *self.state.step_control.limits()]

    def _fast_limits(self) -> list[Limit]:
        forces = self.state.external_forces
        limits = [Limit(speed_limit(self.spacing, self.state.speed, forces.pull(self.time)), "speed", "")]
        if forces.pushes:
            limits.append(Limit(force_limit(forces.slope), "force", ""))
        return limits

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
        if self._forced:
            return maximum, Limit(maximum, "forced", "")
        return step, limit

    def step(self, dt: float) -> None:
        """Advance by dt (s).

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """
        began, state = time.perf_counter(), self.state
        if state.drift >= self._kernels.drift_allowed:
            self._kernels.sort()
            state.drift = 0.0
        # Velocities belong to the middle of steps. They advance from the middle of the last step to that of this one,
        # at the start by half a step. A kick beyond dt / safety^2 might be unstable: kick dt <= (dt / safety)^2.
        kick = min(0.5 * (state.last_step + dt), dt / self.scene.time.safety**2)
        pull = state.external_forces.pull(state.time)
        state.external_forces.begin_step(state.time)
        result = self._kernels.step(dt, kick)
        state.time += dt
        state.last_step = dt
        state.step_count += 1
        if state.step_count == 1:
            self.first_step_seconds = time.perf_counter() - began
        if result is not None:
            if not result.speed >= 0:
                self._stop(dt)
            state.speed = result.speed
        else:
            # Not read back: bounded by what gravity and forces add.
            state.speed += kick * pull
        state.courant = dt * state.speed / self.spacing
        # On a GPU stress may double the speed; `ParticleUpdate.advance` flags particles that went further.
        unseen = 2 * state.courant + UNSEEN if result is None else 0.0
        state.drift += max(state.courant, unseen)
        due = state.step_control.after_step(dt, state.courant, result)
        if unseen > 0 and state.drift + unseen >= self._kernels.drift_allowed:
            self.measure_state(dt)
        elif due:
            self.measure_state(dt, due)

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
            self._stop(dt)
        if not self.state.step_control.measure(due):
            # A particle was crushed or inverted by the last step; the next one would not scatter it.
            self._stop(dt)
        self.state.external_forces.measure(self.time, self.state.step_control.longest * dt)
        # Otherwise the fastest node of the last step bounds the speeds of all.
        if self.state.step_control.fresh:
            self.state.speed = self.state.step_control.speed

    @property
    def measure_seconds(self) -> float:
        """Wall time spent so far on measuring the state for the limits."""
        return self.state.step_control.seconds

    def state_was_replaced(self) -> None:
        """Sort and measure particles whose state was set from outside; none of them counts as lost."""
        self._kernels.particles.lost.fill(NOT_LOST)
        self.state.drift = math.inf
        self.measure_state(self.last_step)

    def _stop(self, dt: float) -> None:
        for group, lost in zip(self.groups, self._kernels.particles.lost.to_numpy(), strict=True):
            snapshot = read_group(group)
            p = int(lost) if lost != NOT_LOST else first_unsound(snapshot)
            if p is not None:
                cause = cause_of(snapshot, p, dt, self.scene.domain.size)
                raise UnstableRunError(self._diagnose(snapshot, p, cause, dt))
        raise AssertionError("a step reported a lost particle and kept no trace of it")

    def _stop_collapsed(self, step: float) -> None:
        """Stop at the particle that requires the smallest step: the one that moves or deforms fastest."""
        snapshots = [read_group(group) for group in self.groups]
        rates = [rate_of_change(snapshot, self.spacing) for snapshot in snapshots]
        worst = max(range(len(snapshots)), key=lambda g: rates[g].max())
        p = int(rates[worst].argmax())
        cause = f"allows a step of only {step:.3g} s, where the run began with {self.state.first_stable_step:.3g} s"
        raise UnstableRunError(self._diagnose(snapshots[worst], p, cause, step))

    def _diagnose(self, snapshot: Snapshot, p: int, cause: str, dt: float) -> Diagnosis:
        forced = self._forced and dt > self.nearest_limit.value
        return diagnose(
            snapshot, p, cause, self.scene, self.step_count, self.time, dt, self.nearest_limit, forced=forced
        )

    def frames(self, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the state as it is and then one frame for each output time to come, with its ledger row.

        The time left to the next frame is split into equal steps, so that frames land on their times.

        Args:
            stop: called after each step; True ends the run there.

        Raises:
            UnstableRunError: see `step`.
            KeyboardInterrupt: `stop` returned True.
        """
        count = self.scene.time.frames
        yield self.frame(0, [])
        for index in range(1, count + 1):
            target = self.scene.time.end * index / count
            if target <= self.time:
                continue
            taken: list[tuple[float, float, str]] = []
            while True:
                largest, limit = self.stable_step()
                if largest < COLLAPSE * self.state.first_stable_step:
                    self._stop_collapsed(largest)
                left = target - self.time
                splits = max(1, math.ceil(left / largest - 1e-6))
                dt = left / splits
                self.step(dt)
                taken.append((dt, self.courant, limit.name))
                if splits == 1:
                    break
                if stop():
                    raise KeyboardInterrupt
            self.state.time = target
            self.measure_state(dt)
            yield self.frame(index, taken)

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, and the ledger row for the steps (size, Courant number, limit) taken."""
        began = time.perf_counter()
        snapshots = [read_group(group) for group in self.groups]
        fields = self.scene.output.fields
        stress = any(name in STRESSES for name in fields)
        seen = [
            observe(self.last_step, stress=stress, stored=(snapshot.deformation, snapshot.internal))
            for observe, snapshot in zip(self._observe, snapshots, strict=True)
        ]
        kept = (self._origin, self._position_type, self._initial)
        frame = build_frame(snapshots, seen, fields, *kept, index, self.time, self.step_count)
        gravity, moment = self.state.external_forces.gravity_at(self.time), affine_moment(self.scene.solver)
        sums = measure(snapshots, seen, gravity, self.spacing, self.last_step, moment)
        row = ledger_row(sums, self.time, taken)
        self.frame_seconds += time.perf_counter() - began
        return frame, row
