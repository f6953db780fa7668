"""Coulomb friction of walls: what it takes from each column of nodes in a step.

A column is what lies along the normal of a node on the wall. The wall takes as much tangential momentum from it as
sticking would, and at most the coefficient times the normal momentum that it gives (docs/theory.md, 3.4).
"""

import taichi as ti

from mpmcli.boundaries.walls import REACH


@ti.func
def find_friction(images: ti.template(), grid: ti.template(), q: int, gravity_step: ti.template()):
    """For the q-th node in use of the plane of every rough face, find what friction does to its column.

    `find_contact` comes before. Other walls fold here as if nothing stuck by friction.
    """
    for r, number, axis, side in ti.static(images.walls.rough):
        node, inside = images.plane_node(grid, q, axis, side)
        if inside:
            depth, mirror, upper = images.walls.place(node)
            acts = images.walls.acting(node, depth, mirror, upper)
            impulse = ti.Vector.zero(float, images.dimension)
            massive = grid.nodes[grid.linear_index(node)][ti.static(images.dimension)] > 0
            if massive and acts[axis] == 1:
                acts[axis] = 0
                coefficient = images.walls.friction.of(number)
                found = column_friction(
                    images, grid, node, mirror, acts, depth, upper, gravity_step, axis, side, coefficient
                )
                for c in ti.static(range(images.dimension)):
                    impulse[c] = found[c]
            place = images.walls.plane_index(node, axis)
            for c in ti.static(range(images.dimension)):
                images.walls.impulse[images.walls.first_rough + r, place][c] = impulse[c]


@ti.func
def column_friction(
    images: ti.template(),
    grid: ti.template(),
    node: ti.template(),
    mirror: ti.template(),
    acts: ti.template(),
    depth: ti.template(),
    upper: ti.template(),
    gravity_step: ti.template(),
    axis: ti.template(),
    side: ti.template(),
    coefficient: float,
):
    """Return the entry of `Walls.impulse` for the column of a node on a wall that acts.

    Folding and gathering take p_w + sum_j 2 (m' p + m p') / (m + m') from a column along each axis whose sign they
    turn, with mass m and momentum p of the node w + j and m', p' of its image; the sum is that of a wall that
    sticks. The normal part of it is what the wall pushes with.

    Args:
        acts: which walls act along the other axes.
    """
    d = ti.static(images.dimension)
    holds = images.walls.holding(node, depth, upper, False)
    on_wall = images.image_sum(grid, grid.nodes, node, mirror, acts, depth, holds, gravity_step)
    taken = on_wall
    slip = ti.Vector.zero(float, d)
    compliance = 0.0
    for k in range(ti.static(REACH)):
        j = REACH - k
        inner, outer = node, node
        inner[axis] += ti.static(1 - 2 * side) * j
        outer[axis] -= ti.static(1 - 2 * side) * j
        here = images.image_sum(grid, grid.nodes, inner, mirror, acts, depth, holds, gravity_step)
        there = images.image_sum(grid, grid.nodes, outer, mirror, acts, depth, holds, gravity_step)
        mass = here[d] + there[d]
        if mass > 0:
            for c in ti.static(range(d)):
                taken[c] += 2 * (there[d] * here[c] + here[d] * there[c]) / mass
                # In the end that of the nodes beside the wall.
                slip[c] = images.shares[1] * (here[c] + there[c]) / mass
            compliance = images.shares[1] ** 2 / mass
    result = ti.Vector.zero(float, d)
    bound = coefficient * (taken[axis] if ti.static(side == 1) else -taken[axis])
    if bound >= 0:
        needed, speed = 0.0, 0.0
        for c in ti.static(images.walls.lateral[axis]):
            slip[c] += images.shares[0] * on_wall[c] / on_wall[d]
            needed += taken[c] ** 2
            speed += slip[c] ** 2
        compliance += images.shares[0] ** 2 / on_wall[d]
        if needed <= bound**2:
            result[axis] = 1.0
        elif speed > 0:
            speed = ti.sqrt(speed)
            size = ti.min(bound, speed / compliance) / speed
            for c in ti.static(images.walls.lateral[axis]):
                result[c] = -size * slip[c]
    return result
