"""The two halves of a step of one particle: its contribution to nodes in P2G, and its update from nodes in G2P.

Both are functions of local variables only, for `scatter` and `advance`. MLS-MPM (Hu et al. 2018) with APIC (Jiang et
al. 2015) or AFLIP; see docs/theory.md, 2.
"""

from dataclasses import dataclass
from typing import Any

from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.total_solids import pulled_back, push_of_walls
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.state_bounds import deformation_rate, volume_growth
from mpmcli.solver.transfer.volume import even, log_volume, stretch_to


@dataclass(frozen=True)
class Sender:
    """A particle before P2G: variables of a kernel.

    Attributes:
        place: position on the grid, m.
        here: position in the domain, m; differs from `place` only in a group that is `total`.
        v, C: velocity and affine velocity.
        state: J or F.
        inner: internal variables.
        row, constants: its row of the table of its group, and the constants of the law in that row.
        loads: the external loads.
        borne: the share of its stress that it bears.
    """

    place: Any
    here: Any
    v: Any
    C: Any
    state: Any
    inner: Any
    row: Any
    constants: Any
    loads: "ExternalLoads"
    borne: Any


@dataclass(frozen=True)
class ExternalLoads:
    """External loads on a particle: variables of a kernel, zero for loads that the scene does not have.

    Attributes:
        share: fraction of its motion that its body keeps.
        missing: mean of ln J over its cell minus its own ln J.
        push, slope: acceleration by forces and nozzles, m/s^2, and its gradient, 1/s^2.
        touch, friction: acceleration by other bodies and by friction on walls, m/s^2.
    """

    share: Any
    missing: Any
    push: Any
    slope: Any
    touch: Any
    friction: Any


@dataclass(frozen=True)
class Receiver:
    """State of a particle before G2P; all attributes are variables of a kernel.

    Attributes:
        place: position in the domain, m.
        remainder: rounding error of the position, m.
        v, C: values before the step, used if its body keeps a fraction of its motion.
        deformation: J - 1 or F - I.
        constants: constants of the law.
        share: fraction of its motion that its body keeps.
        missing: mean growth of ln J over its cell minus its own growth.
    """

    place: Any
    remainder: Any
    v: Any
    C: Any
    deformation: Any
    constants: Any
    share: Any
    missing: Any


@dataclass(frozen=True)
class NodeSums:
    """Sums over the stencil of a particle in G2P: variables of a kernel.

    Attributes:
        distance: distance of the particle from the first node, cells.
        velocity, moment: sums of nodal velocities, see `gather_linear`.
        old_velocity, old_moment: sums of the velocity that bodies keep, if any do.
    """

    distance: Any
    velocity: Any
    moment: Any
    old_velocity: Any
    old_moment: Any


@ti.func
def p2g(particles: ti.template(), group: ti.template(), own: ti.template(), distance: ti.template(), kick: float):
    """Return the contribution of a particle, a `Sender`, to its nodes, and its plastic flow.

    Node i receives the momentum w_i (m v + A (x_i - x_p)), A = m C - kick V0 tau / D (Hu et al. 2018, eq. 18), and the
    mass w_i m. v and C include the external loads over `kick`.

    Args:
        distance: position relative to the first node of its stencil, (d,), cells.
        kick: time for which stress and forces act, s.

    Returns:
        middle, change: momentum and mass at the middle node, and their change per cell along each axis, see `momentum`.
        plastic, inner: for a law that `projects`, the change of J or F by plastic flow, and the internal variables
            after it; unused for other laws.
    """
    grid, d = ti.static((particles.grid, group.dimension))
    seen, stretch = own.state, 1.0
    if ti.static(group.uses_f_bar):
        stretch = stretch_to(own.loads.missing, d)
        seen *= stretch
    stress, spherical, plastic, inner = group.law.respond(seen, own.inner, own.C, kick, own.constants)
    if ti.static(group.law.projects):
        plastic -= seen
        if ti.static(group.uses_f_bar):
            plastic /= stretch
    if ti.static(group.eased):
        stress, _ = group.law.eased(stress, spherical, own.borne)
    v, C = own.v, own.C
    if ti.static(group.is_pushed):
        v += kick * own.loads.push
        C += kick * own.loads.slope
    if ti.static(group.total):
        if ti.static(particles.repels):
            v += kick * own.loads.touch
        if ti.static(group.has_wall_friction):
            v += kick * own.loads.friction
        v += kick * push_of_walls(particles, group, own.here, own.place, own.state, own.row, own.constants)
        # Entry by entry, because Taichi loses matrices that are assigned as a whole here.
        at_rest, nominal = C @ own.state, pulled_back(stress, own.state)
        for i, j in ti.static(ti.ndrange(d, d)):
            C[i, j] = at_rest[i, j]
            stress[i, j] = nominal[i, j]
    middle, change = momentum(grid, distance, own.row, v, C, stress, kick)
    if ti.static(grid.scheme.keeps_flip_velocity):
        kept = own.C
        if ti.static(group.total):
            kept = own.C @ own.state
        add_kept(grid, distance, own.loads.share * own.row[MASS], own.v, kept, middle, change)
    return middle, change, plastic, inner


@ti.func
def g2p(
    particles: ti.template(),
    group: ti.template(),
    own: ti.template(),
    sums: ti.template(),
    dt: float,
    gravity_step: ti.template(),
):
    """Return the new state of a particle, a `Receiver`, after a step of dt with the given `NodeSums`.

    x += dt v, and F <- (I + dt C) F or J *= det(I + dt C); on the grid of the state at rest F += dt dv/dX.

    Returns:
        v, C: velocity and affine velocity.
        place, remainder, beyond: see `ParticleUpdate.moved`.
        deformation: J - 1 or F - I.
        growth: increase of ln J in the step, if the group is `evened`.
        rate: rate of deformation, 1/s (see `deformation_rate`).
        slope: gradient of the velocity, by which F changes, 1/s.
    """
    grid, d = ti.static((particles.grid, group.dimension))
    C = centred(grid, sums.distance, sums.velocity, sums.moment).transpose()
    after, growth, F = own.deformation, 0.0, ti.Matrix.identity(float, d)
    if ti.static(group.total):
        after += dt * C
        F += after
        C = C @ F.inverse()
    v, affine = sums.velocity, C
    if ti.static(grid.scheme.keeps_flip_velocity):
        C_before = centred(grid, sums.distance, sums.old_velocity, sums.old_moment).transpose()
        own_C = own.C
        if ti.static(group.total):
            own_C = own.C @ (ti.Matrix.identity(float, d) + own.deformation)
        unseen, unseen_C = own.share * (own.v - sums.old_velocity), own.share * (own_C - C_before)
        turn = turned(grid, sums.velocity - sums.old_velocity - gravity_step, unseen, unseen_C, C_before, dt)
        if ti.static(group.total):
            unseen_C = unseen_C @ F.inverse()
        v += unseen
        affine += unseen_C + turn
    place, remainder, beyond = particles.moved(group, own.place, own.remainder, sums.velocity, dt)
    rate = deformation_rate(group, C)
    if ti.static(group.law.deformation == "J"):
        after = group.law.grown(own.deformation, volume_growth(C, dt), own.constants)
    elif ti.static(not group.total):
        if ti.static(group.evened):
            after = even(own.deformation, own.missing)
            growth = log_volume(dt * C)
        after = deformed_gradient(after, C, dt)
    return v, affine, place, remainder, beyond, after, growth, rate, C


@ti.func
def momentum(
    grid: ti.template(),
    distance: ti.template(),
    row: ti.template(),
    v: ti.template(),
    C: ti.template(),
    stress: ti.template(),
    kick: float,
):
    """Return unweighted momentum and mass at the middle node of a stencil, and their change per cell and axis."""
    d = ti.static(grid.dimension)
    mass, volume, middle = row[MASS], row[VOLUME], ti.Vector.zero(float, grid.width)
    change = ti.Matrix.zero(float, d, grid.width)
    stress_scale = kick * volume * grid.gradient_scale
    for c in ti.static(range(d)):
        middle[c] = mass * v[c]
        for a in ti.static(range(d)):
            change[a, c] = (mass * grid.spacing) * C[c, a] - stress_scale * stress[c, a]
            middle[c] -= change[a, c] * (distance[a] - 1.0)
    middle[d] = mass
    return middle, change


@ti.func
def add_kept(
    grid: ti.template(),
    distance: ti.template(),
    mass: float,
    v: ti.template(),
    C: ti.template(),
    middle: ti.template(),
    change: ti.template(),
):
    """Set the entries of `middle` and `change` for the motion that a body keeps, with its mass; see `momentum`."""
    d, kept = ti.static((grid.dimension, grid.kept))
    for c in ti.static(range(d)):
        middle[kept + c] = mass * v[c]
        for a in ti.static(range(d)):
            change[a, kept + c] = (mass * grid.spacing) * C[c, a]
            middle[kept + c] -= change[a, kept + c] * (distance[a] - 1.0)
    middle[kept + d] = mass


@ti.func
def centred(grid: ti.template(), distance: ti.template(), velocity: ti.template(), moment: ti.template()):
    """Return the velocity gradient at a point from sums over its stencil, see `gather_linear`.

    It is the sum of w_i (x_i - x) v_i^T / D; row a is dv/dx_a.
    """
    gradient = moment
    for a in ti.static(range(moment.n)):
        for c in ti.static(range(moment.m)):
            gradient[a, c] = (moment[a, c] - velocity[c] * (distance[a] - 1.0)) * grid.gradient_scale
    return gradient


@ti.func
def turned(grid: ti.template(), gained: ti.template(), v: ti.template(), C: ti.template(), H: ti.template(), dt: float):
    """Return the change of affine velocity that conserves angular momentum if a particle keeps v and affine part C.

    It is dt (g v^T - v g^T) / (2 D) + dt (C H^T - H C^T) / 2. Here g is `gained`, the change of the gathered velocity
    without that by gravity, and H the gradient of the nodal velocity of the kept motion (docs/theory.md, 2.3).
    """
    d = ti.static(grid.dimension)
    result, scale = ti.Matrix.zero(float, d, d), 0.5 * dt * grid.gradient_scale * grid.inverse_spacing
    sheared = C @ H.transpose()
    for c, a in ti.static(ti.ndrange(d, d)):
        result[c, a] = scale * (gained[c] * v[a] - v[c] * gained[a]) + 0.5 * dt * (sheared[c, a] - sheared[a, c])
    return result


@ti.func
def deformed_gradient(H: ti.template(), C: ti.template(), dt: float):
    """Return F - I after a step from H = F - I before it, d rows: H + dt C + dt C H."""
    new = H
    for i in ti.static(range(H.n)):
        for k in ti.static(range(H.n)):
            rate = dt * C[i, k]
            new[i, k] += rate
            for j in ti.static(range(H.m)):
                new[i, j] += rate * H[k, j]
    return new
