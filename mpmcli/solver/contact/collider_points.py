"""Contact of material with colliders at points of their surfaces (docs/theory.md, 3.8).

A node within half a cell of a surface gives one point of it, the nearest. The velocity of the material at the point is
interpolated from the 3^d nodes around this node, and the impulse that stops it is spread by the same weights. Both
momenta are exact, and the surface acts where it is, at any position on the grid. Kinetic energy only falls. A point
begins a step with its impulse in the last one, so that material at rest keeps no velocity into the surface.

Nodes gather from points, and points from nodes, so that the results depend neither on threads nor on the order in which
points are found. A step calls, with a barrier after each: `find`, `spread_out`, `weigh`, for rigid bodies `push_rigid`
and `settle`, and `push`.
"""

import math

from mpmcli.boundaries.colliders import HELD, HOLD, LOOSE, PRESSED, SEPARATE, STICK, Colliders
from mpmcli.boundaries.feature import Feature, Phase, changed
from mpmcli.boundaries.rigid_bodies import ROUNDS
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.solver.transfer.splines import QuadraticSpline

# A point acts in full if the share of its kernel that is filled is ACTS_FULLY or more, not at all up to ACTS_FROM. The
# share falls from 1 to 0.8, 0.54, 0.34 if material stands off by 0.1, 0.3, 0.5 cells, wherever the nodes are.
ACTS_FROM, ACTS_FULLY = 0.5, 0.8
# Between these shares the weights of nodes that lack material rise from their filled part to the whole: the former lets
# material come near, the latter makes less noise where it rests.
PART, WHOLE = 0.75, 0.9
# Smallest share of the kernel of a node outside of colliders by which masses are divided, and the smallest for which
# the mass of a full node is estimated.
LEAST, FREE = 1e-5, 0.45
# Distance from a surface, cells, within which a node gives a point: a little more than a half, so that rounding leaves
# out no surface between two nodes. The share of such a node is at most NEAR.
HALF, NEAR = 0.501, 0.835
# Share of the mass of a full node below which the speed of a node does not bound the step.
LIGHT = 0.1
# Points of a node that keep their impulses.
KEPT = 2


@ti.func
def smooth(t: float):
    """Return a smooth step from 0 at t = 0 to 1 at t = 1."""
    inside = ti.min(ti.max(t, 0.0), 1.0)
    return inside * inside * (3.0 - 2.0 * inside)


@ti.data_oriented
class ColliderPoints(Feature):
    """The points of the surfaces of colliders that material touches in a step, in the shared layer of some runs.

    Attributes:
        capacity: largest number of points of a run.
        count: number of points of each run, while they are found.
        density: mass of a full node, kg, of the lightest material of each run.
        free: per node, the share of its kernel that is outside of colliders, negative if a collider holds the node.
        head: per node, 1 + the index of its first point, or 0; `next` of a point likewise.
        busy, marked: whether a row of nodes has points, and whether points have weights in it, 1 or 0; for phases that
            go row by row.
        spread: per node, the sum of the weights of all points; -1 while it is not yet summed.
        pushed: per node, the sum of the impulses with which all points begin, N s.
        kept: per node, the forces of its first KEPT points in the last step per weight, N. A sparse grid renumbers its
            nodes: `keeper` is 1 + the index of the node in a dense grid to which they belong.
        collider: index of the collider in its run.
        normal: normal into the material.
        centre: weighted mean of the positions of the nodes relative to the lower corner, m, where impulses act.
        weights: weights of the nodes around the node of the point; `share` is their sum.
        part: share of the point that belongs to the domain: a half on a wall.
        gain: impulse per velocity, kg.
        first: impulse per weight with which the point begins, N s; `drive` is the velocity that those of all points
            give to the material, times `share`.
        couples: whether rigid bodies are met.
        fills: whether the inside of colliders counts as filled, because some volumes relax.
        given: velocity of the material times `share`, then the impulse per weight on the material, N s.
    """

    def __init__(
        self, colliders: Colliders, nodes: int, layers: int, runs: int, *, fills: bool, sparse: bool = False
    ) -> None:
        """Allocate points for a grid with a number of nodes per run and layer."""
        d = colliders.dimension
        self.colliders, self.dimension, self.run, self.layers = colliders, d, 0, layers
        self.node_count, self.capacity, self.stencil = nodes, self.room(nodes, d), 3**d
        n = runs * self.capacity
        self.count = ti.field(int, shape=runs)
        self.density = ti.field(float, shape=runs)
        self.free, self.spread = (ti.field(float, shape=runs * nodes) for _ in range(2))
        self.pushed = ti.Vector.field(d, float, shape=runs * nodes)
        self.kept = ti.Vector.field(d, float, shape=runs * nodes * KEPT)
        self.sparse = sparse
        self.keeper = ti.field(int, shape=runs * nodes) if sparse else None
        self.head = ti.field(int, shape=runs * nodes)
        self.next, self.collider = ti.field(int, shape=n), ti.field(int, shape=n)
        vectors = (ti.Vector.field(d, float, shape=n) for _ in range(5))
        self.normal, self.centre, self.given, self.first, self.drive = vectors
        self.part, self.share, self.gain = (ti.field(float, shape=n) for _ in range(3))
        self.weights = ti.field(float, shape=n * self.stencil)
        self.rows = math.prod(colliders.shape[:-1])
        self.busy, self.marked = ti.field(int, shape=runs * self.rows), ti.field(int, shape=runs * self.rows)
        self.spline = QuadraticSpline()
        self.couples, self.fills = len(colliders.kind.free) > 0, fills

    @staticmethod
    def room(nodes: int, dimension: int) -> int:
        """Return the largest number of points of a run with this number of nodes: surfaces are fewer than volumes."""
        return nodes if dimension == 2 else min(nodes, nodes // 6 + 1000)

    def on(self, nodes: int) -> "ColliderPoints":
        """Return points for a grid with another number of nodes, and the same numbers of runs."""
        runs, sparse = self.density.shape[0], self.sparse
        result = ColliderPoints(self.colliders, nodes, self.layers, runs, fills=self.fills, sparse=sparse)
        result.density = self.density
        return result

    def viewed(self, view: object) -> "ColliderPoints":
        return changed(self, run=view.w, colliders=view.features.colliders)

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        """Return the phases that find points and their impulses, in rounds if rigid bodies are met, and push nodes."""
        found = [
            *[Phase("fill_solids", "nodes", "scatter", body=fill_solids, wanted=near_row)] * self.fills,
            Phase("find_points", "nodes", "points", body=find_points, wanted=new_row, words="find points of colliders"),
            Phase("spread_points", "nodes", "points", body=spread_points, wanted=marked_row),
            Phase(
                "weigh_points",
                "nodes",
                "points",
                body=weigh_points,
                wanted=busy_row,
                words="find impulses of colliders",
            ),
        ]
        if self.couples:
            how = {"turns": 2, "rounds": ROUNDS, "part": solve_part, "item": solve_item, "words": "meet rigid bodies"}
            found += [
                Phase("solve_rigid", "rows", "points", body=push_rigid, wanted=busy_row, **how),
                Phase("settle_points", "nodes", "points", body=settle_points, wanted=busy_row),
            ]
        push = Phase("push_points", "nodes", "points", body=push_points, wanted=last_row, words="let colliders push")
        return (*found, push)

    def saved(self) -> dict[str, ti.Field]:
        return {} if self.sparse else self.kept_fields

    @property
    def kept_fields(self) -> dict[str, ti.Field]:
        """The fields of nodes that persist between steps, by name."""
        return {"points.kept": self.kept} | ({"points.keeper": self.keeper} if self.sparse else {})

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the mass of a full node of a run."""
        least = min((body.material.density for body in scene.sources), default=0.0)
        self.density[run] = least * scene.domain.spacing**self.dimension

    # Shares of nodes.

    @ti.func
    def place(self, index: int):
        """Return the index of a node of layer 0 in the fields of nodes, given that in the grid."""
        return index - self.run * ((self.layers - 1) * self.node_count)

    @ti.func
    def row_of(self, node: ti.template()):
        """Return the index of the row of a node in the fields of rows."""
        return self.run * self.rows + self.colliders.loads.row_of(node)

    @ti.func
    def near_row(self, node: ti.template()):
        """Return whether a collider may cut the kernel of a node of the row that begins at a node."""
        x, result = self.colliders.position_of(node), False
        for k in range(self.colliders.count[self.run]):
            i = self.run * self.colliders.capacity + k
            result = result or self.colliders.covers(i, x, self.colliders.beyond(), self.dimension - 1)
        return result

    @ti.func
    def fill(self, grid: ti.template(), walls: ti.template(), node: ti.template()):
        """Count the part of a node that is inside of colliders as filled, for the relaxation of volumes."""
        share, inside = 1.0 - ti.abs(self.colliders.free_share(node, grid.scheme.spline)), True
        if share > 0.0:
            for a in ti.static(range(self.dimension)):
                if ti.static(a not in walls.periodic):
                    inside = inside and node[a] >= walls.first and node[a] <= walls.last[a]
                    if node[a] == walls.first or node[a] == walls.last[a]:
                        share *= 0.5
                share *= grid.spacing
            if inside:
                index = grid.linear_index(node)
                entry = ti.static(self.dimension)
                grid.filling[index][entry] = grid.filling[index][entry] + share
                grid.filling[index][0] = share

    @ti.func
    def around(self, node: ti.template(), c: int, way: ti.template()):
        """Return neighbour c of a node; with way = -1 the node of which this node is neighbour c."""
        found, rest = node, c
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            found[a] += way * (rest % 3 - 1)
            rest = rest // 3
        return found

    # Points.

    @ti.func
    def find(self, grid: ti.template(), images: ti.template(), extent: ti.template(), node: ti.template(), kick: float):
        """Find the points of a node, their weights, and the impulses with which they begin, in a step of `kick` s."""
        d, walls = ti.static((self.dimension, images.walls))
        index = grid.linear_index(node)
        own = self.place(index)
        self.head[own] = 0
        # Without mass at the node, no particle is within a cell of its point; images beyond a periodic face have none.
        near = grid.nodes[index][d] > 0.0 and ti.abs(self.free[own]) <= NEAR
        if ti.static(len(walls.periodic) > 0):
            near = near or walls.near(node)
        if near:
            # Counted first: software Vulkan loses atomic additions in loops.
            wanted = self.visit(walls, extent, node, own, -1)
            if wanted > 0:
                first = ti.atomic_add(self.count[self.run], wanted)
                if first + wanted <= self.capacity:
                    self.visit(walls, extent, node, own, self.run * self.capacity + first)
            p, row, place, keeps = self.head[own] - 1, self.row_of(node), 0, self.keeps(node, own)
            while p >= 0:
                self.busy[row] = 1
                self.weight_all(grid, images, node, p)
                self.first[p] = ti.Vector.zero(float, d)
                if place < KEPT and keeps:
                    self.first[p] = self.gain[p] * kick * self.kept[KEPT * own + place]
                self.given[p] = self.first[p]
                place += 1
                p = self.next[p] - 1
        for place in range(KEPT):
            self.kept[KEPT * own + place] = ti.Vector.zero(float, d)

    @ti.func
    def keeps(self, node: ti.template(), own: int):
        """Return whether the impulses at a place in the fields of nodes are those of a node, which takes the place."""
        result = True
        if ti.static(self.sparse):
            index = 0
            for a in ti.static(range(self.dimension)):
                index = index * ti.static(self.colliders.shape[a]) + node[a]
            result = self.keeper[own] == index + 1
            self.keeper[own] = index + 1
        return result

    @ti.func
    def visit(self, walls: ti.template(), extent: ti.template(), node: ti.template(), own: int, first: int):
        """Return the number of points of a node; write them from index `first` on, unless it is negative."""
        h, x, found = self.colliders.spacing, self.colliders.position_of(node), 0
        for k in range(self.colliders.count[self.run]):
            i = self.run * self.colliders.capacity + k
            if self.colliders.wall[i] != HOLD and self.colliders.covers(i, x):
                arm = x - self.colliders.place[i]
                for face in range(self.colliders.faces_of(i)):
                    phi, normal = self.colliders.distance(i, arm, face, True)
                    if ti.abs(phi) <= HALF * h and self.colliders.acts_by_points(i, arm, face, phi, normal):
                        y, part = self.place_inside(walls, extent, node, x - phi * normal, normal)
                        if part > 0.0:
                            if first >= 0:
                                self.write_point(first + found, own, k, y, normal, part)
                            found += 1
        return found

    @ti.func
    def write_point(self, p: int, own: int, k: int, y: ti.template(), normal: ti.template(), part: float):
        """Set point p, at y on collider k, of the node with this place in the fields of nodes."""
        self.collider[p], self.part[p] = k, part
        self.next[p], self.head[own] = self.head[own], p + 1
        for a in ti.static(range(self.dimension)):
            self.centre[p][a], self.normal[p][a] = y[a], normal[a]

    @ti.func
    def place_inside(
        self,
        walls: ti.template(),
        extent: ti.template(),
        node: ti.template(),
        y: ti.template(),
        normal: ti.template(),
    ):
        """Return the place of point y of a node, and its share inside the domain: 1, 0, or a half for nodes on a wall.

        If the point of a node on a wall lies beyond the wall, it is moved along the surface to the wall.
        """
        place, part, tiny = y, 1.0, 1e-5 * self.colliders.spacing
        for a in ti.static(range(self.dimension)):
            if ti.static(a in walls.periodic):
                if y[a] < -tiny or y[a] >= extent[a] - tiny:
                    part = 0.0
            elif node[a] == walls.first or node[a] == walls.last[a]:
                part *= 0.5
                back = ti.min(ti.max(y[a], 0.0), extent[a]) - y[a]
                # The point of a surface that is nearly parallel to the wall is not moved as far as that.
                along = ti.max(1.0 - normal[a] ** 2, 0.5)
                for c in ti.static(range(self.dimension)):
                    place[c] += ti.select(c == a, 1.0, -normal[a] * normal[c] / along) * back
            elif y[a] < -tiny or y[a] > extent[a] + tiny:
                part = 0.0
        return place, part

    @ti.func
    def weight(self, along: ti.template(), c: int):
        """Return the weight of neighbour c from those along each axis, a row for each of the three nodes."""
        result, rest = 1.0, c
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            k = rest % 3
            result *= ti.select(k == 0, along[0, a], ti.select(k == 1, along[1, a], along[2, a]))
            rest = rest // 3
        return result

    @ti.func
    def borne(self, place: ti.template(), normal: ti.template(), c: int):
        """Return over its weight the share of a stress behind a plane through a point that neighbour c bears.

        The forces of MLS-MPM, 4 V p w (x_i - x_p) / h^2, of a half space are those of a spline whose derivative is
        -4 u w(u) along the normal, not those of w: with the weights alone a row of particles along a face on nodes is
        at rest at 0.88 of the pressure. `place` is the point, in cells from the first neighbour.
        """
        result, rest = 0.0, c
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            u = ti.abs(place[a] - ti.cast(rest % 3, float))
            w = ti.max(0.75 - u * u, 0.5)
            result += normal[a] ** 2 * ti.select(u < 0.5, w + 0.25 / w, 1.0 - (u - 0.5) ** 2)
            rest = rest // 3
        return result

    @ti.func
    def weight_all(self, grid: ti.template(), images: ti.template(), node: ti.template(), p: int):
        """Find the weights of point p, which has its place in `centre`."""
        d = ti.static(self.dimension)
        i, h = self.run * self.colliders.capacity + self.collider[p], self.colliders.spacing
        place = ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            place[a] = self.centre[p][a] / h - ti.cast(node[a] - self.colliders.first - 1, float)
        along = self.spline.weights(place)
        full = self.fill_stencil(grid, images, node, p)
        share, total, centre = 0.0, 0.0, ti.Vector.zero(float, d)
        if full > 0.0:
            for c in range(self.stencil):
                share += self.weight(along, c) * ti.min(ti.abs(self.weights[p * self.stencil + c]) / full, 1.0)
        acts = smooth((share - ACTS_FROM) / (ACTS_FULLY - ACTS_FROM))
        whole = 0.0 if self.colliders.wall[i] == STICK else smooth((share - PART) / (WHOLE - PART))
        for c in range(self.stencil):
            weight = 0.0
            if acts > 0.0 and self.weights[p * self.stencil + c] > 0.0:
                filled = ti.min(self.weights[p * self.stencil + c] / full, 1.0)
                weight = self.weight(along, c) * (filled + (1.0 - filled) * whole)
                # What sticks cannot sink; sheared sand vibrates where the points of a lid bear like this.
                if self.colliders.wall[i] != STICK:
                    weight *= self.borne(place, self.normal[p], c)
                other = self.around(node, c, 1)
                own, _sign = images.owner(other)
                self.spread[self.place(grid.linear_index(own))] = -1.0
                self.marked[self.row_of(own)] = 1
                centre += weight * self.colliders.position_of(other)
            self.weights[p * self.stencil + c] = weight
            total += weight
        self.share[p], self.gain[p] = total, acts
        for a in ti.static(range(d)):
            self.centre[p][a] = centre[a] / ti.max(total, LEAST)

    @ti.func
    def fill_stencil(self, grid: ti.template(), images: ti.template(), node: ti.template(), p: int):
        """Set the weights of point p to the masses that the nodes would have without colliders.

        A node that is held counts as filled, but with a negative sign, because it will have no weight. Return the mass
        of a full node, kg.
        """
        d, walls = ti.static((self.dimension, images.walls))
        most = 0.0
        for c in range(self.stencil):
            own, _sign = images.owner(self.around(node, c, 1))
            index = grid.linear_index(own)
            mass, free = grid.nodes[index][d], self.free[self.place(index)]
            filled = 0.0
            if mass > 0.0:
                for a in ti.static(range(d)):
                    if ti.static(a not in walls.periodic):
                        if own[a] == walls.first or own[a] == walls.last[a]:
                            mass *= 2.0
                if free > FREE:
                    most = ti.max(most, mass / free)
                filled = ti.select(free < 0.0, -1.0, 1.0) * mass / ti.max(ti.abs(free), LEAST)
            self.weights[p * self.stencil + c] = filled
        # Where the outside holds only spray, `most` is no measure of what fits.
        return ti.min(most, self.density[self.run])

    # Sums.

    @ti.func
    def spread_out(self, grid: ti.template(), images: ti.template(), node: ti.template()):
        """Sum the weights of all points at a node and its images, and the impulses with which they begin."""
        own = self.place(grid.linear_index(node))
        if self.spread[own] < 0.0:
            self.pushed[own], self.spread[own] = self.gathered(grid, images, node)

    @ti.func
    def gathered(self, grid: ti.template(), images: ti.template(), node: ti.template()):
        """Return the sums over the points of their impulses at a node and its images, and of their weights."""
        total, weights = ti.Vector.zero(float, self.dimension), 0.0
        depth, mirror, upper, acts, holds = images.walls.state(node, False)
        every = images.every_image(acts, depth)
        for k in range(images.image_sets(every)):
            if k & every == k:
                weights += self.gather(grid, images.image(node, mirror, k), images.signs(k, holds), total)
        # Walls take what is normal to them, and if they stick all.
        for a in ti.static(images.walls.axes):
            if acts[a] == 1 and depth[a] == 0:
                total = images.walls.stopped(total, a, depth, holds, upper, 0.0)
        return total, weights

    @ti.func
    def gather(self, grid: ti.template(), node: ti.template(), sign: ti.template(), total: ti.template()):
        """Add to the total the impulses that the points around a node give to it, in order; return their weights."""
        weights = 0.0
        for c in range(self.stencil):
            beside = self.around(node, c, -1)
            if grid.in_use(beside) and self.busy[self.row_of(beside)] == 1:
                p = self.head[self.place(grid.linear_index(beside))] - 1
                while p >= 0:
                    weight = self.weights[p * self.stencil + c] * self.part[p]
                    for a in ti.static(range(self.dimension)):
                        total[a] += weight * sign[a] * self.given[p][a]
                    weights += weight
                    p = self.next[p] - 1
        return weights

    @ti.func
    def weigh(self, grid: ti.template(), images: ti.template(), node: ti.template(), kick: float):
        """Find the gain of the points of a node, and their impulses, unless rigid bodies have yet to be met."""
        d = ti.static(self.dimension)
        p = self.head[self.place(grid.linear_index(node))] - 1
        while p >= 0:
            resistance, drive, seen = 0.0, ti.Vector.zero(float, d), ti.Vector.zero(float, d)
            for c in range(self.stencil):
                weight = self.weights[p * self.stencil + c]
                if weight > 0.0:
                    own, sign = images.owner(self.around(node, c, 1))
                    index = grid.linear_index(own)
                    share = weight / grid.nodes[index][d]
                    resistance += share * self.spread[self.place(index)]
                    for a in ti.static(range(d)):
                        seen[a] += weight * sign[a] * grid.nodes[index][a]
                        drive[a] += share * sign[a] * self.pushed[self.place(index)][a]
            # The impulse that stops the material if all points act alike.
            self.gain[p] = self.gain[p] / resistance if resistance > 0.0 else 0.0
            self.drive[p] = drive
            for a in ti.static(range(d)):
                self.given[p][a] = seen[a]
            p = self.next[p] - 1
        if ti.static(not self.couples):
            self.settle(grid, node, kick)

    @ti.func
    def settle(self, grid: ti.template(), node: ti.template(), kick: float):
        """Find the impulses of the points of a node in a step of `kick` s, and keep them for the next one."""
        own = self.place(grid.linear_index(node))
        p, place = self.head[own] - 1, 0
        while p >= 0:
            self.settle_point(node, p)
            if place < KEPT and kick > 0.0:
                if self.colliders.wall[self.run * self.colliders.capacity + self.collider[p]] != STICK:
                    self.kept[KEPT * own + place] = self.given[p] / kick
            place += 1
            p = self.next[p] - 1

    @ti.func
    def settle_point(self, node: ti.template(), p: int):
        """Find the impulse of a point, and add it to the loads of its collider."""
        i = self.run * self.colliders.capacity + self.collider[p]
        given, _grip, _gain = self.impulse(p)
        for a in ti.static(range(self.dimension)):
            self.given[p][a] = given[a]
        if ti.static(not self.colliders.deterministic):
            taken = -(self.share[p] * self.part[p]) * given
            arm = self.centre[p] - self.colliders.place[i]
            self.colliders.loads.take(self.run, node, self.collider[p], taken, arm)

    @ti.func
    def add_row(self, grid: ti.template(), q: int):
        """Add to the loads of collider q % capacity the impulses of the points of a row of nodes, in order."""
        d = ti.static(self.dimension)
        (loads,) = ti.static((self.colliders.loads,))
        k, rest = q % self.colliders.capacity, q // self.colliders.capacity
        i, node = self.run * self.colliders.capacity + k, ti.Vector.zero(int, d)
        for b in ti.static(range(d - 1)):
            a = ti.static(d - 2 - b)
            node[a] = rest % ti.static(self.colliders.shape[a])
            rest = rest // ti.static(self.colliders.shape[a])
        total = ti.Vector.zero(float, ti.static(self.colliders.loads.width))
        for n in range(ti.static(self.colliders.shape[-1])):
            node[ti.static(d - 1)] = n
            if grid.in_use(node):
                p = self.head[self.place(grid.linear_index(node))] - 1
                while p >= 0:
                    if self.collider[p] == k:
                        arm = self.centre[p] - self.colliders.place[i]
                        total -= loads.of((self.share[p] * self.part[p]) * self.given[p], arm)
                    p = self.next[p] - 1
        row = self.run * self.colliders.loads.rows * self.colliders.capacity + q
        self.colliders.loads.taken[row] = self.colliders.loads.taken[row] + total

    @ti.func
    def impulse(self, p: int):
        """Return the impulse per weight on the material at a point, N s, the effect, and the impulse per velocity, kg.

        It begins with that of the last step, and is at most twice the one that would stop the material if all points
        acted alike: up to there kinetic energy falls. See `Colliders.met` for effects.
        """
        i = self.run * self.colliders.capacity + self.collider[p]
        arm, normal, gain = self.centre[p] - self.colliders.place[i], self.normal[p], self.gain[p]
        own = self.colliders.velocity[i] + self.colliders.turning[i] @ arm
        relative = self.given[p] - self.share[p] * own
        away = relative.dot(normal)
        along = relative - away * normal
        result, grip = ti.Vector.zero(float, self.dimension), LOOSE
        if self.colliders.wall[i] == STICK:
            result, grip = -gain * relative, HELD
        elif away < 0.0 or self.colliders.wall[i] != SEPARATE:
            start = self.first[p] - gain * (relative + self.drive[p])
            most, push = -2.0 * gain * away, start.dot(normal)
            rub, turn = start - push * normal, -gain * along
            if ti.abs(push) > ti.abs(most) and push * most > 0.0:
                push, gain = most, 2.0 * gain
            if push * most > 0.0:
                result, grip = push * normal, PRESSED
                bound = self.colliders.friction[i] * ti.max(push, 0.0)
                if bound > 0.0:
                    # Within this ball it takes energy, as the push does between 0 and `most`.
                    off, most_off = (rub - turn).norm(), turn.norm()
                    if off > most_off:
                        rub = turn + (most_off / off) * (rub - turn)
                    size = rub.norm()
                    if size > 0.0:
                        result += ti.min(1.0, bound / size) * rub
                        if bound >= size:
                            grip = HELD
        return result, grip, gain

    @ti.func
    def push_rigid(self, grid: ti.template(), node: ti.template(), rigid: ti.template()):
        """Add to the sums of rigid bodies the impulses that the points of a node would give to them."""
        d = ti.static(self.dimension)
        p = self.head[self.place(grid.linear_index(node))] - 1
        while p >= 0:
            for j in range(rigid.count):
                b, i = self.run * rigid.count + j, rigid.collider_of(self.run, j)
                if rigid.settled[b] == 0 and i == self.run * self.colliders.capacity + self.collider[p]:
                    given, grip, gain = self.impulse(p)
                    if grip != LOOSE:
                        arm, normal = self.centre[p] - self.colliders.place[i], self.normal[p]
                        scale = self.share[p] * self.part[p]
                        (loads,) = ti.static((self.colliders.loads,))
                        row = (self.run * loads.rows + loads.row_of(node)) * rigid.count + j
                        load = loads.of(-scale * given, arm)
                        for a in ti.static(range(rigid.loads)):
                            rigid.sums[row, a] = rigid.sums[row, a] + ti.cast(load[a], ti.f64)
                        directions = 1
                        if grip == HELD:
                            directions += ti.static(d - 1)
                        for c in range(directions):
                            along = normal
                            if grip == HELD:
                                for a in ti.static(range(d)):
                                    along[a] = ti.cast(a == c, float)
                            lever = ti.cast(loads.of(along, arm), ti.f64)
                            rigid.resist(row, lever, scale * self.share[p] * gain)
            p = self.next[p] - 1

    @ti.func
    def push(self, grid: ti.template(), images: ti.template(), node: ti.template()):
        """Give the impulses of the points to a node and its images; return the squared speed of the node."""
        d = ti.static(self.dimension)
        index, squared = grid.linear_index(node), 0.0
        own = self.place(index)
        if self.spread[own] > 0.0:
            self.spread[own] = 0.0
            change, _weights = self.gathered(grid, images, node)
            change /= grid.nodes[index][d]
            depth, mirror, _upper, acts, holds = images.walls.state(node, False)
            every = images.every_image(acts, depth)
            for k in range(images.image_sets(every)):
                if k & every == k:
                    at, signs = grid.linear_index(images.image(node, mirror, k)), images.signs(k, holds)
                    for a in ti.static(range(d)):
                        grid.nodes[at][a] = grid.nodes[at][a] + signs[a] * change[a]
            # Nodes inside, and light ones, hardly move particles.
            free = ti.abs(self.free[own])
            if free > 0.5 and grid.nodes[index][d] > LIGHT * free * self.density[self.run]:
                for a in ti.static(range(d)):
                    squared += grid.nodes[index][a] ** 2
        return squared


# The bodies of the phases, functions of a node. Points exist in layer 0 alone.


@ti.func
def fill_solids(at: ti.template(), node: ti.template(), _kick: float):
    """Count colliders as filled, in steps that relax volumes."""
    if at.nodes.colliders.own == 0 and at.step.relaxed > 0.0:
        at.features.points.fill(at.grid, at.nodes.images.walls, node)


@ti.func
def find_points(at: ti.template(), node: ti.template(), kick: float):
    """Find the points of a node."""
    if at.nodes.colliders.own == 0:
        at.features.points.find(at.grid, at.nodes.images, at.particles.extent, node, kick)


@ti.func
def spread_points(at: ti.template(), node: ti.template(), _kick: float):
    """Sum the weights of points at a node."""
    if at.nodes.colliders.own == 0:
        at.features.points.spread_out(at.grid, at.nodes.images, node)


@ti.func
def weigh_points(at: ti.template(), node: ti.template(), kick: float):
    """Find the gains of the points of a node, and without rigid bodies their impulses."""
    if at.nodes.colliders.own == 0:
        at.features.points.weigh(at.grid, at.nodes.images, node, kick)


@ti.func
def push_rigid(at: ti.template(), node: ti.template(), _kick: float):
    """Add the impulses of the points of a node to the sums of rigid bodies."""
    at.features.points.push_rigid(at.grid, node, at.features.rigid)


@ti.func
def solve_part(phases: ti.template(), at: ti.template()):
    """Find the velocities of rigid bodies: sum the impulses of points in even turns, and solve in odd turns."""
    if at.turn % 2 == 0:
        phases.each_node(at)
    elif at.region == 0 and at.part == 0:
        at.features.rigid.solve(at.w, at.run.dt)


@ti.func
def solve_item(phases: ti.template(), at: ti.template()):
    """The same for a row of nodes, or a run, on a GPU."""
    if ti.static(at.turn % 2 == 0):
        phases.each_row(at)
    elif at.q == 0:
        at.features.rigid.solve(at.w, at.run.dt)


@ti.func
def settle_points(at: ti.template(), node: ti.template(), kick: float):
    """Find the impulses of the points of a node after rigid bodies have been met."""
    at.features.points.settle(at.grid, node, kick)


@ti.func
def push_points(at: ti.template(), node: ti.template(), _kick: float):
    """Give the impulses of points to a node."""
    if at.nodes.colliders.own == 0:
        squared = at.features.points.push(at.grid, at.nodes.images, node)
        if ti.static(at.atomic):
            at.peaks.include(at.w, 0, squared)
        elif squared > at.step.speed_squared:
            ti.atomic_max(at.step.speed_squared, squared)


# Whether a phase has work in the row of nodes that begins at a node.


@ti.func
def near_row(at: ti.template(), node: ti.template()):
    """Return whether the row may be near a collider."""
    return at.features.points.near_row(node)


@ti.func
def new_row(at: ti.template(), node: ti.template()):
    """Return whether the row may be near a collider; no point of it is found yet."""
    at.features.points.busy[at.features.points.row_of(node)] = 0
    return at.features.points.near_row(node)


@ti.func
def busy_row(at: ti.template(), node: ti.template()):
    """Return whether the row has points."""
    return at.features.points.busy[at.features.points.row_of(node)] == 1


@ti.func
def marked_row(at: ti.template(), node: ti.template()):
    """Return whether a point has weights in the row."""
    return at.features.points.marked[at.features.points.row_of(node)] == 1


@ti.func
def last_row(at: ti.template(), node: ti.template()):
    """Return whether a point has weights in the row, for the last time in a step."""
    row = at.features.points.row_of(node)
    marked = at.features.points.marked[row]
    at.features.points.marked[row] = 0
    return marked == 1
