"""Shifts particles of liquids and grains out of crowds that flow creates (docs/theory.md, 5.12).

Flow stretches the lattice of particles along its own axes: rows separate and planes pile up. The grid does not resolve
this, because the weights of planes one cell apart sum to 1. In the steps that relax volumes, a fine grid with about one
node per particle resolves the crowds. Particles move down the gradient of the crowding by an amount that grows with the
strain since the last shift. The mean of this motion on the grid is then subtracted. v changes by C times the
displacement, so that the velocity field does not change.

The functions below are the bodies of the phases of a shift, each for one node or one particle. `at` is a `Part` on a
CPU or an `Item` on a GPU; `time` is the time since the last shift, s.
"""

import math
from collections.abc import Sequence

from mpmcli.materials.fluid import shear_rate
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import points_per_cell
from mpmcli.solver.grid.grid import Grid, LinearNodes
from mpmcli.solver.grid.sparse_grid import BlockNodes, SparseGrid
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.transfer.lanes import (
    LANES,
    load_entry,
    load_vectors,
    matrix_of,
    repeat_first,
    store_lanes,
    vector_of,
    weights_of,
    zero_lanes,
)
from mpmcli.solver.transfer.splines import PAD, SPLINES, TransferScheme, bounded
from mpmcli.solver.transfer.stencils import add_linear, gather_linear, node_of, origin_of
from mpmcli.solver.transfer.volume import image_along
from mpmcli.stability.transfer_factors import FARTHEST

# Factor s of the strain e since the last shift: a particle moves by s e / (1 + s e) of the gradient of the crowding.
PUSH = 8.0
# Excess of the filling over 1 below which it counts less: that of rows of a lattice stretched twice.
MILD = 0.5
# Bound on a displacement in the sums in fixed point, cells.
LARGEST_WAY = 4.0


def fine_nodes(scene: Scene, laws: Sequence[Law]) -> int:
    """Return the fine nodes per cell along an axis, about one per shifted particle; 0 if no particles are shifted."""
    flowing = {law.name for law in laws if law.shifts}
    if not scene.solver.redistribute:
        return 0
    counts = [points_per_cell(body, scene.domain.spacing) for body in scene.bodies if body.material.law in flowing]
    counts += [emitter.particles_per_cell for emitter in scene.emitters if emitter.material.law in flowing]
    return max((max(1, round(count ** (1 / scene.dimension))) for count in counts), default=0)


def farthest_shift(fine: "FineGrid | None") -> float:
    """Return the largest displacement of a particle by a shift and the subtraction of its mean, cells."""
    return 2 * FARTHEST / fine.per_cell if fine else 0.0


@ti.data_oriented
class FineGrid(LinearNodes):
    """Nodes about as far apart as particles, `per_cell` per cell of a grid along each axis.

    Attributes:
        per_cell: nodes per cell along an axis.
        in_cell: nodes per cell.
        fill: Vector(1) field: the filled fraction of each fine cell; after `fold_fine` the crowding phi.
    """

    width = 1

    def __init__(self, grid: Grid, per_cell: int) -> None:
        self.dimension, self.per_cell, self.runs, self.first_node = grid.dimension, per_cell, grid.runs, 0
        self.in_cell = per_cell**self.dimension
        self.scheme, self.planes = TransferScheme(SPLINES["quadratic"]), 3 if self.dimension == 3 else 1
        self.strides = tuple(math.prod(per_cell * n for n in grid.shape[a + 1 :]) for a in range(self.dimension))
        self.node_count = self.in_cell * grid.node_count
        self.fill = ti.Vector.field(1, float, shape=self.runs * self.node_count)

    @ti.func
    def place_in_cell(self, node: ti.template(), q: int):
        """Return the integer coordinates of the q-th fine node in the cell whose first node is `node`."""
        place = node * self.per_cell
        for a in ti.static(range(self.dimension)):
            place[a] += q // ti.static(self.per_cell ** (self.dimension - 1 - a)) % self.per_cell
        return place

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance from it, given the 1/h of the grid."""
        base, distance = self.scheme.spline.stencil(x, inverse_spacing * self.per_cell)
        return base + ti.static(PAD * (self.per_cell - 1)), distance


@ti.data_oriented
class FineBlocks(BlockNodes, FineGrid):
    """The fine nodes of a sparse grid: a block stores the fine nodes of its cells."""

    def __init__(self, grid: SparseGrid, per_cell: int) -> None:
        super().__init__(grid, per_cell)
        self.tile, self.tiles, self.table = per_cell * grid.tile, grid.tiles, grid.table
        self.block = self.tile**self.dimension


@ti.func
def inside_along(j: int, axis: ti.template(), grid: ti.template(), last: ti.template(), n: ti.template()):
    """Return whether node j of a grid with n nodes per cell is not an image node beyond a face of an axis."""
    inside = True
    if ti.static((axis, 0) not in grid.opens):
        inside = j >= ti.static(PAD * n)
    if ti.static((axis, 1) not in grid.opens):
        inside = inside and j <= last[axis] * n - ti.static(axis in grid.period.axes)
    return inside


@ti.func
def clear_fine(at: ti.template(), node: ti.template(), time: float):
    """Clear a node and the fine nodes of its cell."""
    at.grid.clear(at.grid.linear_index(node))
    for q in range(ti.static(at.grid.fine.in_cell)):
        index = at.grid.fine.linear_index(at.grid.fine.place_in_cell(node, q))
        at.grid.fine.fill[index][0] = 0.0
        if ti.static(at.grid.deterministic):
            at.grid.fixed.fine.clear(index)


@ti.func
def fill_fine(at: ti.template(), p: int, time: float):
    """Add the volume of particle p to its fine nodes, as a fraction of a fine cell of at most 1."""
    (fine,) = ti.static((at.grid.fine,))
    base, distance = fine.stencil(at.group.x[p], at.grid.inverse_spacing)
    volume = at.group.row(p)[VOLUME]
    for _ in ti.static(range(fine.dimension)):
        volume *= ti.static(float(fine.per_cell)) * at.grid.inverse_spacing
    # A particle larger than a fine cell is not a crowd by itself.
    volume = ti.min(volume, 1.0)
    w = fine.scheme.spline.weights(distance)
    even = ti.Matrix.zero(float, fine.dimension, 1)
    first = fine.stencil_at(base)
    if ti.static(at.grid.deterministic):
        scaled = ti.Vector([volume * ti.static(at.grid.fixed.of_fine)])
        add_linear(at.grid.fixed.fine, fine, first, w, scaled, even, at.atomic)
    else:
        add_linear(fine.fill, fine, first, w, ti.Vector([volume]), even, at.atomic)


@ti.func
def fill_range(at: ti.template(), first: int, last: int, time: float):
    """Add the volumes of particles first to last - 1 to fine nodes."""
    for p in range(first, last):
        stay_rolled(at.order.buffers.real, p)
        fill_fine(at, p, time)


@ti.func
def fine_to_float(at: ti.template(), node: ti.template(), time: float):
    """Convert the sums of the fine nodes from fixed point."""
    for q in range(ti.static(at.grid.fine.in_cell)):
        index = at.grid.fine.linear_index(at.grid.fine.place_in_cell(node, q))
        at.grid.fine.fill[index][0] = at.grid.fixed.fine.value(index)[0] / ti.static(at.grid.fixed.of_fine)


@ti.func
def fold_fine(at: ti.template(), node: ti.template(), time: float):
    """Add values of image nodes beyond the faces of an axis to fine nodes; after the last axis keep the crowding.

    Nodes on a wall count twice, because half of their cell is outside. Images receive the same value.
    """
    grid, fine, last, d = ti.static((at.grid, at.grid.fine, at.particles.last, at.grid.dimension))
    for axis in ti.static(range(d)):
        if at.turn == axis:
            _, near = image_along(node[axis], axis, grid, last, 1, 1)
            if ti.static(axis == d - 1) or near:
                for q in range(ti.static(fine.in_cell)):
                    place = fine.place_in_cell(node, q)
                    if inside_along(place[axis], axis, grid, last, fine.per_cell):
                        image, exists = image_along(place[axis], axis, grid, last, 1, fine.per_cell)
                        index = fine.linear_index(place)
                        total, beyond = fine.fill[index][0], index
                        if exists:
                            place[axis] = image
                            beyond = fine.linear_index(place)
                            total += fine.fill[beyond][0]
                        if ti.static(axis == d - 1):
                            excess = ti.max(total - 1.0, 0.0) / MILD
                            total = excess * ti.min(excess * excess, 1.0)
                        fine.fill[index][0] = total
                        if exists:
                            fine.fill[beyond][0] = total


@ti.func
def shift(at: ti.template(), p: int, time: float):
    """Move particle p down the gradient of the crowding; add its mass and mass times displacement to its nodes."""
    grid, fine, group, d = ti.static((at.grid, at.grid.fine, at.group, at.grid.dimension))
    v, C = group.motion(p)
    x = group.x[p]
    fine_base, fine_distance = fine.stencil(x, grid.inverse_spacing)
    slope = slope_of(fine, fine.stencil_at(fine_base), fine.scheme.spline.weights(fine_distance), fine_distance)
    way = held_back(at, x, way_down(at, slope, C, time))
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    even = ti.Matrix.zero(float, d, d)
    add_shift(at, grid.stencil_at(base), grid.scheme.spline.weights(distance), group.row(p)[MASS], way, even)
    for a in ti.static(range(d)):
        group.x[p][a] = x[a] + way[a]
        group.v[p][a] = v[a] + (C @ way)[a]


@ti.func
def unshift(at: ti.template(), p: int, time: float):
    """Subtract the mean displacement at particle p from its position."""
    grid, group, d = ti.static((at.grid, at.group, at.grid.dimension))
    v, C = group.motion(p)
    x = group.x[p]
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    mean, _ = gather_linear(grid.nodes, grid, grid.stencil_at(base), grid.scheme.spline.weights(distance))
    back = ti.Vector.zero(float, d)
    for a in ti.static(range(d)):
        back[a] = -mean[a]
    way = held_back(at, x, back)
    for a in ti.static(range(d)):
        group.x[p][a] = x[a] + way[a]
        group.v[p][a] = v[a] + (C @ way)[a]


@ti.func
def shift_range(at: ti.template(), first: int, last: int, time: float):
    """Shift particles first to last - 1."""
    if ti.static(at.grid.sparse):
        for p in range(first, last):
            shift(at, p, time)
    else:
        shift_lanes(at, first, last, time, False)


@ti.func
def unshift_range(at: ti.template(), first: int, last: int, time: float):
    """Subtract the mean displacements at particles first to last - 1 from their positions."""
    if ti.static(at.grid.sparse):
        for p in range(first, last):
            unshift(at, p, time)
    else:
        shift_lanes(at, first, last, time, True)


@ti.func
def shift_lanes(at: ti.template(), first: int, last: int, time: float, back: ti.template()):
    """Shift particles first to last - 1, or unshift them if `back`, LANES at a time; see `lanes`."""
    grid, fine, group, d = ti.static((at.grid, at.grid.fine, at.group, at.grid.dimension))
    nodes = ti.static(grid.scheme.spline.nodes)
    x, v, affine, ways = zero_lanes(d), zero_lanes(d), zero_lanes(ti.static(d * d)), zero_lanes(d)
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    first_fine, fine_weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(3 * d))
    distances, masses = zero_lanes(d), ti.Vector.zero(float, LANES)
    begin = first
    while begin < last:
        count, origin = ti.min(LANES, last - begin), bounded(begin)
        load_vectors(x, group.x, origin)
        load_vectors(v, group.v, origin)
        for c, a in ti.static(ti.ndrange(d, d)):
            load_entry(affine, c * d + a, group.gradient, (a, c), origin)
        if count < LANES:
            repeat_first(x, count)
        for lane in range(LANES):
            base, distance = grid.scheme.spline.stencil(vector_of(x, 0, d, lane), grid.inverse_spacing)
            first_node[lane] = grid.linear_index(base)
            store_weights(weights, grid.scheme.spline.weights(distance), lane)
            if ti.static(not back):
                base, distance = fine.stencil(vector_of(x, 0, d, lane), grid.inverse_spacing)
                first_fine[lane] = fine.linear_index(base)
                store_weights(fine_weights, fine.scheme.spline.weights(distance), lane)
                for a in ti.static(range(d)):
                    distances[a, lane] = distance[a]
        for lane in range(count):
            stay_rolled(at.order.buffers.real, first_node[lane])
            if ti.static(back):
                w = weights_of(weights, nodes, d, lane)
                mean, _ = gather_linear(grid.nodes, grid, first_node[lane], w)
                for a in ti.static(range(d)):
                    ways[a, lane] = -mean[a]
            else:
                masses[lane] = group.row(begin + lane)[MASS]
                w = weights_of(fine_weights, 3, d, lane)
                slope = slope_of(fine, first_fine[lane], w, vector_of(distances, 0, d, lane))
                for a in ti.static(range(d)):
                    ways[a, lane] = slope[a]
        for lane in range(LANES):
            C, way = matrix_of(affine, 0, d, lane), vector_of(ways, 0, d, lane)
            if ti.static(not back):
                way = way_down(at, way, C, time)
            way = held_back(at, vector_of(x, 0, d, lane), way)
            change = C @ way
            for a in ti.static(range(d)):
                ways[a, lane] = way[a]
                x[a, lane] += way[a]
                v[a, lane] += change[a]
        if count == LANES:
            for a in ti.static(range(d)):
                store_lanes(group.x, (a,), origin, x, a)
                store_lanes(group.v, (a,), origin, v, a)
        else:
            for lane in range(count):
                stay_rolled(at.order.buffers.real, first_node[lane])
                for a in ti.static(range(d)):
                    group.x[begin + lane][a] = x[a, lane]
                    group.v[begin + lane][a] = v[a, lane]
        if ti.static(not back):
            for lane in range(count):
                stay_rolled(at.order.buffers.real, first_node[lane])
                w = weights_of(weights, nodes, d, lane)
                even = ti.Matrix.zero(float, d, d)
                add_shift(at, first_node[lane], w, masses[lane], vector_of(ways, 0, d, lane), even)
        begin += LANES


@ti.func
def store_weights(lanes: ti.template(), w: ti.template(), lane: int):
    for k, a in ti.static(ti.ndrange(w.n, w.m)):
        lanes[k * w.m + a, lane] = w[k, a]


@ti.func
def slope_of(fine: ti.template(), first: ti.template(), w: ti.template(), distance: ti.template()):
    """Return the gradient of `FineGrid.fill` per fine cell, the sum of fill_j grad w_j over a stencil."""
    d = ti.static(fine.dimension)
    slopes = ti.Matrix.rows([distance - 1.5, 2.0 - 2.0 * distance, distance - 0.5])
    result, origin = ti.Vector.zero(float, d), origin_of(first, fine)
    for i, j in ti.static(ti.ndrange(fine.planes, 3)):
        total, slope = 0.0, 0.0
        for k in ti.static(range(3)):
            fill = fine.fill[node_of(origin, fine, i, j, k)][0]
            total += w[k, d - 1] * fill
            slope += slopes[k, d - 1] * fill
        if ti.static(d == 3):
            result += ti.Vector(
                [slopes[i, 0] * w[j, 1] * total, w[i, 0] * slopes[j, 1] * total, w[i, 0] * w[j, 1] * slope]
            )
        else:
            result += ti.Vector([slopes[j, 0] * total, w[j, 0] * slope])
    return result


@ti.func
def way_down(at: ti.template(), slope: ti.template(), C: ti.template(), time: float):
    """Return the displacement of a particle down the gradient of the crowding, m; 0 at zero strain rate."""
    strain = PUSH * time * shear_rate(C)
    way = -strain / (1.0 + strain) * slope
    return way * (FARTHEST / ti.max(way.norm(), FARTHEST) * (at.grid.spacing * ti.static(1.0 / at.grid.fine.per_cell)))


@ti.func
def add_shift(
    at: ti.template(), first: ti.template(), w: ti.template(), mass: float, way: ti.template(), slope: ti.template()
):
    """Add the mass of a particle times its displacement, m, and its mass, to the nodes of a stencil.

    The rows of `slope` are the change of the displacement per cell along each axis, m.
    """
    grid, d = ti.static((at.grid, at.grid.dimension))
    value, change = ti.Vector.zero(float, grid.width), ti.Matrix.zero(float, d, grid.width)
    scale = mass
    if ti.static(grid.deterministic):
        # Convert to a speed within the range of the sums.
        scale *= grid.fixed.pace[grid.fixed.run][2] * ti.static(1.0 / LARGEST_WAY) * grid.inverse_spacing
    for c in ti.static(range(d)):
        value[c] = scale * way[c]
        for a in ti.static(range(d)):
            change[a, c] = scale * slope[a, c]
    value[d] = mass
    if ti.static(grid.deterministic):
        if grid.fixed.scaled(mass, value, change):
            add_linear(grid.fixed.nodes, grid, first, w, value, change, at.atomic)
    else:
        add_linear(grid.nodes, grid, first, w, value, change, at.atomic)


@ti.func
def shift_to_float(at: ti.template(), node: ti.template(), time: float):
    """Convert the sums of a node from fixed point."""
    (grid,) = ti.static((at.grid,))
    index = grid.linear_index(node)
    grid.fixed.to_float(grid, index, 0.0)
    for a in ti.static(range(grid.dimension)):
        grid.nodes[index][a] *= LARGEST_WAY * grid.spacing / grid.fixed.pace[grid.fixed.run][2]


@ti.func
def fold_shift(at: ti.template(), node: ti.template(), time: float):
    """Add values of image nodes beyond the faces of an axis to nodes; after the last axis divide by the mass.

    Displacements of images are mirrored: odd along the normal of a wall.
    """
    grid, last, d = ti.static((at.grid, at.particles.last, at.grid.dimension))
    for axis in ti.static(range(d)):
        if at.turn == axis and inside_along(node[axis], axis, grid, last, 1):
            reach = ti.static(grid.scheme.spline.nodes - 2)
            place, index = node, grid.linear_index(node)
            image, exists = image_along(node[axis], axis, grid, last, reach, 1)
            total, beyond = grid.nodes[index], index
            if exists:
                place[axis] = image
                beyond = grid.linear_index(place)
                total += mirrored(grid.nodes[beyond], axis, grid)
            if ti.static(axis == d - 1):
                if total[d] > 0.0:
                    total /= total[d]
            grid.nodes[index] = total
            if exists:
                grid.nodes[beyond] = mirrored(total, axis, grid)


@ti.func
def mirrored(value: ti.template(), axis: ti.template(), grid: ti.template()):
    result = value
    if ti.static(axis not in grid.period.axes):
        result[axis] = -value[axis]
    return result


@ti.func
def held_back(at: ti.template(), x: ti.template(), way: ti.template()):
    """Return the displacement, m, limited to half the distance from x to a wall or a collider, or out of a collider."""
    (grid,) = ti.static((at.grid,))
    result = way
    if ti.static(at.nodes.collides):
        most = FARTHEST * at.grid.spacing * ti.static(1.0 / at.grid.fine.per_cell)
        result = at.nodes.colliders.held_back(x, way, most)
    for a in ti.static(range(grid.dimension)):
        if ti.static(a not in grid.period.axes and (a, 0) not in grid.opens):
            result[a] = ti.max(result[a], -0.5 * x[a])
        if ti.static(a not in grid.period.axes and (a, 1) not in grid.opens):
            result[a] = ti.min(result[a], 0.5 * (at.particles.extent[a] - x[a]))
    return result
