"""What is computed of a run as a whole: its next step, and what follows from the last one (docs/theory.md, 6).

Kernels call these functions, and the host where a device has no double precision.
"""

from collections.abc import Sequence

from taichi.lang.impl import inside_kernel

from mpmcli.quick_taichi import ti
from mpmcli.solver.drive.forces import DriveValues
from mpmcli.solver.engine.run_numbers import ATTEND, BEYOND, COLLAPSED, LIMITS, LOST, Layout
from mpmcli.solver.transfer.kept_motion import kept_share
from mpmcli.solver.transfer.splines import TransferScheme
from mpmcli.stability.limits import COURANT, DEFORMATION
from mpmcli.stability.transfer_factors import INTERVAL

COLLIDER, DEFORMING, FORCE, FORCED, MAXIMUM, CROSSING = (
    LIMITS.index(name) for name in ("collider", "deformation", "force", "forced", "maximum", "speed")
)


@ti.pyfunc
def as_double(number: ti.template()):
    """Return a number in double precision: a literal in a kernel has that of particles."""
    if ti.static(inside_kernel()):
        return ti.cast(number, ti.f64)
    else:
        return float(number)


@ti.pyfunc
def as_real(number: ti.template()):
    """Return a number in the precision of particles."""
    if ti.static(inside_kernel()):
        return ti.cast(number, float)
    else:
        return number


@ti.data_oriented
class StepSize:
    """The steps of the runs of a batch, w being the number of a run; numbers and counts as of `run_numbers`."""

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
        """Prepare; `drifts`: whether particles move on the grid; shift: cells by which some steps shift them."""
        self.drifts, self.shift = drifts, shift
        self.real, self.count = layout.real, layout.count
        self.values = values
        self.groups, self.bodies, self.scheme = tuple(groups), layout.bodies, scheme

    @ti.pyfunc
    def begin(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Choose the next step.

        Returns the step and the kick, s, float64, and the step is 0 where it collapsed or the host must fill time
        tables; the number of such steps to the target; the code of the bound that sets the step; the bound by
        deformation, s; and the stable step, s.
        """
        largest, limit, deformation = self.stable_step(w, numbers, counts)
        left = numbers[w, self.real.target] - numbers[w, self.real.time]
        splits = ti.max(ti.ceil(left / largest - numbers[w, self.real.slack]), 1.0)
        dt = left / splits
        given = numbers[w, self.real.given]
        if given > 0:
            splits = as_double(1.0)
            dt = given
        due_kick = numbers[w, self.real.owed] + 0.5 * (numbers[w, self.real.last_step] + dt)
        kick = ti.min(due_kick, dt / numbers[w, self.real.safety])
        since = self.velocity_time(w, numbers)
        # First: as long as the tables hold another time, the step means nothing.
        ends = since + kick
        if ti.static(len(self.values.motions) > 0):
            ends = ti.max(ends, numbers[w, self.real.time] + dt)
        if ends > numbers[w, self.real.horizon]:
            counts[w, self.count.status] = BEYOND
            dt = 0.0 * dt
        elif largest < numbers[w, self.real.collapse] and given == 0:
            counts[w, self.count.status] = COLLAPSED
            dt = 0.0 * dt
        else:
            numbers[w, self.real.owed] = due_kick - kick
            self.values.set_means(w, since, since + kick)
            if ti.static(self.scheme.keeps_before):
                self.keep(w, dt, numbers)
        return dt, kick, splits, limit, deformation, ti.min(largest, numbers[w, self.real.end])

    @ti.pyfunc
    def keep(self, w: int, dt: ti.f64, numbers: ti.template()):
        """Find the share of its motion that each body keeps in a step."""
        for g, group in ti.static(enumerate(self.groups)):
            slowest = numbers[w, self.real.infinity]
            if numbers[w, self.real.rate[g]] > 0:
                slowest = DEFORMATION / numbers[w, self.real.rate[g]]
            for i in range(self.bodies[g]):
                bound = ti.min(numbers[w, self.real.own[g] + i], slowest)
                group.kept[w * self.bodies[g] + i] = as_real(kept_share(dt / bound, self.scheme.damped))

    @ti.pyfunc
    def velocity_time(self, w: int, numbers: ti.template()):
        """Return the time to which velocities have advanced, s, float64, as `Progress.velocity_time`."""
        return numbers[w, self.real.time] - 0.5 * numbers[w, self.real.last_step] - numbers[w, self.real.owed]

    @ti.pyfunc
    def end(
        self,
        w: int,
        dt: ti.f64,
        splits: ti.f64,
        limit: int,
        deformation: ti.f64,
        speed: ti.f64,
        numbers: ti.template(),
        counts: ti.template(),
    ):
        """Count a step with this largest speed of a node, m/s, -1 where a particle was lost. Its rates are stored."""
        numbers[w, self.real.time] = numbers[w, self.real.time] + dt
        if splits == 1:
            numbers[w, self.real.time] = numbers[w, self.real.target]
        numbers[w, self.real.last_step] = dt
        counts[w, self.count.steps] += 1
        counts[w, self.count.budget] -= 1
        if speed >= 0:
            courant = dt * speed / numbers[w, self.real.spacing]
            # What waits for an emitter counts from the start.
            numbers[w, self.real.speed] = ti.max(speed, numbers[w, self.real.slowest])
            numbers[w, self.real.courant] = courant
            if ti.static(self.drifts):
                numbers[w, self.real.drift] = numbers[w, self.real.drift] + courant
            self.hold(w, ti.min(numbers[w, self.real.stiffness], deformation), numbers)
            due = self.control(w, dt, numbers, counts)
            self.book(w, dt, courant, limit, numbers, counts)
            if splits == 1:
                counts[w, self.count.arrived] = 1
            if due or (splits == 1 and counts[w, self.count.records] == 0):
                counts[w, self.count.status] = ATTEND
        else:
            counts[w, self.count.status] = LOST

    @ti.pyfunc
    def stable_step(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Return the step, s, and the code of its bound, and the bound by deformation, s."""
        value = numbers[w, self.real.stiffness]
        limit = counts[w, self.count.stiffness_limit]
        sharpest = numbers[w, self.real.rate[0]]
        for g in ti.static(range(1, len(self.groups))):
            sharpest = ti.max(sharpest, numbers[w, self.real.rate[g]])
        deformation = numbers[w, self.real.infinity]
        if sharpest > 0:
            deformation = DEFORMATION / sharpest
        if deformation < value or (deformation == value and limit > DEFORMING):
            value = deformation
            limit = DEFORMING
        value = ti.min(value, numbers[w, self.real.held])
        speed = ti.max(numbers[w, self.real.speed], numbers[w, self.real.wall_speed])
        pull = numbers[w, self.real.pull]
        if ti.static(self.values.gravity_varies):
            # The next kick ends in the middle of a step that is no longer than the other bounds allow.
            ahead = ti.min(numbers[w, self.real.safety] * value, numbers[w, self.real.end])
            pull += self.values.largest_gravity(w, self.velocity_time(w, numbers), numbers[w, self.real.time] + ahead)
        h = numbers[w, self.real.spacing]
        crossing = numbers[w, self.real.infinity]
        if speed != 0 or pull != 0:
            crossing = 2 * COURANT * h / (speed + ti.sqrt(speed * speed + 4 * pull * COURANT * h))
        if crossing < value or (crossing == value and limit > CROSSING):
            value = crossing
            limit = CROSSING
        force = numbers[w, self.real.force]
        if force < value or (force == value and limit > FORCE):
            value = force
            limit = FORCE
        collider = numbers[w, self.real.collider]
        if collider < value or (collider == value and limit > COLLIDER):
            value = collider
            limit = COLLIDER
        value = numbers[w, self.real.safety] * value
        maximum = numbers[w, self.real.maximum]
        if maximum < value:
            value = maximum
            limit = MAXIMUM
        elif counts[w, self.count.forced] == 1:
            value = maximum
            limit = FORCED
        return value, limit, deformation

    @ti.pyfunc
    def aim(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Go on to the next frame after one that was recorded."""
        index = as_double(counts[w, self.count.frame])
        numbers[w, self.real.target] = numbers[w, self.real.end] * index / as_double(counts[w, self.count.frames])
        numbers[w, self.real.smallest] = numbers[w, self.real.infinity]
        numbers[w, self.real.largest] = as_double(0.0)
        numbers[w, self.real.largest_courant] = as_double(0.0)
        counts[w, self.count.limit] = 0
        counts[w, self.count.arrived] = 0

    @ti.pyfunc
    def shift_ahead(self, w: int, counts: ti.template()):
        """Return the cells by which the next step may shift particles before it scatters them."""
        cells = as_double(0.0)
        if counts[w, self.count.unrelaxed_steps] + 1 >= INTERVAL:
            cells = as_double(self.shift)
        return cells

    @ti.pyfunc
    def relaxed_in(self, w: int, dt: ti.f64, numbers: ti.template(), counts: ti.template()):
        """Count a step and return the time over which it relaxes volumes, s."""
        relaxed = numbers[w, self.real.unrelaxed] + dt
        numbers[w, self.real.drift] = numbers[w, self.real.drift] + self.shift_ahead(w, counts)
        if counts[w, self.count.unrelaxed_steps] + 1 < INTERVAL:
            counts[w, self.count.unrelaxed_steps] += 1
            numbers[w, self.real.unrelaxed] = relaxed
            relaxed = as_double(0.0)
        else:
            counts[w, self.count.unrelaxed_steps] = 0
            numbers[w, self.real.unrelaxed] = as_double(0.0)
        return relaxed

    @ti.pyfunc
    def hold(self, w: int, bound: ti.f64, numbers: ti.template()):
        """Keep the smallest bound of the last steps, see `HeldBound`."""
        low = ti.min(numbers[w, self.real.low], bound)
        held = ti.min(numbers[w, self.real.held], bound)
        steps = numbers[w, self.real.held_steps] + 1
        if steps >= numbers[w, self.real.hold]:
            lowest = ti.min(numbers[w, self.real.low_before], low)
            if lowest > numbers[w, self.real.rise] * held:
                held = lowest
            numbers[w, self.real.low_before] = low
            low = numbers[w, self.real.infinity]
            steps -= steps
        numbers[w, self.real.held] = held
        numbers[w, self.real.low] = low
        numbers[w, self.real.held_steps] = steps

    @ti.pyfunc
    def control(self, w: int, dt: ti.f64, numbers: ti.template(), counts: ti.template()):
        """Count a step; return whether the host must measure."""
        due = False
        for g in ti.static(range(len(self.groups))):
            counts[w, self.count.unwatched[g]] += 1
            strain = dt * numbers[w, self.real.rate[g]]
            numbers[w, self.real.change[g]] = (
                numbers[w, self.real.change[g]] + strain * numbers[w, self.real.sensitivity[g]]
            )
            numbers[w, self.real.hardened[g]] = (
                numbers[w, self.real.hardened[g]] + strain * numbers[w, self.real.hardening[g]]
            )
            allowed = numbers[w, self.real.growth_allowed]
            if counts[w, self.count.unwatched[g]] >= counts[w, self.count.longest]:
                due = True
            if numbers[w, self.real.change[g]] >= allowed or numbers[w, self.real.hardened[g]] >= allowed:
                due = True
        return due

    @ti.pyfunc
    def book(self, w: int, dt: ti.f64, courant: ti.f64, limit: int, numbers: ti.template(), counts: ti.template()):
        """Keep the smallest step with its bound, the largest one, and the largest Courant number, for the ledger."""
        smallest = numbers[w, self.real.smallest]
        between = numbers[w, self.real.smallest_courant]
        same = dt == smallest and (courant < between or (courant == between and limit < counts[w, self.count.limit]))
        if dt < smallest or same:
            numbers[w, self.real.smallest] = dt
            numbers[w, self.real.smallest_courant] = courant
            counts[w, self.count.limit] = limit
        numbers[w, self.real.largest] = ti.max(numbers[w, self.real.largest], dt)
        numbers[w, self.real.largest_courant] = ti.max(numbers[w, self.real.largest_courant], courant)
