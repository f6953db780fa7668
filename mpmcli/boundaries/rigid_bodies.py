"""Colliders that move freely: their velocities are found together with those of the nodes in reach.

Each body has one velocity U, of its centre and its spin, with which its momentum and what the nodes give it agree:
M U = P + sum A^T J(U), where J are the impulses of `Colliders.met` and A maps U to the velocity at a node. Newton's
method finds it in rounds, of which each adds up the nodes row by row and then the rows in their order. Whatever it
finds, the body gets exactly what the nodes lose in the update. Sums, momenta and poses are in double precision.
"""

import numpy as np

from mpmcli.boundaries.colliders import HELD, LOOSE, REACH, Colliders
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene

# Most rounds of a step. A body is settled when a round would change less than this share of its energy with the nodes.
ROUNDS, SETTLED = 6, 1e-12
# Angle of a part of a turn in a step, rad, and most parts.
PART, MOST_PARTS = 1e-3, 100.0


@ti.data_oriented
class RigidBodies:
    """The colliders of some runs that move freely.

    Attributes:
        free: their indices among the colliders of a run; run: whose bodies are meant.
        pose: where their centres are, relative to the lower corner, m, and their angles, rad, or unit quaternions.
        momentum: and angular momentum about the centre. booked: what they took from the material since the last frame.
        rate: velocity and angular velocity, as the rounds of a step have found them so far.
        support: what walls and the like gave each in the last step; the rounds take it for what they give in this one.
        inertia, inverse: about the axes of the shape; yielding: the inverse about those of space, as it is turned now.
        axes: in 3D the principal axes of the shape, a column each, and behind them the moments about them.
        sums: impulses of nodes on each, and the matrix that says how they fall with its velocity, by rows of nodes.
    """

    def __init__(self, colliders: Colliders, runs: int) -> None:
        self.colliders, self.dimension, self.free = colliders, colliders.dimension, colliders.kind.free
        self.loads, self.turns, self.run = colliders.loads.width, 1 if colliders.dimension == 2 else 3, 0
        self.count, self.width = len(self.free), self.dimension + (1 if self.dimension == 2 else 4)
        self.entries = self.loads + self.loads * (self.loads + 1) // 2
        n = runs * self.count
        self.numbers = ti.field(int, shape=self.count)
        self.numbers.from_numpy(np.array(self.free, np.int32))
        self.pose = ti.field(ti.f64, shape=(n, self.width))
        self.momentum, self.rate, self.booked, self.support = (
            ti.field(ti.f64, shape=(n, self.loads)) for _ in range(4)
        )
        self.mass = ti.field(ti.f64, shape=n)
        self.inertia, self.inverse, self.yielding = (
            ti.Matrix.field(self.turns, self.turns, ti.f64, shape=n) for _ in range(3)
        )
        if self.dimension == 3:
            self.axes = ti.field(ti.f64, shape=(n, 4, 3))
        self.settled = ti.field(int, shape=n)
        self.sums = ti.Vector.field(self.entries, ti.f64, shape=n * colliders.loads.rows)
        # Of the equation of a round: its matrix, its right side, and the solution.
        self.system = ti.field(ti.f64, shape=(n, self.loads, self.loads + 2))

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the bodies of a run, at time 0."""
        d, origin = self.dimension, np.array(scene.domain.origin)
        for j, k in enumerate(self.free):
            collider, b = scene.colliders[k], run * self.count + j
            moments = collider.moments
            start = [*(np.array(moments.center) - origin), *([0.0] if d == 2 else [1.0, 0.0, 0.0, 0.0])]
            momentum = [*(moments.mass * np.array(collider.velocity)), *(moments.inertia @ collider.spin)]
            rows = ((self.pose, start), (self.momentum, momentum))
            for field, row in (*rows, *((field, [0.0] * self.loads) for field in (self.booked, self.support))):
                for a, value in enumerate(row):
                    field[b, a] = value
            self.mass[b] = moments.mass
            self.inertia[b] = moments.inertia.tolist()
            self.inverse[b] = self.yielding[b] = np.linalg.inv(moments.inertia).tolist()
            if d == 3:
                found, axes = np.linalg.eigh(moments.inertia)
                for (a, c), value in np.ndenumerate(np.vstack([axes, found])):
                    self.axes[b, a, c] = value

    @ti.func
    def sum_up(self, run: int, frame: int, column: int, notes: ti.template()):
        """Store poses and rates in notes[run, frame], from a column on; add what bodies took to the loads before it."""
        loads, room = ti.static((self.loads, self.colliders.room))
        for j in range(self.count):
            b = run * self.count + j
            self.take_rate(b)
            own, taken = column + j * ti.static(self.width + loads), column + (self.numbers[j] - room) * loads
            for a in range(self.width):
                notes[run, frame, own + a] = self.pose[b, a]
            for a in range(loads):
                notes[run, frame, own + ti.static(self.width) + a] = self.rate[b, a]
                notes[run, frame, taken + a] += self.booked[b, a]
                self.booked[b, a] = ti.cast(0, ti.f64)

    # A step.

    @ti.func
    def begin(self, run: int, dt: ti.f64, pull: ti.template()):
        """Begin a step of dt seconds, in which gravity changes velocities by pull, m/s: put the bodies in place."""
        d = ti.static(self.dimension)
        for j in range(self.count):
            b = run * self.count + j
            i = self.collider_of(run, j)
            turned = self.turned(b)
            for a in ti.static(range(d)):
                self.momentum[b, a] = self.momentum[b, a] + self.mass[b] * ti.cast(pull[a], ti.f64)
                self.colliders.place[i][a] = ti.cast(self.pose[b, a], float)
                for c in ti.static(range(d)):
                    self.colliders.turned[i][a, c] = ti.cast(turned[a, c], float)
            self.take_rate(b)
            self.show_rate(b, i, dt)
            self.settled[b] = 0

    @ti.func
    def near(self, node: ti.template(), axes: ti.template()):
        """Return 1 where a body that is not settled may act on a node, as far as the first axes tell, else 0."""
        x, near = self.colliders.place_of(node), 0
        for j in range(self.count):
            i = self.collider_of(self.run, j)
            own = 1 - self.settled[self.run * self.count + j]
            for a in ti.static(range(axes)):
                arm = x[a] - self.colliders.place[i][a]
                if arm < self.colliders.reach[i][0, a] or arm > self.colliders.reach[i][1, a]:
                    own = 0
            near = ti.max(near, own)
        return near

    @ti.func
    def meet(self, node: ti.template(), velocity: ti.template(), mass: float):
        """Add what a node with this velocity, m/s, and mass, kg, would give to each body."""
        d = ti.static(self.dimension)
        x, v = self.colliders.place_of(node), ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            v[a] = velocity[a]
        for j in range(self.count):
            b = self.run * self.count + j
            i = self.collider_of(self.run, j)
            arm = x - self.colliders.place[i]
            if self.settled[b] == 0 and self.colliders.covers(i, x):
                phi, normal = self.colliders.distance(i, arm, 0)
                if phi <= REACH * self.colliders.spacing:
                    after, grip = self.colliders.met(i, arm, normal, v)
                    if grip != LOOSE:
                        row = (
                            self.run * self.colliders.loads.rows + self.colliders.loads.row_of(node)
                        ) * self.count + j
                        load = self.colliders.loads.of(mass * (v - after), arm)
                        for a in ti.static(range(self.loads)):
                            self.sums[row][a] = self.sums[row][a] + ti.cast(load[a], ti.f64)
                        directions = 1
                        if grip == HELD:
                            directions += ti.static(d - 1)
                        for c in range(directions):
                            along = normal
                            if grip == HELD:
                                for a in ti.static(range(d)):
                                    along[a] = ti.cast(a == c, float)
                            self.resist(row, ti.cast(self.colliders.loads.of(along, arm), ti.f64), mass)

    @ti.func
    def resist(self, row: int, lever: ti.template(), mass: float):
        """Add the matrix of a node in a direction whose load is `lever` for an impulse of 1 N s."""
        for a in ti.static(range(self.loads)):
            for c in ti.static(range(a, self.loads)):
                at = ti.static(self.entry(a, c))
                self.sums[row][at] = self.sums[row][at] + ti.cast(mass, ti.f64) * lever[a] * lever[c]

    def entry(self, a: int, c: int) -> int:
        """Return where a sum has the entry (a, c) of the matrix, which is symmetric: its upper half behind the load."""
        low, high = min(a, c), max(a, c)
        return self.loads + low * self.loads - low * (low - 1) // 2 + high - low

    @ti.func
    def solve(self, run: int, dt: ti.f64):
        """End a round: change the velocity of each body by what the sums ask for."""
        d, n = ti.static((self.dimension, self.loads))
        for j in range(self.count):
            b = run * self.count + j
            if self.settled[b] == 0:
                i = self.collider_of(run, j)
                total = ti.Vector.zero(ti.f64, self.entries)
                low, rows = self.rows_near(i)
                for q in range(self.product(rows)):
                    row = (run * self.colliders.loads.rows + self.row_at(low, rows, q)) * self.count + j
                    total += self.sums[row]
                    for a in ti.static(range(self.entries)):
                        self.sums[row][a] = ti.cast(0, ti.f64)
                # Of the body alone.
                own = self.about_axes(b, self.inertia[b])
                for a in ti.static(range(n)):
                    self.system[b, a, n] = self.momentum[b, a] + self.support[b, a] + total[a]
                    for c in ti.static(range(n)):
                        inert = ti.cast(0, ti.f64)
                        if ti.static(a >= d and c >= d):
                            inert += own[ti.static(a - d), ti.static(c - d)]
                        elif ti.static(a == c):
                            inert += self.mass[b]
                        self.system[b, a, c] = inert + total[ti.static(self.entry(a, c))]
                        self.system[b, a, n] -= inert * self.rate[b, c]
                self.eliminate(b)
                self.show_rate(b, i, dt)

    @ti.func
    def eliminate(self, b: int):
        """Solve the system of body b, which is symmetric and positive; add the solution to its rate."""
        n = ti.static(self.loads)
        gain, energy = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for a in range(n):
            self.system[b, a, n + 1] = self.system[b, a, n]
            for c in range(n):
                energy += self.rate[b, a] * self.system[b, a, c] * self.rate[b, c]
        for k in range(n):
            for a in range(k + 1, n):
                factor = self.system[b, a, k] / self.system[b, k, k]
                for c in range(k, n):
                    self.system[b, a, c] -= factor * self.system[b, k, c]
                self.system[b, a, n + 1] -= factor * self.system[b, k, n + 1]
        for back in range(n):
            a = n - 1 - back
            for c in range(a + 1, n):
                self.system[b, a, n + 1] -= self.system[b, a, c] * self.system[b, c, n + 1]
            self.system[b, a, n + 1] /= self.system[b, a, a]
            gain += self.system[b, a, n] * self.system[b, a, n + 1]
        for a in range(n):
            self.rate[b, a] += self.system[b, a, n + 1]
        if gain <= SETTLED * energy:
            self.settled[b] = 1

    @ti.func
    def take(self, run: int):
        """Give the bodies what the nodes lost."""
        for j in range(self.count):
            b = run * self.count + j
            i = self.collider_of(run, j)
            for a in ti.static(range(self.loads)):
                self.support[b, a] = ti.cast(0, ti.f64)
            low, rows = self.rows_near(i)
            for q in range(self.product(rows)):
                row = (
                    run * self.colliders.loads.rows + self.row_at(low, rows, q)
                ) * self.colliders.room + self.numbers[j]
                for a in ti.static(range(self.loads)):
                    self.booked[b, a] += self.colliders.loads.taken[row][a]
                    self.momentum[b, a] += self.colliders.loads.taken[row][a]
                    self.colliders.loads.taken[row][a] = ti.cast(0, ti.f64)
            self.take_rate(b)

    @ti.func
    def move(self, run: int, dt: ti.f64):
        """End a step: move the bodies; return the square of their largest speed."""
        d = ti.static(self.dimension)
        fastest = 0.0
        for j in range(self.count):
            b = run * self.count + j
            i = self.collider_of(run, j)
            speed, spin = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
            for a in ti.static(range(d)):
                self.pose[b, a] += dt * self.rate[b, a]
                speed += self.rate[b, a] ** 2
            for a in ti.static(range(d, self.loads)):
                spin += self.rate[b, a] ** 2
            self.turn(b, dt)
            self.yielding[b] = self.about_axes(b, self.inverse[b])
            reached = ti.sqrt(speed) + ti.sqrt(spin) * ti.cast(self.colliders.reach[i][1, 0], ti.f64)
            fastest = ti.max(fastest, ti.cast(reached * reached, float))
        return fastest

    @ti.func
    def turn(self, b: int, dt: ti.f64):
        """Turn body b about its centre in dt seconds, in which its angular momentum stays.

        In 3D in parts, of each turns about the principal axes one after another (Dullweber, Leimkuhler and McLachlan
        1997): the energy swings by the square of an angle PART, and does not drift.
        """
        if ti.static(self.dimension == 2):
            self.pose[b, 2] += dt * self.rate[b, 2]
        else:
            q, square = ti.Vector([self.pose[b, 3 + a] for a in range(4)]), ti.cast(0, ti.f64)
            momentum = ti.Vector([self.momentum[b, 3 + a] for a in range(3)])
            for a in ti.static(range(3)):
                square += self.rate[b, 3 + a] ** 2
            parts = ti.cast(ti.min(ti.sqrt(square) * dt / PART, MOST_PARTS), int) + 1
            for _ in range(parts):
                for k in range(5):
                    c = 2 - ti.abs(2 - k)
                    axis = ti.Vector([self.axes[b, a, c] for a in range(3)])
                    half = 0.5 * dt / parts * momentum.dot(self.carried(q, axis)) / self.axes[b, 3, c]
                    if c < 2:
                        half *= 0.5
                    s = ti.sin(half)
                    q = self.product_of(q, ti.Vector([ti.cos(half), s * axis[0], s * axis[1], s * axis[2]]))
            q = q.normalized()
            for a in ti.static(range(4)):
                self.pose[b, 3 + a] = q[a]

    @ti.func
    def carried(self, q: ti.template(), v: ti.template()):
        """Return a vector turned by a unit quaternion."""
        u = ti.Vector([q[1], q[2], q[3]])
        side = 2.0 * u.cross(v)
        return v + q[0] * side + u.cross(side)

    @ti.func
    def product_of(self, p: ti.template(), q: ti.template()):
        """Return the product of two quaternions."""
        v, u = ti.Vector([p[1], p[2], p[3]]), ti.Vector([q[1], q[2], q[3]])
        w = p[0] * u + q[0] * v + v.cross(u)
        return ti.Vector([p[0] * q[0] - v.dot(u), w[0], w[1], w[2]])

    # Of a body.

    @ti.func
    def load_of(self, impulse: ti.template(), arm: ti.template()):
        """Return what `Loads.of` does, in double precision."""
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
    def velocity_at(self, b: int, arm: ti.template()):
        """Return the velocity of body b at an arm from its centre."""
        spin, result = ti.Vector.zero(ti.f64, self.turns), ti.Vector.zero(ti.f64, self.dimension)
        for a in ti.static(range(self.turns)):
            spin[a] = self.rate[b, ti.static(self.dimension + a)]
        turning = self.crossed(spin) @ arm
        for a in ti.static(range(self.dimension)):
            result[a] = self.rate[b, a] + turning[a]
        return result

    @ti.func
    def hit(self, b: int, impulse: ti.template(), arm: ti.template()):
        """Give body b an impulse at an arm from its centre."""
        load = self.load_of(impulse, arm)
        for a in ti.static(range(self.loads)):
            self.momentum[b, a] += load[a]
            self.support[b, a] += load[a]
        self.take_rate(b)

    @ti.func
    def yields(self, b: int, n: ti.template(), arm: ti.template()):
        """Return by how much the velocity of body b along n grows with an impulse along it at an arm, 1/kg."""
        inverse, load = self.yielding[b], self.load_of(n, arm)
        result = n.dot(n) / self.mass[b]
        for a in ti.static(range(self.turns)):
            for c in ti.static(range(self.turns)):
                result += load[ti.static(self.dimension + a)] * inverse[a, c] * load[ti.static(self.dimension + c)]
        return result

    @ti.func
    def collider_of(self, run: int, j: int):
        """Return the index of the j-th body among the colliders of all runs."""
        return run * self.colliders.room + self.numbers[j]

    @ti.func
    def turned(self, b: int):
        """Return the rotation of body b, (d, d)."""
        d = ti.static(self.dimension)
        result = ti.Matrix.zero(ti.f64, d, d)
        if ti.static(d == 2):
            c, s = ti.cos(self.pose[b, 2]), ti.sin(self.pose[b, 2])
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
        """Return the matrix (d, d) that maps an arm to the velocity there for a spin, of 1 or 3 numbers."""
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
    def about_axes(self, b: int, own: ti.template()):
        """Return an inertia, or its inverse, about the axes of space, of one about those of the shape of body b."""
        result = own
        if ti.static(self.dimension == 3):
            turned = self.turned(b)
            result = turned @ own @ turned.transpose()
        return result

    @ti.func
    def take_rate(self, b: int):
        """Let body b have the velocity that follows from its momentum."""
        d = ti.static(self.dimension)
        inverse = self.yielding[b]
        for a in ti.static(range(d)):
            self.rate[b, a] = self.momentum[b, a] / self.mass[b]
        for a in ti.static(range(self.turns)):
            spin = ti.cast(0, ti.f64)
            for c in ti.static(range(self.turns)):
                spin += inverse[a, c] * self.momentum[b, d + c]
            self.rate[b, d + a] = spin

    @ti.func
    def sinc(self, x: ti.f64):
        """Return sin(x) / x."""
        return ti.sin(x) / x if x > 0 else ti.cast(1, ti.f64)

    @ti.func
    def show_rate(self, b: int, i: int, dt: ti.f64):
        """Let nodes meet body b, which is collider i, with its rate: the chords of a step of dt seconds."""
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

    # Rows of nodes in reach.

    @ti.func
    def rows_near(self, i: int):
        """Return the first row that collider i may act on, and how many there are, per axis but the last."""
        d = ti.static(self.dimension)
        low, count = ti.Vector.zero(int, d - 1), ti.Vector.zero(int, d - 1)
        for a in ti.static(range(d - 1)):
            # One more on each side, whatever is rounded.
            begin = (self.colliders.place[i][a] + self.colliders.reach[i][0, a]) / self.colliders.spacing
            end = (self.colliders.place[i][a] + self.colliders.reach[i][1, a]) / self.colliders.spacing
            nodes = ti.static(self.colliders.shape[a])
            low[a] = ti.min(ti.max(ti.cast(ti.floor(begin), int) + self.colliders.first - 1, 0), nodes)
            count[a] = ti.max(ti.min(ti.cast(ti.ceil(end), int) + self.colliders.first + 2, nodes) - low[a], 0)
        return low, count

    @ti.func
    def product(self, count: ti.template()):
        result = count[0]
        for a in ti.static(range(1, self.dimension - 1)):
            result *= count[a]
        return result

    @ti.func
    def row_at(self, low: ti.template(), count: ti.template(), q: int):
        """Return the q-th of these rows."""
        row = low[0] + q
        if ti.static(self.dimension == 3):
            row = (low[0] + q // count[1]) * ti.static(self.colliders.shape[1]) + low[1] + q % count[1]
        return row
