"""Particle to grid and back: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015).

Both transfers walk the stencil in lines of three nodes along the last axis and measure positions from its
middle node, whose neighbours lie at -1, 0 and 1: moments are then differences of what the nodes share anyway.
On the CPU every node and every row below is four numbers wide, which the compiler turns into vector
instructions; that halves the time of the gather in 3D.
"""

import taichi as ti

from mpmcli.solver.kernel import stencil, weights
from mpmcli.solver.particles import MASS, VOLUME


@ti.func
def scatter(group: ti.template(), grid: ti.template(), p: int, kick: float, atomic: ti.template()):
    """Add the mass and the momentum of particle p, stress included, to the nodes around it.

    A law with plastic flow returns the particle's state to what it can bear first. Forces change what is
    scattered: v by kick a, and C by kick da/dx.

    Node i receives w_i (m v + A (x_i - x_p)) with A = m C - dt V0 (4/h^2) tau (Hu et al. 2018, eq. 18
    with the quadratic D = h^2/4), and w_i m. Without `atomic` the caller owns those nodes.
    """
    d = ti.static(grid.dimension)
    h = ti.static(grid.spacing)
    row = group.row(p)
    mass = row[MASS]
    v, C = group.motion(p)
    stress, _, deformation, inner = group.law.respond(group.stored(p), group.inner(p), C, kick, group.constants(p))
    if ti.static(group.law.projects):
        group.store(p, deformation, inner)
    if ti.static(group.pushed):
        push, slope = group.force.acceleration(group, p, group.force.spreads)
        v += kick * push
        C += kick * slope
    base, distance = stencil(group.x[p], 1 / h)
    w = weights(distance)

    # Momentum and mass that the middle node would take, and their change per cell along each axis.
    middle = ti.Vector.zero(float, grid.width)
    change = ti.Matrix.zero(float, d, grid.width)
    stress_scale = kick * row[VOLUME] * (4 / h)
    for c in ti.static(range(d)):
        middle[c] = mass * v[c]
        for a in ti.static(range(d)):
            change[a, c] = (mass * h) * C[c, a] - stress_scale * stress[c, a]
            middle[c] -= change[a, c] * (distance[a] - 1.0)
    middle[d] = mass

    first = grid.first_node(base)
    for o, line_node in ti.static(grid.lines):
        line_weight = 1.0
        line = middle
        step = ti.Vector.zero(float, grid.width)
        for a in ti.static(range(d - 1)):
            line_weight *= w[o[a]][a]
        for c in ti.static(range(grid.width)):
            for a in ti.static(range(d - 1)):
                if ti.static(o[a] == 0):
                    line[c] -= change[a, c]
                if ti.static(o[a] == 2):
                    line[c] += change[a, c]
            line[c] *= line_weight
            step[c] = line_weight * change[d - 1, c]
        node = first + line_node
        add(grid, node, (line - step) * w[0][d - 1], atomic)
        add(grid, node + 1, line * w[1][d - 1], atomic)
        add(grid, node + 2, (line + step) * w[2][d - 1], atomic)


@ti.func
def add(grid: ti.template(), node: int, share: ti.template(), atomic: ti.template()):
    """Add a share of momentum and mass to a node."""
    if ti.static(atomic):
        ti.atomic_add(grid.nodes[node], share)
    else:
        grid.nodes[node] = grid.nodes[node] + share


@ti.func
def gather(x: ti.template(), grid: ti.template()):
    """Return the velocity at a point and its gradient, (4/h^2) sum w_i (x_i - x) v_i^T.

    The gradient has a row for each axis: row a holds dv/dx_a, so it is the transpose of C. Both are as wide
    as a node; what they hold beyond the d components of the velocity means nothing.
    """
    d = ti.static(grid.dimension)
    base, distance = stencil(x, ti.static(1 / grid.spacing))
    w = weights(distance)
    first = grid.first_node(base)
    velocity = ti.Vector.zero(float, grid.width)
    moment = ti.Matrix.zero(float, d, grid.width)
    for o, line_node in ti.static(grid.lines):
        line_weight = 1.0
        for a in ti.static(range(d - 1)):
            line_weight *= w[o[a]][a]
        node = first + line_node
        low = grid.nodes[node] * (w[0][d - 1] * line_weight)
        mid = grid.nodes[node + 1] * (w[1][d - 1] * line_weight)
        high = grid.nodes[node + 2] * (w[2][d - 1] * line_weight)
        total = (low + high) + mid
        velocity += total
        for c in ti.static(range(grid.width)):
            for a in ti.static(range(d - 1)):
                if ti.static(o[a] == 0):
                    moment[a, c] -= total[c]
                if ti.static(o[a] == 2):
                    moment[a, c] += total[c]
            moment[d - 1, c] += high[c] - low[c]
    for a in ti.static(range(d)):
        for c in ti.static(range(grid.width)):
            moment[a, c] = (moment[a, c] - velocity[c] * (distance[a] - 1.0)) * ti.static(4 / grid.spacing)
    return velocity, moment
