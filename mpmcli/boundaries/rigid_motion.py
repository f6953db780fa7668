"""Motion of rigid bodies: momenta, constraints, and time integration of the poses, in double precision.

The velocity U of a body has the components of its centre and its spin. U = W y, with a column of W per degree of
freedom: all of them, those that `fixed` leaves, or that of its joint. Constraints take the rest of the momentum. A
motor gives the impulse that keeps y, limited by its strength.
"""

import math

import numpy as np

from mpmcli.boundaries.colliders import Colliders
from mpmcli.boundaries.doubles import double_field, sin_cos
from mpmcli.boundaries.feature import Feature
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.rigid import Hinge

# Angle of a substep of the rotation in a step, rad, and largest number of substeps.
SUBSTEP_ANGLE, MOST_SUBSTEPS = 1e-3, 100.0
# Size of a position, m, or angle, rad, from which a pose counts as not finite.
FAR = 1e30


@ti.data_oriented
class RigidMotion(Feature):
    """The free colliders of some runs.

    Attributes:
        free: their indices among the colliders of a run.
        run: the current run.
        pushes: a `RigidDrive`.
        pose: positions of the centres relative to the lower corner, m, and angles, rad, or unit quaternions.
        momentum: momentum, and angular momentum about the centre.
        booked: impulses of the material since the last frame; angular ones about a hinge, or else the centre.
        rate: velocity and angular velocity, as found by the rounds of a step so far.
        settled: whether the rounds have converged.
        support: impulses of walls and other contacts in the last step, the estimate of the rounds for this step.
        inertia: inertia about the axes of the shape.
        mobility: matrix that maps momentum to rate in the current pose, W (W^T M W)^-1 W^T.
        axes: in 3D, the principal axes of the shape in columns, followed by the moments about them.
        ways, left: W, and the number of its columns.
        spins: whether W includes all rotations.
        start: initial position of the centre.
        kick: velocity change by gravity and forces in this step, m/s.
        hinge: position of a hinge, and the arm from it to the centre about the axes of the shape, m.
        hinged: whether there is a hinge.
        strength: strength of a motor, N m or N, 0 without a motor.
        motor: the rate that the motor keeps.
        drive: impulse of the motor in this step.
        weight, square: w^T M w and w^T w of the first column w of W.
        system: matrix and right side of an equation for U.
        reduced: the same for y, with room for several right sides.
    """

    def __init__(self, colliders: Colliders, pushes: object, runs: int) -> None:
        """Allocate the state of the free colliders of a number of runs, nearly all in double precision."""
        self.pushes = pushes
        self.colliders, self.dimension, self.free = colliders, colliders.dimension, colliders.kind.free
        self.loads, self.turns, self.run = colliders.loads.width, 1 if colliders.dimension == 2 else 3, 0
        self.count, self.width = len(self.free), self.dimension + (1 if self.dimension == 2 else 4)
        n = runs * self.count
        self.numbers = ti.field(int, shape=self.count)
        self.numbers.from_numpy(np.array(self.free, np.int32))
        self.pose = double_field(n, self.width)
        self.momentum, self.rate, self.booked, self.support = (double_field(n, self.loads) for _ in range(4))
        self.mass, self.weight, self.square, self.strength, self.motor, self.drive = (double_field(n) for _ in range(6))
        self.inertia = double_field(n, entries=(self.turns, self.turns))
        self.mobility, self.ways = (double_field(n, self.loads, self.loads) for _ in range(2))
        self.left, self.spins, self.hinged = (ti.field(int, shape=n) for _ in range(3))
        self.hinge = double_field(n, entries=(2, self.dimension))
        self.start = ti.Vector.field(self.dimension, float, shape=n)
        self.kick = double_field(n, entries=(self.dimension,))
        if self.dimension == 3:
            self.axes = double_field(n, 4, 3)
        self.settled = ti.field(int, shape=n)
        self.system = double_field(n, self.loads, self.loads + 1)
        self.reduced = double_field(n, self.loads, 2 * self.loads)
        fields = [self.pose, self.momentum, self.booked, self.support, self.mobility, self.ways, self.mass]
        fields += [self.inertia, self.weight, self.square, self.left, self.spins, self.hinged, self.start]
        fields += [self.hinge, self.strength] + ([self.axes] if self.dimension == 3 else [])
        self._rows = Rows(*fields)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the bodies of a run, at time 0."""
        d, origin = self.dimension, np.array(scene.domain.origin)
        rows, zeros = [], np.zeros(self.loads)
        for collider in (scene.colliders[k] for k in self.free):
            moments, ways, joint = collider.moments, collider.ways, collider.joint
            start = [*(np.array(moments.center) - origin), *([0.0] if d == 2 else [1.0, 0.0, 0.0, 0.0])]
            inert = np.zeros((self.loads, self.loads))
            inert[:d, :d], inert[d:, d:] = moments.mass * np.eye(d), moments.inertia
            mobility = ways @ np.linalg.inv(ways.T @ inert @ ways) @ ways.T
            found, axes = np.linalg.eigh(moments.inertia)
            left, first = ways.shape[1], ways[:, 0]
            spins, wide = int(np.linalg.matrix_rank(ways[d:]) == self.turns), np.zeros((self.loads, self.loads))
            wide[:, :left] = ways
            row = [start, inert @ collider.rates, zeros, zeros, mobility, wide, moments.mass, moments.inertia]
            row += [first @ inert @ first, first @ first, left, spins, int(isinstance(joint, Hinge)), start[:d]]
            driven = joint is not None and joint.motor is not None
            hinge = [np.array(moments.center) - collider.arm - origin, collider.arm]
            row += [hinge, (joint.strength or math.inf) if driven else 0.0]
            rows.append(row + ([np.vstack([axes, found])] if d == 3 else []))
        self._rows.write_all(run * self.count, rows)

    def saved(self) -> dict[str, ti.Field]:
        names = ("pose", "mobility", "ways", "weight", "momentum", "booked", "support")
        return {f"rigid.{name}": getattr(self, name) for name in names}

    def broken(self, run: int) -> int | None:
        poses = self.pose.to_numpy()[run * self.count :][: self.count]
        found = np.flatnonzero(~(np.abs(poses) < FAR).all(axis=1))
        return self.free[found[0]] if len(found) else None

    def fastest(self, run: int) -> float:
        """Return the bound of `move` on the speed of the bodies of a run now, m/s."""
        own, d = slice(run * self.count, (run + 1) * self.count), self.dimension
        rates = (self.mobility.to_numpy()[own] @ self.momentum.to_numpy()[own][..., None])[..., 0]
        first = run * self.colliders.capacity
        reach = self.colliders.reach.to_numpy()[[first + k for k in self.free], 1, 0]
        return float((np.linalg.norm(rates[:, :d], axis=1) + np.linalg.norm(rates[:, d:], axis=1) * reach).max())

    # A step.

    @ti.func
    def begin(self, run: int, dt: ti.f64, kick: float, pull: ti.template()):
        """Begin a step of dt seconds: set the positions of the bodies, and apply gravity and forces.

        Gravity changes velocities by `pull`, m/s, and forces act for `kick` seconds.
        """
        d = ti.static(self.dimension)
        for j in range(self.count):
            b = run * self.count + j
            i = self.collider_of(run, j)
            self.show_pose(b, i)
            v = ti.Vector.zero(float, d)
            for a in ti.static(range(d)):
                v[a] = ti.cast(self.rate[b, a], float)
            push = self.pushes.change(j, self.colliders.place[i], self.start[b], v, pull, kick, run)
            self.motor[b] = ti.cast(self.pushes.motor(j, run), ti.f64)
            for a in ti.static(range(d)):
                self.kick[b][a] = ti.cast(push[a], ti.f64)
                self.momentum[b, a] = self.momentum[b, a] + self.mass[b] * self.kick[b][a]
            self.take_rate(b)
            self.show_rate(b, i, dt)
            self.settled[b] = 0

    @ti.func
    def show_pose(self, b: int, i: int):
        """Set the position and the rotation of collider i from the pose of body b."""
        turned = self.turned(b)
        for a in ti.static(range(self.dimension)):
            self.colliders.place[i][a] = ti.cast(self.pose[b, a], float)
            for c in ti.static(range(self.dimension)):
                self.colliders.turned[i][a, c] = ti.cast(turned[a, c], float)

    @ti.func
    def move(self, run: int, dt: ti.f64):
        """Move the bodies for dt seconds; return their largest squared speed, and whether all poses are finite."""
        d = ti.static(self.dimension)
        fastest, finite = 0.0, True
        for j in range(self.count):
            b = run * self.count + j
            i = self.collider_of(run, j)
            speed, spin = ti.cast(0, ti.f64), self.spin(b)
            for a in ti.static(range(d)):
                self.pose[b, a] = self.pose[b, a] + dt * self.rate[b, a]
                speed += self.rate[b, a] ** 2
            self.turn(b, dt)
            if self.hinged[b] == 1:
                self.follow(b)
            self.set_mobility(b)
            if self.left[b] < self.loads:
                # Constraints take the momentum in other directions.
                if self.hinged[b] == 0:
                    self.take_rate(b)
                for a in range(self.loads):
                    own = ti.cast(0, ti.f64)
                    for c in range(self.loads):
                        own += self.system[b, a, c] * self.rate[b, c]
                    self.momentum[b, a] = own
            self.show_pose(b, i)
            reached = ti.sqrt(speed) + spin * ti.cast(self.colliders.reach[i][1, 0], ti.f64)
            fastest = ti.max(fastest, ti.cast(reached * reached, float))
            for a in range(self.width):
                # Written so that a NaN is not finite.
                if not ti.abs(self.pose[b, a]) < FAR:
                    finite = False
        return fastest, finite

    @ti.func
    def turn(self, b: int, dt: ti.f64):
        """Rotate body b about its centre in dt seconds, at constant angular momentum, or spin if that is constrained.

        In 3D an unconstrained rotation takes substeps, each of rotations about the principal axes in sequence
        (Dullweber, Leimkuhler and McLachlan 1997): the energy oscillates by the square of SUBSTEP_ANGLE, without
        drift.
        """
        if ti.static(self.dimension == 2):
            self.pose[b, 2] = self.pose[b, 2] + dt * self.rate[b, 2]
        else:
            q, square = ti.Vector([self.pose[b, 3 + a] for a in range(4)]), ti.cast(0, ti.f64)
            momentum = ti.Vector([self.momentum[b, 3 + a] for a in range(3)])
            for a in ti.static(range(3)):
                square += self.rate[b, 3 + a] ** 2
            parts = ti.cast(ti.min(ti.sqrt(square) * dt / SUBSTEP_ANGLE, MOST_SUBSTEPS), int) + 1
            if self.spins[b] == 0:
                parts = 0
                half = 0.5 * dt * ti.sqrt(square)
                scale = 0.5 * dt * self.sinc(half)
                spin = ti.Vector([scale * self.rate[b, 3 + a] for a in range(3)])
                _s, c = self.sin_cos(half)
                turned = self.product_of(ti.Vector([c, spin[0], spin[1], spin[2]]), q)
                # Entry by entry here and below: Taichi may lose vectors that are assigned as a whole.
                for a in ti.static(range(4)):
                    q[a] = turned[a]
            for _ in range(parts):
                for k in range(5):
                    c = 2 - ti.abs(2 - k)
                    axis = ti.Vector([self.axes[b, a, c] for a in range(3)])
                    half = 0.5 * dt / parts * momentum.dot(self.carried(q, axis)) / self.axes[b, 3, c]
                    if c < 2:
                        half *= 0.5
                    s, w = self.sin_cos(half)
                    turned = self.product_of(q, ti.Vector([w, s * axis[0], s * axis[1], s * axis[2]]))
                    for a in ti.static(range(4)):
                        q[a] = turned[a]
            unit = q.normalized()
            for a in ti.static(range(4)):
                self.pose[b, 3 + a] = unit[a]

    @ti.func
    def carried(self, q: ti.template(), v: ti.template()):
        """Return a vector rotated by a unit quaternion."""
        u = ti.Vector([q[1], q[2], q[3]])
        side = 2.0 * u.cross(v)
        return v + q[0] * side + u.cross(side)

    @ti.func
    def product_of(self, p: ti.template(), q: ti.template()):
        """Return the product of two quaternions."""
        v, u = ti.Vector([p[1], p[2], p[3]]), ti.Vector([q[1], q[2], q[3]])
        w = p[0] * u + q[0] * v + v.cross(u)
        return ti.Vector([p[0] * q[0] - v.dot(u), w[0], w[1], w[2]])

    # Bodies with a joint.

    @ti.func
    def turn_motor(self, b: int, dt: ti.f64):
        """Set the impulse of the motor of body b in a step of dt seconds: it keeps the rate, within its strength."""
        if self.strength[b] > 0:
            given = self.clamped(b, dt, self.drive[b] + (self.motor[b] - self.rate_of(b)) * self.weight[b])
            for a in range(self.loads):
                change = self.ways[b, a, 0] * (given - self.drive[b]) / self.square[b]
                self.momentum[b, a] = self.momentum[b, a] + change
            self.drive[b] = given
            self.take_rate(b)

    @ti.func
    def clamped(self, b: int, dt: ti.f64, impulse: ti.f64):
        """Return an impulse limited by the strength of the motor of body b in dt seconds."""
        return ti.max(ti.min(impulse, self.strength[b] * dt), -self.strength[b] * dt)

    @ti.func
    def rate_of(self, b: int):
        """Return the rate of body b along its first degree of freedom, that of a joint."""
        result = ti.cast(0, ti.f64)
        for a in range(self.loads):
            result += self.ways[b, a, 0] * self.rate[b, a]
        return result / self.square[b]

    @ti.func
    def follow(self, b: int):
        """Set the centre of body b from its hinge and rotation, and its velocity to a rotation about the hinge."""
        d = ti.static(self.dimension)
        rate = self.rate_of(b)
        own, spin = ti.Vector.zero(ti.f64, d), ti.Vector.zero(ti.f64, self.turns)
        for a in ti.static(range(d)):
            own[a] = self.hinge[b][1, a]
        arm = self.turned(b) @ own
        for a in ti.static(range(self.turns)):
            spin[a] = self.ways[b, ti.static(d + a), 0]
        along = self.crossed(spin) @ arm
        for a in ti.static(range(d)):
            self.pose[b, a] = self.hinge[b][0, a] + arm[a]
            self.ways[b, a, 0] = along[a]
        for a in range(self.loads):
            self.rate[b, a] = rate * self.ways[b, a, 0]

    # Response of a body to a momentum or an impulse.

    @ti.func
    def set_mobility(self, b: int):
        """Set the mobility of body b in its current pose."""
        n, ways = ti.static(self.loads), self.left[b]
        self.set_inertia(b)
        self.reduce(b)
        self.weight[b] = self.reduced[b, 0, 0]
        for k in range(ways):
            for a in range(n):
                self.reduced[b, k, ways + a] = self.ways[b, a, k]
        self.eliminate(b, n)
        for a in range(n):
            for c in range(n):
                entry = ti.cast(0, ti.f64)
                for k in range(ways):
                    entry += self.ways[b, a, k] * self.reduced[b, k, ways + c]
                self.mobility[b, a, c] = entry

    @ti.func
    def set_inertia(self, b: int):
        """Set the matrix of the system of body b to that of its mass and inertia."""
        d = ti.static(self.dimension)
        own = self.inertia[b]
        if ti.static(d == 3):
            turned = self.turned(b)
            carried = turned @ self.inertia[b] @ turned.transpose()
            for a, c in ti.static(ti.ndrange(3, 3)):
                own[a, c] = carried[a, c]
        for a in range(self.loads):
            for c in range(self.loads):
                self.system[b, a, c] = self.mass[b] if a == c else ti.cast(0, ti.f64)
        for a, c in ti.static(ti.ndrange(self.turns, self.turns)):
            self.system[b, d + a, d + c] = own[a, c]

    @ti.func
    def reduce(self, b: int):
        """Set the reduced matrix W^T S W of body b, where S is that of its system."""
        n, ways = ti.static(self.loads), self.left[b]
        for m in range(ways):
            for a in range(n):
                # S W, stored after the matrix.
                moved = ti.cast(0, ti.f64)
                for c in range(n):
                    moved += self.system[b, a, c] * self.ways[b, c, m]
                self.reduced[b, a, n + m] = moved
        for k in range(ways):
            for m in range(ways):
                entry = ti.cast(0, ti.f64)
                for a in range(n):
                    entry += self.ways[b, a, k] * self.reduced[b, a, n + m]
                self.reduced[b, k, m] = entry

    @ti.func
    def eliminate(self, b: int, sides: int):
        """Solve the reduced, symmetric positive definite system of body b for `sides` right sides, in place."""
        n = self.left[b]
        for k in range(n):
            first = 1.0 / self.reduced[b, k, k]
            for c in range(k, n + sides):
                self.reduced[b, k, c] = self.reduced[b, k, c] * first
            for a in range(n):
                factor = self.reduced[b, a, k]
                if a != k:
                    for c in range(k, n + sides):
                        self.reduced[b, a, c] = self.reduced[b, a, c] - factor * self.reduced[b, k, c]

    @ti.func
    def show_rate(self, b: int, i: int, dt: ti.f64):
        """Set the velocity field of collider i from the rate of body b: along the chords of a step of dt seconds."""
        d = ti.static(self.dimension)
        spin, square = ti.Vector.zero(ti.f64, self.turns), ti.cast(0, ti.f64)
        for a in ti.static(range(self.turns)):
            spin[a] = self.rate[b, d + a]
            square += spin[a] ** 2
        angle = dt * ti.sqrt(square)
        half = self.sinc(0.5 * angle)
        cross = self.crossed(spin)
        turning = self.sinc(angle) * cross + (0.5 * dt * half * half) * (cross @ cross)
        for a in ti.static(range(d)):
            self.colliders.velocity[i][a] = ti.cast(self.rate[b, a], float)
            for c in ti.static(range(d)):
                self.colliders.turning[i][a, c] = ti.cast(turning[a, c], float)

    @ti.func
    def sinc(self, x: ti.f64):
        """Return sin(x) / x."""
        s, _c = self.sin_cos(x)
        return s / x if x > 0 else ti.cast(1, ti.f64)

    @ti.func
    def sin_cos(self, x: ti.f64):
        """Return sine and cosine."""
        s, c = ti.cast(0, ti.f64), ti.cast(1, ti.f64)
        if ti.static(self.colliders.loads.on_cpu):
            s, c = ti.sin(x), ti.cos(x)
        else:
            s, c = sin_cos(x)
        return s, c

    # Quantities of a body.

    @ti.func
    def load_of(self, impulse: ti.template(), arm: ti.template()):
        """Return the result of `Loads.of` in double precision."""
        load = ti.Vector.zero(ti.f64, self.loads)
        for a in ti.static(range(self.dimension)):
            load[a] = impulse[a]
        if ti.static(self.dimension == 2):
            load[2] = arm[0] * impulse[1] - arm[1] * impulse[0]
        else:
            turning = arm.cross(impulse)
            for a in ti.static(range(3)):
                load[3 + a] = turning[a]
        return load

    @ti.func
    def velocity_at(self, b: int, arm: ti.template(), dt: ti.f64):
        """Return the mean velocity of a point of body b, now at an arm, over dt seconds, to second order."""
        spin, result = ti.Vector.zero(ti.f64, self.turns), ti.Vector.zero(ti.f64, self.dimension)
        for a in ti.static(range(self.turns)):
            spin[a] = self.rate[b, ti.static(self.dimension + a)]
        cross = self.crossed(spin)
        turning = cross @ (arm + 0.5 * dt * (cross @ arm))
        for a in ti.static(range(self.dimension)):
            result[a] = self.rate[b, a] + turning[a]
        return result

    @ti.func
    def spin(self, b: int):
        """Return the angular speed of body b, rad/s."""
        square = ti.cast(0, ti.f64)
        for a in ti.static(range(self.dimension, self.loads)):
            square += self.rate[b, a] ** 2
        return ti.sqrt(square)

    @ti.func
    def hit(self, b: int, impulse: ti.template(), arm: ti.template()):
        """Apply an impulse to body b at an arm from its centre."""
        load = self.load_of(impulse, arm)
        for a in ti.static(range(self.loads)):
            self.momentum[b, a] = self.momentum[b, a] + load[a]
            self.support[b, a] = self.support[b, a] + load[a]
        self.take_rate(b)

    @ti.func
    def yields(self, b: int, n: ti.template(), arm: ti.template()):
        """Return the increase of the velocity of body b along n per impulse along n at an arm, 1/kg."""
        load, result = self.load_of(n, arm), ti.cast(0, ti.f64)
        for a in ti.static(range(self.loads)):
            for c in ti.static(range(self.loads)):
                result += load[a] * self.mobility[b, a, c] * load[c]
        return result

    @ti.func
    def take_rate(self, b: int):
        """Set the rate of body b from its momentum."""
        for a in range(self.loads):
            rate = ti.cast(0, ti.f64)
            for c in range(self.loads):
                rate += self.mobility[b, a, c] * self.momentum[b, c]
            self.rate[b, a] = rate

    @ti.func
    def turned(self, b: int):
        """Return the rotation matrix of body b, (d, d)."""
        d = ti.static(self.dimension)
        result = ti.Matrix.zero(ti.f64, d, d)
        if ti.static(d == 2):
            s, c = self.sin_cos(self.pose[b, 2])
            result[0, 0], result[0, 1], result[1, 0], result[1, 1] = c, -s, s, c
        else:
            cross = self.crossed(ti.Vector([self.pose[b, 4 + a] for a in range(3)]))
            square = cross @ cross
            for a in ti.static(range(3)):
                for c in ti.static(range(3)):
                    own = 1.0 if ti.static(a == c) else 0.0
                    result[a, c] = own + 2.0 * (self.pose[b, 3] * cross[a, c] + square[a, c])
        return result

    @ti.func
    def crossed(self, v: ti.template()):
        """Return the matrix (d, d) that maps an arm to the velocity there for a spin of 1 or 3 components."""
        d = ti.static(self.dimension)
        result = ti.Matrix.zero(ti.f64, d, d)
        if ti.static(d == 2):
            result[0, 1], result[1, 0] = -v[0], v[0]
        else:
            for a in ti.static(range(3)):
                b, c = ti.static((a + 1) % 3), ti.static((a + 2) % 3)
                result[b, c], result[c, b] = -v[a], v[a]
        return result

    @ti.func
    def collider_of(self, run: int, j: int):
        """Return the index of the j-th body among the colliders of all runs."""
        return run * self.colliders.capacity + self.numbers[j]
