"""Corrects the volumes of particles by the mean of a cell (F-bar) and by the density on the grid.

Particles of a cell may share their change of volume, so that nearly incompressible material does not lock. The law then
receives F (J'/J)^(1/d), where ln J' is the mean of ln J over the particles of the cell, weighted by their volumes at
rest: F-bar (de Souza Neto et al. 1996) with the projection of B-bar (Hughes 1980). If particles change cells
(`ParticleArrays.evened`), F itself takes the mean growth of ln J of its cell. See docs/theory.md, 4.4. This code is
compiled only for groups with `ParticleArrays.averages`. Laws with `levels` take the mean of ln J into their state, in
the steps that relax volumes.

The volumes of liquids and grains relax towards the density on the grid (docs/theory.md, 5.11). This code is compiled
only for laws with `Law.relaxes` and runs in one step of every `INTERVAL`.
"""

import math
from collections.abc import Sequence

from mpmcli.materials.elementary import exp, exp_minus_1, log
from mpmcli.materials.fluid import BESIDE, DEAD_BAND, FULL, LARGEST_LACK
from mpmcli.materials.law import SMALLEST, Law
from mpmcli.materials.tensors import volume_strain
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.loop import INDEX, Operation, Pass, over
from mpmcli.solver.particles.state_bounds import deformation_rate, volume_ratio
from mpmcli.solver.transfer.splines import PAD

# Lack of volume that is ignored where a collider cuts the kernel, beside what a law ignores. The density of particles
# there is less even; without it still water rises from inclined faces.
UNEVEN = 0.08


def averages_volume(settings: SolverSettings, law: Law) -> bool:
    """Return whether the particles of a law share their change of volume."""
    if settings.f_bar == "auto":
        return law.locks
    return settings.f_bar and law.deformation == "F"


def levels_volume(settings: SolverSettings, law: Law) -> bool:
    """Return whether the particles of a law take the mean volume of their cell in steps that relax volumes."""
    return settings.f_bar == "auto" and law.levels


@ti.func
def cell_of(grid: ti.template(), x: ti.template()):
    """Return the linear index of the first node of the cell of a point."""
    cell = ti.Vector.zero(int, ti.static(grid.dimension))
    for a in ti.static(range(grid.dimension)):
        if ti.static(a in grid.images.periodic):
            # The coordinate of a particle beyond the lower face is negative.
            cell[a] = ti.cast(ti.floor(x[a] * grid.inverse_spacing), int) + PAD
        else:
            cell[a] = ti.cast(x[a] * grid.inverse_spacing, int) + PAD
    return grid.linear_index(cell)


@ti.func
def in_layer(grid: ti.template(), group: ti.template(), p: int, cell: int):
    """Return the index of a cell in the layer of the body of particle p, given that in layer 0."""
    return cell + group.layer_of(p) * grid.node_count


@ti.func
def log_volume(H: ti.template()):
    """Return ln J from F - I; the result is finite for crushed and inverted particles too."""
    return log(1.0 + ti.max(volume_strain(H), ti.static(SMALLEST - 1.0)))


@ti.func
def earlier_cell(grid: ti.template(), group: ti.template(), p: int, dt: float):
    """Return the linear index of the first node of the cell in which particle p was a step of dt, s, ago."""
    return in_layer(grid, group, p, cell_of(grid, group.x[p] - dt * group.v[p]))


@ti.func
def measure_volume(at: ti.template(), _p: int, _dt: float, place: ti.template(), deformation: ti.template()):
    """Return ln J of a particle and its cell in layer 0."""
    return log_volume(deformation), cell_of(at.grid, place)


@ti.func
def add_volume(at: ti.template(), p: int, dt: float, log_J: float, cell: int):
    """Add a particle to the sums of its cell, and its growth to those of its cell in the last step, of dt, s."""
    (group,) = ti.static((at.group,))
    volume, own = group.row(p)[VOLUME], in_layer(at.grid, group, p, cell)
    group.cell[p], group.to_mean[p] = own, log_J
    at.grid.add_mean(at.g, own, 0, volume, log_J, at.atomic)
    if ti.static(group.evened):
        at.grid.add_mean(at.g, earlier_cell(at.grid, group, p, dt), 2, volume, group.growth[p], at.atomic)


# Adds particles to the sums of their cells, which no other thread may write unless sums are atomic.
AVERAGE = Operation(
    reads=("place", "deformation"),
    passes=(Pass(measure_volume, {"log_J": (), "cell": INDEX}, in_lanes=True), Pass(add_volume)),
)


@ti.func
def clear_mean(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Set the sums of the cell of particle p and of its periodic images to zero."""
    cell = in_layer(grid, group, p, cell_of(grid, group.on_grid(p)))
    grid.clear_mean(g, cell)
    if ti.static(len(grid.images.periodic) > 0):
        for images in range(1, ti.static(grid.images.by_period.sets)):
            image, exists = grid.images.by_period.image(grid.node_at(cell), images, 1)
            if exists:
                grid.clear_mean(g, grid.linear_index(image))


@ti.func
def sums_of_cell(grid: ti.template(), g: ti.template(), cell: int):
    """Return the sums over a cell and its periodic images, after all particles were added."""
    sums = grid.mean(g, cell)
    if ti.static(len(grid.images.periodic) > 0):
        for images in range(1, ti.static(grid.images.by_period.sets)):
            image, exists = grid.images.by_period.image(grid.node_at(cell), images, 1)
            if exists:
                more = grid.mean(g, grid.linear_index(image))
                for k in ti.static(range(4)):
                    sums[k] += more[k]
    return sums


@ti.func
def missing_to_mean(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Return the mean of ln J over the cell of particle p minus its own ln J."""
    sums = sums_of_cell(grid, g, group.cell[p])
    return sums[0] / sums[1] - group.to_mean[p]


@ti.func
def missing_growth(grid: ti.template(), g: ti.template(), group: ti.template(), p: int, dt: float):
    """Return the mean growth of ln J in the last step, of dt, s, over the cell of particle p then minus its own."""
    sums = sums_of_cell(grid, g, earlier_cell(grid, group, p, dt))
    return sums[2] / sums[3] - group.growth[p]


@ti.func
def stretch_to(missing: float, d: ti.template()):
    """Return the factor of F that increases ln J by `missing`."""
    return exp(missing * ti.static(1.0 / d))


@ti.func
def even(H: ti.template(), missing: float):
    """Return F - I after an increase of ln J by `missing`, given F - I before it."""
    d = ti.static(H.n)
    return H + exp_minus_1(missing * ti.static(1.0 / d)) * (H + ti.Matrix.identity(float, d))


@ti.func
def average_for_frame(at: ti.template(), first: int, last: int):
    """Store `missing_to_mean` of all particles of a run in `to_mean`, on one thread."""
    for p in range(first, last):
        clear_mean(at.grid, at.g, at.group, p)
    over(at, AVERAGE, first, last, 0.0)
    for p in range(first, last):
        at.group.to_mean[p] = missing_to_mean(at.grid, at.g, at.group, p)


def needs_filling(scene: Scene, laws: Sequence[Law], layers: Layers) -> bool:
    """Return whether nodes store the volume scattered to them, in layer 0 for all layers.

    With a single density, a single layer and no colliders that it touches, it follows from their mass.
    """
    alike = len({body.material.density for body in scene.sources}) == 1 and layers.count == 1
    return any(law.relaxes for law in laws) and (layers.by_points or not alike)


@ti.func
def change_volume(at: ti.template(), p: int, relaxed: float, C: ti.template()):
    """Relax the volume of a particle over a time, s, after P2G; return the absolute change of its logarithm."""
    change = 0.0
    # A particle at rest is not relaxed.
    if deformation_rate(at.group, C) > 0.0:
        if ti.static(at.group.levels):
            change = level_volume(at.grid, at.g, at.group, p)
        else:
            change = relax_volume(at.group, at.grid, p, at.group.x[p], relaxed)
    return change


RELAX = Operation(reads=("C",), passes=(Pass(change_volume, {"change": ()}),), largest="change")


@ti.func
def level_volume(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Give particle p the mean volume of its cell; return the absolute change of its logarithm."""
    missing = missing_to_mean(grid, g, group, p)
    group.store(p, group.stored(p) * stretch_to(missing, group.dimension), group.inner(p))
    return ti.abs(missing)


@ti.func
def relax_volume(group: ti.template(), grid: ti.template(), p: int, x: ti.template(), time: float):
    """Relax the volume of particle p, at x, towards the density on the grid, over a time, s.

    Returns the absolute change of the logarithm of its volume, as far as it changes its stiffness.
    """
    row = group.row(p)
    # Factor from the mass of a node, or from its volume if nodes store it, to the filled fraction of a cell.
    scale = row[VOLUME] / row[MASS]
    if ti.static(grid.keeps_filling):
        scale = 1.0
    for _ in ti.static(range(grid.dimension)):
        scale *= grid.inverse_spacing
    filled, opens, relaxes, change = 0.0, 0.0, True, 0.0
    if ti.static(group.law.opens_at_surfaces):
        filled, slope = filling_around(x, grid, scale)
        opens = filling_below_surface(slope, grid.scheme.spline)
    else:
        held, least = held_around(x, grid)
        filled = held * scale
        relaxes = least * scale > FULL
        # In the dead band of the law, where most particles are, it does not matter.
        J = volume_ratio(group, group.stored(p))
        if relaxes and 1.0 / filled > ti.min(ti.max(J, 1.0) + DEAD_BAND, J + LARGEST_LACK):
            opens = ti.select(held_beside(x, grid) > BESIDE * held, 1.0, 0.0)
    if relaxes:
        seen = 1.0 / filled
        if ti.static(grid.has_solids and not group.law.opens_at_surfaces):
            least = ti.min(volume_ratio(group, group.stored(p)), 1.0)
            if seen < least and solid_around(x, grid):
                seen = ti.min(least, seen + UNEVEN)
        deformation, inner, change = group.law.relax(
            group.stored(p), group.inner(p), seen, opens, time * grid.inverse_spacing, group.constants(p)
        )
        if ti.static(group.law.opens_at_surfaces and group.eased):
            # A grain by itself sees too little to know how loose it is.
            least_share = ti.static(1.0 / group.law.relief)
            inner *= ti.min(2.0 * (group.borne[p] - least_share) / (1.0 - least_share), 1.0)
        group.store(p, deformation, inner)
    return change


@ti.func
def held_around(x: ti.template(), grid: ti.template()):
    """Return the weighted mean and the minimum, over the stencil of a point, of the nodal mass or volume after P2G.

    It is the mass, kg, or the volume, m^3, if nodes store the volume scattered to them.
    """
    d = ti.static(grid.dimension)
    # Number of nodes beyond a wall that stencils of particles inside reach, and of nodes inside with such images.
    reach = ti.static(grid.scheme.spline.nodes - 2)
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    first = grid.linear_index(base)
    near_face = False
    for a in ti.static(grid.images.axes):
        for j in ti.static((base[a], base[a] + 1 + reach)):
            _, depth, _ = grid.images.image_along(j, a, reach, 1)
            near_face = near_face or depth <= reach
    mean, least = 0.0, 1e30
    if near_face:
        # Not unrolled: copies of the sum over images would take half of the compile time of a 3D scene.
        for q in range(ti.static(grid.scheme.spline.nodes**d)):
            node, rest, weight = base, q, 1.0
            for b in ti.static(range(d)):
                a = ti.static((b + d - 1) % d)
                place = rest // ti.static(grid.scheme.spline.nodes ** (d - 1 - a)) % ti.static(grid.scheme.spline.nodes)
                node[a] += place
                for k in ti.static(range(grid.scheme.spline.nodes)):
                    if place == k:
                        weight *= w[k, a]
            held = grid.images.sum(grid.holding, d, grid, node, reach)
            mean += held * weight
            least = ti.min(least, held)
    else:
        # All numbers of a node at once, which the compiler vectorises.
        total = ti.Vector.zero(float, grid.holding.n)
        smallest = grid.holding[first]
        # A loop over lines of nodes: few steps relax, and unrolled copies would take a tenth of the compile time of a
        # 3D scene.
        for line in range(ti.static(grid.scheme.spline.nodes ** (d - 1))):
            node, line_weight, at = first, 1.0, base
            for a in ti.static(range(d - 1)):
                place = line // ti.static(grid.scheme.spline.nodes ** (d - 2 - a)) % ti.static(grid.scheme.spline.nodes)
                node += place * ti.static(grid.strides[a])
                at[a] += place
                for k in ti.static(range(grid.scheme.spline.nodes)):
                    if place == k:
                        line_weight *= w[k, a]
            for k in ti.static(range(grid.scheme.spline.nodes)):
                index = node + k
                if ti.static(grid.sparse):
                    index = grid.linear_index(at)
                    at[d - 1] += 1
                held = grid.holding[index]
                total += held * (line_weight * w[k, d - 1])
                smallest = ti.min(smallest, held)
        mean, least = total[d], smallest[d]
    return mean, least


@ti.func
def solid_around(x: ti.template(), grid: ti.template()):
    """Return whether a collider cuts the kernel of a node of the stencil of a point, see `ColliderPoints.fill`."""
    base, _ = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    solid = 0.0
    for q in range(ti.static(grid.scheme.spline.nodes**grid.dimension)):
        node, rest = base, q
        for a in ti.static(range(grid.dimension)):
            node[a] += rest % ti.static(grid.scheme.spline.nodes)
            rest = rest // ti.static(grid.scheme.spline.nodes)
        solid += grid.filling[grid.linear_index(node)][0]
    return solid > 0.0


@ti.func
def filling_around(x: ti.template(), grid: ti.template(), scale: float):
    """Return the filled fraction of the grid at a point, and its gradient per cell; what is behind walls is full."""
    d, nodes = ti.static(grid.dimension, grid.scheme.spline.nodes)
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    filled, moment = 0.0, ti.Vector.zero(float, d)
    for q in range(ti.static(nodes**d)):
        node, weight, way = base, 1.0, -distance
        for a in ti.static(range(d)):
            place = q // ti.static(nodes ** (d - 1 - a)) % ti.static(nodes)
            node[a] += place
            way[a] += ti.cast(place, float)
            for k in ti.static(range(nodes)):
                if place == k:
                    weight *= w[k, a]
        held = grid.images.by_period.sum(grid.holding, d, grid, node, 1)
        part = weight * (held * scale + 1.0 - grid.images.share_inside(node, grid.scheme.spline))
        filled += part
        moment += part * way
    return filled, moment.norm() * ti.static(grid.scheme.spline.inverse_moment)


@ti.func
def filling_below_surface(slope: float, spline: ti.template()):
    """Return the filled fraction of the grid at a point of dense material with a plane surface from its slope per cell.

    Both are functions of the depth: the normal distribution function of variance 2 D, D that of the spline, and the
    normal density of variance 2 D - 1/30 (docs/theory.md, 5.11).
    """
    variance = ti.static(2.0 / spline.inverse_moment)
    narrow = ti.static(variance - 1.0 / 30.0)
    share = ti.min(ti.max(slope * ti.static(math.sqrt(2.0 * math.pi * narrow)), 1e-6), 1.0)
    z = ti.sqrt(-2.0 * log(share) * ti.static(narrow / variance))
    # The distribution function to 2e-4.
    return 1.0 / (1.0 + exp(-z * (1.5976 + 0.07056 * z * z)))


@ti.func
def held_beside(x: ti.template(), grid: ti.template()):
    """Return the smallest nodal mass or volume among the nodes beside the stencil of a point, two along each axis."""
    d = ti.static(grid.dimension)
    base, _ = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    least = 1e30
    for side in range(ti.static(2 * d)):
        offset = ti.select(side % 2 == 0, -1, ti.static(grid.scheme.spline.nodes))
        node, share, used = base, 1.0, True
        for b in ti.static(range(d)):
            node[b] += ti.select(side // 2 == b, offset, 1)
            # The node may be outside the grid; the one of which it is the image is inside.
            image, depth, _ = grid.images.image_along(node[b], b, 0, 1)
            if depth < 0:
                node[b] = image
            elif depth == 0:
                share *= 2.0
            # Nodes that are not in use hold old values.
            used = used and node[b] >= grid.box[0, b] and node[b] < grid.box[0, b] + grid.box[1, b]
        held = 0.0
        if used:
            held = grid.images.by_period.sum(grid.holding, d, grid, node, 1) * share
        least = ti.min(least, held)
    return least
