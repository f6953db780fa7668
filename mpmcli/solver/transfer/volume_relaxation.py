"""Relaxes the volumes of particles towards those that the grid sees (docs/theory.md, 5.11).

Only laws that ask for it (`Law.relaxes`) have any of this compiled, and only one step in `INTERVAL` does it.
"""

from collections.abc import Sequence

from mpmcli.materials.fluid import BESIDE, FULL
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.state_bounds import volume_ratio
from mpmcli.solver.transfer.splines import PAD


def needs_filling(scene: Scene, laws: Sequence[Law], layers: int) -> bool:
    """Return whether nodes keep the volume scattered to them, that of all layers in layer 0.

    With one density and one layer alone it follows from their mass.
    """
    alike = len({body.material.density for body in scene.sources}) == 1 and layers == 1
    return any(law.relaxes for law in laws) and not alike


@ti.func
def relax_volume(group: ti.template(), grid: ti.template(), last: ti.template(), p: int, x: ti.template(), time: float):
    """Relax the volume of particle p, at x, towards what the nodes hold, over a time, s.

    Returns the change of the logarithm of its volume, without sign, as far as it changes its stiffness.
    """
    row = group.row(p)
    # Fraction of a cell that a node's mass fills, or its volume where nodes keep that.
    scale = row[VOLUME] / row[MASS]
    if ti.static(grid.keeps_filling):
        scale = 1.0
    for _ in ti.static(range(grid.dimension)):
        scale *= grid.inverse_spacing
    held, least = held_around(x, grid, last)
    change = 0.0
    if least * scale > FULL:
        seen = 1.0 / (held * scale)
        opens = 0.0
        if seen > volume_ratio(group, group.stored(p)):
            opens = ti.select(held_beside(x, grid, last) > BESIDE * held, 1.0, 0.0)
        deformation, inner, change = group.law.relax(
            group.stored(p), group.inner(p), seen, opens, time * grid.inverse_spacing, group.constants(p)
        )
        group.store(p, deformation, inner)
    return change


@ti.func
def held_around(x: ti.template(), grid: ti.template(), last: ti.template()):
    """Return the weighted mean over the stencil of a point of what nodes hold after P2G, and the smallest of them.

    It is the mass, kg, or where nodes keep the volume scattered to them that, m^3.
    """
    d = ti.static(grid.dimension)
    # Nodes inside a wall, and behind it, that particles beyond them reach.
    reach = ti.static(grid.scheme.spline.nodes - 2)
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    first = grid.linear_index(base)
    near_wall = False
    for a in ti.static(range(d)):
        if ti.static(a in grid.period.axes):
            near_wall = near_wall or base[a] <= 2 * PAD or base[a] + 1 + reach >= last[a] - PAD
        else:
            if ti.static((a, 0) not in grid.opens):
                near_wall = near_wall or base[a] <= PAD + reach
            if ti.static((a, 1) not in grid.opens):
                near_wall = near_wall or base[a] + 1 + 2 * reach >= last[a]
    mean, least = 0.0, 1e30
    if near_wall:
        # Not unrolled, as below: copies of the sum over images would take half of the compile time of a 3D scene.
        for q in range(ti.static(grid.scheme.spline.nodes**d)):
            node, rest, weight = base, q, 1.0
            for b in ti.static(range(d)):
                a = ti.static((b + d - 1) % d)
                place = rest // ti.static(grid.scheme.spline.nodes ** (d - 1 - a)) % ti.static(grid.scheme.spline.nodes)
                node[a] += place
                for k in ti.static(range(grid.scheme.spline.nodes)):
                    if place == k:
                        weight *= w[k, a]
            held = mirrored_sum(node, grid, last, reach)
            mean += held * weight
            least = ti.min(least, held)
    else:
        # All numbers of a node at once, which the compiler turns into vector instructions.
        total = ti.Vector.zero(float, grid.holding.n)
        smallest = grid.holding[first]
        # Lines of nodes in a loop: few steps relax, and copies would take a tenth of the compile time of a 3D scene.
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
def held_beside(x: ti.template(), grid: ti.template(), last: ti.template()):
    """Return the least that the nodes beside the stencil of a point hold, two along each axis."""
    d = ti.static(grid.dimension)
    base, _ = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    least = 1e30
    for side in range(ti.static(2 * d)):
        offset = ti.select(side % 2 == 0, -1, ti.static(grid.scheme.spline.nodes))
        node, share, used = base, 1.0, True
        for b in ti.static(range(d)):
            node[b] += ti.select(side // 2 == b, offset, 1)
            if ti.static(b in grid.period.axes):
                # The grid may end here, but not at its image.
                if node[b] < PAD:
                    node[b] += last[b] - PAD
                elif node[b] >= last[b]:
                    node[b] -= last[b] - PAD
            if ti.static(b not in grid.period.axes and (b, 0) not in grid.opens):
                if node[b] < PAD:
                    node[b] = 2 * PAD - node[b]
                if node[b] == PAD:
                    share *= 2.0
            if ti.static(b not in grid.period.axes and (b, 1) not in grid.opens):
                if node[b] > last[b]:
                    node[b] = 2 * last[b] - node[b]
                if node[b] == last[b]:
                    share *= 2.0
            # Nodes that are not in use hold what was there before.
            used = used and node[b] >= grid.box[0, b] and node[b] < grid.box[0, b] + grid.box[1, b]
        held = 0.0
        if used:
            held = grid.holding[grid.linear_index(node)][d] * share
            if ti.static(len(grid.period.axes) > 0):
                for images in range(1, ti.static(2**d)):
                    image, exists = grid.period.image(node, images)
                    if exists:
                        held += grid.holding[grid.linear_index(image)][d] * share
        least = ti.min(least, held)
    return least


@ti.func
def mirrored_sum(node: ti.template(), grid: ti.template(), last: ti.template(), reach: ti.template()):
    """Return what a node and its images behind walls and periodic faces hold; one on a wall, half outside, twice.

    All walls mirror here, those that have let go, and those that set velocities to zero, too.
    """
    d = ti.static(grid.dimension)
    total = 0.0
    for images in range(ti.static(2**d)):
        place, exists = node, True
        for a in ti.static(range(d)):
            if images >> a & 1 == 1:
                image, found = image_along(node[a], a, grid, last, reach, 1)
                place[a] = image
                exists = exists and found
        if exists:
            total += grid.holding[grid.linear_index(place)][d]
    return total


@ti.func
def image_along(
    j: int, axis: ti.template(), grid: ti.template(), last: ti.template(), reach: ti.template(), n: ti.template()
):
    """Return the image of node j behind the faces of an axis, itself where it has none, and whether it has one.

    reach: of the nodes inside a wall, those that have images; n: nodes in a cell.
    """
    image, exists = j, True
    first, end = ti.static(PAD * n), last[axis] * n
    if ti.static(axis in grid.period.axes):
        if j <= 2 * first:
            image = j + end - first
        elif j >= end - first:
            image = j - end + first
        else:
            exists = False
    elif j <= first + reach and ti.static((axis, 0) not in grid.opens):
        image = 2 * first - j
    elif j >= end - reach and ti.static((axis, 1) not in grid.opens):
        image = 2 * end - j
    else:
        exists = False
    return image, exists
