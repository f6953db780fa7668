"""Contact of bodies with velocity fields of their own: impulses at the nodes that two of them reach.

At a node the surface of each body is a distance along an axis, by the logarithm of a sum of exponentials over the
points of the surface around. Of three axes, the mean of both normals and the normals of the faces that it meets, that
of the largest gap separates them. The impulse is that of a spring on the gap, by backward Euler, and Coulomb's
friction. See docs/theory.md, 2.8.
"""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.materials.elementary import exp, log
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import lattice_spacing
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.contact.surfaces import BodySurfaces
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.sort import TileOrder, stay_rolled
from mpmcli.solver.transfer.lanes import LANES, zero_lanes
from mpmcli.solver.transfer.splines import PAD, bounded

# Radius of the ball of a surface point, cells: what lies aside counts as farther away, as the front of a ball would.
BALL = 3.0
# Sharpness of the soft minimum of distances, per distance of particles.
SHARP = 12.0
# Sharpness of the mean normal of the faces that an axis meets. Bodies whose normals have a larger product look the same
# way, and not at each other.
FACING, ALIKE = 16.0, 0.7
# Differences of gaps over which axes are blended, and the overlap beyond which the push stays the same, cells.
BLEND, DEEPEST = 0.02, 1.0
# Exponents beyond which single precision has no number; in place of 0 where it divides, or its logarithm is taken.
LARGEST, SMALLEST = 80.0, 1e-37
# The gap of bodies of which one shows no surface, cells: they do not meet.
APART = 9.0
# Numbers of a layer: P-wave modulus, Pa, sharpness, 1/m, factor of a sum over a flat surface, distance of particles, m,
# density, kg/m^3, and from FRICTION on the coefficient of friction with each layer, `STICKS` for one that sticks.
MODULUS, SHARPNESS, FLAT, DISTANCE, DENSITY, FRICTION = range(6)


@ti.data_oriented
class BodyContact:
    """What the bodies of a batch do to each other; w is the number of a run.

    Attributes:
        surfaces: what they show; layers: of each run; room: surface points near a node, of each body.
        rows: of each layer of each run its numbers, see MODULUS.
        points: of each thread and of two bodies, row by row, of surface points near a node the way to it, m, by how
            much farther away than along an axis they count, m, their normals and their weights; of the second body ways
            and normals with the opposite sign.
    """

    def __init__(
        self,
        groups: Sequence[ParticleArrays],
        orders: Sequence[TileOrder],
        grid: Grid,
        layers: Layers,
        runs: int,
        threads: int,
    ) -> None:
        self.surfaces = BodySurfaces(groups, orders, grid, layers, runs)
        self.dimension, self.layers, self.node_count = grid.dimension, layers.count, grid.node_count
        # Two layers of particles, at four times the density of those at rest.
        self.room = 8 * math.ceil((grid.scheme.spline.nodes * layers.per_axis) ** (grid.dimension - 1))
        self.rows = ti.field(float, shape=(runs * layers.count, FRICTION + layers.count))
        self.share = (2 * grid.dimension + 2) * self.room
        self.points = ti.field(float, shape=2 * max(runs, threads) * self.share + LANES)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set what a run has: its bodies, and the friction between them."""
        layers, h = Layers.of(scene), scene.domain.spacing
        self.surfaces.count[run] = layers.count
        rows = np.zeros((layers.count, FRICTION))
        for source, layer in enumerate(layers.numbers):
            if layers.has_own(source):
                material, distance = scene.sources[source].material, lattice_spacing(scene.sources[source], h)
                beta = SHARP / distance
                width = math.sqrt(2 * math.pi * BALL * h / beta) / distance
                modulus = material.lame_lambda + 2 * material.shear_modulus
                rows[layer] = [modulus, beta, width ** (1 - self.dimension), distance, material.density]
        for layer, row in enumerate(np.hstack([rows, layers.frictions(scene)])):
            for k, number in enumerate(row):
                self.rows[run * self.layers + layer, k] = number

    @ti.func
    def exchange_rows(self, grid: ti.template(), w: int, thread: int, first: int, after: int, dt: float):
        """Let bodies exchange momentum at rows of nodes of the box, in a step of dt seconds."""
        last = ti.static(self.dimension - 1)
        for row in range(first, after):
            node = grid.row_start(row)
            index = grid.linear_index(node)
            for _ in range(grid.row_length(node)):
                # Layers in descending order.
                rest = self.surfaces.present[self.surfaces.place_of(grid, w, index)]
                while rest > 255:
                    c, others = ti.cast(rest & 255, int) - 1, rest >> 8
                    while others > 0:
                        self.exchange(grid, w, thread, node, index, ti.cast(others & 255, int) - 1, c, dt)
                        others = others >> 8
                    rest = rest >> 8
                node[last] += 1
                index += 1

    @ti.func
    def exchange(
        self, grid: ti.template(), w: int, thread: int, node: ti.template(), index: int, a: int, c: int, dt: float
    ):
        """Let layers a and c exchange momentum at a node, which has a linear index in layer 0."""
        d = ti.static(self.dimension)
        at_a, at_c = index + a * ti.static(self.node_count), index + c * ti.static(self.node_count)
        m_a, m_c = grid.nodes[at_a][d], grid.nodes[at_c][d]
        # In this order: the product of two masses may be too small for single precision.
        reduced, friction = m_a * (m_c / (m_a + m_c)), self.rows[w * self.layers + a, FRICTION + c]
        u, J = ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        for b in ti.static(range(d)):
            u[b] = grid.nodes[at_c][b] / m_c - grid.nodes[at_a][b] / m_a
        if friction < 0.0:
            for b in ti.static(range(d)):
                J[b] = -reduced * u[b]
        else:
            gap, middle, n = self.separation(grid, w, thread, node, index, a, c)
            if gap < APART * grid.spacing:
                pushed = self.impulse(grid, w, a, c, friction, gap, middle, n, u, reduced, dt)
                for b in ti.static(range(d)):
                    J[b] = pushed[b]
        for b in ti.static(range(d)):
            grid.nodes[at_a][b] -= J[b]
            grid.nodes[at_c][b] += J[b]

    @ti.func
    def impulse(
        self,
        grid: ti.template(),
        w: int,
        a: int,
        c: int,
        friction: float,
        gap: float,
        middle: float,
        n: ti.template(),
        u: ti.template(),
        reduced: float,
        dt: float,
    ):
        """Return the impulse that layer c gets and layer a gives at a node, N s.

        gap, middle, n: see `separation`; u: velocity of c relative to a, m/s; reduced: m_a m_c / (m_a + m_c), kg.
        """
        h, d, row = ti.static((grid.spacing, self.dimension, w * self.layers))
        away, weight = u.dot(n), spline(middle * grid.inverse_spacing)
        modulus = 2.0 / (1.0 / self.rows[row + a, MODULUS] + 1.0 / self.rows[row + c, MODULUS])
        # As much as nodes on flat faces that touch have: those with less, and that is at edges, push less.
        mass = 0.5 * h**d / (1.0 / self.rows[row + a, DENSITY] + 1.0 / self.rows[row + c, DENSITY])
        kappa = modulus * h ** ti.static(d - 2) * weight * dt**2 / ti.max(reduced, mass)
        push = reduced * ti.max(0.0, -away - ti.max(gap, -DEEPEST * h) / dt) * kappa / (1.0 + kappa)
        along = u - away * n
        slip, rub = along.norm(), 0.0
        if slip > 0.0:
            rub = ti.min(friction * push, reduced * slip) / slip
        return push * n - rub * along

    @ti.func
    def separation(self, grid: ti.template(), w: int, thread: int, node: ti.template(), index: int, a: int, c: int):
        """Return the gap of two bodies at a node, m, how far it is from their middle, m, and the normal from a to c."""
        h, d, row = ti.static((grid.spacing, self.dimension, w * self.layers))
        gap, middle, normal = APART * h, 0.0, ti.Vector.zero(float, d)
        n_a, n_c, counts = self.collect(grid, w, thread, node, index, a, c)
        if counts.min() > 0 and n_a.dot(n_c) < ALIKE:
            axes, gaps, mean = ti.Matrix.zero(float, 4, d), ti.Vector.zero(float, 3), (n_a - n_c).normalized(SMALLEST)
            for side in range(2):
                stay_rolled(self.points, thread + side)
                met = self.normal_along((2 * thread + side) * self.share, counts[side], mean)
                for b in ti.static(range(d)):
                    axes[side, b], axes[2, b] = met[b], mean[b]
            for j in range(4):
                stay_rolled(self.points, thread + j)
                axis, far = ti.Vector.zero(float, d), ti.Vector.zero(float, 2)
                for b in ti.static(range(d)):
                    axis[b] = axes[j, b]
                for side in range(2):
                    stay_rolled(self.points, thread + side)
                    layer = row + ti.select(side == 0, a, c)
                    first, beta = (2 * thread + side) * self.share, self.rows[layer, SHARPNESS]
                    inverse_width = ti.static(0.5 / BALL) * grid.inverse_spacing
                    total = self.sum_points(first, counts[side], axis, beta, inverse_width)
                    far[side] = -log(ti.max(total * self.rows[layer, FLAT], SMALLEST)) / beta
                gap, middle = far[0] + far[1], 0.5 * (far[0] - far[1])
                if j < 3:
                    gaps[j] = gap
                if j == 2:
                    # Blended, so that nothing jumps where another axis becomes the best.
                    best, blend = gaps.max(), ti.Vector.zero(float, d)
                    for i in range(3):
                        share = exp(ti.max((gaps[i] - best) * grid.inverse_spacing / BLEND, -LARGEST))
                        for b in ti.static(range(d)):
                            blend[b] += share * axes[i, b]
                    normal = blend.normalized(SMALLEST)
                    for b in ti.static(range(d)):
                        axes[3, b] = normal[b]
        return gap, middle, normal

    @ti.func
    def collect(self, grid: ti.template(), w: int, thread: int, node: ti.template(), index: int, a: int, c: int):
        """Store the surface points of two layers near a node; return their outward normals, and how many points."""
        h, d = ti.static((grid.spacing, self.dimension))
        n_a, n_c, counts = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(int, 2)
        place = self.surfaces.place_of(grid, w, index)
        for q in range(ti.static(grid.scheme.spline.nodes**d)):
            before, inside = self.surfaces.stencil_before(grid, node, q)
            if inside:
                for g in ti.static(self.surfaces.surfaced):
                    p = self.surfaces.first[g][place - before]
                    while p >= 0:
                        layer = self.surfaces.shown[g][p]
                        side = ti.select(layer == a, 0, ti.select(layer == c, 1, -1))
                        if side >= 0:
                            outwards = ti.select(side == 0, 1.0, -1.0)
                            n, way, weight = ti.Vector.zero(float, d), ti.Vector.zero(float, d), 1.0
                            for b in ti.static(range(d)):
                                way[b] = ti.cast(node[b] - PAD, float) * h - self.surfaces.groups[g].x[p][b]
                                n[b] = self.surfaces.surface[g][p][b]
                                weight *= spline(way[b] * grid.inverse_spacing)
                            if side == 0:
                                n_a += weight * n
                            else:
                                n_c += weight * n
                            depth = self.surfaces.surface[g][p][d]
                            near = depth < self.rows[w * self.layers + layer, DISTANCE]
                            if near and counts[side] < self.room:
                                way -= depth * n
                                at = (2 * thread + side) * self.share + counts[side]
                                for b in ti.static(range(d)):
                                    self.points[at + b * self.room] = outwards * way[b]
                                    self.points[at + ti.static(d + 1 + b) * self.room] = outwards * n[b]
                                self.points[at + d * self.room] = way.norm_sqr() / (2.0 * BALL * h)
                                self.points[at + ti.static(2 * d + 1) * self.room] = weight
                                counts[side] += 1
                        p = self.surfaces.following[g][p]
        return n_a.normalized(SMALLEST), n_c.normalized(SMALLEST), counts

    @ti.func
    def sum_points(self, first: int, count: int, axis: ti.template(), beta: float, inverse_width: float):
        """Return the sum of exponentials of the distances of a node from surface points along an axis, outwards."""
        d = ti.static(self.dimension)
        total, begin = 0.0, 0
        while begin < count:
            points, found = zero_lanes(ti.static(d + 1)), ti.Vector.zero(float, LANES)
            self.load(first + begin, points)
            for lane in range(LANES):
                along = 0.0
                for b in ti.static(range(d)):
                    along += points[b, lane] * axis[b]
                far = along - along * along * inverse_width + points[d, lane]
                found[lane] = exp(ti.min(ti.max(-beta * far, -LARGEST), LARGEST))
            for lane in range(ti.min(LANES, count - begin)):
                total += found[lane]
            begin += LANES
        return total

    @ti.func
    def normal_along(self, first: int, count: int, axis: ti.template()):
        """Return the mean normal of the surface points that look along an axis most."""
        d = ti.static(self.dimension)
        total, begin = ti.Vector.zero(float, d), 0
        while begin < count:
            points, found = zero_lanes(ti.static(d + 1)), ti.Vector.zero(float, LANES)
            self.load(first + ti.static(d + 1) * self.room + begin, points)
            for lane in range(LANES):
                along = -1.0
                for b in ti.static(range(d)):
                    along += points[b, lane] * axis[b]
                found[lane] = points[d, lane] * exp(ti.max(FACING * along, -LARGEST))
            for lane in range(ti.min(LANES, count - begin)):
                for b in ti.static(range(d)):
                    total[b] += found[lane] * points[b, lane]
            begin += LANES
        return total.normalized(SMALLEST)

    @ti.func
    def load(self, origin: int, points: ti.template()):
        """Copy some rows of LANES surface points."""
        first = bounded(origin)
        for k in ti.static(range(points.n)):
            for lane in range(LANES):
                points[k, lane] = self.points[first + k * self.room + lane]


@ti.func
def spline(r: float):
    """Return the quadratic spline at r cells from its node."""
    far = ti.abs(r)
    beyond = ti.max(1.5 - far, 0.0)
    return ti.select(far < 0.5, 0.75 - far**2, 0.5 * beyond**2)
