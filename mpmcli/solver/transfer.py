"""Particle to grid and back: MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), PIC or AFLIP.

See docs/theory.md, 2.
"""

import taichi as ti

from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particle_friction import friction_of_walls
from mpmcli.solver.reference_grid import pulled_back, push_of_walls
from mpmcli.solver.stencils import add_linear, gather_linear
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
