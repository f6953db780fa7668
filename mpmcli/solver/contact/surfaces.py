"""Surface data of bodies with their own velocity fields, near nodes where they may be in contact.

Each particle stores the depth D below the nearest face of its body at rest, and the normal N of that face. Under F they
become d = D / |F^-T N| and n = F^-T N / |F^-T N|, and the point that was on the face is at x + D F N. Where plastic
flow changes F, particles store d and n, and the point is x + d n. Particles with a surface point ("shown" particles)
are inserted into bins, one for each node at which stencils begin. Each then finds its partners: the walls and
colliders, by their exact distance, and the body that its point is inside of.
"""

from collections.abc import Sequence

import numpy as np

from mpmcli.boundaries.colliders import COLLIDER_REACH, SEPARATE, Colliders
from mpmcli.boundaries.walls import Walls
from mpmcli.quick_taichi import ti
from mpmcli.scene import Body
from mpmcli.scene.sampling import BodyParticles, lattice_spacing
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.grid.grid import Grid, box_of
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.sort import TileOrder, stay_rolled
from mpmcli.solver.transfer.splines import PAD

# Distance from a surface, cells, beyond which nodes are not in contact: half the support of the spline that distributes
# it.
CONTACT_REACH = 1.5
# Distance of an obstacle that is absent or does not act, m; and a node index beyond any grid.
FAR, ALL_NODES = 1e30, 2**20
# Product of two normals, or of a normal and an axis, above which they have the same direction.
ALIKE = 0.7
# A number that replaces 0 in divisors and logarithms.
DIVISOR_FLOOR = 1e-37


@ti.data_oriented
class Obstacles:
    """Walls and colliders of one run in a kernel: first the faces of the domain, then the faces of colliders.

    Attributes:
        walls, colliders: views of the run, see `device.RunView`; `colliders` is None if there are none.
        faces: separating walls.
        sides: largest number of faces of a collider.
        any: whether there can be any obstacle.
    """

    def __init__(self, walls: Walls, colliders: Colliders | None, spacing: object) -> None:
        self.walls, self.colliders, self.spacing = walls, colliders, spacing
        self.dimension, self.faces = walls.dimension, walls.separating
        self.collides = colliders is not None
        self.sides = self.dimension if self.collides and colliders.boxes else 1
        self.any = self.collides or len(self.faces) > 0

    @ti.func
    def count(self):
        """Return the number of obstacles."""
        count = 0
        if ti.static(self.collides):
            count += self.colliders.count[self.colliders.run] * self.sides
        return count + ti.static(len(self.faces))

    @ti.func
    def collider_of(self, o: int):
        """Return the collider of an obstacle, and its index in the batch; -1 for a wall."""
        k, i = -1, -1
        if ti.static(self.collides):
            if o >= ti.static(len(self.faces)):
                k = ti.raw_div(o - ti.static(len(self.faces)), self.sides)
                i = k + self.colliders.run * self.colliders.capacity
        return k, i

    @ti.func
    def at(self, o: int, x: ti.template(), reach: float):
        """Return the distance of a point to an obstacle, m, its normal into the material, velocity, m/s, and friction.

        Normal and velocity are those of the nearest point of the obstacle. Beyond `reach`, cells, the distance is a
        lower bound and the normal zero. x is relative to the lower corner, m.
        """
        d, h = ti.static((self.dimension, self.spacing))
        distance, friction, normal, velocity = FAR, 0.0, ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        for f, face in ti.static(enumerate(self.faces)):
            if o == f:
                axis, side = ti.static(face)
                distance = x[axis]
                normal[axis] = 1.0
                if ti.static(side == 1):
                    distance = ti.cast(self.walls.last[axis] - self.walls.first, float) * h - x[axis]
                    normal[axis] = -1.0
                for _, number, rough_axis, rough_side in ti.static(self.walls.rough):
                    if ti.static((rough_axis, rough_side) == face):
                        friction = self.walls.friction.of(number)
                if ti.static(self.walls.moves):
                    along = self.walls.velocity(axis, side)
                    for a in ti.static(range(d)):
                        velocity[a] = along[a]
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                side = o - ti.static(len(self.faces)) - k * self.sides
                arm = x - self.colliders.place[i]
                acts, beyond = self.colliders.wall[i] == SEPARATE and side < self.colliders.faces_of(i), -FAR
                for a in ti.static(range(d)):
                    beyond = ti.max(
                        beyond, self.colliders.reach[i][0, a] - arm[a], arm[a] - self.colliders.reach[i][1, a]
                    )
                beyond += COLLIDER_REACH * h
                if acts and beyond > reach * h:
                    distance = beyond
                elif acts:
                    found, own = self.colliders.distance(i, arm, side)
                    along = self.colliders.velocity[i] + self.colliders.turning[i] @ (arm - found * own)
                    distance, friction = found, self.colliders.friction[i]
                    for a in ti.static(range(d)):
                        normal[a], velocity[a] = own[a], along[a]
        return distance, normal, velocity, friction

    @ti.func
    def nearest(self, x: ti.template(), reach: float):
        """Return the distance to the nearest obstacle, m, see `at`."""
        least = FAR
        for o in range(self.count()):
            distance, _normal, _velocity, _friction = self.at(o, x, reach)
            least = ti.min(least, distance)
        return least

    @ti.func
    def range(self, o: int):
        """Return the first and last node per axis that may be in contact with an obstacle."""
        low, high = ti.Vector([-ALL_NODES] * self.dimension), ti.Vector([ALL_NODES] * self.dimension)
        for f, face in ti.static(enumerate(self.faces)):
            if o == f:
                axis, side = ti.static(face)
                if ti.static(side == 0):
                    high[axis] = self.walls.first + 1
                else:
                    low[axis] = self.walls.last[axis] - 1
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                # A margin beyond the reach stored with the collider, and for rounding.
                wider = ti.static(CONTACT_REACH - COLLIDER_REACH + 0.1)
                for a in ti.static(range(self.dimension)):
                    place = self.colliders.place[i][a]
                    first = (place + self.colliders.reach[i][0, a]) / self.spacing - wider
                    last = (place + self.colliders.reach[i][1, a]) / self.spacing + wider
                    low[a] = PAD + ti.cast(ti.floor(ti.max(first, -ALL_NODES)), int)
                    high[a] = PAD + ti.cast(ti.ceil(ti.min(last, ALL_NODES)), int)
        return low, high

    @ti.func
    def take(self, o: int, node: ti.template(), x: ti.template(), impulse: ti.template()):
        """Add the impulse on an obstacle from a node, N s, to its loads if it is a collider."""
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                self.colliders.loads.take(self.colliders.run, node, k, impulse, x - self.colliders.place[i])


@ti.func
def position_of(node: ti.template(), spacing: float):
    """Return the position of a node relative to the lower corner, m."""
    return ti.cast(node - PAD, float) * spacing


# Inverse of the smallest principal stretch up to which particles are found.
CRUSHED = 4.0
# Values in place of the first particle of a bin: empty, or closed. Value in place of the layer of a particle that is
# not shown.
EMPTY, CLOSED, HIDDEN = -1, -2, -1
# Depth of particles that are never shown.
BELOW_ALL = 1e30
# Cells that a point may be from the nearest point of a body inside of which it is, and its largest depth that counts.
NEAREST, DEEPEST = 1.0, 0.5
# Products of the normals of a point and, opposite, of the body that it is inside of, up to which it does not count and
# from which it counts in full: what slides past an edge meets its side with 0.
FACES = (0.3, 0.6)
# Depth of a point below the plane of another, over the particle spacing, from which the surface is convex there.
CONVEX = 0.01
# Fractions of the particle spacing: the offset of points from edges between equally near faces, which selects one face,
# and the step of the finite difference for the normal.
ASIDE, STEP = 1e-4, 1e-6


def rest_surface(body: Body, particles: BodyParticles, spacing: float | None) -> np.ndarray:
    """Return the outward unit normal N and the depth D, m, of particles, (n, d + 1).

    The shape of an initially deformed body is the deformed one: N is along F^T n, and D = d / |F^T n|. That of a body
    of a result is the one from which it began, if known. `spacing` is that of the grid, m; None for a body without a
    surface, whose particles get the depth BELOW_ALL.
    """
    position, d = particles.position, particles.position.shape[1]
    if spacing is None:
        return np.full((len(position), d + 1), BELOW_ALL)
    form, distance, began = body.shape.form, lattice_spacing(body, spacing), body.shape.at_rest
    if began:
        form, position = began
    # Offset away from the centre, so that mirrored bodies have mirrored normals.
    away = np.where(position < np.mean(form.bounds(), axis=0), -1.0, 1.0)
    place = position + ASIDE * distance * away * [1.0, 0.618, 0.414][:d]
    steps = STEP * distance * np.eye(d)
    slope = [form.signed_distance(place + step) - form.signed_distance(place - step) for step in steps]
    normal = np.stack(slope, axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if particles.deformation is not None and not began:
        normal = np.einsum("pji,pj->pi", particles.deformation, normal)
    size = np.linalg.norm(normal, axis=1)
    depth = np.maximum(-form.signed_distance(position), 0.0)
    return np.column_stack([normal / size[:, None], depth / size])


@ti.data_oriented
class BodySurfaces:
    """Surfaces of the bodies of a batch, and where they may be in contact; w is the index of a run.

    Attributes:
        layers: number of layers per run.
        groups, orders: groups of particles and their tile orders.
        surfaced: indices of the groups with surfaces.
        low, high: per layer of each run, the range of first nodes of stencils at the last sort; along a periodic axis
            the whole axis from the step on in which the layer comes near a face.
        used: per layer of each run, the nodes in use, as in `Grid.box`.
        box: per run, the box of nodes where layers may be in contact with each other or with an obstacle.
        drift: per run, the largest displacement of particles since the sort, cells.
        band: per layer of each run, the depth below the surface up to which particles are shown, m.
        present: per node of a run in the box, the layers with mass there plus 1, one byte each.
        met: per node in the box, 1 if two bodies with their own layers are present, plus 2 if an obstacle is within
            reach of one.
        first: per node and surfaced group, the bin: the first shown particle whose stencil begins there, EMPTY, or
            CLOSED if there is no contact at any node of that stencil.
        following: the next particle in the bin of each particle.
        end: per tile, the index after the last particle that may be shown.
        counted, rank, slots, reserved: on a GPU, number of particles per bin; rank of each particle in its bin; the
            particles, bin by bin; and number of reserved slots per run.
        shown: layer of each particle, or HIDDEN.
        surface: per particle, the normal n of the body, the way to its point of the surface, m, and dv/dn, 1/s.
        partners: per particle, d of the things that its point is inside of, a layer, or the number of layers plus that
            of an obstacle, or EMPTY; overlaps: the depth in each, m, times its normal there, inwards.
    """

    def __init__(
        self,
        groups: Sequence[ParticleArrays],
        orders: Sequence[TileOrder],
        grid: Grid,
        layers: Layers,
        runs: int,
        *,
        on_cpu: bool,
    ) -> None:
        """Allocate the surfaces of groups for a number of runs; on a GPU also the counts and slots of bins."""
        d = self.dimension = grid.dimension
        self.layers, self.shares, self.runs = layers.count, layers.shares, runs
        self.groups, self.orders = tuple(groups), tuple(orders)
        self.surfaced = tuple(g for g, group in enumerate(groups) if group.surfaced)
        self.node_count, count = grid.node_count, runs * layers.count
        self.low, self.high = (ti.Vector.field(d, int, shape=count) for _ in range(2))
        self.used = ti.field(int, shape=(2 * count, d))
        self.box = ti.field(int, shape=(2 * runs, d))
        self.drift, self.count = ti.field(int, shape=runs), ti.field(int, shape=runs)
        self.band = ti.field(float, shape=count)
        self.present = ti.field(ti.i64, shape=runs * grid.node_count)
        self.met = ti.field(int, shape=runs * grid.node_count)
        self.first, self.following, self.shown, self.surface, self.end = {}, {}, {}, {}, {}
        self.partners, self.overlaps = {}, {}
        for g in self.surfaced:
            room = groups[g].capacity
            self.first[g] = ti.field(int, shape=runs * grid.node_count)
            self.following[g], self.shown[g] = ti.field(int, shape=room), ti.field(int, shape=room)
            self.end[g] = ti.field(int, shape=orders[g].start.shape)
            self.surface[g] = ti.Vector.field(3 * d, float, shape=room)
            self.partners[g] = ti.Vector.field(d, int, shape=room)
            self.overlaps[g] = ti.Vector.field(d * d, float, shape=room)
        self.counted, self.rank, self.slots, self.reserved = {}, {}, {}, {}
        for g in () if on_cpu else self.surfaced:
            self.counted[g] = ti.field(int, shape=runs * grid.node_count)
            self.rank[g], self.slots[g] = (ti.field(int, shape=groups[g].capacity) for _ in range(2))
            self.reserved[g] = ti.field(int, shape=runs)

    # Where bodies may be in contact.

    @ti.func
    def forget(self, w: int):
        """Reset the ranges of the layers of a run, before its particles are added again."""
        for layer in range(w * self.layers, w * self.layers + self.count[w]):
            for a in ti.static(range(self.dimension)):
                self.low[layer][a], self.high[layer][a] = 2**30, -(2**30)

    @ti.func
    def used_by(self, w: int, layer: int):
        """Return the box in use of a layer of run w, as in `Grid.box`."""
        own = ti.Matrix.zero(int, 2, self.dimension)
        for i, a in ti.static(ti.ndrange(2, self.dimension)):
            own[i, a] = self.used[(w * self.layers + layer) * 2 + i, a]
        return own

    @ti.func
    def widen(self, w: int, of_run: int, base: ti.template()):
        """Extend the range of a layer of run w to a stencil."""
        layer = w * self.layers + of_run
        for a in ti.static(range(self.dimension)):
            # The comparisons may use old values; they avoid most atomic operations on a GPU.
            if base[a] < self.low[layer][a]:
                ti.atomic_min(self.low[layer][a], base[a])
            if base[a] > self.high[layer][a]:
                ti.atomic_max(self.high[layer][a], base[a])

    @ti.func
    def find_box(self, grid: ti.template(), obstacles: ti.template(), w: int, drift: int, last: ti.template()):
        """Compute the nodes used by each layer and the box of possible contact; release all slots.

        Particles have moved by up to `drift` cells since the sort. The box also includes the first stencil node of
        every particle whose stencil reaches a node of possible contact.
        """
        d, reach, begin = ti.static((self.dimension, grid.scheme.spline.nodes - 1, w * self.layers))
        self.drift[w] = drift
        for g in ti.static(tuple(self.reserved)):
            self.reserved[g][w] = 0
        for layer in range(begin, begin + self.count[w]):
            stay_rolled(self.orders[0].buffers.real, layer)
            for a in ti.static(range(d)):
                first, end = box_of(grid, a, self.low[layer][a], self.high[layer][a], drift, last[a])
                if ti.static(a in grid.images.periodic):
                    self.low[layer][a] = ti.min(self.low[layer][a], first + drift)
                    self.high[layer][a] = ti.max(self.high[layer][a], end - reach - drift)
                # Emitted material, and bodies that share its layer, may be anywhere in the box of all layers.
                if ti.static(self.shares):
                    if layer == begin:
                        first, end = grid.box[2 * w, a], grid.box[2 * w, a] + grid.box[2 * w + 1, a] - 1
                self.used[2 * layer, a], self.used[2 * layer + 1, a] = first, ti.max(end - first + 1, 0)
        low, high = ti.Vector([2**30] * d), ti.Vector([-1] * d)
        for c in range(begin + 1, begin + self.count[w]):
            for a in range(begin, c):
                stay_rolled(self.orders[0].buffers.real, a)
                first = ti.max(self.low[a], self.low[c]) - drift - reach
                end = ti.min(self.high[a], self.high[c]) + drift + reach
                if (end - first).min() >= reach:
                    low, high = ti.min(low, first), ti.max(high, end)
        if ti.static(obstacles.any):
            for o in range(obstacles.count()):
                first_met, last_met = obstacles.range(o)
                for layer in range(begin + ti.static(int(self.shares)), begin + self.count[w]):
                    first = ti.max(self.low[layer] - drift, first_met) - reach
                    end = ti.min(self.high[layer] + drift + reach, last_met)
                    if (end - first).min() >= reach:
                        middle, radius = self.ball_of(first, end, obstacles.spacing)
                        distance, _n, _v, _f = obstacles.at(o, middle, radius / obstacles.spacing + CONTACT_REACH)
                        if distance < radius + CONTACT_REACH * obstacles.spacing:
                            low, high = ti.min(low, first), ti.max(high, end)
        for a in ti.static(range(d)):
            first_used, count = grid.box[2 * w, a], grid.box[2 * w + 1, a]
            first, end = ti.max(low[a], first_used), ti.min(high[a], first_used + count - 1)
            self.box[2 * w, a], self.box[2 * w + 1, a] = first, ti.max(end - first + 1, 0)

    @ti.func
    def ball_of(self, first: ti.template(), last: ti.template(), spacing: float):
        """Return the centre and the radius of the ball around a box of nodes, m."""
        low, high = ti.cast(first - PAD, float), ti.cast(last - PAD, float)
        return 0.5 * spacing * (low + high), 0.5 * spacing * (high - low).norm()

    @ti.func
    def index_in_batch(self, grid: ti.template(), w: int, index: int):
        """Return the index of a node among those of all runs, as in `first`, given its linear index in layer 0."""
        return index - grid.first_node + w * ti.static(self.node_count)

    @ti.func
    def clear_rows(self, grid: ti.template(), w: int, first: int, after: int):
        """Clear rows of nodes of the box, which is the box of `grid` here and below."""
        for row in range(first, after):
            node = grid.row_start(row)
            place = self.index_in_batch(grid, w, grid.linear_index(node))
            for k in range(grid.row_length(node)):
                stay_rolled(self.orders[0].buffers.real, place + k)
                self.clear(place + k)

    @ti.func
    def clear(self, place: int):
        """Clear a node."""
        self.present[place] = 0
        for g in ti.static(self.surfaced):
            self.first[g][place] = CLOSED
            if ti.static(len(self.counted) > 0):
                self.counted[g][place] = 0

    @ti.func
    def find_rows(self, grid: ti.template(), obstacles: ti.template(), w: int, first: int, after: int):
        """Find which layers have mass at rows of nodes, and whether they may be in contact."""
        last = ti.static(self.dimension - 1)
        for layer in range(self.count[w]):
            used, behind = 2 * (w * self.layers + layer), layer * ti.static(self.node_count)
            begin = ti.max(self.used[used, last], grid.box[0, last])
            end = ti.min(self.used[used, last] + self.used[used + 1, last], grid.box[0, last] + grid.box[1, last])
            for row in range(first, after):
                node = grid.row_start(row)
                inside = True
                for a in ti.static(range(last)):
                    beyond = node[a] - self.used[used, a]
                    inside = inside and beyond >= 0 and beyond < self.used[used + 1, a]
                if inside:
                    index = grid.linear_index(node) - node[last]
                    place = self.index_in_batch(grid, w, index)
                    for k in range(begin, end):
                        stay_rolled(self.orders[0].buffers.real, place + k)
                        node[last] = k
                        if self.total(grid, node, index + k, behind)[last + 1] > 0.0:
                            self.present[place + k] = 256 * self.present[place + k] + layer + 1
        for row in range(first, after):
            node = grid.row_start(row)
            # `far` is the node up to which no obstacle is near.
            place, far = self.index_in_batch(grid, w, grid.linear_index(node)), node[last]
            for k in range(grid.row_length(node)):
                bodies = self.bodies_at(place + k)
                met = ti.cast(self.present[place + k] > 255, int)
                if ti.static(obstacles.any):
                    if bodies > 0 and node[last] >= far:
                        cells = obstacles.nearest(position_of(node, grid.spacing), CONTACT_REACH) * grid.inverse_spacing
                        met += 2 * ti.cast(cells < CONTACT_REACH, int)
                        far = node[last] + ti.cast(ti.min(ti.max(cells - CONTACT_REACH, 0.0), 1e6), int)
                self.open_bins(grid, node, place + k, met)
                node[last] += 1

    @ti.func
    def total(self, grid: ti.template(), node: ti.template(), index: int, behind: int):
        """Return momentum and mass of a node of a layer with its periodic images; zero at an image beyond a face.

        `index` is the index of the node in layer 0, and `behind` the offset of the layer.
        """
        result = ti.Vector.zero(float, ti.static(self.dimension + 1))
        if ti.static(len(grid.images.periodic) == 0):
            for c in ti.static(range(self.dimension + 1)):
                result[c] = grid.nodes[behind + index][c]
        else:
            for images in range(ti.static(grid.images.by_period.sets)):
                there, exists = grid.images.by_period.image_from_inside(node, images)
                if exists:
                    at = behind + grid.linear_index(there)
                    for c in ti.static(range(self.dimension + 1)):
                        result[c] += grid.nodes[at][c]
        return result

    @ti.func
    def open_bins(self, grid: ti.template(), node: ti.template(), place: int, met: int):
        """Store `met` of a node, and open the bins of the stencils that contain it."""
        self.met[place] = met
        if met > 0:
            for images in range(ti.static(grid.images.by_period.sets)):
                there, exists = grid.images.by_period.image_from_inside(node, images)
                if exists:
                    offset = grid.linear_index(there) - grid.linear_index(node)
                    for q in range(ti.static(grid.scheme.spline.nodes**self.dimension)):
                        before, inside = self.stencil_before(grid, there, q)
                        if inside:
                            for g in ti.static(self.surfaced):
                                self.first[g][place + offset - before] = EMPTY

    @ti.func
    def find(self, grid: ti.template(), obstacles: ti.template(), w: int, node: ti.template()):
        """Find which layers have mass at a node, and whether they may be in contact, like `find_rows`."""
        index = grid.linear_index(node)
        place = self.index_in_batch(grid, w, index)
        present = ti.cast(0, ti.i64)
        for layer in range(self.count[w]):
            used, inside = 2 * (w * self.layers + layer), True
            for a in ti.static(range(self.dimension)):
                beyond = node[a] - self.used[used, a]
                inside = inside and beyond >= 0 and beyond < self.used[used + 1, a]
            if inside:
                if self.total(grid, node, index, layer * ti.static(self.node_count))[self.dimension] > 0.0:
                    present = 256 * present + layer + 1
        self.present[place] = present
        bodies = self.bodies_at(place)
        met = ti.cast(present > 255, int)
        if ti.static(obstacles.any):
            if bodies > 0:
                distance = obstacles.nearest(position_of(node, grid.spacing), CONTACT_REACH)
                met += 2 * ti.cast(distance < CONTACT_REACH * grid.spacing, int)
        self.open_bins(grid, node, place, met)

    @ti.func
    def opens(self, g: ti.template(), grid: ti.template(), w: int, low: ti.template(), high: ti.template()):
        """Return whether the bin of any node in a box, given by its first and last node, is open."""
        last = ti.static(self.dimension - 1)
        first, end, rows, found = low, high, 1, False
        for a in ti.static(range(self.dimension)):
            first[a] = ti.max(low[a], grid.box[0, a])
            end[a] = ti.min(high[a] + 1, grid.box[0, a] + grid.box[1, a])
            if ti.static(a < last):
                rows *= ti.max(end[a] - first[a], 0)
        for row in range(rows):
            node, rest = first, row
            for a in ti.static(range(last)):
                after = ti.raw_div(rest, end[a] - first[a])
                node[a] += rest - after * (end[a] - first[a])
                rest = after
            place = self.index_in_batch(grid, w, grid.linear_index(node))
            for k in range(end[last] - first[last]):
                stay_rolled(self.orders[0].buffers.real, place + k)
                found = found or self.first[g][place + k] != CLOSED
        return found

    @ti.func
    def bodies_at(self, place: int):
        """Return the number of bodies with their own layers that are present at a node."""
        bodies, rest = 0, self.present[place]
        while rest > 0:
            bodies += ti.cast((rest & 255) > ti.static(int(self.shares)), int)
            rest = rest >> 8
        return bodies

    @ti.func
    def stencil_before(self, grid: ti.template(), node: ti.template(), q: int):
        """Return the offset of a node from the start of a stencil in which it is q-th, and if that is in the box."""
        n = ti.static(grid.scheme.spline.nodes)
        before, rest, inside = 0, q, True
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            after = ti.raw_div(rest, n)
            along = rest - after * n
            before += along * ti.static(grid.strides[a])
            inside = inside and node[a] - along >= grid.box[0, a]
            rest = after
        return before, inside

    # Surface data.

    @ti.func
    def tiles(self, grid: ti.template(), w: int):
        """Return the first tile and the number of tiles per axis with particles whose stencils may begin in the box."""
        first, count = ti.Vector.zero(int, self.dimension), ti.Vector.zero(int, self.dimension)
        for a in ti.static(range(self.dimension)):
            first[a] = ti.raw_div(ti.max(grid.box[0, a] - self.drift[w], 0), ti.static(grid.tile))
            last = ti.raw_div(grid.box[0, a] + grid.box[1, a] - 1 + self.drift[w], ti.static(grid.tile))
            if grid.box[1, a] > 0:
                count[a] = ti.min(last, ti.static(grid.tiles[a] - 1)) - first[a] + 1
        return first, count

    @ti.func
    def tile_count(self, grid: ti.template(), w: int):
        _, count = self.tiles(grid, w)
        product = 1
        for a in ti.static(range(self.dimension)):
            product *= count[a]
        return product

    @ti.func
    def tile_at(self, grid: ti.template(), order: ti.template(), w: int, q: int):
        """Return the index in `order.start` of the q-th of these tiles, and its position per axis."""
        first, count = self.tiles(grid, w)
        place, rest, tile = first, q, 0
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            after = ti.raw_div(rest, count[a])
            place[a] += rest - after * count[a]
            rest = after
        for a in ti.static(range(self.dimension)):
            tile = tile * ti.static(grid.tiles[a]) + place[a]
        return tile + w * ti.static(order.bins + 1), place

    @ti.func
    def bin_of(self, grid: ti.template(), w: int, base: ti.template()):
        """Return the bin of the stencils that begin at a node, or -1 outside the box."""
        place = self.index_in_batch(grid, w, grid.linear_index(base))
        for a in ti.static(range(self.dimension)):
            if base[a] < grid.box[0, a] or base[a] >= grid.box[0, a] + grid.box[1, a]:
                place = -1
        return place

    @ti.func
    def find_surface_points(self, g: ti.template(), grid: ti.template(), w: int, q: int):
        """Find the surface data of the particles of the g-th group in the q-th tile."""
        tile, place = self.tile_at(grid, self.orders[g], w, q)
        begin, end = self.orders[g].start[tile], self.orders[g].start[tile + 1]
        if begin < end:
            first, drift = place * grid.tile, self.drift[w]
            if not self.opens(g, grid, w, first - drift, first + drift + ti.static(grid.tile - 1)):
                end = begin
        self.end[g][tile] = end
        for p in range(begin, self.end[g][tile]):
            self.find_surface_point(g, grid, w, p)

    @ti.func
    def find_surface_point(self, g: ti.template(), grid: ti.template(), w: int, p: int):
        """Find the surface data of a particle of the g-th group."""
        d, group = ti.static((self.dimension, self.groups[g]))
        base, _ = grid.scheme.spline.stencil(group.x[p], grid.inverse_spacing)
        shown, layer = HIDDEN, group.layer_of(p)
        band = self.band[w * self.layers + layer]
        # Those of elastic bodies are always the same: one that came or went inside an obstacle would bring or take
        # energy. Where plastic flow changes depths, they are known only now, unless particles are crushed.
        if group.carried[p][d] < ti.static(CRUSHED if group.law.projects else 1.0) * band:
            bin_ = self.bin_of(grid, w, base)
            if bin_ >= 0 and self.first[g][ti.max(bin_, 0)] != CLOSED:
                N = ti.Vector.zero(float, d)
                for c in ti.static(range(d)):
                    N[c] = group.carried[p][c]
                n, way = N, N
                if ti.static(not group.law.projects):
                    F = group.stored(p)
                    n, way = F.inverse().transpose() @ N, F @ N
                size = n.norm()
                if ti.static(not group.law.projects) or group.carried[p][d] / size < band:
                    shown = layer
                    for c in ti.static(range(d)):
                        self.surface[g][p][c] = n[c] / size
                        slope = 0.0
                        for a in ti.static(range(d)):
                            slope += group.gradient[p][a, c] * n[a] / size
                        self.surface[g][p][d + c] = group.carried[p][d] * way[c]
                        self.surface[g][p][2 * d + c] = slope
        self.shown[g][p] = shown

    @ti.func
    def link(self, g: ti.template(), grid: ti.template(), w: int, q: int):
        """Insert the shown particles of the g-th group in the q-th tile into their bins."""
        tile, _ = self.tile_at(grid, self.orders[g], w, q)
        for p in range(self.orders[g].start[tile], self.end[g][tile]):
            stay_rolled(self.orders[0].buffers.real, p)
            if self.shown[g][p] != HIDDEN:
                base, _ = grid.scheme.spline.stencil(self.groups[g].x[p], grid.inverse_spacing)
                place = self.bin_of(grid, w, base)
                self.following[g][p] = self.first[g][place]
                self.first[g][place] = p

    # On a GPU, with a thread per node or particle: particles are counted per bin, bins reserve slots, particles are
    # stored in these, and the slots of each bin are linked to its list.

    @ti.func
    def bin_at(self, g: ti.template(), grid: ti.template(), w: int, p: int):
        """Return the bin of a particle of the g-th group."""
        base, _ = grid.scheme.spline.stencil(self.groups[g].x[p], grid.inverse_spacing)
        return self.bin_of(grid, w, base)

    @ti.func
    def count_particle(self, g: ti.template(), grid: ti.template(), w: int, p: int):
        """Find the surface data of a particle of the g-th group, and count it in its bin."""
        self.find_surface_point(g, grid, w, p)
        if self.shown[g][p] != HIDDEN:
            self.rank[g][p] = ti.atomic_add(self.counted[g][self.bin_at(g, grid, w, p)], 1)

    @ti.func
    def reserve(self, w: int, place: int):
        """Reserve slots for the bins of a node."""
        for g in ti.static(self.surfaced):
            if self.counted[g][place] > 0:
                begin = w * ti.static(self.groups[g].capacity // self.runs)
                self.first[g][place] = begin + ti.atomic_add(self.reserved[g][w], self.counted[g][place])

    @ti.func
    def store_particle(self, g: ti.template(), grid: ti.template(), w: int, p: int):
        """Store a particle of the g-th group in its slot."""
        if self.shown[g][p] != HIDDEN:
            self.slots[g][self.first[g][self.bin_at(g, grid, w, p)] + self.rank[g][p]] = p

    @ti.func
    def link_slots(self, _w: int, place: int):
        """Link the slots of the bins of a node to lists."""
        for g in ti.static(self.surfaced):
            if self.counted[g][place] > 0:
                begin, end = self.first[g][place], self.first[g][place] + self.counted[g][place]
                self.first[g][place] = self.slots[g][begin]
                for k in range(begin, end):
                    following = EMPTY
                    if k + 1 < end:
                        following = self.slots[g][k + 1]
                    self.following[g][self.slots[g][k]] = following

    # What surface points are inside of.

    @ti.func
    def find_partners_in(self, g: ti.template(), grid: ti.template(), obstacles: ti.template(), w: int, q: int):
        """Find the partners of the particles of the g-th group in the q-th tile."""
        tile, _ = self.tile_at(grid, self.orders[g], w, q)
        for p in range(self.orders[g].start[tile], self.end[g][tile]):
            self.find_partners(g, grid, obstacles, w, p)

    @ti.func
    def find_partners(self, g: ti.template(), grid: ti.template(), obstacles: ti.template(), w: int, p: int):
        """Find the partners of a particle of the g-th group."""
        d = ti.static(self.dimension)
        if self.shown[g][p] != HIDDEN:
            count, point = 0, self.groups[g].x[p]
            for c in ti.static(range(d)):
                point[c] += self.surface[g][p][d + c]
            if ti.static(self.layers > int(self.shares) + 1):
                # The other body has mass at the nearest node.
                here = ti.cast(ti.round(point * grid.inverse_spacing), int) + PAD
                for a in ti.static(grid.images.periodic):
                    here[a] = grid.images.inside_along(here[a], a)
                place = self.bin_of(grid, w, here)
                if place >= 0 and self.present[ti.max(place, 0)] > 255:
                    layer, overlap = self.body_around(g, grid, w, p)
                    if layer != HIDDEN:
                        count = self.add_partner(g, p, count, layer, overlap)
            for o in range(obstacles.count()):
                distance, normal, _velocity, _friction = obstacles.at(o, point, 0.0)
                if distance < 0.0 and count < d:
                    count = self.add_partner(g, p, count, self.layers + o, distance * normal)
            for k in ti.static(range(d)):
                if k >= count:
                    self.partners[g][p][k] = EMPTY

    @ti.func
    def add_partner(self, g: ti.template(), p: int, count: int, partner: int, overlap: ti.template()):
        """Store a partner of a particle; return the number of its partners."""
        for k in ti.static(range(self.dimension)):
            if k == count:
                self.partners[g][p][k] = partner
                for c in ti.static(range(self.dimension)):
                    self.overlaps[g][p][k * ti.static(self.dimension) + c] = overlap[c]
        return count + 1

    @ti.func
    def body_around(self, g: ti.template(), grid: ti.template(), w: int, p: int):
        """Return the layer of the body that the point of a particle is inside of, or HIDDEN, and the overlap.

        It is inside by its depth below the plane of the nearest point of another body or, around an edge, of the one
        that is farther out.
        """
        d, h = ti.static((self.dimension, grid.spacing))
        # Around the place of a particle of the other body as deep below the same point.
        across = self.groups[g].x[p]
        for c in ti.static(range(d)):
            across[c] += 2.0 * self.surface[g][p][d + c]
        base, _ = grid.scheme.spline.stencil(across, grid.inverse_spacing)
        layer, nearest, distance, facing = HIDDEN, (NEAREST * h) ** 2, 0.0, 0.0
        place, normal, overlap = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        for turn in range(2):
            # Without any near point there is no edge.
            for q in range(ti.select(turn == 0 or distance < 0.0, ti.static(3**d * grid.images.by_period.sets), 0)):
                node, rest = base, q
                for a in ti.static(range(d)):
                    after = ti.raw_div(rest, 3)
                    node[a] += rest - after * 3 - 1
                    rest = after
                there, exists = grid.images.by_period.image(node, rest, 1)
                bin_ = self.bin_of(grid, w, there)
                if exists and bin_ >= 0:
                    for other in ti.static(self.surfaced):
                        r = self.first[other][bin_]
                        while r >= 0:
                            theirs = self.shown[other][r]
                            n, way, apart, off = ti.Vector.zero(float, d), ti.Vector.zero(float, d), 0.0, 0.0
                            for c in ti.static(range(d)):
                                n[c] = self.surface[other][r][c]
                                # From the point of the other, or its image, to that of the particle.
                                way[c] = self.groups[g].x[p][c] - self.groups[other].x[r][c]
                                way[c] += self.surface[g][p][d + c] - self.surface[other][r][d + c]
                                way[c] += ti.cast(there[c] - node[c], float) * h
                                apart += way[c] ** 2
                                off += way[c] * n[c]
                            takes = turn == 0 and theirs != self.shown[g][p] and apart < nearest
                            if turn == 1 and theirs == layer and off > distance:
                                takes = n.dot(way - place) < -CONVEX * self.band[w * self.layers + layer]
                            if takes:
                                layer, distance, facing = theirs, off, 0.0
                                for c in ti.static(range(d)):
                                    facing -= n[c] * self.surface[g][p][c]
                                    normal[c] = n[c]
                                    if turn == 0:
                                        place[c] = way[c]
                                if turn == 0:
                                    nearest = apart
                            r = self.following[other][r]
        if distance >= 0.0 or facing <= ti.static(FACES[0]):
            layer = HIDDEN
        depth = ti.max(distance, -DEEPEST * h) * ti.min((facing - FACES[0]) / ti.static(FACES[1] - FACES[0]), 1.0)
        for c in ti.static(range(d)):
            overlap[c] = depth * normal[c]
        return layer, overlap
