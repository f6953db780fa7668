"""Free rigid bodies: their velocities are solved together with those of the nodes in reach.

The velocity U of a body satisfies M U = P + sum A^T J(U), where J are the impulses of `Colliders.met` and A maps U to
the velocity at a node. Newton's method solves this in rounds; each round sums over the nodes row by row, and then over
the rows in order. Converged or not, the body receives exactly the impulse that the nodes lose in the update; on a GPU
to single precision, because many nodes add to a row at once.
"""

from collections.abc import MutableMapping

import numpy as np

from mpmcli.boundaries.colliders import Colliders
from mpmcli.boundaries.doubles import double_field
from mpmcli.boundaries.feature import changed
from mpmcli.boundaries.rigid_motion import RigidMotion
from mpmcli.quick_taichi import ti

# Largest number of rounds of a step. A body is settled if a round changes less than this fraction of its energy with
# the nodes.
ROUNDS, SETTLED = 6, 1e-12


@ti.data_oriented
class RigidBodies(RigidMotion):
    """Rigid bodies coupled to the nodes of the grid.

    Attributes:
        sums: by rows of nodes, the impulses of the nodes on each body, and the matrix of their decrease with its
            velocity.
        total: sum of `sums` over all rows.
        entries: number of entries of each sum.
    """

    begins = True

    def __init__(self, colliders: Colliders, pushes: object, runs: int) -> None:
        super().__init__(colliders, pushes, runs)
        n = runs * self.count
        self.entries = self.loads + self.loads * (self.loads + 1) // 2
        self.sums = double_field(n * colliders.loads.rows, self.entries)
        self.total = double_field(n, self.entries)

    def viewed(self, view: object) -> "RigidBodies":
        return changed(self, run=view.w, colliders=view.features.colliders)

    @ti.func
    def begin_step(self, phases: ti.template(), run: ti.template(), step: ti.template()):
        self.begin(run.w, run.dt, step.kick, phases.gravity_of(step))

    @property
    def noted(self) -> int:
        return self.count * (self.width + 2 * self.loads)

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store pose, rate, and loads since the last frame, of each body."""
        loads, wide = ti.static((self.loads, self.width + self.loads))
        for j in range(self.count):
            b = run * self.count + j
            self.take_rate(b)
            own = column + j * ti.static(wide + loads)
            for a in range(self.width):
                frame_stats[run, frame, own + a] = self.pose[b, a]
            for a in range(loads):
                frame_stats[run, frame, own + ti.static(self.width) + a] = self.rate[b, a]
                frame_stats[run, frame, own + wide + a] = self.booked[b, a]
                self.booked[b, a] = ti.cast(0, ti.f64)

    def read(self, run: int) -> np.ndarray:
        own = slice(run * self.count, (run + 1) * self.count)
        momentum, mobility, booked = (one.to_numpy() for one in (self.momentum, self.mobility, self.booked))
        rates = (mobility[own] @ momentum[own][..., None])[..., 0]
        taken = booked[own].copy()
        booked[own] = 0.0
        self.booked.from_numpy(booked)
        return np.hstack([self.pose.to_numpy()[own], rates, taken]).ravel()

    def tell(self, values: np.ndarray, _run: int, found: MutableMapping[str, np.ndarray]) -> None:
        own = values.reshape(len(values), self.count, -1)
        found["rigid"] = own[..., : -self.loads]
        found["collider"][:, list(self.free)] += own[..., -self.loads :]

    # Rounds.

    @ti.func
    def resist(self, row: int, lever: ti.template(), mass: float):
        """Add the matrix of a node in one direction; `lever` is the load of an impulse of 1 N s in this direction."""
        for a in ti.static(range(self.loads)):
            for c in ti.static(range(a, self.loads)):
                at = ti.static(self.entry(a, c))
                self.sums[row, at] = self.sums[row, at] + ti.cast(mass, ti.f64) * lever[a] * lever[c]

    def entry(self, low: int, high: int) -> int:
        """Return the index in a sum of an entry of the symmetric matrix, whose upper triangle follows the load."""
        return self.loads + low * self.loads - low * (low - 1) // 2 + high - low

    @ti.func
    def solve(self, run: int, dt: ti.f64):
        """End a round: update the velocity of each body from the sums."""
        n = ti.static(self.loads)
        for j in range(self.count):
            b = run * self.count + j
            if self.settled[b] == 0:
                i = self.collider_of(run, j)
                for e in range(self.entries):
                    self.total[b, e] = 0
                low, rows = self.rows_near(i)
                for q in range(self.product(rows)):
                    row = (run * self.colliders.loads.rows + self.row_at(low, rows, q)) * self.count + j
                    for e in range(self.entries):
                        self.total[b, e] = self.total[b, e] + self.sums[row, e]
                        self.sums[row, e] = 0
                self.set_inertia(b)
                for a in range(n):
                    lacked = self.momentum[b, a] + self.support[b, a] + self.total[b, a]
                    for c in range(n):
                        lacked -= self.system[b, a, c] * self.rate[b, c]
                    self.system[b, a, n] = lacked
                # The upper triangle of the matrix follows the load row by row.
                e = n
                for a in range(n):
                    for c in range(a, n):
                        self.system[b, a, c] = self.system[b, a, c] + self.total[b, e]
                        self.system[b, c, a] = self.system[b, a, c]
                        e += 1
                self.improve(b, dt)
                self.show_rate(b, i, dt)

    @ti.func
    def improve(self, b: int, dt: ti.f64):
        """Solve the system of body b for the correction of its rate, and add it; include the impulse of a motor."""
        n, ways = ti.static(self.loads), self.left[b]
        self.reduce(b)
        for k in range(ways):
            right = ti.cast(0, ti.f64)
            for a in range(n):
                right += self.ways[b, a, k] * self.system[b, a, n]
            self.reduced[b, k, ways] = right
        # A body with a motor has one degree of freedom, and its system is a scalar.
        resisted, lacked = self.reduced[b, 0, 0], self.reduced[b, 0, ways]
        if self.strength[b] > 0:
            wanted = resisted * (self.motor[b] - self.rate_of(b)) - lacked
            self.reduced[b, 0, 1] = self.reduced[b, 0, 1] + self.clamped(b, dt, wanted)
        driven = self.reduced[b, 0, ways] - lacked
        self.eliminate(b, 1)
        gain, energy = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for a in range(n):
            for c in range(n):
                energy += self.rate[b, a] * self.system[b, a, c] * self.rate[b, c]
        for k in range(ways):
            found = self.reduced[b, k, ways]
            for a in range(n):
                gain += found * self.ways[b, a, k] * self.system[b, a, n]
                self.rate[b, a] = self.rate[b, a] + self.ways[b, a, k] * found
        gain += self.reduced[b, 0, ways] * driven
        if gain <= SETTLED * energy:
            self.settled[b] = 1

    @ti.func
    def take(self, run: int, dt: ti.f64):
        """Add the impulses that the nodes lost to the momenta of the bodies, and those of their motors."""
        for j in range(self.count):
            b = run * self.count + j
            for a in ti.static(range(self.loads)):
                self.support[b, a] = ti.cast(0, ti.f64)
            self.absorb(run, j)
            self.drive[b] = 0
            self.turn_motor(b, dt)

    @ti.func
    def absorb_all(self, run: int, dt: ti.f64):
        """Add the impulses that the nodes lost so far to the momenta of the bodies; a step may bring more."""
        for j in range(self.count):
            b = run * self.count + j
            self.absorb(run, j)
            self.show_rate(b, self.collider_of(run, j), dt)
            self.settled[b] = 0

    @ti.func
    def absorb(self, run: int, j: int):
        """Add the impulses that the nodes lost to the momentum of the j-th body, and forget them."""
        b, i = run * self.count + j, self.collider_of(run, j)
        low, rows = self.rows_near(i)
        push = ti.Vector.zero(ti.f64, self.dimension)
        for q in range(self.product(rows)):
            row = (run * self.colliders.loads.rows + self.row_at(low, rows, q)) * self.colliders.capacity
            row += self.numbers[j]
            for a in ti.static(range(self.loads)):
                self.booked[b, a] = self.booked[b, a] + self.colliders.loads.taken[row][a]
                self.momentum[b, a] = self.momentum[b, a] + self.colliders.loads.taken[row][a]
                if ti.static(a < self.dimension):
                    push[a] += self.colliders.loads.taken[row][a]
                self.colliders.loads.taken[row][a] = 0.0
        if self.hinged[b] == 1:
            # The torque about the hinge, which is that about the centre and this one.
            arm = ti.Vector.zero(ti.f64, self.dimension)
            for a in ti.static(range(self.dimension)):
                arm[a] = self.pose[b, a] - self.hinge[b][0, a]
            load = self.load_of(push, arm)
            for a in ti.static(range(self.dimension, self.loads)):
                self.booked[b, a] = self.booked[b, a] + load[a]
        self.take_rate(b)

    # Rows of nodes in reach.

    @ti.func
    def rows_near(self, i: int):
        """Return the first row that collider i may act on, and the number of rows, per axis except the last."""
        d = ti.static(self.dimension)
        low, count = ti.Vector.zero(int, d - 1), ti.Vector.zero(int, d - 1)
        for a in ti.static(range(d - 1)):
            # One more on each side for rounding.
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
        """Return the index of the q-th of these rows."""
        row = low[0] + q
        if ti.static(self.dimension == 3):
            row = (low[0] + q // count[1]) * ti.static(self.colliders.shape[1]) + low[1] + q % count[1]
        return row
