"""Particle to grid and back: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), PIC or AFLIP (docs/theory.md, 2).

Both transfers walk the stencil in lines of three nodes along the last axis and measure positions from its
middle node, so that its nodes lie at -1, 0 and 1: moments are then differences of sums that are at hand.
A cubic stencil has one node more, at 2.
On the CPU every node and every row below is four numbers wide, which the compiler turns into vector
instructions; that halves the time of the gather in 3D.
"""

import taichi as ti

from mpmcli.solver.fixed_sums import FixedSums
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particle_friction import friction_of_walls
from mpmcli.solver.reference_grid import pulled_back, push_of_walls
from mpmcli.solver.volume_average import missing_to_mean, stretch_to


@ti.func
def scatter(g: ti.template(), group: ti.template(), particles: ti.template(), p: int, kick: float):
    """Add the mass and the momentum of particle p, stress included, to the nodes around it, with atomics.

    A law with plastic flow projects the particle's state first. Forces change what is scattered: v by kick a, and C by
    kick da/dx.

    Node i receives w_i (m v + A (x_i - x_p)) with A = m C - dt V0 tau / D (Hu et al. 2018, eq. 18; D = h^2/4
    for quadratic splines), and w_i m. PIC leaves m C out."""
    grid = particles.grid
    affine = ti.static(grid.scheme.affine)
    row = group.row(p)
    mass = row[MASS]
    v, C = group.motion(p)
    seen = group.stored(p)
    share = 1.0
    if ti.static(group.averaged):
        share = stretch_to(missing_to_mean(grid, g, group, p), ti.static(group.dimension))
        seen *= share
    stress, _, deformation, inner = group.law.respond(seen, group.inner(p), C, kick, group.constants(p))
    if ti.static(group.law.projects):
        if ti.static(group.averaged):
            group.store(p, group.stored(p) + (deformation - seen) / share, inner)
        else:
            group.store(p, deformation, inner)
    if ti.static(group.pushed):
        push, slope = group.force.acceleration(group, p, ti.static(group.force.spreads and affine))
        v += kick * push
        C += kick * slope
    if ti.static(group.total):
        F = group.stored(p)
        if ti.static(group.slips):
            v += kick * friction_of_walls(particles, group, p, kick, True)
        v += kick * push_of_walls(particles, group, group.x[p], group.initial[p], F, row, group.constants(p))
        # Entry by entry: Taichi loses matrices that are assigned as a whole here.
        C_rest, P = C @ F, pulled_back(stress, F)
        for i, j in ti.static(ti.ndrange(group.dimension, group.dimension)):
            C[i, j] = C_rest[i, j]
            stress[i, j] = P[i, j]
    base, distance = grid.scheme.spline.stencil(group.on_grid(p), grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    middle, change = momentum(grid, distance, mass, row[VOLUME], v, C, stress, kick)
    first = grid.linear_index(base)
    if ti.static(grid.deterministic):
        if not add_fixed(grid.fixed.nodes, grid, first, w, mass, middle, change):
            grid.fixed.note(group.id[p])
    else:
        add_linear(grid.nodes, grid, first, w, middle, change, True)
    if ti.static(grid.scheme.keeps_before):
        # Last, and with a copy: before it, Taichi 1.7.4 loses what a force with branches adds to v and C.
        own_v, own_C = group.motion_on_grid(p)
        scatter_before(group.on_grid(p), mass, own_v, own_C, grid, True)


@ti.func
def momentum(
    grid: ti.template(),
    distance: ti.template(),
    mass: float,
    volume: float,
    v: ti.template(),
    C: ti.template(),
    stress: ti.template(),
    kick: float,
):
    """Return the momentum and mass that the middle node of a stencil would take, and their change per cell.

    Both are as wide as a node; the change has a row for each axis. `distance` is that to the first node, in cells.
    """
    d = ti.static(grid.dimension)
    middle = ti.Vector.zero(float, grid.width)
    change = ti.Matrix.zero(float, d, grid.width)
    stress_scale = kick * volume * grid.gradient_scale
    for c in ti.static(range(d)):
        middle[c] = mass * v[c]
        for a in ti.static(range(d)):
            if ti.static(grid.scheme.affine):
                change[a, c] = (mass * grid.spacing) * C[c, a] - stress_scale * stress[c, a]
            else:
                change[a, c] = -stress_scale * stress[c, a]
            middle[c] -= change[a, c] * (distance[a] - 1.0)
    middle[d] = mass
    return middle, change


@ti.func
def scatter_before(
    x: ti.template(),
    mass: float,
    v: ti.template(),
    C: ti.template(),
    grid: ti.template(),
    atomic: ti.template(),
):
    """Add the momentum of a particle, without this step's stress and forces, to `grid.before`."""
    d = ti.static(grid.dimension)
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    middle = ti.Vector.zero(float, grid.width)
    change = ti.Matrix.zero(float, d, grid.width)
    for c in ti.static(range(d)):
        middle[c] = mass * v[c]
        for a in ti.static(range(d)):
            change[a, c] = (mass * grid.spacing) * C[c, a]
            middle[c] -= change[a, c] * (distance[a] - 1.0)
    if ti.static(grid.weighs_before):
        middle[grid.dimension] = mass
    if ti.static(grid.deterministic):
        # With stress and forces it was noted where there is no room.
        add_fixed(grid.fixed.before, grid, grid.linear_index(base), w, mass, middle, change)
    else:
        add_linear(grid.before, grid, grid.linear_index(base), w, middle, change, atomic)


@ti.func
def scatter_volume(x: ti.template(), volume: float, grid: ti.template(), atomic: ti.template()):
    """Add the volume of a particle at rest, m^3, to `grid.filling`."""
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    middle = ti.Vector.zero(float, grid.width)
    middle[ti.static(grid.dimension)] = volume
    change = ti.Matrix.zero(float, ti.static(grid.dimension), grid.width)
    if ti.static(grid.deterministic):
        middle[ti.static(grid.dimension)] = volume * grid.fixed.volume_scale
        add_linear(grid.fixed.filling, grid, grid.linear_index(base), w, middle, change, atomic)
    else:
        add_linear(grid.filling, grid, grid.linear_index(base), w, middle, change, atomic)


@ti.func
def add_fixed(
    sums: ti.template(),
    grid: ti.template(),
    first: int,
    w: ti.template(),
    mass: float,
    middle: ti.template(),
    change: ti.template(),
):
    """Add momentum and mass to sums in fixed point, as `add_linear` to fields, where there is room for them.

    Returns:
        Whether there was; `middle` and `change` are scaled then.
    """
    fits = grid.fixed.scaled(mass, middle, change)
    if fits:
        add_linear(sums, grid, first, w, middle, change, True)
    return fits


@ti.func
def add_linear(
    field: ti.template(),
    grid: ti.template(),
    first: int,
    w: ti.template(),
    middle: ti.template(),
    change: ti.template(),
    atomic: ti.template(),
):
    """Add to the nodes of a stencil a quantity that varies linearly over it, weighted by the spline.

    Without `atomic` no other thread may write those nodes.

    Args:
        field: of the nodes, or sums in fixed point, to which the rest is scaled.
        first: linear index of the first node.
        middle: the quantity at the middle node; change: its change per cell, a row for each axis.
    """
    d = ti.static(grid.dimension)
    for o, line_node in ti.static(grid.lines):
        line_weight = 1.0
        line = middle
        step = ti.Vector.zero(float, grid.width)
        for a in ti.static(range(d - 1)):
            line_weight *= w[o[a], a]
        for c in ti.static(range(grid.width)):
            for a in ti.static(range(d - 1)):
                if ti.static(o[a] == 0):
                    line[c] -= change[a, c]
                if ti.static(o[a] == 2):
                    line[c] += change[a, c]
                if ti.static(o[a] == 3):
                    line[c] += 2.0 * change[a, c]
            line[c] *= line_weight
            step[c] = line_weight * change[d - 1, c]
        node = first + line_node
        add(field, node, (line - step) * w[0, d - 1], atomic)
        add(field, node + 1, line * w[1, d - 1], atomic)
        add(field, node + 2, (line + step) * w[2, d - 1], atomic)
        if ti.static(grid.scheme.spline.nodes == 4):
            add(field, node + 3, (line + 2.0 * step) * w[3, d - 1], atomic)


@ti.func
def add(field: ti.template(), node: int, share: ti.template(), atomic: ti.template()):
    """Add a share of momentum and mass to a node."""
    if ti.static(isinstance(field, FixedSums)):
        field.add(node, share)
    elif ti.static(atomic):
        ti.atomic_add(field[node], share)
    else:
        field[node] = field[node] + share


@ti.func
def gather(x: ti.template(), grid: ti.template(), field: ti.template()):
    """Return the velocity at a point and its gradient, sum w_i (x_i - x) v_i^T / D, of a field of the nodes.

    The gradient has a row for each axis: row a holds dv/dx_a, so it is the transpose of C. Both are as wide
    as a node; entries beyond the d components of the velocity have no meaning.
    """
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    velocity, moment = gather_linear(field, grid, grid.linear_index(base), w)
    return velocity, centred(grid, distance, velocity, moment)


@ti.func
def centred(grid: ti.template(), distance: ti.template(), velocity: ti.template(), moment: ti.template()):
    """Return the gradient of the velocity at a point from sums over its stencil, see `gather` and `gather_linear`."""
    gradient = moment
    for a in ti.static(range(moment.n)):
        for c in ti.static(range(moment.m)):
            gradient[a, c] = (moment[a, c] - velocity[c] * (distance[a] - 1.0)) * grid.gradient_scale
    return gradient


@ti.func
def gather_linear(field: ti.template(), grid: ti.template(), first: int, w: ti.template()):
    """Return the weighted sums over a stencil of what nodes hold, and of that times the cells from the middle node.

    Args:
        field: of the nodes; first: linear index of the first node.
    """
    d = ti.static(grid.dimension)
    velocity = ti.Vector.zero(float, grid.width)
    moment = ti.Matrix.zero(float, d, grid.width)
    for o, line_node in ti.static(grid.lines):
        line_weight = 1.0
        for a in ti.static(range(d - 1)):
            line_weight *= w[o[a], a]
        node = first + line_node
        low = field[node] * (w[0, d - 1] * line_weight)
        mid = field[node + 1] * (w[1, d - 1] * line_weight)
        high = field[node + 2] * (w[2, d - 1] * line_weight)
        total = (low + high) + mid
        if ti.static(grid.scheme.spline.nodes == 4):
            far = field[node + 3] * (w[3, d - 1] * line_weight)
            total += far
            for c in ti.static(range(grid.width)):
                moment[d - 1, c] += 2.0 * far[c]
        velocity += total
        for c in ti.static(range(grid.width)):
            for a in ti.static(range(d - 1)):
                if ti.static(o[a] == 0):
                    moment[a, c] -= total[c]
                if ti.static(o[a] == 2):
                    moment[a, c] += total[c]
                if ti.static(o[a] == 3):
                    moment[a, c] += 2.0 * total[c]
            moment[d - 1, c] += high[c] - low[c]
    return velocity, moment
