"""The time step of a run (docs/theory.md, 6).

`StepSize` chooses the next step and updates the run after a step. Kernels call it with the `RunState` of a run; so does
the host if the device has no double precision. `StepControl` measures the state of the particles when due, and computes
the bounds that follow (6.7).
"""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict

from taichi.lang.impl import inside_kernel

from mpmcli.boundaries.doubles import as_double
from mpmcli.materials.law import StateBound
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.solver.drive.forces import DriveValues, HostValues
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.run_state import ATTEND, BEYOND, COLLAPSED, LIMITS, LOST, Layout, RunState
from mpmcli.solver.particles.state_bounds import SMALLEST_J, StateBounds
from mpmcli.solver.transfer.kept_motion import kept_share
from mpmcli.solver.transfer.redistribution import farthest_shift
from mpmcli.solver.transfer.splines import TransferScheme
from mpmcli.stability.limits import DEFORMATION, Limit, crossing_step, deformation_limit, mode_limit, speed_limit
from mpmcli.stability.transfer_factors import INTERVAL, step_inertia

COLLIDER, DEFORMING, FORCE, FORCED, MAXIMUM, CROSSING = (
    LIMITS.index(name) for name in ("collider", "deformation", "force", "forced", "maximum", "speed")
)
# A bound falls immediately. It rises only to the smallest bound of the last steps, HOLD_STEPS to twice as many, and
# only if that exceeds it by the factor RISE. A step that follows the oscillation of a particle, always smaller in the
# same phase, would amplify the oscillation. Lone neo-Hookean particles released at strains of 5 to 40 % gained up to 27
# times their energy in 10,000 steps when the bound rose by a thousandth per step, and up to 4 times with this rule.
HOLD_STEPS, RISE = 128, 1.05
# Ratio of the stable step to the first one below which a run stops, because such small steps do not recover.
COLLAPSE = 1e-4
# Fraction of a step by which the time to a target may exceed an integer number of steps.
SLACK = 1e-6
INFINITE = math.inf


@ti.pyfunc
def as_real(number: ti.template()):
    """Return a number in the precision of particles."""
    if ti.static(inside_kernel()):
        return ti.cast(number, float)
    else:
        return number


@ti.pyfunc
def nearer(value: ti.f64, limit: int, bound: ti.f64, code: int):
    """Return the smaller of two bounds on the step, and its code."""
    nearest, of_nearest = value, limit
    if bound < value or (bound == value and limit > code):
        nearest = bound
        of_nearest = code
    return nearest, of_nearest


@ti.data_oriented
class StepSize:
    """Choice of the steps of the runs of a batch."""

    def __init__(
        self,
        layout: Layout,
        groups: Sequence,
        values: DriveValues,
        scheme: TransferScheme,
        *,
        drifts: bool,
        shift: float = 0.0,
    ) -> None:
        """Store constants; `drifts` is whether particles move on the grid, `shift` the largest shift, cells."""
        self.drifts, self.shift = drifts, shift
        self.values = values
        self.groups, self.bodies, self.scheme = tuple(groups), layout.bodies, scheme

    @classmethod
    def of(cls, device: Device, layout: Layout, values: DriveValues | HostValues) -> "StepSize":
        """Return the `StepSize` of the runs of a batch; `values` provides time-dependent numbers."""
        drifts = device.particles.repels or not all(group.total for group in device.groups)
        shift = farthest_shift(device.grid.fine)
        return cls(layout, device.groups, values, device.grid.scheme, drifts=drifts, shift=shift)

    @ti.pyfunc
    def begin(self, run: ti.template()):
        """Choose the next step and return whether it can be taken.

        It cannot if the stable step has collapsed or the host must fill time tables.
        """
        value, limit = self.stable_step(run)
        run.step_limit, run.deformation = limit, self.deformation_limit(run)
        run.stable = ti.min(value, run.end)
        left = run.target - run.time
        steps = ti.max(ti.ceil(left / value - as_double(SLACK)), 1.0)
        dt = left / steps
        if run.given > 0:
            steps = as_double(1.0)
            dt = run.given
        run.dt = dt
        run.steps_to_target = steps
        due = run.kick_carry + 0.5 * (run.last_step + dt)
        kick = ti.min(due, dt / run.safety)
        run.kick = kick
        since = run.velocity_time
        # Checked first, because the step is meaningless while the tables cover another time.
        ends = since + kick
        if ti.static(len(self.values.motions) > 0):
            ends = ti.max(ends, run.time + dt)
        possible = True
        if ends > run.horizon:
            run.status = BEYOND
            possible = False
        elif value < as_double(COLLAPSE) * run.first_stable_step and run.given == 0:
            run.status = COLLAPSED
            possible = False
        else:
            run.kick_carry = due - kick
            self.values.set_means(run.w, since, since + kick)
            if ti.static(self.scheme.keeps_flip_velocity):
                self.keep(run)
            self.relax(run)
        return possible

    @ti.pyfunc
    def relax(self, run: ti.template()):
        """Update the time since the last relaxation, and set the time over which this step relaxes volumes."""
        run.drift = run.drift + self.shift_ahead(run)
        run.relaxed = as_double(0.0)
        run.unrelaxed = run.unrelaxed + run.dt
        if run.unrelaxed_steps + 1 < INTERVAL:
            run.unrelaxed_steps += 1
        else:
            run.relaxed = run.unrelaxed
            run.unrelaxed_steps = 0
            run.unrelaxed = as_double(0.0)

    @ti.pyfunc
    def shift_ahead(self, run: ti.template()):
        """Return the largest shift of particles before the scatter of the next step, cells."""
        cells = as_double(0.0)
        if run.unrelaxed_steps + 1 >= INTERVAL:
            cells = as_double(self.shift)
        return cells

    @ti.pyfunc
    def keep(self, run: ti.template()):
        """Compute the fraction of its motion that each body keeps in a step."""
        for g, group in ti.static(enumerate(self.groups)):
            slowest = as_double(INFINITE)
            if run.rate[g] > 0:
                slowest = DEFORMATION / run.rate[g]
            damped = ti.static(min(self.scheme.damped, group.law.lost))
            for i in range(self.bodies[g]):
                bound = ti.min(run.own[g][i], slowest)
                group.kept[run.w * self.bodies[g] + i] = as_real(kept_share(run.dt / bound, damped))

    @ti.pyfunc
    def end(self, run: ti.template(), speed: ti.f64):
        """Finish a step with this largest speed of a node, m/s, -1 if a particle was lost; rates are already stored."""
        dt = run.dt
        run.time = run.time + dt
        if run.steps_to_target == 1:
            run.time = run.target
        run.last_step = dt
        run.step_count = run.step_count + 1
        run.budget -= 1
        if speed >= 0:
            courant = dt * speed / run.spacing
            # Particles waiting for an emitter count from the start.
            run.speed = ti.max(speed, run.slowest)
            run.courant = courant
            if ti.static(self.drifts):
                run.drift = run.drift + courant
            self.limit_rise(run, ti.min(run.stiffness, run.deformation))
            due = self.watch(run)
            self.record_step(run)
            if run.steps_to_target == 1:
                run.arrived = 1
            if due or (run.steps_to_target == 1 and run.records == 0):
                run.status = ATTEND
        else:
            run.status = LOST

    @ti.pyfunc
    def stable_step(self, run: ti.template()):
        """Return the next step, s, including the safety factor, and the code of the bound that determines it."""
        value, limit = self.nearest(run)
        value = run.safety * value
        if run.maximum < value:
            value = run.maximum
            limit = MAXIMUM
        elif run.forced == 1:
            value = run.maximum
            limit = FORCED
        return value, limit

    @ti.pyfunc
    def nearest(self, run: ti.template()):
        """Return the smallest bound on the next step, s, and its code."""
        value, limit = nearer(run.stiffness, run.stiffness_limit, self.deformation_limit(run), DEFORMING)
        value = ti.min(value, run.held)
        value, limit = nearer(value, limit, self.speed_limit(run, value), CROSSING)
        value, limit = nearer(value, limit, run.force, FORCE)
        value, limit = nearer(value, limit, run.collider, COLLIDER)
        return value, limit

    @ti.pyfunc
    def deformation_limit(self, run: ti.template()):
        """Return the bound by the largest rate of deformation, s."""
        max_rate = run.rate[0]
        for g in ti.static(range(1, len(self.groups))):
            max_rate = ti.max(max_rate, run.rate[g])
        bound = as_double(INFINITE)
        if max_rate > 0:
            bound = DEFORMATION / max_rate
        return bound

    @ti.pyfunc
    def speed_limit(self, run: ti.template(), value: ti.f64):
        """Return the bound by the fastest particle, s; the other bounds allow a step of `value`, s."""
        speed, pull = ti.max(run.speed, run.wall_speed), run.pull
        if ti.static(self.values.gravity_varies):
            # The next kick ends in the middle of a step, which is at most as long as the other bounds allow.
            ahead = ti.min(run.safety * value, run.end)
            pull += self.values.largest_gravity(run.w, run.velocity_time, run.time + ahead)
        bound = as_double(INFINITE)
        if speed != 0 or pull != 0:
            (step,) = ti.static((crossing_step(run.spacing, speed, pull, ti.sqrt),))
            bound = step
        return bound

    @ti.pyfunc
    def next_frame(self, run: ti.template()):
        """Set the target to the time of the frame `run.frame`, and reset the statistics of steps."""
        run.target = run.end * as_double(run.frame) / as_double(run.frames)
        self.forget_steps(run)

    @ti.pyfunc
    def forget_steps(self, run: ti.template()):
        """Reset the statistics of steps for the ledger."""
        run.smallest = as_double(INFINITE)
        run.largest = as_double(0.0)
        run.largest_courant = as_double(0.0)
        run.limit = 0
        run.arrived = 0

    @ti.pyfunc
    def limit_rise(self, run: ti.template(), bound: ti.f64):
        """Lower the held bound to a bound immediately, or raise it with a delay, see HOLD_STEPS."""
        low, held = ti.min(run.low, bound), ti.min(run.held, bound)
        steps = run.held_steps + 1
        if steps >= HOLD_STEPS:
            lowest = ti.min(run.low_before, low)
            if lowest > as_double(RISE) * held:
                held = lowest
            run.low_before = low
            low = as_double(INFINITE)
            steps -= steps
        run.held, run.low, run.held_steps = held, low, steps

    @ti.pyfunc
    def watch(self, run: ti.template()):
        """Update the growth of stiffness after a step; return whether the host must measure the state."""
        due = False
        for g in ti.static(range(len(self.groups))):
            run.unwatched[g] += 1
            strain = run.dt * run.rate[g]
            run.change[g] = run.change[g] + strain * run.sensitivity[g]
            run.hardened[g] = run.hardened[g] + strain * run.hardening[g]
            if run.unwatched[g] >= run.longest:
                due = True
            if run.change[g] >= run.growth_allowed or run.hardened[g] >= run.growth_allowed:
                due = True
        return due

    @ti.pyfunc
    def record_step(self, run: ti.template()):
        """Update, for the ledger, the smallest step and its bound, the largest step, and the largest Courant number."""
        dt, courant, limit = run.dt, run.courant, run.step_limit
        before = run.smallest_courant
        same = dt == run.smallest and (courant < before or (courant == before and limit < run.limit))
        if dt < run.smallest or same:
            run.smallest = dt
            run.smallest_courant = courant
            run.limit = limit
        run.largest = ti.max(run.largest, dt)
        run.largest_courant = ti.max(run.largest_courant, courant)


# Largest number of steps between two measurements of the state, without and with forces. A measurement is due earlier
# if a stiffness may have grown by more than UNWATCHED_SHARE of the margin of time.safety; a decrease is noticed late.
# The share is near 1 because every step reads back the rate of deformation.
MOST_UNWATCHED_STEPS, MOST_PUSHED_STEPS, UNWATCHED_SHARE = 256, 64, 0.95
# Largest step of rigid bodies alone, as a share of the bound for a body that begins to fall.
FALL = 0.2


class StepControl:
    """The last measurement of each group of particles, and the bounds on the step that follow from it.

    Attributes:
        seconds: wall time spent so far on measuring.
    """

    def __init__(
        self, scene: Scene, groups: Sequence, state: RunState, measurements: Sequence[Callable[[], StateBounds]]
    ) -> None:
        """Store the first measurement of each `RunGroup`; `measurements` return the last measurement of each."""
        self._groups, self._state = groups, state
        self._names = tuple(body.name for body in scene.sources)
        self._spacing = scene.domain.spacing
        # Without material; the energy in the ledger is then within 1 % of that turned over.
        pull = math.hypot(*scene.domain.gravity_at(0.0))
        self._none = Limit(FALL * speed_limit(self._spacing, 0.0, pull), "speed", "")
        self._inertia = step_inertia(scene.solver)
        self._measure = measurements
        state.longest = MOST_PUSHED_STEPS if scene.pushes else MOST_UNWATCHED_STEPS
        # A step of safety times the limit is stable until the stiffness has grown by the factor safety^-2.
        state.growth_allowed = -2 * UNWATCHED_SHARE * math.log(scene.time.safety)
        self.seconds = 0.0
        self._bounds = [measure() for measure in measurements]
        # Per group, whether it was not yet measured after the start.
        self._at_start = [True] * len(groups)
        self._limits = [self._limits_of(g, bounds) for g, bounds in enumerate(self._bounds)]

    def begin(self) -> None:
        """Write the bounds at time 0."""
        self._state.rate = [bounds.deformation_rate for bounds in self._bounds]
        self._write_limits()

    def save(self) -> dict[str, object]:
        """Return the last measurement of each group as plain numbers, lists and dictionaries."""
        return {"bounds": [asdict(bounds) for bounds in self._bounds], "at_start": list(self._at_start)}

    def load(self, saved: dict) -> None:
        """Restore the result of `save`; the numbers of the run are loaded separately."""
        self._at_start = list(saved["at_start"])
        for g, bounds in enumerate(saved["bounds"]):
            internal = {name: tuple(pair) for name, pair in bounds["bound"]["internal"].items()}
            bound = StateBound(**bounds["bound"] | {"internal": internal})
            self._bounds[g] = StateBounds(**bounds | {"bound": bound})
            self._limits[g] = self._limits_of(g, self._bounds[g])

    @property
    def speed(self) -> float:
        """Largest speed in the last measurement, m/s."""
        return max(bounds.speed for bounds in self._bounds)

    @property
    def fresh(self) -> bool:
        """Whether every group was measured after the last step."""
        return max(self._state.unwatched) == 0

    def limits(self) -> list[Limit]:
        """Return all bounds from the last measurements, and the bound by the rates of deformation in the last step."""
        return [limit for limits in self._limits for limit in limits] + [_deformation_limit(self._state.rate)]

    def _own_limits(self) -> list[list[float]]:
        """Return the bound, s, of each body of each group by its stiffness and by the speed of its group."""
        return [
            [
                min(
                    speed_limit(self._spacing, bounds.speed, 0.0),
                    *(limit.value for limit in limits if limit.body == self._names[place]),
                )
                for place in group.bodies
            ]
            for group, bounds, limits in zip(self._groups, self._bounds, self._limits, strict=True)
        ]

    def limits_now(self) -> list[Limit]:
        """Return all bounds from the current measurements without storing them."""
        states = [measure() for measure in self._measure]
        limits = [limit for g, bounds in enumerate(states) for limit in self._limits_of(g, bounds)]
        return [*limits, _deformation_limit(bounds.deformation_rate for bounds in states)]

    @property
    def stiffest(self) -> Limit:
        """The smallest bound by stiffness."""
        return min((limit for limits in self._limits for limit in limits), default=self._none)

    def due(self) -> list[int]:
        """Return the groups to measure after a series of steps by a kernel.

        For groups that harden the measurement of the kernel after such a series is used instead, if it is sound.
        """
        began = time.perf_counter()
        state, due = self._state, []
        for g, group in enumerate(self._groups):
            if state.unwatched[g] >= state.longest:
                due.append(g)
            elif max(state.change[g], state.hardened[g]) >= state.growth_allowed:
                known = self._measure[g]() if group.law.hardening > 0 else None
                if known is not None and _sound(known):
                    self._take(g, known)
                else:
                    due.append(g)
        self.seconds += time.perf_counter() - began
        return due

    def sound(self) -> bool:
        """Return whether no particle is crushed, inverted or NaN; the measurement is not stored."""
        return all(_sound(measure()) for measure in self._measure)

    def measure(self, due: Iterable[int]) -> bool:
        """Measure some groups and return whether no particle is crushed, inverted or NaN."""
        began = time.perf_counter()
        sound = True
        for g in due:
            bounds = self._measure[g]()
            sound = sound and _sound(bounds)
            if sound:
                self._take(g, bounds)
                self._state.unwatched[g] = 0
        self.seconds += time.perf_counter() - began
        return sound

    def _take(self, g: int, bounds: StateBounds) -> None:
        """Store the bounds of the state of a group and the limits that follow from them."""
        self._bounds[g] = bounds
        self._at_start[g] = False
        self._state.rate[g] = bounds.deformation_rate
        self._state.change[g] = self._state.hardened[g] = 0.0
        self._limits[g] = self._limits_of(g, bounds)
        self._write_limits()

    def _limits_of(self, g: int, bounds: StateBounds) -> list[Limit]:
        """Return the limits by the stiffness of the g-th group within these bounds of its state."""
        group, bound = self._groups[g], bounds.bound
        if self._at_start[g]:
            # Initially deformed material springs back; later the bound is held through all phases of an oscillation.
            bound = group.law.rebound_bound(bound)
        limits = []
        for place, parameters in zip(group.bodies, group.law.members, strict=True):
            modes = group.law.reference_modes if group.total else group.law.modes
            for mode in modes(parameters, bound):
                stiffness = mode.stiffness / group.law.relief
                value, cause = mode_limit(self._spacing, parameters.density, stiffness, mode.viscosity, self._inertia)
                limits.append(Limit(value, cause, self._names[place]))
        return limits

    def _write_limits(self) -> None:
        """Write the bounds that follow from the measurements."""
        self._state.stiffness, self._state.stiffness_limit = self.stiffest.value, LIMITS.index(self.stiffest.name)
        for g, own in enumerate(self._own_limits()):
            for i, bound in enumerate(own):
                self._state.own[g][i] = bound


def _sound(bounds: StateBounds) -> bool:
    """Return whether no particle is crushed, inverted or NaN."""
    return bounds.bound.volume_ratio_min > SMALLEST_J


def _deformation_limit(rates: Iterable[float]) -> Limit:
    return Limit(deformation_limit(max(rates)), "deformation", "")
