"""Contact of bodies with their own velocity fields: impulses at nodes shared by two bodies or by a body and a wall.

At a node the surface of each body is represented by its distance along an axis: the logarithm of a sum of exponentials
over nearby points of the surface. The candidates for the axis are the mean of both normals and the normal of each face
that faces the other body; the axis with the largest gap separates the bodies. The impulse is that of a spring on the
gap, by backward Euler, with Coulomb friction. See docs/theory.md, 2.8.
"""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.rows import Rows
from mpmcli.materials.elementary import exp, log
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import lattice_spacing
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.contact.surfaces import FAR, REACH, BodySurfaces, place_of
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.sort import TileOrder, stay_rolled
from mpmcli.solver.transfer.lanes import LANES, zero_lanes
from mpmcli.solver.transfer.splines import PAD, bounded

# Radius of the ball of a surface point, cells: points off the axis count as farther away, like the front of a ball.
BALL = 3.0
# Sharpness of the soft minimum of distances, per particle spacing.
SHARP = 12.0
# Sharpness of the mean normal of the faces that face another body. Bodies whose normals have a product above ALIKE face
# the same direction and not each other.
FACING, ALIKE = 16.0, 0.7
# Products of normals above which only one axis is evaluated: of the faces of two bodies, and of an obstacle.
SAME, SMOOTH = 0.999, 0.9
# Difference of gaps over which axes are blended, and overlap beyond which the push is constant, cells.
BLEND, DEEPEST = 0.02, 0.3
# Range of overlaps, cells, over which the approach of bodies is increasingly stopped, independent of the spring.
STOPS = (0.1, 0.2)
# Fraction of the mass of a node at touching flat faces, above which overlaps and gaps of a node are recorded.
LIGHT = 0.1
# Reach of the search for further points of an obstacle near its nearest point, cells.
FAR_ASIDE = 3.0
# Largest exponent in single precision, and a number that replaces 0 in divisors and logarithms.
LARGEST, SMALLEST = 80.0, 1e-37
# Gap, cells, if one of the bodies has no surface here: they are not in contact.
APART = 9.0
# Number of GPU threads for the nodes of all runs, limited because each needs memory for surface points, and smallest
# number per run.
GPU_THREADS, LEAST_THREADS = 4096, 64
# Numbers of a layer: P-wave modulus, Pa, sharpness, 1/m, normalisation of the sum over a flat surface, density, kg/m^3,
# and from FRICTION on the coefficient of friction with each layer, `STICKS` for sticking.
MODULUS, SHARPNESS, FLAT, DENSITY, FRICTION = range(5)
# Entries of `LedgerRow`, see `BodyContact.extremes`.
EXTREMES = ("contact_overlap", "contact_gap")


@ti.data_oriented
class BodyContact:
    """Contact of the bodies of a batch with each other and with obstacles; w is the index of a run.

    Attributes:
        surfaces: surfaces of the bodies.
        layers: number of layers per run.
        capacity: largest number of surface points of a body near a node.
        rows: numbers of each layer of each run, see MODULUS.
        threads: threads of a run on a GPU.
        loads: loads on the first layer of each pair by the second, about the lower corner, see `Layers.pairs`.
        extremes: per run, the deepest overlap and the largest gap with a push since the last frame, cells.
        points: surface points of two bodies near a node, per thread, row by row: vector to the node, m, additional
            distance for being off the axis, m, normal, and weight; vectors and normals of the second body have the
            opposite sign.
    """

    def __init__(
        self,
        groups: Sequence[ParticleArrays],
        orders: Sequence[TileOrder],
        grid: Grid,
        layers: Layers,
        runs: int,
        threads: int,
        *,
        on_cpu: bool,
    ) -> None:
        self.surfaces = BodySurfaces(groups, orders, grid, layers, runs, on_cpu=on_cpu)
        self.dimension, self.layers, self.node_count = grid.dimension, layers.count, grid.node_count
        self.capacity = points_near(grid.scheme.spline.nodes, layers, grid.dimension)
        self.rows = ti.field(float, shape=(runs * layers.count, FRICTION + layers.count))
        self._rows, self._count = Rows(self.rows, self.surfaces.band), Rows(self.surfaces.count)
        self.pairs, self.loads = layers.pairs, Loads(max(1, layers.pairs), grid.shape, runs, on_cpu=on_cpu)
        self.extremes = ti.field(float, shape=(runs, len(EXTREMES)))
        self.share = (2 * grid.dimension + 2) * self.capacity
        self.threads = max(LEAST_THREADS, GPU_THREADS // runs)
        at_once = max(runs, threads) if on_cpu else runs * self.threads
        self.points = ti.field(float, shape=2 * at_once * self.share + LANES)

    @staticmethod
    def gpu_bytes(stencil: int, layers: Layers, dimension: int, real: int) -> int:
        """Return the bytes of surface points on a GPU, for stencils with `stencil` nodes per axis."""
        return 2 * GPU_THREADS * (2 * dimension + 2) * points_near(stencil, layers, dimension) * real

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the numbers of the layers of a run, and the friction between them."""
        layers, h = Layers.of(scene), scene.domain.spacing
        self._count.write(run, [layers.count])
        rows, bands = np.zeros((layers.count, FRICTION)), np.zeros(layers.count)
        for source, layer in enumerate(layers.numbers):
            if layers.has_own(source):
                material, distance = scene.sources[source].material, lattice_spacing(scene.sources[source], h)
                beta = SHARP / distance
                width = math.sqrt(2 * math.pi * BALL * h / beta) / distance
                modulus = material.lame_lambda + 2 * material.shear_modulus
                rows[layer] = [modulus, beta, width ** (1 - self.dimension), material.density]
                bands[layer] = distance
        self._rows.write(run * self.layers, np.hstack([rows, layers.frictions(scene)]), bands)

    def read(self, run: int) -> dict[str, np.ndarray]:
        """Return the loads and the extremes of a run since the last frame, on a GPU, and reset them."""
        extremes = self.extremes.to_numpy()
        found = {"contact": self.loads.read(run, self.pairs)} | dict(zip(EXTREMES, extremes[run], strict=True))
        extremes[run] = 0.0
        self.extremes.from_numpy(extremes)
        return found

    @ti.func
    def sum_up(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the loads and then the extremes of a frame, from a column on, and reset them."""
        self.loads.sum_up(run, frame, column, frame_stats)
        for k in ti.static(range(len(EXTREMES))):
            frame_stats[run, frame, column + ti.static(self.loads.capacity * self.loads.width) + k] = self.extremes[
                run, k
            ]
            self.extremes[run, k] = 0.0

    @ti.func
    def exchange_rows(
        self,
        grid: ti.template(),
        obstacles: ti.template(),
        w: int,
        thread: int,
        first: int,
        after: int,
        dt: float,
        gravity_step: ti.template(),
    ):
        """Exchange momentum between bodies, then with obstacles, at rows `first` to `after` - 1 of the contact box.

        `dt` is the step, s; `gravity_step` is the change of velocity by gravity in the step, m/s.
        """
        last = ti.static(self.dimension - 1)
        for row in range(first, after):
            node = grid.row_start(row)
            index = grid.linear_index(node)
            for _ in range(grid.row_length(node)):
                self.exchange_all(grid, obstacles, w, thread, node, index, dt, gravity_step)
                node[last] += 1
                index += 1

    @ti.func
    def exchange_all(
        self,
        grid: ti.template(),
        obstacles: ti.template(),
        w: int,
        thread: int,
        node: ti.template(),
        index: int,
        dt: float,
        gravity_step: ti.template(),
    ):
        """Exchange momentum between bodies, and then with obstacles, at a node with this index in layer 0."""
        place = self.surfaces.place_of(grid, w, index)
        present = self.surfaces.present[place]
        # Layers in descending order: first all pairs of layers, then each layer with the obstacles, numbered after the
        # layers.
        for turn in range(ti.select(self.surfaces.met[place] > 1, 2, 1)):
            rest = present
            while rest > 255 or (turn == 1 and rest > ti.static(int(self.surfaces.shares))):
                c, others, o = ti.cast(rest & 255, int) - 1, rest >> 8, 0
                while (turn == 0 and others > 0) or (turn == 1 and o < obstacles.count()):
                    a = ti.select(turn == 0, ti.cast(others & 255, int) - 1, c)
                    met = ti.select(turn == 0, c, self.layers + o)
                    self.exchange(grid, obstacles, w, thread, node, index, a, met, dt, gravity_step)
                    others, o = others >> 8, o + 1
                rest = rest >> 8

    @ti.func
    def exchange(
        self,
        grid: ti.template(),
        obstacles: ti.template(),
        w: int,
        thread: int,
        node: ti.template(),
        index: int,
        a: int,
        c: int,
        dt: float,
        gravity_step: ti.template(),
    ):
        """Exchange momentum of layer a with layer c, or obstacle c - layers, at a node with this index in layer 0."""
        h, d, row = ti.static((grid.spacing, self.dimension, w * self.layers))
        at_a, at_c = index + a * ti.static(self.node_count), index + c * ti.static(self.node_count)
        of_a = self.surfaces.total(grid, node, index, a * ti.static(self.node_count))
        m_a, bodies, way, agree = of_a[d], c < self.layers, FAR, 0.0
        reduced, friction, known = m_a, 0.0, True
        # The sum of the inverse moduli of both.
        soft = 1.0 / self.rows[row + a, MODULUS]
        u, J, facing = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        if bodies:
            of_c = self.surfaces.total(grid, node, index, c * ti.static(self.node_count))
            m_c = of_c[d]
            # Evaluated in this order, because the product of two masses may be too small for single precision.
            reduced, friction = m_a * (m_c / (m_a + m_c)), self.rows[row + a, FRICTION + c]
            soft += 1.0 / self.rows[row + c, MODULUS]
            for b in ti.static(range(d)):
                u[b] = of_c[b] / m_c - of_a[b] / m_a
        if ti.static(obstacles.any):
            if not bodies:
                distance, normal, velocity, rough, same = self.collect_obstacle(
                    obstacles, thread, c - self.layers, place_of(node, h)
                )
                way, friction, agree = distance, rough, same
                for b in ti.static(range(d)):
                    facing[b] = normal[b]
                    u[b] = velocity[b] - gravity_step[b] - of_a[b] / m_a
        if friction < 0.0:
            for b in ti.static(range(d)):
                J[b] = -reduced * u[b]
        elif bodies or way < REACH * h:
            gap, middle, n, aside = self.separation(grid, w, thread, node, index, a, c, facing, agree)
            if gap >= APART * h and way <= 0.0:
                # Material without a surface, because it was torn or crushed, is stopped behind an obstacle.
                gap, middle, n, aside, known = -h, gap, -facing, 0.0 * facing, False
            if gap < APART * h:
                # Mass of such a node at flat faces. Nodes with less mass, which are at edges, push less.
                light = 1.0 / (self.rows[row + a, DENSITY] * filled((0.5 * gap + middle) * grid.inverse_spacing))
                if bodies:
                    light += 1.0 / (self.rows[row + c, DENSITY] * filled((0.5 * gap - middle) * grid.inverse_spacing))
                mass = ti.max(reduced, h**d / light)
                kappa = 2.0 / soft * h ** ti.static(d - 2) * traction(middle * grid.inverse_spacing) * dt**2 / mass
                pushed = self.impulse(gap / h, u, n, aside, kappa, reduced, h / dt, friction)
                for b in ti.static(range(d)):
                    J[b] = pushed[b]
                # Nodes with very little mass, beside edges, do not represent a surface and are not recorded.
                if known and pushed.dot(n) > 0.0 and reduced > LIGHT * mass:
                    for k, reached in ti.static(enumerate((-gap / h, gap / h))):
                        # Most values are not extremes, and atomic operations are slow.
                        if reached > self.extremes[w, k]:
                            ti.atomic_max(self.extremes[w, k], reached)
        for b in ti.static(range(d)):
            grid.nodes[at_a][b] -= J[b]
            if bodies:
                grid.nodes[at_c][b] += J[b]
        if ti.abs(J).max() > 0.0:
            if bodies:
                self.loads.take(w, node, ti.raw_div(c * (c - 1), 2) + a, -J, place_of(node, h))
            elif ti.static(obstacles.any):
                obstacles.take(c - self.layers, node, place_of(node, h), J)

    @ti.func
    def impulse(
        self,
        gap: float,
        u: ti.template(),
        n: ti.template(),
        aside: ti.template(),
        kappa: float,
        reduced: float,
        speed: float,
        friction: float,
    ):
        """Return the impulse from a to c at a node, N s.

        Args:
            gap: gap, cells.
            u: velocity of c relative to a, m/s.
            n, aside: see `separation`.
            kappa: k dt^2 / m of the spring.
            reduced: m_a m_c / (m_a + m_c), kg.
            speed: speed of one cell per step, m/s.
            friction: coefficient of friction.
        """
        away = u.dot(n)
        push = ti.max(0.0, -away - ti.max(gap, -DEEPEST) * speed) * kappa / (1.0 + kappa)
        # Approach that is too fast for the spring is stopped.
        push = reduced * ti.max(push, -away * ti.min(ti.max((-gap - STOPS[0]) / (STOPS[1] - STOPS[0]), 0.0), 1.0))
        along = u + aside
        along -= along.dot(n) * n
        slip, rub = along.norm(), 0.0
        if slip > 0.0:
            rub = ti.min(friction * push, reduced * slip) / slip
        return push * n - rub * along

    @ti.func
    def separation(
        self,
        grid: ti.template(),
        w: int,
        thread: int,
        node: ti.template(),
        index: int,
        a: int,
        c: int,
        facing: ti.template(),
        agree: float,
    ):
        """Return the gap between layers a and c at a node, and the geometry of the contact.

        Args:
            a: layer of a body.
            c: layer of another body, or number of an obstacle whose points were collected.
            facing, agree: results of `collect_obstacle` for an obstacle.

        Returns:
            gap: the gap, m.
            middle: distance of the node from the middle of the gap, m.
            normal: normal from a to c.
            aside: correction of the velocity of c relative to a from the node to the surfaces, m/s.
        """
        h, d, row = ti.static((grid.spacing, self.dimension, w * self.layers))
        gap, middle, normal, smooth = APART * h, 0.0, ti.Vector.zero(float, d), agree > SMOOTH
        n_a, n_c, counts, slopes = self.collect(grid, w, thread, node, index, a, c)
        if c >= self.layers:
            n_c, counts[1] = facing, 2 * d - 1
        if counts.min() > 0 and n_a.dot(n_c) < ALIKE:
            normal = (n_a - n_c).normalized(SMALLEST)
            if smooth:
                normal = -n_c
            axes, gaps, first_axis = ti.Matrix.zero(float, 4, d), ti.Vector.zero(float, 3), 3
            if not smooth:
                alike = 0.0
                for side in range(2):
                    stay_rolled(self.points, thread + side)
                    towards = ti.select(side == 0, -n_c, n_a)
                    met = self.normal_along((2 * thread + side) * self.share, counts[side], towards)
                    for b in ti.static(range(d)):
                        axes[side, b] = met[b]
                        alike += axes[0, b] * axes[1, b]
                for b in ti.static(range(d)):
                    axes[2, b] = normal[b]
                if alike < SAME:
                    first_axis = 0
                else:
                    # Not the mean of n_a and -n_c, which tilts beside edges.
                    for b in ti.static(range(d)):
                        normal[b] = axes[0, b] + axes[1, b]
                    normal = normal.normalized()
            for b in ti.static(range(d)):
                axes[3, b] = normal[b]
            for j in range(first_axis, 4):
                stay_rolled(self.points, thread + j)
                axis, far = ti.Vector.zero(float, d), ti.Vector.zero(float, 2)
                for b in ti.static(range(d)):
                    axis[b] = axes[j, b]
                for side in range(2):
                    stay_rolled(self.points, thread + side)
                    layer = row + ti.select(side == 0 or c >= self.layers, a, c)
                    first, beta = (2 * thread + side) * self.share, self.rows[layer, SHARPNESS]
                    inverse_width = ti.static(0.5 / BALL) * grid.inverse_spacing
                    total = self.sum_points(first, counts[side], axis, beta, inverse_width)
                    flat = self.rows[layer, FLAT]
                    if side == 1 and c >= self.layers:
                        flat = 1.0 / (1.0 + ti.static(2 * (d - 1)) * exp(-beta * h * ti.static(0.5 / BALL)))
                    far[side] = -log(ti.max(total * flat, SMALLEST)) / beta
                gap, middle = far[0] + far[1], 0.5 * (far[0] - far[1])
                if j < 3:
                    gaps[j] = gap
                if j == 2:
                    # Blended, so that the axis changes continuously.
                    best, blend = gaps.max(), ti.Vector.zero(float, d)
                    for i in range(3):
                        share = exp(ti.max((gaps[i] - best) * grid.inverse_spacing / BLEND, -LARGEST))
                        for b in ti.static(range(d)):
                            blend[b] += share * axes[i, b]
                    normal = blend.normalized(SMALLEST)
                    for b in ti.static(range(d)):
                        axes[3, b] = normal[b]
        # Change of velocity from the node to the surface of each body, along its normal.
        aside = ti.Vector.zero(float, d)
        for b in ti.static(range(d)):
            aside[b] = (0.5 * gap + middle) * slopes[0, b] - (0.5 * gap - middle) * slopes[1, b]
        return gap, middle, normal, aside

    @ti.func
    def collect(self, grid: ti.template(), w: int, thread: int, node: ti.template(), index: int, a: int, c: int):
        """Store the surface points of layers a and c near a node.

        Return their outward normals, the numbers of points, and dv/dn of both, a row each, 1/s.
        """
        h, d = ti.static((grid.spacing, self.dimension))
        n_a, n_c, counts = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(int, 2)
        slopes, weights = ti.Matrix.zero(float, 2, d), ti.Vector.zero(float, 2)
        for images in range(ti.static(grid.period.sets)):
            there, exists = grid.period.image_from_inside(node, images)
            if exists:
                place = self.surfaces.place_of(grid, w, grid.linear_index(there))
                for q in range(ti.static(grid.scheme.spline.nodes**d)):
                    before, inside = self.surfaces.stencil_before(grid, there, q)
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
                                        way[b] = ti.cast(there[b] - PAD, float) * h - self.surfaces.groups[g].x[p][b]
                                        n[b] = self.surfaces.surface[g][p][b]
                                        weight *= spline(way[b] * grid.inverse_spacing)
                                    if side == 0:
                                        n_a += weight * n
                                    else:
                                        n_c += weight * n
                                    weights[side] += weight
                                    for b in ti.static(range(d)):
                                        slopes[side, b] += weight * self.surfaces.surface[g][p][d + 1 + b]
                                    depth = self.surfaces.surface[g][p][d]
                                    if counts[side] < self.capacity:
                                        at = (2 * thread + side) * self.share + counts[side]
                                        for b in ti.static(range(d)):
                                            # Entry by entry, because Taichi may lose vectors assigned as a whole.
                                            way[b] -= depth * n[b]
                                            self.points[at + b * self.capacity] = outwards * way[b]
                                            self.points[at + ti.static(d + 1 + b) * self.capacity] = outwards * n[b]
                                        self.points[at + d * self.capacity] = way.norm_sqr() / (2.0 * BALL * h)
                                        self.points[at + ti.static(2 * d + 1) * self.capacity] = weight
                                        counts[side] += 1
                                p = self.surfaces.following[g][p]
        for side, b in ti.static(ti.ndrange(2, d)):
            slopes[side, b] /= ti.max(weights[side], SMALLEST)
        return n_a.normalized(SMALLEST), n_c.normalized(SMALLEST), counts, slopes

    @ti.func
    def collect_obstacle(self, obstacles: ti.template(), thread: int, o: int, x: ti.template()):
        """Store points of an obstacle near x, like those of a second body in `collect`, if it is within reach.

        They are the nearest point, and the points nearest to positions one cell beside it, two along each tangent.
        Return the results of `Obstacles.at`, and the smallest product of another normal with that of the nearest point.
        """
        h, d = ti.static((obstacles.spacing, self.dimension))
        place, nearest, facing, velocity = x, x, ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        way, friction, agree, count, k = FAR, 0.0, 1.0, 1, 0
        while k < count:
            if k > 0:
                place = nearest + ti.select(k % 2 == 0, h, -h) * tangent(facing, ti.raw_div(k - 1, 2))
            distance, normal, pace, rough = obstacles.at(o, place, ti.select(k == 0, REACH, FAR_ASIDE))
            point = place - distance * normal
            if k == 0:
                nearest, facing, way, velocity, friction = point, normal, distance, pace, rough
                if way < REACH * h:
                    count = 2 * d - 1
            agree = ti.min(agree, normal.dot(facing))
            at = (2 * thread + 1) * self.share + k
            for b in ti.static(range(d)):
                self.points[at + b * self.capacity] = point[b] - x[b]
                self.points[at + ti.static(d + 1 + b) * self.capacity] = -normal[b]
            self.points[at + d * self.capacity] = (x - point).norm_sqr() * (0.5 / BALL) / h
            self.points[at + ti.static(2 * d + 1) * self.capacity] = 1.0
            k += 1
        return way, facing, velocity, friction, agree

    @ti.func
    def sum_points(self, first: int, count: int, axis: ti.template(), beta: float, inverse_width: float):
        """Return the sum of exponentials of distances of a node from surface points along an outward axis."""
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
        """Return the mean normal of the surface points whose normals are closest to an axis."""
        d = ti.static(self.dimension)
        total, begin = ti.Vector.zero(float, d), 0
        while begin < count:
            points, found = zero_lanes(ti.static(d + 1)), ti.Vector.zero(float, LANES)
            self.load(first + ti.static(d + 1) * self.capacity + begin, points)
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
                points[k, lane] = self.points[first + k * self.capacity + lane]


def points_near(stencil: int, layers: Layers, dimension: int) -> int:
    """Return the largest number of surface points of a body near a node: two layers at four times the rest density."""
    return 8 * math.ceil((stencil * layers.per_axis) ** (dimension - 1))


@ti.func
def tangent(normal: ti.template(), k: int):
    """Return the k-th of d - 1 unit vectors normal to a unit vector and to each other."""
    result = ti.Vector.zero(float, normal.n)
    if ti.static(normal.n == 2):
        result[0], result[1] = -normal[1], normal[0]
    else:
        # From the coordinate axis with the largest angle to the normal.
        least = normal.norm_sqr()
        for a in ti.static(range(3)):
            if normal[a] ** 2 < least:
                least = normal[a] ** 2
                result = ti.Vector.unit(3, a, float) - normal[a] * normal
        result = result.normalized()
        if k == 1:
            result = normal.cross(result)
    return result


@ti.func
def spline(r: float):
    """Return the quadratic B-spline at r cells from its node."""
    far = ti.abs(r)
    beyond = ti.max(1.5 - far, 0.0)
    return ti.select(far < 0.5, 0.75 - far**2, 0.5 * beyond**2)


@ti.func
def traction(r: float):
    """Return the fraction of a surface traction that acts on a node at r cells from the surface.

    It is the force on the node by a uniform stress up to the surface, 4 w(r) r summed over all particles behind it.
    """
    far = ti.abs(r)
    beyond = ti.max(1.5 - far, 0.0)
    return ti.select(far < 0.5, 0.8125 + (far**2 - 1.5) * far**2, (1.0 - 0.5 * beyond) * beyond**3)


@ti.func
def filled(r: float):
    """Return the fraction of the quadratic B-spline of a node inside a body whose flat surface is r cells before it."""
    far = ti.abs(r)
    beyond = ti.max(1.5 - far, 0.0)
    outside = ti.select(far < 0.5, 0.5 - far * (0.75 - far**2 / 3.0), beyond**3 / 6.0)
    return ti.max(ti.select(r > 0.0, outside, 1.0 - outside), SMALLEST)
