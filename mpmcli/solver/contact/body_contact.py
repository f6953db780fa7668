"""Contact of bodies with their own velocity fields: impulses at nodes shared by two bodies or by a body and a wall.

Each point of the surface of a body has a spring to what it is inside of, another body or an obstacle. A node takes its
force with the weight with which the node moves the point, so that nodes do the work that springs release. All impulses
are implicit in the velocity of the node, with Coulomb friction. See docs/theory.md, 2.8.
"""

from collections.abc import MutableMapping, Sequence

import numpy as np

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import lattice_spacing
from mpmcli.solver.contact.contact_phases import contact_phases, obstacles_of
from mpmcli.solver.contact.layers import AREA, DENSITY, FRICTION, MODULUS, Layers
from mpmcli.solver.contact.shared_field import stopped
from mpmcli.solver.contact.surfaces import CONTACT_REACH, DIVISOR_FLOOR, FAR, BodySurfaces, position_of
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.sort import TileOrder
from mpmcli.solver.transfer.splines import PAD

# Fraction of the velocity after a step with which springs act in it: the least with which they make no energy.
IMPLICIT = 0.5
# Least mass of a node for the springs between two bodies, over that of a layer of a cell below its points: one of both
# may have hardly any mass there.
LIGHT = 0.15
# Range of overlaps, cells, over which approach is increasingly stopped, independent of the springs.
STOPS = (0.1, 0.2)
# Entries of `LedgerRow`: `BodyContact.deepest`, and one of `BodyContact.loads`.
OVERLAP, WORK = "contact_overlap", "contact_work"


@ti.data_oriented
class BodyContact(Feature):
    """Contact of the bodies of a batch with each other and with obstacles; w is the index of a run.

    Attributes:
        surfaces: surfaces of the bodies.
        layers: number of layers per run.
        rows: numbers of each layer of each run, see `layers.MODULUS`.
        loads: loads on the first layer of each pair by the second, about the lower corner, see `Layers.pairs`; the
            first number of one more row is the work of all contact on what it parts since the last frame, J.
        deepest: per run, the deepest overlap since the last frame, cells.
    """

    begins = True

    def __init__(
        self,
        groups: Sequence[ParticleArrays],
        orders: Sequence[TileOrder],
        grid: Grid,
        layers: Layers,
        runs: int,
        *,
        on_cpu: bool,
        couples: bool,
    ) -> None:
        """Allocate the contact of a number of runs; `couples` is whether there are rigid bodies that move freely."""
        self.couples = couples
        self.surfaces = BodySurfaces(groups, orders, grid, layers, runs, on_cpu=on_cpu)
        self.dimension, self.layers, self.node_count = grid.dimension, layers.count, grid.node_count
        self.rows = ti.field(float, shape=(runs * layers.count, FRICTION + layers.count))
        self._rows, self._count = Rows(self.rows, self.surfaces.band), Rows(self.surfaces.count)
        self.pairs, self.loads = layers.pairs, Loads(layers.pairs + 1, grid.shape, runs, on_cpu=on_cpu)
        self.deepest = ti.field(float, shape=runs)

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
                modulus = material.lame_lambda + 2 * material.shear_modulus
                rows[layer] = [modulus, material.density, distance ** (self.dimension - 1)]
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
        self.surfaces.find_box(phases.device.grid, obstacles, run.w, drift, view.grid.images.last)

    def saved(self) -> dict[str, ti.Field]:
        own = {"contact.taken": self.loads.taken, "contact.deepest": self.deepest}
        return {"layers.low": self.surfaces.low, "layers.high": self.surfaces.high} | own

    @property
    def noted(self) -> int:
        return self.loads.capacity * self.loads.width + 1

    def read(self, run: int) -> np.ndarray:
        # The whole field: with an entry written from Python, the next kernel on Vulkan reads wrong values.
        deepest = self.deepest.to_numpy()
        found = np.append(self.loads.read(run), deepest[run])
        deepest[run] = 0.0
        self.deepest.from_numpy(deepest)
        return found

    def tell(self, values: np.ndarray, _run: int, found: MutableMapping[str, np.ndarray]) -> None:
        loads = values[:, :-1].reshape(len(values), -1, self.loads.width)
        found |= {"contact": loads[:, :-1], WORK: loads[:, -1, 0], OVERLAP: values[:, -1]}

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the loads and then the deepest overlap."""
        self.loads.note(run, frame, column, frame_stats)
        frame_stats[run, frame, column + ti.static(self.loads.capacity * self.loads.width)] = self.deepest[run]
        self.deepest[run] = 0.0

    @ti.func
    def exchange_all(self, at: ti.template(), weighs: ti.template()):
        """Exchange momentum between bodies, and then with obstacles, at a node; `at` is a `ContactNode`.

        If it `weighs`, add only to the sums of rigid bodies what they would take.
        """
        place = self.surfaces.index_in_batch(at.grid, at.w, at.index)
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
                distance, normal, velocity, rough = obstacles.at(c - self.layers, position_of(node, h), CONTACT_REACH)
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
        elif (bodies and a >= ti.static(int(self.surfaces.shares))) or way < CONTACT_REACH * h:
            pushed = self.push(at, a, c, u, soft, reduced, friction, way, facing, weighs)
            for b in ti.static(range(d)):
                J[b] = pushed[b]
        if ti.static(not weighs):
            for b in ti.static(range(d)):
                grid.nodes[at_a][b] -= J[b]
                if bodies:
                    grid.nodes[at_c][b] += J[b]
            if ti.abs(J).max() > 0.0:
                if bodies:
                    self.loads.take(w, node, ti.raw_div(c * (c - 1), 2) + a, -J, position_of(node, h))
                elif ti.static(obstacles.any):
                    obstacles.take(c - self.layers, node, position_of(node, h), J)

    @ti.func
    def push(
        self,
        at: ti.template(),
        a: int,
        c: int,
        u: ti.template(),
        soft: float,
        reduced: float,
        friction: float,
        way: float,
        facing: ti.template(),
        weighs: ti.template(),
    ):
        """Return the impulse of springs and friction from a to c at a node, N s; see `exchange`.

        Args:
            u: velocity of c relative to a, m/s.
            soft: sum of the inverse moduli of both, 1/Pa.
            reduced: reduced mass of both, kg.
            friction: coefficient of friction.
            way, facing: distance of the node from an obstacle, m, and the normal of that.
        """
        h, d, w = ti.static((at.grid.spacing, self.dimension, at.w))
        J, row, bodies = ti.Vector.zero(float, d), w * self.layers, c < self.layers
        gap, n, aside, area, deepest = self.springs(at, a, c)
        mass, implicit = reduced, IMPLICIT
        if bodies:
            density = ti.min(self.rows[row + a, DENSITY], self.rows[row + c, DENSITY])
            mass = ti.max(reduced, LIGHT * density * h * area)
        elif area < 0.0 and way <= 0.0:
            # Material without a surface, because it was torn or crushed, is stopped behind an obstacle.
            gap = -h
            for b in ti.static(range(d)):
                n[b] = -facing[b]
        elif ti.static(self.couples):
            # What arrives at an overlap of up to a step leaves no faster than it came.
            swing = at.swing(c - self.layers, 2.0 / soft * at.step.dt**2)
            implicit = ti.max(implicit, 1.0 - 2.0 / ti.max(swing, DIVISOR_FLOOR))
        kappa = 2.0 / soft * at.step.dt**2 / h * ti.max(area, 0.0) / mass
        if gap < 0.0:
            pushed, yields, holds = self.impulse(
                gap / h, u, n, aside, kappa, implicit, reduced, h / at.step.dt, friction
            )
            for b in ti.static(range(d)):
                J[b] = pushed[b]
            if ti.static(weighs):
                at.weigh(c - self.layers, pushed, n, yields, ti.select(holds, reduced, 0.0))
            else:
                self.loads.add(w, at.node, ti.static(self.pairs), 0, pushed.dot(u + pushed / reduced))
            # Most values are not extremes, and atomic operations are slow.
            if ti.static(not weighs) and pushed.dot(n) > 0.0 and deepest / h > self.deepest[w]:
                ti.atomic_max(self.deepest[w], deepest / h)
        return J

    @ti.func
    def impulse(
        self,
        gap: float,
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
            u: velocity of c relative to a, m/s.
            n, aside: see `springs`.
            kappa: k dt^2 / m of the springs.
            implicit: fraction of the velocity after the step with which it acts.
            reduced: m_a m_c / (m_a + m_c), kg.
            speed: speed of one cell per step, m/s.
            friction: coefficient of friction.
        """
        away, share = u.dot(n), kappa / (1.0 + implicit * kappa)
        push = ti.max(0.0, -implicit * away - gap * speed) * share
        # Approach that is too fast for the springs is stopped.
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
    def springs(self, at: ti.template(), a: int, c: int):
        """Return what a node has of the springs between the points of layer a and layer c, or obstacle c - layers.

        Returns:
            gap: minus the mean overlap, m; 0 without contact.
            axis: normal from a to c.
            aside: correction of the velocity of c relative to a from the node to the surfaces, m/s.
            area: of the points, m^(d-1), each with the weight with which the node moves it; -1 if a shows none.
            deepest: overlap of the deepest of them, m.
        """
        grid, h, d = ti.static((at.grid, at.grid.spacing, self.dimension))
        area, deepest, seen, force = 0.0, 0.0, 0.0, ti.Vector.zero(float, d)
        ways, slopes = ti.Matrix.zero(float, 2, d), ti.Matrix.zero(float, 2, d)
        pushes, weights = ti.Vector.zero(float, 2), ti.Vector.zero(float, 2)
        for images in range(ti.static(grid.images.by_period.sets)):
            there, exists = grid.images.by_period.image_from_inside(at.node, images)
            if exists:
                place = self.surfaces.index_in_batch(grid, at.w, grid.linear_index(there))
                for q in range(ti.static(grid.scheme.spline.nodes**d)):
                    before, inside = self.surfaces.stencil_before(grid, there, q)
                    if inside:
                        for g in ti.static(self.surfaces.surfaced):
                            p = self.surfaces.first[g][place - before]
                            while p >= 0:
                                layer = self.surfaces.shown[g][p]
                                side = ti.select(layer == a, 0, ti.select(layer == c, 1, -1))
                                if side >= 0:
                                    way, weight, lever = ti.Vector.zero(float, d), 1.0, 0.0
                                    for b in ti.static(range(d)):
                                        way[b] = ti.cast(there[b] - PAD, float) * h - self.surfaces.groups[g].x[p][b]
                                        weight *= grid.scheme.spline.at(way[b] * grid.inverse_spacing)
                                        lever += self.surfaces.surface[g][p][d + b] * way[b]
                                    weights[side] += weight
                                    seen += 1.0 - ti.cast(side, float)
                                    for b in ti.static(range(d)):
                                        way[b] -= self.surfaces.surface[g][p][d + b]
                                        slopes[side, b] += weight * self.surfaces.surface[g][p][2 * d + b]
                                    # The point moves with v + C (y - x), C = D^-1 sum w_i v_i (x_i - x)^T.
                                    lever *= ti.static(grid.scheme.spline.inverse_moment) * grid.inverse_spacing**2
                                    share = weight * (1.0 + lever) * self.rows[at.w * self.layers + layer, AREA]
                                    if c < self.layers:
                                        share *= 0.5
                                    for k in ti.static(range(d)):
                                        if self.surfaces.partners[g][p][k] == ti.select(side == 0, c, a):
                                            size = 0.0
                                            for b in ti.static(range(d)):
                                                overlap = self.surfaces.overlaps[g][p][k * d + b]
                                                size += overlap**2
                                                force[b] += ti.select(side == 0, share, -share) * overlap
                                            size = ti.sqrt(size)
                                            area += ti.abs(share)
                                            deepest = ti.max(deepest, size)
                                            pushes[side] += ti.abs(share) * size
                                            for b in ti.static(range(d)):
                                                ways[side, b] += ti.abs(share) * size * way[b]
                                p = self.surfaces.following[g][p]
        overlap, axis, aside = self.mean_overlap(c, area, force, weights, pushes, ways, slopes)
        if seen == 0.0:
            area = -1.0
        return -overlap, axis, aside, area, deepest

    @ti.func
    def mean_overlap(
        self,
        c: int,
        area: float,
        total: ti.template(),
        weights: ti.template(),
        pushes: ti.template(),
        ways: ti.template(),
        slopes: ti.template(),
    ):
        """Return the mean overlap at a node, m, its direction, and the correction `aside` of `springs`.

        Args:
            c: layer, or obstacle.
            area: of the points.
            total: sum of their overlaps, times area.
            weights, pushes: per side, the sums of their weights, and of their overlaps times area.
            ways, slopes: per side, sums of the ways from the points to the node times overlap and area, and of their
                rates of strain times weight.
        """
        d = ti.static(self.dimension)
        # Divided first, because the squares of weights may be too small for single precision.
        force = total / ti.max(area, DIVISOR_FLOOR)
        overlap = force.norm()
        axis = force / ti.max(overlap, DIVISOR_FLOOR)
        # Distances of the node from the surfaces: their sum is the gap.
        far = ti.Vector.zero(float, 2)
        for side, b in ti.static(ti.ndrange(2, d)):
            slopes[side, b] /= ti.max(weights[side], DIVISOR_FLOOR)
            far[side] += (1.0 - 2.0 * side) * ways[side, b] * axis[b] / ti.max(pushes[side], DIVISOR_FLOOR)
        if c < self.layers:
            for side in ti.static(range(2)):
                if pushes[side] == 0.0:
                    far[side] = -overlap - far[1 - side]
        aside = ti.Vector.zero(float, d)
        for b in ti.static(range(d)):
            aside[b] = far[0] * slopes[0, b] - far[1] * slopes[1, b]
        return overlap, axis, aside
