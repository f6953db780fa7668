"""Contact of bodies with their own velocity fields: impulses at nodes shared by two bodies or by a body and a wall.

At an obstacle each point of the surface of a body has a spring that acts where the point is inside. A node takes its
force with the weight with which the node moves the point, so that nodes do the work that springs release. At a node of
two bodies with parallel faces, surfaces are represented by their distances along the normal, the logarithm of a sum of
exponentials over nearby points; elsewhere by the distances of the points of each from the other. The impulse is that of
a spring on the gap. All impulses are implicit in the velocity of the node, with Coulomb friction. See docs/theory.md,
2.8.
"""

import math
from collections.abc import MutableMapping, Sequence

import numpy as np

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.rows import Rows
from mpmcli.materials.elementary import exp, log
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import lattice_spacing
from mpmcli.solver.contact.contact_phases import contact_phases, obstacles_of
from mpmcli.solver.contact.layers import AREA, DENSITY, FLAT, FRICTION, MODULUS, SHARPNESS, Layers
from mpmcli.solver.contact.shared_field import on_face, stopped
from mpmcli.solver.contact.surfaces import ALIKE, FAR, REACH, SMALLEST, BodySurfaces, place_of
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.sort import TileOrder, stay_rolled
from mpmcli.solver.transfer.lanes import LANES, zero_lanes
from mpmcli.solver.transfer.splines import PAD, bounded

# Radius of the ball of a surface point, cells: points off the axis count as farther away, like the front of a ball.
BALL = 3.0
# Sharpness of the soft minimum of distances, per particle spacing.
SHARP = 12.0
# Sharpness of the mean normal of the faces that face another body.
FACING = 16.0
# Product of the normals of the faces of two bodies above which they are parallel.
SAME = 0.999
# Product of the normals of an obstacle near a node, and this far along it, cells, above which it is plane there. Points
# of a body are up to two cells aside.
PLANE, ASIDE = 0.9999, 2.5
# Depth of a point below the plane of another, over 1 / beta, from which the surface counts as convex there.
CONVEX = 0.1
# Fraction of the velocity after a step with which springs act in it: between bodies, and at obstacles the least with
# which they make no energy.
IMPLICIT, IMPLICIT_OBSTACLES = 1.0, 0.5
# Overlap beyond which the push of bodies on each other is constant, cells.
DEEPEST = 0.3
# Range of overlaps, cells, over which the approach of bodies is increasingly stopped, independent of the spring.
STOPS = (0.1, 0.2)
# Fraction of the mass of a node at touching flat faces, above which overlaps and gaps of a node are recorded.
LIGHT = 0.1
# Reach of the distance from an obstacle of points near a node, cells.
FAR_ASIDE = 3.0
# Largest exponent in single precision.
LARGEST = 80.0
# Products of the normals of a point and, opposite, of the body that it meets, up to which it does not count and from
# which it counts in full: what slides past an edge meets its side with 0. Least product of the normals of faces that
# meet.
FACES, MEET = (0.3, 0.6), 0.15
# Gap, cells, if one of the bodies has no surface here: they are not in contact.
APART = 9.0
# Number of GPU threads for the nodes of all runs, limited because each needs memory for surface points, and smallest
# number per run.
GPU_THREADS, LEAST_THREADS = 4096, 64
# Entries of `LedgerRow`, see `BodyContact.extremes`.
EXTREMES = ("contact_overlap", "contact_gap")
# The entry of `LedgerRow` in `BodyContact.loads`.
WORK = "contact_work"


@ti.data_oriented
class BodyContact(Feature):
    """Contact of the bodies of a batch with each other and with obstacles; w is the index of a run.

    Attributes:
        surfaces: surfaces of the bodies.
        layers: number of layers per run.
        capacity: largest number of surface points of a body near a node.
        rows: numbers of each layer of each run, see `layers.MODULUS`.
        threads: threads of a run on a GPU.
        loads: loads on the first layer of each pair by the second, about the lower corner, see `Layers.pairs`; the
            first number of one more row is the work of all contact on what it parts since the last frame, J.
        extremes: per run, the deepest overlap and the largest gap with a push since the last frame, cells.
        points: surface points of two bodies near a node, per thread, row by row: vector to the node, m, additional
            distance for being off the axis, m, normal, and weight of its particle, at obstacles that with which the
            node moves the point; vectors and normals of the second body have the opposite sign.
    """

    begins = True

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
        couples: bool,
    ) -> None:
        self.couples = couples
        self.surfaces = BodySurfaces(groups, orders, grid, layers, runs, on_cpu=on_cpu)
        self.dimension, self.layers, self.node_count = grid.dimension, layers.count, grid.node_count
        self.capacity = points_near(grid.scheme.spline.nodes, layers, grid.dimension)
        self.rows = ti.field(float, shape=(runs * layers.count, FRICTION + layers.count))
        self._rows, self._count = Rows(self.rows, self.surfaces.band), Rows(self.surfaces.count)
        self.pairs, self.loads = layers.pairs, Loads(layers.pairs + 1, grid.shape, runs, on_cpu=on_cpu)
        self.extremes = ti.field(float, shape=(runs, len(EXTREMES)))
        self.stride = (2 * grid.dimension + 2) * self.capacity
        self.threads = max(LEAST_THREADS, GPU_THREADS // runs)
        at_once = max(runs, threads) if on_cpu else runs * self.threads
        self.points = ti.field(float, shape=2 * at_once * self.stride + LANES)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the numbers of the layers of a run, and the friction between them."""
        layers, h = Layers.of(scene), scene.domain.spacing
        self._count.write(run, [layers.count])
        rows, bands = np.zeros((layers.count, FRICTION)), np.zeros(layers.count)
        shared = [scene.sources[i].material.density for i in range(len(layers.numbers)) if not layers.has_own(i)]
        if shared:
            rows[0, DENSITY] = min(shared)
        for source, layer in enumerate(layers.numbers):
            if layers.has_own(source):
                material, distance = scene.sources[source].material, lattice_spacing(scene.sources[source], h)
                beta = SHARP / distance
                width = math.sqrt(2 * math.pi * BALL * h / beta) / distance
                modulus = material.lame_lambda + 2 * material.shear_modulus
                area = distance ** (self.dimension - 1)
                rows[layer] = [modulus, beta, width ** (1 - self.dimension), material.density, area]
                bands[layer] = distance
        self._rows.write(run * self.layers, np.hstack([rows, layers.frictions(scene)]), bands)

    def phases(self, *, serial: bool) -> tuple[Phase, ...]:
        return contact_phases(self.surfaces.groups, serial=serial, couples=self.couples)

    @ti.func
    def begin_step(self, phases: ti.template(), run: ti.template(), _step: ti.template()):
        """Find where bodies may be in contact in a step, with the current positions of colliders."""
        drift = ti.cast(ti.ceil(run.drift), int)
        (view,) = ti.static(phases.see(run))
        (obstacles,) = ti.static((obstacles_of(view),))
        self.surfaces.find_box(phases.device.grid, obstacles, run.w, drift, view.particles.last)

    def saved(self) -> dict[str, ti.Field]:
        own = {"contact.taken": self.loads.taken, "contact.extremes": self.extremes}
        return {"layers.low": self.surfaces.low, "layers.high": self.surfaces.high} | own

    @property
    def noted(self) -> int:
        return self.loads.capacity * self.loads.width + len(EXTREMES)

    def read(self, run: int) -> np.ndarray:
        extremes = self.extremes.to_numpy()
        found = np.append(self.loads.read(run), extremes[run])
        extremes[run] = 0.0
        self.extremes.from_numpy(extremes)
        return found

    def tell(self, values: np.ndarray, _run: int, found: MutableMapping[str, np.ndarray]) -> None:
        loads, extremes = np.split(values, [-len(EXTREMES)], axis=1)
        loads = loads.reshape(len(values), -1, self.loads.width)
        found |= {"contact": loads[:, :-1], WORK: loads[:, -1, 0], **dict(zip(EXTREMES, extremes.T, strict=True))}

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the loads and then the extremes."""
        self.loads.note(run, frame, column, frame_stats)
        for k in ti.static(range(len(EXTREMES))):
            frame_stats[run, frame, column + ti.static(self.loads.capacity * self.loads.width) + k] = self.extremes[
                run, k
            ]
            self.extremes[run, k] = 0.0

    @ti.func
    def exchange_all(self, at: ti.template(), weighs: ti.template()):
        """Exchange momentum between bodies, and then with obstacles, at a node; `at` is a `ContactNode`.

        If it `weighs`, add only to the sums of rigid bodies what they would take.
        """
        place = self.surfaces.place_of(at.grid, at.w, at.index)
        present = self.surfaces.present[place]
        # Layers in descending order: first all pairs of layers, then each layer with the obstacles, numbered after the
        # layers.
        for turn in range(ti.static(int(weighs or self.pairs == 0)), ti.select(self.surfaces.met[place] > 1, 2, 1)):
            rest = present
            while rest > 255 or (turn == 1 and rest > ti.static(int(self.surfaces.shares))):
                c, others, o = ti.cast(rest & 255, int) - 1, rest >> 8, 0
                while (turn == 0 and others > 0) or (turn == 1 and o < at.obstacles.count()):
                    a = ti.select(turn == 0, ti.cast(others & 255, int) - 1, c)
                    met, acts = ti.select(turn == 0, c, self.layers + o), True
                    if ti.static(weighs):
                        acts = at.rigid_of(o) >= 0
                    if acts:
                        self.exchange(at, a, met, weighs)
                    others, o = others >> 8, o + 1
                rest = rest >> 8

    @ti.func
    def exchange(self, at: ti.template(), a: int, c: int, weighs: ti.template()):
        """Exchange momentum of layer a with layer c, or obstacle c - layers, at a node; see `exchange_all`."""
        grid, obstacles, h, d = ti.static((at.grid, at.obstacles, at.grid.spacing, self.dimension))
        w, node, row = ti.static((at.w, at.node, at.w * self.layers))
        at_a, at_c = at.index + a * ti.static(self.node_count), at.index + c * ti.static(self.node_count)
        of_a = self.surfaces.total(grid, node, at.index, a * ti.static(self.node_count))
        m_a, bodies, way = of_a[d], c < self.layers, FAR
        reduced, friction = m_a, 0.0
        # The sum of the inverse moduli of both.
        soft = 1.0 / self.rows[row + a, MODULUS]
        u, J, facing = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        if ti.static(self.pairs > 0):
            if bodies:
                of_c = self.surfaces.total(grid, node, at.index, c * ti.static(self.node_count))
                m_c = of_c[d]
                # Evaluated in this order, because the product of two masses may be too small for single precision.
                reduced, friction = m_a * (m_c / (m_a + m_c)), self.rows[row + a, FRICTION + c]
                soft += 1.0 / self.rows[row + c, MODULUS]
                for b in ti.static(range(d)):
                    u[b] = of_c[b] / m_c - of_a[b] / m_a
        if ti.static(obstacles.any):
            if not bodies:
                distance, normal, velocity, rough = obstacles.at(c - self.layers, place_of(node, h), REACH)
                way, friction = distance, rough
                for b in ti.static(range(d)):
                    facing[b] = normal[b]
                    u[b] = velocity[b] - at.gravity_step[b] - of_a[b] / m_a
        if ti.static(self.surfaces.shares):
            if bodies and a == 0 and friction >= 0.0:
                change = stopped(self, at, c, u, friction)
                for b in ti.static(range(d)):
                    J[b] = reduced * change[b]
                self.loads.add(w, node, ti.static(self.pairs), 0, reduced * change.dot(u + change))
        if friction < 0.0:
            for b in ti.static(range(d)):
                J[b] = -reduced * u[b]
        elif (bodies and a >= ti.static(int(self.surfaces.shares))) or way < REACH * h:
            stiffness = 2.0 / soft * at.step.dt**2
            gap, n, aside, kappa, deepest = self.separation(at, a, c, way, facing, reduced, stiffness)
            if kappa >= 0.0:
                spring, implicit = gap / h, IMPLICIT_OBSTACLES
                if bodies:
                    spring, implicit = ti.max(spring, -DEEPEST), IMPLICIT
                elif ti.static(self.couples):
                    # What arrives at an overlap of up to a step leaves no faster than it came.
                    implicit = ti.max(implicit, 1.0 - 2.0 / ti.max(at.swing(c - self.layers, stiffness), SMALLEST))
                pushed, yields, holds = self.impulse(
                    gap / h, spring, u, n, aside, kappa, implicit, reduced, h / at.step.dt, friction
                )
                for b in ti.static(range(d)):
                    J[b] = pushed[b]
                if ti.static(weighs):
                    at.weigh(c - self.layers, pushed, n, yields, ti.select(holds, reduced, 0.0))
                else:
                    self.loads.add(w, node, ti.static(self.pairs), 0, pushed.dot(u + pushed / reduced))
                if ti.static(not weighs) and pushed.dot(n) > 0.0:
                    for k, reached in ti.static(enumerate((deepest / h, gap / h))):
                        # Most values are not extremes, and atomic operations are slow.
                        if reached > self.extremes[w, k]:
                            ti.atomic_max(self.extremes[w, k], reached)
        if ti.static(not weighs):
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
        spring: float,
        u: ti.template(),
        n: ti.template(),
        aside: ti.template(),
        kappa: float,
        implicit: float,
        reduced: float,
        speed: float,
        friction: float,
    ):
        """Return the impulse from a to c at a node, N s, its decrease with the velocity of c, and whether they stick.

        Args:
            gap: gap, cells.
            spring: the gap in the force of the spring, cells.
            u: velocity of c relative to a, m/s.
            n, aside: see `separation`.
            kappa: k dt^2 / m of the spring.
            implicit: fraction of the velocity after the step with which it acts.
            reduced: m_a m_c / (m_a + m_c), kg.
            speed: speed of one cell per step, m/s.
            friction: coefficient of friction.
        """
        away, share = u.dot(n), kappa / (1.0 + implicit * kappa)
        push = ti.max(0.0, -implicit * away - spring * speed) * share
        # Approach that is too fast for the spring is stopped.
        stops = ti.min(ti.max((-gap - STOPS[0]) / (STOPS[1] - STOPS[0]), 0.0), 1.0)
        yields = reduced * ti.select(-away * stops > push, stops, ti.select(push > 0.0, implicit * share, 0.0))
        push = reduced * ti.max(push, -away * stops)
        along = u + aside
        along -= along.dot(n) * n
        slip, rub = along.norm(), 0.0
        if slip > 0.0:
            rub = ti.min(friction * push, reduced * slip) / slip
        return push * n - rub * along, yields, friction * push > 0.0 and friction * push >= reduced * slip

    @ti.func
    def separation(
        self,
        at: ti.template(),
        a: int,
        c: int,
        way: float,
        facing: ti.template(),
        reduced: float,
        stiffness: float,
    ):
        """Return the gap between layers a and c at a node, and the geometry of the contact.

        Args:
            at: a `ContactNode`.
            a: layer of a body.
            c: layer of another body, or the number of layers plus the number of an obstacle.
            way, facing: distance of the node from the obstacle, m, and its normal there.
            reduced: m_a m_c / (m_a + m_c), kg.
            stiffness: of a spring per volume of cells, times dt^2, kg/m^3 m^2.

        Returns:
            gap: the gap, m.
            normal: normal from a to c.
            aside: correction of the velocity of c relative to a from the node to the surfaces, m/s.
            kappa: k dt^2 / m of the spring at the node, -1 without contact.
            deepest: the deepest overlap, m; negative at nodes that do not represent a surface.
        """
        h, d, row = ti.static((at.grid.spacing, self.dimension, at.w * self.layers))
        gap, normal, far, kappa, deepest = 0.0, ti.Vector.zero(float, d), ti.Vector.zero(float, 2), -1.0, 0.0
        n_a, n_c, counts, slopes = self.collect(at, a, c)
        if ti.static(at.obstacles.any):
            if c >= self.layers:
                o = c - self.layers
                gap, area, off, axis, most = self.springs(at, counts[0], o, row + a, way, facing)
                if counts[0] == 0 and way <= 0.0:
                    # Material without a surface, because it was torn or crushed, is stopped behind an obstacle.
                    gap, axis, kappa = -h, -facing, 0.0
                if area > 0.0:
                    far[0], deepest, kappa = off, most, stiffness / h * area / reduced
                for b in ti.static(range(d)):
                    normal[b] = axis[b]
        if ti.static(self.pairs > 0):
            if c < self.layers and counts.min() > 0 and n_a.dot(n_c) < ALIKE:
                gap, axis, kappa, deepest = self.apart(at, a, c, n_a, n_c, counts, reduced, stiffness, far)
                for b in ti.static(range(d)):
                    normal[b] = axis[b]
        # Change of velocity from the node to the surface of each body, along its normal.
        aside = ti.Vector.zero(float, d)
        for b in ti.static(range(d)):
            aside[b] = far[0] * slopes[0, b] - far[1] * slopes[1, b]
        return gap, normal, aside, kappa, deepest

    @ti.func
    def apart(
        self,
        at: ti.template(),
        a: int,
        c: int,
        n_a: ti.template(),
        n_c: ti.template(),
        counts: ti.template(),
        reduced: float,
        stiffness: float,
        far: ti.template(),
    ):
        """Return gap, normal, kappa and the deepest overlap of two bodies that face each other, see `separation`.

        Args:
            n_a, n_c, counts: see `collect`.
            far: distances of the node from their surfaces, m, which are set.
        """
        h, d, row = ti.static((at.grid.spacing, self.dimension, at.w * self.layers))
        gap, normal, kappa, deepest = 0.0, ti.Vector.zero(float, d), -1.0, 0.0
        # The faces of the bodies that look at each other. Mean normals tilt beside edges.
        faces, alike, middle = ti.Matrix.zero(float, 2, d), 0.0, 0.0
        for side in range(2):
            stay_rolled(self.points, at.thread + side)
            towards = ti.select(side == 0, -n_c, n_a)
            met = self.normal_along((2 * at.thread + side) * self.stride, counts[side], towards)
            for b in ti.static(range(d)):
                faces[side, b] = met[b]
                alike += faces[0, b] * faces[1, b]
        for b in ti.static(range(d)):
            normal[b] = faces[0, b] + faces[1, b]
        normal, meet = normal.normalized(SMALLEST), alike > MEET
        if alike < SAME:
            found, axis, off = self.between(at.thread, counts, row + a, row + c)
            # Without any point that faces the other body the axis is zero: faces that hardly look at each other.
            if axis.norm_sqr() > 0.5:
                gap, middle, meet, kappa = found, off, False, 1.0
                for b in ti.static(range(d)):
                    normal[b] = axis[b]
        if meet:
            for side in range(2):
                stay_rolled(self.points, at.thread + side)
                far[side] = self.distance_along(at, side, counts[side], row + ti.select(side == 0, a, c), normal)
            gap, middle, kappa = far[0] + far[1], 0.5 * (far[0] - far[1]), 1.0
        if kappa > 0.0:
            far[0], far[1] = 0.5 * gap + middle, 0.5 * gap - middle
            # Mass of such a node at flat faces. Nodes with less mass, which are at edges, push less.
            light = 0.0
            for side in range(2):
                density = self.rows[row + ti.select(side == 0, a, c), DENSITY]
                light += 1.0 / (density * filled(far[side] * at.grid.inverse_spacing))
            mass = ti.max(reduced, h**d / light)
            kappa = stiffness * h ** ti.static(d - 2) * traction(middle * at.grid.inverse_spacing) / mass
            # Nodes with very little mass, beside edges, do not represent a surface.
            deepest = ti.select(reduced > LIGHT * mass, -gap, 0.0)
        return gap, normal, kappa, deepest

    @ti.func
    def springs(self, at: ti.template(), count: int, o: int, row: int, way_there: float, facing_there: ti.template()):
        """Return the share of a node in the springs of the points of a body that are inside obstacle o.

        Returns:
            gap: minus their mean overlap, m.
            area: sum of their areas, m^(d-1).
            far: distance of the node from the surface of the body along the axis, m.
            axis: mean normal of the obstacle at these points, from the body to the obstacle.
            deepest: overlap of the deepest of them, m.
        """
        obstacles, h, d = ti.static((at.obstacles, at.grid.spacing, self.dimension))
        x, first, area, deepest, weights = place_of(at.node, h), 2 * at.thread * self.stride, 0.0, 0.0, 0.0
        force, mean = ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        # Whether the obstacle is plane here, as walls are, which saves most evaluations of its distance.
        plane, place = True, ti.Vector.zero(float, d)
        for k in range(ti.select(o < ti.static(len(obstacles.faces)), 0, 2 * (d - 1))):
            if plane:
                place = x - way_there * facing_there
                place += ti.select(k % 2 == 0, ASIDE, -ASIDE) * h * tangent(facing_there, ti.raw_div(k, 2))
                _distance, normal, _velocity, _friction = obstacles.at(o, place, FAR_ASIDE)
                plane = normal.dot(facing_there) > PLANE
        for k in range(count):
            way, distance, normal = ti.Vector.zero(float, d), way_there, ti.Vector.zero(float, d)
            for b in ti.static(range(d)):
                way[b] = self.points[first + k + b * self.capacity]
                place[b] = x[b] - way[b]
                normal[b] = facing_there[b]
                distance -= way[b] * facing_there[b]
            if not plane:
                found, there, _velocity, _friction = obstacles.at(o, place, FAR_ASIDE)
                distance = found
                for b in ti.static(range(d)):
                    normal[b] = there[b]
            if distance < 0.0:
                share = self.points[first + k + ti.static(2 * d + 1) * self.capacity] * self.rows[row, AREA]
                push = -share * distance
                area += ti.abs(share)
                weights += ti.abs(push)
                deepest = ti.max(deepest, -distance)
                for b in ti.static(range(d)):
                    force[b] -= push * normal[b]
                    mean[b] += ti.abs(push) * way[b]
        # Divided first, because the squares of weights may be too small for single precision.
        force /= ti.max(area, SMALLEST)
        overlap = force.norm()
        axis = force / ti.max(overlap, SMALLEST)
        return -overlap, area, mean.dot(axis) / ti.max(weights, SMALLEST), axis, deepest

    @ti.func
    def between(self, thread: int, counts: ti.template(), row_a: int, row_c: int):
        """Return the gap between two bodies near a node where both are, and the geometry of the contact.

        It is the smooth minimum of the distances of the points of each from the surface of the other. That surface
        consists of the planes of its points: the nearest one and, around an edge, the one that is farther out.

        Returns:
            gap: the gap, m.
            axis: the mean normal of these planes, from a to c.
            middle: distance of the node from the middle of the gap, m.
        """
        d = ti.static(self.dimension)
        gap, axis, means = LARGEST, ti.Vector.zero(float, d), ti.Matrix.zero(float, 2, d)
        for side in range(2):
            stay_rolled(self.points, thread + side)
            own, other = (2 * thread + side) * self.stride, (2 * thread + 1 - side) * self.stride
            row = ti.select(side == 0, row_a, row_c)
            beta = self.rows[row, SHARPNESS]
            inside = -CONVEX / self.rows[ti.select(side == 0, row_c, row_a), SHARPNESS]
            total, mean, faces = 0.0, ti.Vector.zero(float, d), ti.Vector.zero(float, d)
            for k in range(counts[side]):
                way, face, place = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(float, d)
                size, nearest, distance = 0.0, FAR, 0.0
                for b in ti.static(range(d)):
                    way[b] = self.points[own + k + b * self.capacity]
                    size += way[b] ** 2
                for j in range(counts[1 - side]):
                    apart = 0.0
                    for b in ti.static(range(d)):
                        apart += (way[b] + self.points[other + j + b * self.capacity]) ** 2
                    if apart < nearest:
                        nearest, distance = apart, 0.0
                        for b in ti.static(range(d)):
                            place[b] = self.points[other + j + b * self.capacity]
                            face[b] = self.points[other + j + ti.static(d + 1 + b) * self.capacity]
                            distance += (way[b] + place[b]) * face[b]
                for j in range(counts[1 - side]):
                    off, below = 0.0, 0.0
                    for b in ti.static(range(d)):
                        there = self.points[other + j + b * self.capacity]
                        n = self.points[other + j + ti.static(d + 1 + b) * self.capacity]
                        off += (way[b] + there) * n
                        below += (there - place[b]) * n
                    if below < inside and off > distance:
                        distance = off
                        for b in ti.static(range(d)):
                            face[b] = self.points[other + j + ti.static(d + 1 + b) * self.capacity]
                along, facing = way.dot(face), 0.0
                for b in ti.static(range(d)):
                    facing += face[b] * self.points[own + k + ti.static(d + 1 + b) * self.capacity]
                # The ball of the point, as in `distance_along`.
                aside = self.points[own + k + d * self.capacity] * (1.0 - along**2 / ti.max(size, SMALLEST))
                counted = ti.min(ti.max((facing - FACES[0]) / (FACES[1] - FACES[0]), 0.0), 1.0)
                share = counted * exp(ti.min(ti.max(-beta * (distance + aside), -LARGEST), LARGEST))
                total += share
                for b in ti.static(range(d)):
                    mean[b] += share * way[b]
                    faces[b] += share * face[b]
            gap = ti.min(gap, -log(ti.max(total * self.rows[row, FLAT], SMALLEST)) / beta)
            for b in ti.static(range(d)):
                means[side, b] = mean[b] / ti.max(total, SMALLEST)
                axis[b] += faces[b] / ti.max(total, SMALLEST)
        axis, far, seen = axis.normalized(SMALLEST), ti.Vector.zero(float, 2), ti.Vector.zero(float, 2)
        for side, b in ti.static(ti.ndrange(2, d)):
            far[side] += means[side, b] * axis[b]
            seen[side] = ti.max(seen[side], ti.cast(means[side, b] != 0.0, float))
        # From both bodies, or from the one whose points face the other.
        middle = (seen[0] * (far[0] - 0.5 * gap) - seen[1] * (far[1] - 0.5 * gap)) / ti.max(seen.sum(), 1.0)
        return gap, axis, middle

    @ti.func
    def collect(self, at: ti.template(), a: int, c: int):
        """Store the surface points of layers a and c near a node.

        Return their outward normals, the numbers of points, and dv/dn of both, a row each, 1/s.
        """
        grid, h, d = ti.static((at.grid, at.grid.spacing, self.dimension))
        n_a, n_c, counts = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(int, 2)
        slopes, weights = ti.Matrix.zero(float, 2, d), ti.Vector.zero(float, 2)
        for images in range(ti.static(grid.period.sets)):
            there, exists = grid.period.image_from_inside(at.node, images)
            if exists:
                place = self.surfaces.place_of(grid, at.w, grid.linear_index(there))
                for q in range(ti.static(grid.scheme.spline.nodes**d)):
                    before, inside = self.surfaces.stencil_before(grid, there, q)
                    if inside:
                        for g in ti.static(self.surfaces.surfaced):
                            p = self.surfaces.first[g][place - before]
                            while p >= 0:
                                layer = self.surfaces.shown[g][p]
                                side = ti.select(layer == a, 0, ti.select(layer == c, 1, -1))
                                if ti.static(self.surfaces.shares):
                                    if a == 0 and on_face(self.surfaces, at, g, p):
                                        side = -1
                                if side >= 0:
                                    outwards = ti.select(side == 0, 1.0, -1.0)
                                    n, way, weight = ti.Vector.zero(float, d), ti.Vector.zero(float, d), 1.0
                                    for b in ti.static(range(d)):
                                        way[b] = ti.cast(there[b] - PAD, float) * h - self.surfaces.groups[g].x[p][b]
                                        n[b] = self.surfaces.surface[g][p][b]
                                        weight *= grid.scheme.spline.at(way[b] * grid.inverse_spacing)
                                    if ti.static(self.pairs > 0):
                                        if side == 0:
                                            n_a += weight * n
                                        else:
                                            n_c += weight * n
                                    weights[side] += weight
                                    point, lever = ti.Vector.zero(float, d), 0.0
                                    for b in ti.static(range(d)):
                                        slopes[side, b] += weight * self.surfaces.surface[g][p][2 * d + b]
                                        point[b] = self.surfaces.surface[g][p][d + b]
                                        lever += point[b] * way[b] * grid.inverse_spacing**2
                                    if counts[side] < self.capacity:
                                        slot = (2 * at.thread + side) * self.stride + counts[side]
                                        if c >= self.layers:
                                            # The point moves with v + C (y - x), C = D^-1 sum w_i v_i (x_i - x)^T.
                                            weight *= 1.0 + ti.static(grid.scheme.spline.inverse_moment) * lever
                                        for b in ti.static(range(d)):
                                            # Entry by entry, because Taichi may lose vectors assigned as a whole.
                                            way[b] -= point[b]
                                            self.points[slot + b * self.capacity] = outwards * way[b]
                                            if ti.static(self.pairs > 0):
                                                normal = slot + ti.static(d + 1 + b) * self.capacity
                                                self.points[normal] = outwards * n[b]
                                        if ti.static(self.pairs > 0):
                                            self.points[slot + d * self.capacity] = way.norm_sqr() / (2.0 * BALL * h)
                                        self.points[slot + ti.static(2 * d + 1) * self.capacity] = weight
                                        counts[side] += 1
                                p = self.surfaces.following[g][p]
        for side, b in ti.static(ti.ndrange(2, d)):
            slopes[side, b] /= ti.max(weights[side], SMALLEST)
        return n_a.normalized(SMALLEST), n_c.normalized(SMALLEST), counts, slopes

    @ti.func
    def distance_along(self, at: ti.template(), side: int, count: int, row: int, axis: ti.template()):
        """Return the distance of a node from the surface of a body along an outward axis, m."""
        d = ti.static(self.dimension)
        first, beta = (2 * at.thread + side) * self.stride, self.rows[row, SHARPNESS]
        inverse_width = ti.static(0.5 / BALL) * at.grid.inverse_spacing
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
        return -log(ti.max(total * self.rows[row, FLAT], SMALLEST)) / beta

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
