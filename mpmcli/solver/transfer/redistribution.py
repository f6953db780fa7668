"""Shifts particles of liquids and grains out of crowds that flow creates (docs/theory.md, 5.12).

Flow stretches the lattice of particles along its own axes: rows separate and planes pile up. The grid does not resolve
this, because the weights of planes one cell apart sum to 1. In the steps that relax volumes, a fine grid with about one
node per particle resolves the crowds. Particles move down the gradient of the crowding by an amount that grows with the
strain since the last shift. The mean of this motion on the grid is then subtracted. v changes by C times the
displacement, so that the velocity field does not change.

The functions below are the bodies of the phases of a shift, each for one node or one particle. `at` is a `Part` on a
CPU or an `Item` on a GPU; `time` is the time since the last shift, s.
"""

from collections.abc import Sequence

from mpmcli.materials.fluid import shear_rate
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.sampling import points_per_cell
from mpmcli.solver.grid.fine_grid import FineGrid
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.loop import STENCIL, Operation, Pass
from mpmcli.solver.transfer.stencils import add_linear, gather_linear
from mpmcli.stability.transfer_factors import FARTHEST

# Factor s of the strain e since the last shift: a particle moves by s e / (1 + s e) of the gradient of the crowding.
PUSH = 8.0
# Excess of the filling over 1 below which it counts less: that of rows of a lattice stretched twice.
MILD = 0.5


def fine_nodes(scene: Scene, laws: Sequence[Law]) -> int:
    """Return the fine nodes per cell along an axis, about one per shifted particle; 0 if no particles are shifted."""
    flowing = {law.name for law in laws if law.shifts}
    if not scene.solver.redistribute:
        return 0
    counts = [points_per_cell(body, scene.domain.spacing) for body in scene.bodies if body.material.law in flowing]
    counts += [emitter.particles_per_cell for emitter in scene.emitters if emitter.material.law in flowing]
    return max((max(1, round(count ** (1 / scene.dimension))) for count in counts), default=0)


def farthest_shift(fine: FineGrid | None) -> float:
    """Return the largest displacement of a particle by a shift and the subtraction of its mean, cells."""
    return 2 * FARTHEST / fine.per_cell if fine else 0.0


@ti.func
def clear_fine(at: ti.template(), node: ti.template(), time: float):
    """Clear a node and the fine nodes of its cell."""
    at.grid.clear(at.grid.linear_index(node))
    for q in range(ti.static(at.grid.fine.in_cell)):
        at.grid.fine.clear(at.grid.fine.linear_index(at.grid.fine.place_in_cell(node, q)))


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
    add_linear(fine.sums, fine, fine.stencil_at(base), w, ti.Vector([volume * fine.scale]), even, at.atomic)


@ti.func
def fine_to_float(at: ti.template(), node: ti.template(), time: float):
    """Convert the sums of the fine nodes from fixed point."""
    for q in range(ti.static(at.grid.fine.in_cell)):
        index = at.grid.fine.linear_index(at.grid.fine.place_in_cell(node, q))
        at.grid.fine.fill[index][0] = at.grid.fine.sums.value(index)[0] / at.grid.fine.scale


@ti.func
def fold_fine(at: ti.template(), node: ti.template(), time: float):
    """Add values of image nodes beyond the faces of an axis to fine nodes; after the last axis keep the crowding.

    Nodes on a wall count twice, because half of their cell is outside. Images receive the same value.
    """
    grid, fine, d = ti.static((at.grid, at.grid.fine, at.grid.dimension))
    for axis in ti.static(range(d)):
        if at.turn == axis:
            _, deep, _ = grid.images.image_along(node[axis], axis, 1, 1)
            if ti.static(axis == d - 1) or deep <= 1:
                for q in range(ti.static(fine.in_cell)):
                    place = fine.place_in_cell(node, q)
                    image, depth, _ = grid.images.image_along(place[axis], axis, 1, fine.per_cell)
                    if depth >= 0:
                        index = fine.linear_index(place)
                        total, beyond = fine.fill[index][0], index
                        if depth <= 1:
                            place[axis] = image
                            beyond = fine.linear_index(place)
                            total += fine.fill[beyond][0]
                        if ti.static(axis == d - 1):
                            excess = ti.max(total - 1.0, 0.0) / MILD
                            total = excess * ti.min(excess * excess, 1.0)
                        fine.fill[index][0] = total
                        if depth <= 1:
                            fine.fill[beyond][0] = total


@ti.func
def locate(at: ti.template(), _p: int, _time: float, x: ti.template()):
    """Return the stencil of a particle and its weights."""
    base, distance = at.grid.scheme.spline.stencil(x, at.grid.inverse_spacing)
    return at.grid.stencil_at(base), at.grid.scheme.spline.weights(distance)


@ti.func
def locate_fine(at: ti.template(), _p: int, _time: float, x: ti.template()):
    """Return the stencil of a particle on the fine grid, its weights, and the distance from its first node."""
    base, distance = at.grid.fine.stencil(x, at.grid.inverse_spacing)
    return at.grid.fine.stencil_at(base), at.grid.fine.scheme.spline.weights(distance), distance


@ti.func
def crowd(at: ti.template(), p: int, _time: float, finer: ti.template(), fine_w: ti.template(), apart: ti.template()):
    """Return the gradient of the crowding at a particle, and its mass."""
    return slope_of(at.grid.fine, finer, fine_w, apart), at.group.row(p)[MASS]


@ti.func
def go_down(
    at: ti.template(), _p: int, time: float, x: ti.template(), v: ti.template(), C: ti.template(), slope: ti.template()
):
    """Return a particle moved down the gradient of the crowding, and its displacement."""
    way = held_back(at, x, way_down(at, slope, C, time))
    return x + way, v + C @ way, way


@ti.func
def tell_nodes(
    at: ti.template(), _p: int, _time: float, first: ti.template(), w: ti.template(), mass: float, way: ti.template()
):
    """Add the mass of a particle and its mass times displacement to its nodes."""
    even = ti.Matrix.zero(float, ti.static(at.grid.dimension), ti.static(at.grid.dimension))
    add_shift(at, first, w, mass, way, even)


@ti.func
def mean_shift(at: ti.template(), _p: int, _time: float, first: ti.template(), w: ti.template()):
    """Return the opposite of the mean displacement at a particle."""
    mean, _ = gather_linear(at.grid.nodes, at.grid, first, w)
    back = ti.Vector.zero(float, ti.static(at.grid.dimension))
    for a in ti.static(range(at.grid.dimension)):
        back[a] = -mean[a]
    return back


@ti.func
def go_back(
    at: ti.template(), _p: int, _time: float, x: ti.template(), v: ti.template(), C: ti.template(), back: ti.template()
):
    """Return a particle without the mean displacement."""
    way = held_back(at, x, back)
    return x + way, v + C @ way


LOCATE = Pass(locate, {"first": STENCIL, "w": ("nodes", "d")}, in_lanes=True)
MOTION = {"x": None, "v": None}
# Moves particles down the gradient of the crowding; nodes take the mean of this motion.
SHIFT = Operation(
    reads=("x", "v", "C"),
    passes=(
        LOCATE,
        Pass(locate_fine, {"finer": STENCIL, "fine_w": (3, "d"), "apart": ("d",)}, in_lanes=True),
        Pass(crowd, {"slope": ("d",), "mass": ()}),
        Pass(go_down, MOTION | {"way": ("d",)}, in_lanes=True),
        Pass(tell_nodes),
    ),
    writes=("x", "v"),
)
# Subtracts the mean displacement at particles.
UNSHIFT = Operation(
    reads=("x", "v", "C"),
    passes=(LOCATE, Pass(mean_shift, {"back": ("d",)}), Pass(go_back, MOTION, in_lanes=True)),
    writes=("x", "v"),
)


@ti.func
def slope_of(fine: ti.template(), first: ti.template(), w: ti.template(), distance: ti.template()):
    """Return the gradient of `FineGrid.fill` per fine cell, the sum of fill_j grad w_j over a stencil."""
    d = ti.static(fine.dimension)
    slopes = ti.Matrix.rows([distance - 1.5, 2.0 - 2.0 * distance, distance - 0.5])
    result, origin = ti.Vector.zero(float, d), fine.origin_of(first)
    for i, j in ti.static(ti.ndrange(fine.planes, 3)):
        total, slope = 0.0, 0.0
        for k in ti.static(range(3)):
            fill = fine.fill[fine.node_of(origin, i, j, k)][0]
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
    scale = mass * grid.way_scale()
    for c in ti.static(range(d)):
        value[c] = scale * way[c]
        for a in ti.static(range(d)):
            change[a, c] = scale * slope[a, c]
    value[d] = mass
    if grid.scaled(mass, value, change):
        add_linear(grid.sums, grid, first, w, value, change, at.atomic)


@ti.func
def shift_to_float(at: ti.template(), node: ti.template(), time: float):
    """Convert the sums of a node from fixed point."""
    (grid,) = ti.static((at.grid,))
    index = grid.linear_index(node)
    grid.fixed.to_float(grid, index, 0.0)
    for a in ti.static(range(grid.dimension)):
        grid.nodes[index][a] *= grid.fixed.largest_way(grid.spacing)


@ti.func
def fold_shift(at: ti.template(), node: ti.template(), time: float):
    """Add values of image nodes beyond the faces of an axis to nodes; after the last axis divide by the mass.

    Displacements of images are mirrored: odd along the normal of a wall.
    """
    grid, reach, d = ti.static((at.grid, at.grid.scheme.spline.nodes - 2, at.grid.dimension))
    for axis in ti.static(range(d)):
        image, depth, _ = grid.images.image_along(node[axis], axis, reach, 1)
        if at.turn == axis and depth >= 0:
            place, index = node, grid.linear_index(node)
            total, beyond = grid.nodes[index], index
            if depth <= reach:
                place[axis] = image
                beyond = grid.linear_index(place)
                total += mirrored(grid.nodes[beyond], axis, grid)
            if ti.static(axis == d - 1):
                if total[d] > 0.0:
                    total /= total[d]
            grid.nodes[index] = total
            if depth <= reach:
                grid.nodes[beyond] = mirrored(total, axis, grid)


@ti.func
def mirrored(value: ti.template(), axis: ti.template(), grid: ti.template()):
    result = value
    if ti.static(axis not in grid.images.periodic):
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
    for a, side in ti.static(grid.images.mirrors):
        if ti.static(side == 0):
            result[a] = ti.max(result[a], -0.5 * x[a])
        else:
            result[a] = ti.min(result[a], 0.5 * (at.particles.extent[a] - x[a]))
    return result
