"""Coulomb friction of walls: what it takes from each column of nodes in a step.

A column is what lies along the normal of a node on the wall. The wall takes as much tangential momentum from it as
sticking would, and at most the coefficient times the normal momentum that it gives (docs/theory.md, 3.4). Faces are
numbers of the kernel here: a copy of what follows for each of six faces would triple the compile time of a 3D scene.
"""

import taichi as ti

from mpmcli.boundaries.mirror_images import pulled


@ti.func
def find_friction(images: ti.template(), grid: ti.template(), q: int, gravity_step: ti.template()):
    """For the q-th node in use of the plane of every rough face, find what friction does to its column.

    `find_contact` comes before. Other walls fold here as if nothing stuck by friction.
    """
    d = ti.static(images.dimension)
    for r in range(ti.static(len(images.walls.rough))):
        axis, side, number = 0, 0, 0
        for row, of_scene, its_axis, its_side in ti.static(images.walls.rough):
            if r == row:
                axis, side, number = its_axis, its_side, of_scene
        # What the wall moves by along itself.
        along = ti.Vector.zero(float, d)
        if ti.static(images.walls.moves):
            for row, _of_scene, its_axis, its_side in ti.static(images.walls.rough):
                if r == row:
                    own = images.walls.velocity(its_axis, its_side)
                    for c in ti.static(range(d)):
                        along[c] = own[c]
        node, inside = ti.Vector.zero(int, d), True
        rest, place, count = q, 0, 1
        for b in ti.static(range(d)):
            if b == axis:
                node[b] = images.walls.last[b] if side == 1 else images.walls.first
                inside = inside and node[b] >= grid.box[0, b] and node[b] < grid.box[0, b] + grid.box[1, b]
            else:
                count *= grid.box[1, b]
        if inside and q < count:
            for b in ti.static(range(d)):
                if b != axis:
                    line = ti.raw_div(rest, grid.box[1, b])
                    node[b] = grid.box[0, b] + rest - line * grid.box[1, b]
                    place = place * ti.static(images.walls.shape[b]) + node[b]
                    rest = line
            impulse = ti.Vector.zero(float, d)
            # What an image has fills the node of a periodic face too.
            filled = grid.nodes[grid.linear_index(node)][d] > 0
            if ti.static(len(images.walls.periodic) > 0):
                filled = True
            if filled:
                coefficient = images.walls.friction.of(number)
                found = column_friction(images, grid, node, gravity_step, axis, side, coefficient, along)
                for c in ti.static(range(d)):
                    impulse[c] = found[c]
            for c in ti.static(range(d)):
                images.walls.impulse[images.walls.first_rough + r, place][c] = impulse[c]


@ti.func
def column_friction(
    images: ti.template(),
    grid: ti.template(),
    node: ti.template(),
    gravity_step: ti.template(),
    axis: int,
    side: int,
    coefficient: float,
    along: ti.template(),
):
    """Return the entry of `Walls.impulse` for the column of a node on a wall.

    With mass m and momentum p of the node w + 1 beside the wall and m', p' of its image, folding and gathering take

        p_w + 2 (m' p + m p') / (m + m')

    from a column, along each axis whose sign they turn: along all of them where the wall sticks. The normal part is
    what the wall pushes with.
    """
    d = ti.static(images.dimension)
    depth, mirror, upper = images.walls.place(node)
    acts = images.walls.acting(node, depth, mirror, upper)
    holds = images.walls.holding(node, depth, upper, False)
    pressed, others = False, 0
    for a in ti.static(range(d)):
        if a == axis:
            pressed = acts[a] == 1
            acts[a] = 0
        others += acts[a]
    taken, slip = ti.Vector.zero(float, d), ti.Vector.zero(float, d)
    compliance = 0.0
    if pressed:
        # No particle inside the domain reaches the second node beyond a wall.
        for j in range(2):
            inner, outer = node, node
            for a in ti.static(range(d)):
                if a == axis:
                    inner[a] += j
                    outer[a] -= j
            # Which of them lies inside does not matter.
            here = pulled(grid.nodes[grid.linear_index(inner)], d, gravity_step)
            there = pulled(grid.nodes[grid.linear_index(outer)], d, gravity_step)
            if others > 0:
                here = images.image_sum(grid, grid.nodes, inner, mirror, acts, depth, holds, upper, gravity_step)
                there = images.image_sum(grid, grid.nodes, outer, mirror, acts, depth, holds, upper, gravity_step)
            if ti.static(images.walls.moves):
                # Momentum and slip relative to the wall.
                for c in ti.static(range(d)):
                    here[c] -= here[d] * along[c]
                    there[c] -= there[d] * along[c]
            mass = here[d] + there[d]
            if mass > 0:
                # On the wall both are the same node, which counts once.
                whole = 0.5 if j == 0 else 1.0
                share = 0.0
                if j == 0:
                    share = images.shares[0]
                elif j == 1:
                    share = images.shares[1]
                for c in ti.static(range(d)):
                    taken[c] += 2 * whole * (there[d] * here[c] + here[d] * there[c]) / mass
                    slip[c] += share * (here[c] + there[c]) / mass
                compliance += share**2 / (whole * mass)
    bound, needed, speed = 0.0, 0.0, 0.0
    for c in ti.static(range(d)):
        if c == axis:
            bound = coefficient * (taken[c] if side == 1 else -taken[c])
        else:
            needed += taken[c] ** 2
            speed += slip[c] ** 2
    result = ti.Vector.zero(float, d)
    if pressed and bound >= 0:
        sticks = needed <= bound**2
        speed = ti.sqrt(speed)
        size = 0.0
        if not sticks and speed > 0:
            size = ti.min(bound, speed / compliance) / speed
        for c in ti.static(range(d)):
            if c != axis:
                result[c] = -size * slip[c]
            elif sticks:
                result[c] = 1.0
    return result
