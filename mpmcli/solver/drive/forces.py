"""Gravity and external forces given by expressions, and their bounds for the time step.

They advance the velocity from the middle of the previous step to the middle of this one, which moves particles to
x_(n+1) (docs/theory.md, 6.5 and 7.1). Leapfrog evaluates a force at x_n; a value that depends only on time is averaged
over this interval. Gravity acts on nodes. A force acts on particles before their momentum is scattered.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.materials.elementary import exp_minus_1
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.entry import tree_of
from mpmcli.scene.expression import INITIAL, POSITION, VELOCITY, Number, Tree, apply, derivative, names_in
from mpmcli.scene.quadrature import largest_of
from mpmcli.solver.drive.expressions import MOVES, DeviceValues, Entries, Formula, Place, RunValues, TimeTables, node_of
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.state_bounds import build_maxima

# Half of the interval of the central differences for the gradient of a force, cells.
HALF_INTERVAL = 0.5
# A gradient beyond this counts as zero, like NaN where a force is undefined next to a particle.
STEEPEST = 1e30
# Forces are measured together with the state, for the steps until the next measurement. Forces that depend on time are
# measured at INSTANTS times and at the extrema of values that depend only on time. MARGIN is the safety factor for the
# motion of particles in between.
INSTANTS = 5
MARGIN = 1.5

# Measurement of the force on particles, given the first particle, their number, and the run; see `build_push`.
Push = Callable[[int, int, int], tuple[float, float]]


@dataclass(frozen=True)
class Term:
    """A force on one body of a group.

    Attributes:
        place: index of the body in its group, -1 for all bodies.
        axes: each axis along which the force acts, with its tree, and that of its decrease with the velocity along the
            axis, or None if it does not depend on that.
    """

    place: int
    axes: tuple[tuple[int, Formula | Place, Formula | Place | None], ...]


@dataclass(frozen=True)
class ForceTerms:
    """Forces on particles of one law, or on rigid bodies, as compiled; runs with equal terms share kernels.

    Attributes:
        terms: the forces.
        moves, initial, drags: whether any of them depends on the position, on the initial position, and on the
            velocity.
        reach, slope: half of the interval of differences, m, and the inverse of the interval, 1/m; None without forces.
        gravity: gravity along each axis if any force depends on the velocity, else empty.
    """

    terms: tuple[Term, ...] = ()
    moves: bool = False
    initial: bool = False
    drags: bool = False
    reach: Place | None = None
    slope: Place | None = None
    gravity: tuple[Formula | Place, ...] = ()

    @staticmethod
    def of(scene: Scene, names: Sequence[str], entries: Entries) -> "ForceTerms":
        """Return the forces on some bodies; their numbers are added to `entries`."""
        forces = [force for force in scene.pushes if force.body is None or force.body in names]
        if not forces or not names:
            return ForceTerms()
        terms, found = [], set()
        for force in forces:
            trees = [tree_of(entry) for entry in force.acceleration]
            axes = tuple(
                (axis, entries.placed(tree), _decrease(tree, axis, entries))
                for axis, tree in enumerate(trees)
                if tree != Number(0.0)
            )
            terms.append(Term(-1 if force.body is None else names.index(force.body), axes))
            found.update(*map(names_in, trees))
        reach, drags = HALF_INTERVAL * scene.domain.spacing, not found.isdisjoint(VELOCITY)
        return ForceTerms(
            tuple(terms),
            not found.isdisjoint(POSITION),
            not found.isdisjoint(INITIAL),
            drags,
            entries.number(reach),
            entries.number(0.5 / reach),
            tuple(entries.placed(tree_of(entry)) for entry in scene.domain.gravity) if drags else (),
        )


def _decrease(tree: Tree, axis: int, entries: Entries) -> Formula | Place | None:
    """Return the placed tree of -da/dv along an axis, 1/s, or None if the tree does not depend on v there."""
    if VELOCITY[axis] not in names_in(tree):
        return None
    return entries.placed(apply("negative", derivative(tree, VELOCITY[axis])))


@dataclass(frozen=True)
class Drives:
    """Gravity and forces as compiled; runs with equal ones share kernels.

    Attributes:
        gravity: gravity along each axis, as numbers of a run; empty if it is steady.
        forces: forces on the particles of each law.
        motions: per moving collider, the places of those components of velocity and spin that depend on time, None for
            constant ones.
        rigid: forces on rigid bodies.
        motors: (index of the rigid body, rate) of each motor.
        timed: whether each number of a run depends on time.
    """

    gravity: tuple[Place, ...]
    forces: tuple[ForceTerms, ...]
    motions: tuple[tuple[Place | None, ...], ...]
    rigid: ForceTerms
    motors: tuple[tuple[int, Place], ...]
    timed: tuple[bool, ...]

    @staticmethod
    def of(scene: Scene, members: Sequence[Sequence[int]]) -> "tuple[Drives, list[float | Tree]]":
        """Return the drives of a scene and its numbers; `members` are the indices of the bodies of each law."""
        entries = Entries(scene.domain.origin)
        steady = scene.domain.steady
        gravity = () if steady else tuple(entries.placed(tree_of(entry)) for entry in scene.domain.gravity)
        names = ([scene.sources[i].name for i in own] for own in members)
        forces = tuple(ForceTerms.of(scene, own, entries) for own in names)
        moving = [collider.motion.rates for collider in scene.colliders if collider.driven]
        motions = tuple(tuple(entries.placed(tree) if names_in(tree) else None for tree in rates) for rates in moving)
        free = [collider for collider in scene.colliders if collider.free]
        rigid = ForceTerms.of(scene, [collider.name for collider in free], entries)
        joints = [(j, collider.joint) for j, collider in enumerate(free) if collider.joint]
        motors = tuple((j, entries.placed(tree_of(one.motor))) for j, one in joints if one.motor is not None)
        return Drives(gravity, forces, motions, rigid, motors, entries.timed), entries.found


@ti.data_oriented
class DriveValues:
    """The numbers of all runs on the device, with tables of those that depend on time.

    Attributes:
        device: the numbers.
        timed: (table, index) of each number that depends on time.
        tables: tables of these numbers; None if there are none, or without double precision.
        of_runs: the numbers of each run on the host.
        motions: (moving collider, component of its rates, table) of each rate that depends on time.
        gravity_varies: whether gravity varies.
    """

    def __init__(self, drives: Drives, runs: int, *, doubles: bool = True) -> None:
        """Allocate the numbers of all runs; without double precision, `doubles`, there are no tables."""
        timed = [k for k, depends in enumerate(drives.timed) if depends]
        self.device = DeviceValues(runs, len(drives.timed))
        self.timed = tuple(enumerate(timed))
        self.tables = TimeTables(runs, len(timed)) if timed and doubles else None
        self.of_runs: list[RunValues | None] = [None] * runs
        self.motions = tuple(
            (m, a, timed.index(leaf.index))
            for m, places in enumerate(drives.motions)
            for a, leaf in enumerate(places)
            if leaf is not None
        )
        self.gravity_varies = bool(drives.gravity)
        self.gravity = tuple(
            (leaf.index, timed.index(leaf.index) if leaf.index in timed else -1) for leaf in drives.gravity
        )

    @ti.func
    def set_means(self, w: int, start: ti.f64, end: ti.f64):
        """Set the numbers of a run that depend on time to their means over a kick."""
        for table, k in ti.static(self.timed):
            row = w * ti.static(len(self.timed)) + table
            self.device.field[w, k] = ti.cast(self.tables.mean(row, start, end), float)

    @ti.func
    def set_motions(self, w: int, motion: ti.template(), start: ti.f64, end: ti.f64):
        for m, a, table in ti.static(self.motions):
            row = w * ti.static(len(self.timed)) + table
            motion.rates[w * ti.static(len(motion.moving)) + m, a] = self.tables.mean(row, start, end)

    @ti.func
    def largest_gravity(self, w: int, start: ti.f64, end: ti.f64):
        """Return a bound on gravity between two times, m/s^2."""
        square = 0.0 * start
        for k, table in ti.static(self.gravity):
            if ti.static(table < 0):
                value = ti.cast(self.device.field[w, k], ti.f64)
                square += value * value
            else:
                value = self.tables.largest(w * ti.static(len(self.timed)) + table, start, end)
                square += value * value
        return ti.sqrt(square)


class HostValues:
    """Host version of the kernel functions of `DriveValues`, for devices without double precision."""

    motions = ()

    def __init__(self, values: DriveValues) -> None:
        self._values, self.gravity_varies = values, values.gravity_varies

    def set_means(self, w: int, start: float, end: float) -> None:
        """Set the numbers of a run that depend on time to their means over a kick."""
        if self._values.timed:
            self._values.of_runs[w].write(start, end)

    def largest_gravity(self, w: int, start: float, end: float) -> float:
        """Return a bound on gravity between two times, m/s^2."""
        entries = [self._values.of_runs[w].entries[k] for k, _ in self._values.gravity]
        return math.hypot(*(e if isinstance(e, float) else largest_of(e, start, end) for e in entries))


@ti.data_oriented
class Gravity:
    """Varying gravity, read from the numbers of a run."""

    def __init__(self, places: Sequence[Place], zero: Sequence[float], values: DeviceValues) -> None:
        self.dimension, self.values = len(zero), values
        self.numbers = tuple(place.index for place in places)

    @ti.func
    def in_step(self, kick: float, run: int):
        result = ti.Vector.zero(float, self.dimension)
        for a, k in ti.static(enumerate(self.numbers)):
            result[a] = kick * self.values.field[run, k]
        return result


def _nodes_of(
    forces: ForceTerms, values: DeviceValues, *, decreases: bool = False
) -> tuple[tuple[int, tuple[tuple[int, object], ...]], ...]:
    """Return per force the index of its body, and each axis along which it acts with the node that evaluates it.

    With `decreases`, the nodes of -da/dv.
    """
    return tuple(
        (
            term.place,
            tuple(
                (axis, node_of(slope if decreases else tree, values))
                for axis, tree, slope in term.axes
                if not decreases or slope is not None
            ),
        )
        for term in forces.terms
    )


@ti.func
def decay(rate: float, kick: float):
    """Return (1 - exp(-z)) / z with z = rate kick, or 1 if it is negative: the mean of a decay over a kick, s.

    A change of velocity by kick a times this, where a falls with the velocity at this rate, is exact if a is linear in
    it, and stable for any kick (exponential Euler; Hochbruck and Ostermann 2010).
    """
    z = ti.select(rate > 0.0, rate * kick, 0.0)
    return ti.select(z > 0.0, -exp_minus_1(-z) / ti.select(z > 0.0, z, 1.0), 1.0)


@ti.data_oriented
class GroupForce:
    """All forces on one group of particles.

    Attributes:
        spreads: whether the gradient of the forces is known: at least one depends on the position and none on the
            initial position, whose gradient would require that of the motion so far.
    """

    def __init__(self, dimension: int, forces: ForceTerms, values: DeviceValues, room: int) -> None:
        """Build the nodes; `room` is the capacity for bodies per run in the group."""
        self.dimension, self.terms = dimension, _nodes_of(forces, values)
        self.drags, self.decreases = forces.drags, _nodes_of(forces, values, decreases=True)
        self.known = MOVES + dimension if forces.drags else dimension
        self.gravity = tuple(node_of(tree, values) for tree in forces.gravity)
        self.moves, self.spreads = forces.moves, forces.moves and not forces.initial
        self.reach, self.slope = node_of(forces.reach, values), node_of(forces.slope, values)
        self.capacity = room

    @ti.func
    def at(self, terms: ti.template(), group: ti.template(), p: int, x: ti.template(), X: ti.template()):
        result = ti.Vector.zero(float, self.dimension)
        for place, axes in ti.static(terms):
            if ti.static(place < 0):
                for axis, node in ti.static(axes):
                    result[axis] += node.evaluate(x, X, group.run)
            else:
                if group.body[p] - group.run * self.capacity == ti.static(place):
                    for axis, node in ti.static(axes):
                        result[axis] += node.evaluate(x, X, group.run)
        return result

    @ti.func
    def acceleration(self, group: ti.template(), p: int, kick: float, with_slope: ti.template()):
        """Return the acceleration a of particle p and da/dx at fixed X, d x d, which is 0 without `with_slope`.

        Central differences at the scale of the grid are exact if a is quadratic in x. With a force linear in x a body
        moves affinely up to its surface. What depends on the velocity is a mean over a kick, s, see `decay`, in which
        gravity acts as well; the nodes add gravity itself. The change of the velocity gradient is added to da/dx.
        """
        d = ti.static(self.dimension)
        x, X, a = ti.Vector.zero(float, d), ti.Vector.zero(float, self.known), ti.Vector.zero(float, d)
        slope = ti.Matrix.zero(float, d, d)
        here = group.place(p)
        for c in ti.static(range(d)):
            x[c] = here[c]
            if ti.static(group.keeps_initial):
                X[c] = group.initial[p][c]
        v, C = group.motion(p)
        if ti.static(self.drags):
            for c in ti.static(range(d)):
                X[MOVES + c] = v[c]
        if ti.static(self.moves and with_slope):
            reach, inverse = self.reach.evaluate(x, X, group.run), self.slope.evaluate(x, X, group.run)
            # A loop, so that the expressions are compiled once: forwards and backwards along each axis, then at x
            # itself.
            for k in range(2 * d + 1):
                place = x
                for b in ti.static(range(d)):
                    if k == 2 * b:
                        place[b] += reach
                    if k == 2 * b + 1:
                        place[b] -= reach
                value = self.at(self.terms, group, p, place, X)
                for b, c in ti.static(ti.ndrange(d, d)):
                    if k == 2 * b:
                        slope[c, b] += value[c] * inverse
                    if k == 2 * b + 1:
                        slope[c, b] -= value[c] * inverse
                if k == 2 * d:
                    a = value
            for b, c in ti.static(ti.ndrange(d, d)):
                slope[c, b] = ti.select(ti.abs(slope[c, b]) < STEEPEST, slope[c, b], 0.0)
        else:
            a = self.at(self.terms, group, p, x, X)
        if ti.static(self.drags):
            rates = self.at(self.decreases, group, p, x, X)
            for c in ti.static(range(d)):
                left, rate = decay(rates[c], kick), ti.select(rates[c] > 0.0, rates[c], 0.0)
                pull = self.gravity[c].evaluate(x, X, group.run)
                a[c] = (a[c] + pull) * left - pull
                for b in ti.static(range(d)):
                    # A measurement, without a kick, is of da/dx alone.
                    slope[c, b] = left * (slope[c, b] - ti.select(kick > 0.0, rate * C[c, b], 0.0))
        return a, slope


@ti.data_oriented
class RigidDrive:
    """Forces on rigid bodies, as accelerations of their centres, and the prescribed rates of their motors."""

    def __init__(self, dimension: int, drives: Drives, values: DeviceValues) -> None:
        self.dimension, self.terms = dimension, _nodes_of(drives.rigid, values)
        self.drags, self.decreases = drives.rigid.drags, _nodes_of(drives.rigid, values, decreases=True)
        self.known = MOVES + dimension if self.drags else dimension
        self.motors = tuple((j, node_of(rate, values)) for j, rate in drives.motors)

    @ti.func
    def change(
        self,
        j: int,
        x: ti.template(),
        start: ti.template(),
        v: ti.template(),
        pull: ti.template(),
        kick: float,
        run: int,
    ):
        """Return the change of velocity of the j-th body in a kick, s, its centre at x, initially at `start`.

        Gravity alone changes it by `pull`, m/s.
        """
        X = ti.Vector.zero(float, self.known)
        for c in ti.static(range(self.dimension)):
            X[c] = start[c]
            if ti.static(self.drags):
                X[MOVES + c] = v[c]
        result = pull + kick * self.summed(self.terms, j, x, X, run)
        if ti.static(self.drags):
            rates = self.summed(self.decreases, j, x, X, run)
            for c in ti.static(range(self.dimension)):
                result[c] = result[c] * decay(rates[c], kick)
        return result

    @ti.func
    def summed(self, terms: ti.template(), j: int, x: ti.template(), X: ti.template(), run: int):
        """Return the sum of terms for the j-th body."""
        result = ti.Vector.zero(float, self.dimension)
        for place, axes in ti.static(terms):
            if place < 0 or place == j:
                for axis, node in ti.static(axes):
                    result[axis] += node.evaluate(x, X, run)
        return result

    @ti.func
    def motor(self, j: int, run: int):
        """Return the prescribed rate of the motor of the j-th body."""
        result = 0.0
        nowhere = ti.Vector.zero(float, self.dimension)
        for which, node in ti.static(self.motors):
            if which == j:
                result = node.evaluate(nowhere, nowhere, run)
        return result


def build_push(group: ParticleArrays, backend: Backend) -> Push:
    """Return a measurement of the force on particles of a run: largest |a|, m/s^2, and row sum of |da/dx|, 1/s^2."""

    @ti.func
    def widen_one(own: ti.template(), view: ti.template(), p: int):
        a, slope = view.force.acceleration(view, p, 0.0, True)
        own[0] = ti.max(own[0], a.norm_sqr())
        for c in ti.static(range(view.dimension)):
            row = 0.0
            for b in ti.static(range(view.dimension)):
                row += ti.abs(slope[c, b])
            own[1] = ti.max(own[1], row)

    @ti.func
    def widen(own: ti.template(), p: int, run: int):
        for view in ti.static((group.seen_from(run),)):
            widen_one(own, view, p)

    measure = build_maxima(2, widen, backend)

    def largest(first: int, count: int, run: int) -> tuple[float, float]:
        square, slope = measure(first, count, run)
        return float(square**0.5), slope

    return largest


def push_on(
    group: ParticleArrays, forces: ForceTerms, room: int, values: DeviceValues, backend: Backend
) -> Push | None:
    """Assign forces to a group, before kernels are built; return their measurement, see `build_push`."""
    if not forces.terms:
        return None
    group.push_by(GroupForce(group.dimension, forces, values, room))
    return build_push(group, backend)


class ExternalForces:
    """Measurements of the forces on all groups with forces.

    Attributes:
        pushes: whether there are any forces.
    """

    def __init__(self, values: RunValues, measures: Sequence[Callable[[], tuple[float, float]]]) -> None:
        self._values, self._measures, self.pushes = values, measures, bool(measures)

    def measure(self, time: float, ahead: float) -> tuple[float, float]:
        """Measure forces at the current positions, from `time` until the next measurement, `ahead` s later.

        Returns:
            The largest force per mass, m/s^2, and the largest row sum of |da/dx|, 1/s^2, including the margin.
        """
        times = [time]
        if self._values.timed and ahead > 0:
            times = [*np.linspace(time, time + ahead, INSTANTS), *self._values.telling_times(time, time + ahead)]
        found = [(0.0, 0.0)]
        for instant in times if self.pushes else ():
            if self._values.timed:
                self._values.write(float(instant), float(instant))
            found += [measure() for measure in self._measures]
        push, slope = (MARGIN * max(filter(math.isfinite, values)) for values in zip(*found, strict=True))
        return push, slope
