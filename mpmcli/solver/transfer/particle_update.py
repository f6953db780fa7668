"""What a step does with one particle: P2G and G2P as a GPU takes them, and parts of both that the CPU takes, too.

MLS-MPM (Hu et al. 2018) with APIC (Jiang et al. 2015), or AFLIP; see docs/theory.md, 2.
"""

from collections.abc import Sequence
from copy import copy

from mpmcli.boundaries.walls import MovingFaces, RoughFaces
from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid, LinearNodes
from mpmcli.solver.grid.period import opaque
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.state_bounds import deformation_rate, volume_growth, volume_ratio
from mpmcli.solver.solids.contact import ParticleContact
from mpmcli.solver.solids.reference_grid import friction_of_walls, pulled_back, push_of_walls
from mpmcli.solver.transfer.splines import PAD
from mpmcli.solver.transfer.stencils import add_linear, gather_linear
from mpmcli.solver.transfer.volume_average import even, log_volume, missing_growth, missing_to_mean, stretch_to
from mpmcli.solver.transfer.volume_relaxation import relax_volume


@ti.func
def scatter(g: ti.template(), group: ti.template(), particles: ti.template(), p: int, kick: float):
    """Add the mass and the momentum of particle p, stress included, to the nodes around it, with atomics.

    A law with plastic flow projects the particle's state first; forces change v by kick a, and C by kick da/dx. Node i
    receives w_i (m v + A (x_i - x_p)) with A = m C - dt V0 tau / D (Hu et al. 2018, eq. 18), and w_i m.
    """
    grid = particles.grid
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
        push, slope = group.force.acceleration(group, p, group.force.spreads)
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
    if ti.static(grid.scheme.keeps_before):
        # Last, and with a copy: before it, Taichi 1.7.4 loses what a force with branches adds to v and C.
        own_v, own_C = group.motion_on_grid(p)
        add_kept(grid, distance, group.kept[group.row_number(p)] * mass, own_v, own_C, middle, change)
    first = grid.linear_index(base)
    if ti.static(grid.deterministic):
        if not add_fixed(grid.fixed.nodes, grid, first, w, mass, middle, change):
            grid.fixed.note(group.id[p])
    else:
        add_linear(grid.nodes, grid, first, w, middle, change, True)


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
    """Return the momentum and mass that the middle node of a stencil would take, and their change per cell and axis."""
    d = ti.static(grid.dimension)
    middle = ti.Vector.zero(float, grid.width)
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
    """Set what a stencil takes of the share, of that mass, that a body keeps of its motion, see `momentum`."""
    d, kept = ti.static((grid.dimension, grid.kept))
    for c in ti.static(range(d)):
        middle[kept + c] = mass * v[c]
        for a in ti.static(range(d)):
            change[a, kept + c] = (mass * grid.spacing) * C[c, a]
            middle[kept + c] -= change[a, kept + c] * (distance[a] - 1.0)
    middle[kept + d] = mass


@ti.func
def scatter_volume(x: ti.template(), volume: float, grid: ti.template(), atomic: ti.template()):
    """Add the volume of a particle at rest, m^3, to `grid.filling`."""
    base, distance = grid.scheme.spline.stencil(x, grid.inverse_spacing)
    w = grid.scheme.spline.weights(distance)
    middle = ti.Vector.zero(float, grid.filling.n)
    middle[ti.static(grid.dimension)] = volume
    change = ti.Matrix.zero(float, ti.static(grid.dimension), grid.filling.n)
    if ti.static(grid.deterministic):
        middle[ti.static(grid.dimension)] = volume * grid.fixed.volume_scale()
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
    """Add momentum and mass, which it scales, to sums in fixed point if there is room for them; return whether so."""
    fits = grid.fixed.scaled(mass, middle, change)
    if fits:
        add_linear(sums, grid, first, w, middle, change, True)
    return fits


@ti.func
def gather(x: ti.template(), grid: ti.template(), field: ti.template()):
    """Return the velocity at a point and its gradient, sum w_i (x_i - x) v_i^T / D, of a field of the nodes.

    Row a of the gradient is dv/dx_a. Of both, as wide as a node, the first d columns count.
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


NOT_LOST = 2**31 - 1
# A particle crushed to less than this fraction of its volume is lost: near zero J is round-off, not physics.
SMALLEST_J = 1e-6
# Cells beyond an open face at which particles stay until the next sort retires them: as far as nodes reach.
BEYOND = 1.99


@ti.data_oriented
class ParticleUpdate:
    """Both halves of a step of a particle, as a GPU takes them; on the CPU see `cpu_transfers`.

    Attributes:
        near: the nodes that stencils find: those of the grid, or on a sparse one those of a window.
        extent: size of the domain, m; last: node of the upper walls, per axis; faces: words of the walls, per axis.
        contact: between elastic bodies that are `total`; touches: whether there is any.
        friction, moving: coefficients and velocities of the walls; run: number of the run that a view is for.
        watches_box: whether a particle whose stencil has left the nodes in use is lost: on a GPU, where speeds are not
            read back at every step.
        lost: per group, the first particle (in solver order, by its id where the grid is `deterministic`) that left the
            domain, was inverted or is not finite, or NOT_LOST.
    """

    def __init__(
        self,
        grid: Grid,
        faces: Sequence[tuple[str, str]],
        group_count: int,
        contact: ParticleContact | None,
        friction: RoughFaces,
        moving: MovingFaces,
        *,
        watches_box: bool,
    ) -> None:
        self.contact, self.touches, self.friction, self.moving = contact, contact is not None, friction, moving
        self.grid = self.near = grid
        self.dimension, self.run, self.first_lost = grid.dimension, 0, 0
        self.faces = tuple(tuple(pair) for pair in faces)
        self.extent = tuple(n * grid.spacing for n in grid.cells)
        self.last = tuple(PAD + n for n in grid.cells)
        self.watches_box = watches_box
        self.lost = ti.field(int, shape=group_count)
        self.lost.fill(NOT_LOST)

    def beside(self, nodes: LinearNodes) -> "ParticleUpdate":
        """Return an update whose stencils find these nodes."""
        result = copy(self)
        result.near = nodes
        return result

    @ti.func
    def scatter(self, g: ti.template(), group: ti.template(), p: int, kick: float, relaxed: float):
        """Scatter one particle, with atomics; one that is crushed is lost: its stress would spread NaN."""
        if volume_ratio(group, group.stored(p)) > SMALLEST_J:
            scatter(g, group, self, p, kick)
        else:
            self.lose(g, group, p)
        if ti.static(self.grid.keeps_filling):
            if relaxed > 0.0:
                scatter_volume(group.x[p], group.row(p)[VOLUME], self.grid, True)

    @ti.func
    def relax(self, group: ti.template(), p: int, relaxed: float):
        """Relax the volume of one particle over a time, s, after P2G; return the change of its logarithm."""
        change = 0.0
        _v, C = group.motion(p)
        # What is at rest stays as it is.
        if deformation_rate(group, C) > 0.0:
            change = relax_volume(group, self.grid, self.last, p, group.x[p], relaxed)
        return change

    @ti.func
    def advance(self, g: ti.template(), group: ti.template(), p: int, dt: float, gravity_step: ti.template()):
        """Gather and move one particle; return its rate of deformation, 1/s (see `deformation_rate`).

        x += dt v, and F <- (I + dt C) F or J *= det(I + dt C); on the grid of the state at rest F += dt dv/dX.
        """
        d = ti.static(self.dimension)

        # Gather.
        x = group.x[p]
        v, gradient = gather(group.on_grid(p), self.grid, self.grid.nodes)
        C = ti.Matrix.zero(float, d, d)
        for c, a in ti.static(ti.ndrange(d, d)):
            C[c, a] = gradient[a, c]
        remainder = ti.Vector.zero(float, d)
        if ti.static(group.carries):
            for c in ti.static(range(d)):
                remainder[c] = group.gradient[p][c, d]
        inside, after, beyond = self.moved(group, x, remainder, v, dt)
        own_v, own_C, turn = self.kept_motion(group, p, v, gradient, dt, gravity_step)

        # Motion.
        for c in ti.static(range(group.v.n)):
            group.v[p][c] = v[c]
            if ti.static(self.grid.scheme.keeps_before):
                group.v[p][c] += own_v[c]
        if ti.static(group.total):
            for c, a in ti.static(ti.ndrange(d, d)):
                group.displacement_gradient[p][c, a] += dt * C[c, a]
            # Entry by entry: Taichi loses matrices that are assigned as a whole here.
            in_space = C @ group.stored(p).inverse()
            for c, a in ti.static(ti.ndrange(d, d)):
                C[c, a] = in_space[c, a]
                gradient[a, c] = in_space[c, a]
        if ti.static(self.grid.scheme.keeps_before):
            if ti.static(group.total):
                own_C = own_C @ group.stored(p).inverse()
            for c, a in ti.static(ti.ndrange(d, d)):
                gradient[a, c] += own_C[c, a] + turn[c, a]
        for a in ti.static(range(d)):
            for c in ti.static(range(group.v.n)):
                group.gradient[p][a, c] = gradient[a, c]
            if ti.static(group.carries):
                group.gradient[p][a, d] = after[a]

        # Deformation. The rate here, where C is at hand, takes half the time that it would take at the end.
        deforming = deformation_rate(group, C)
        if ti.static(group.evened):
            missing = missing_growth(self.grid, g, group, p)
            group.displacement_gradient[p] = even(group.displacement_gradient[p], missing)
            group.growth[p] = log_volume(dt * C)
        if ti.static(group.law.deformation == "F" and not group.total):
            group.displacement_gradient[p] = deformed_gradient(group.displacement_gradient[p], C, dt)
        if ti.static(group.law.deformation == "J"):
            growth = volume_growth(C, dt)
            if ti.static(group.law.grows_by_constants):
                group.J_minus_1[p] = group.law.grown(group.J_minus_1[p], growth, group.constants(p))
            else:
                group.J_minus_1[p] = group.law.grown(group.J_minus_1[p], growth, ti.Vector.zero(float, 1))

        # Position. Written so that a NaN is not sound; then it stays, and no later step writes outside the grid.
        sound = beyond <= 0.5 * self.grid.spacing
        if ti.static(self.watches_box and not group.total):
            base, _ = self.grid.scheme.spline.stencil(inside, self.grid.inverse_spacing)
            for a in ti.static(range(d)):
                low = self.grid.box[0, a]
                reach = ti.static(self.grid.scheme.spline.nodes - 1)
                sound = sound and base[a] >= low and base[a] + reach < low + self.grid.box[1, a]
        for c in ti.static(range(d)):
            group.x[p][c] = ti.select(sound, inside[c], x[c])
        if not sound:
            self.lose(g, group, p)
        return deforming

    @ti.func
    def lose(self, g: ti.template(), group: ti.template(), p: int):
        if ti.static(self.grid.deterministic):
            ti.atomic_min(self.lost[self.first_lost + g], group.id[p])
        else:
            ti.atomic_min(self.lost[self.first_lost + g], p)

    @ti.func
    def moved(self, group: ti.template(), x: ti.template(), remainder: ti.template(), v: ti.template(), dt: float):
        """Return where a particle at x moves in dt, the remainder there, and how far it would leave the domain, all m.

        remainder: what rounding took from x: the sum loses nothing (Dekker 1971; docs/theory.md, 8.3). The place is
        inside the domain, but for open faces and along periodic axes.
        """
        inside, after, beyond = ti.Vector.zero(float, self.dimension), ti.Vector.zero(float, self.dimension), 0.0
        for c in ti.static(range(self.dimension)):
            way = dt * v[c] + remainder[c]
            moved = x[c] + way
            if ti.static(c in self.grid.period.axes):
                inside[c], after[c], out = self.grid.period.moved(group, x[c], way, self.extent[c], c)
                beyond += out * self.grid.spacing
            else:
                low, high = 0.0, self.extent[c]
                # Until the next sort, which retires it, a particle moves on beyond an open face.
                if ti.static((c, 0) in self.grid.opens):
                    low = -BEYOND * self.grid.spacing
                if ti.static((c, 1) in self.grid.opens):
                    high = self.extent[c] + BEYOND * self.grid.spacing
                inside[c] = ti.select(moved > low, moved, low)
                inside[c] = ti.select(inside[c] < high, inside[c], high)
                beyond += ti.abs(moved - inside[c])
                if ti.static(group.carries):
                    after[c] = ti.select(moved == inside[c], way - (opaque(inside[c]) - x[c]), 0.0)
                    if ti.static((c, 0) in self.grid.opens):
                        # `opaque` is for numbers that are not negative.
                        after[c] = ti.select(inside[c] > 0.0, after[c], 0.0)
        return inside, after, beyond

    @ti.func
    def kept_motion(
        self,
        group: ti.template(),
        p: int,
        seen: ti.template(),
        slope: ti.template(),
        dt: float,
        gravity_step: ti.template(),
    ):
        """Return what particle p keeps of its velocity and of its gradient on the grid, and what turns with it.

        Args:
            seen, slope: what the stencil of the particle holds, as `gather` returns it.
        """
        d, kept = ti.static((self.dimension, self.grid.kept))
        velocity, gradient, turn = ti.Vector.zero(float, d), ti.Matrix.zero(float, d, d), ti.Matrix.zero(float, d, d)
        if ti.static(self.grid.scheme.keeps_before):
            share = group.kept[group.row_number(p)]
            v, C = group.motion_on_grid(p)
            gained, H = ti.Vector.zero(float, d), ti.Matrix.zero(float, d, d)
            for c in ti.static(range(d)):
                velocity[c] = share * (v[c] - seen[kept + c])
                gained[c] = seen[c] - seen[kept + c] - gravity_step[c]
                for a in ti.static(range(d)):
                    H[c, a] = slope[a, kept + c]
                    gradient[c, a] = share * (C[c, a] - H[c, a])
            found = turned(self.grid, gained, velocity, gradient, H, dt)
            for c, a in ti.static(ti.ndrange(d, d)):
                turn[c, a] = found[c, a]
        return velocity, gradient, turn


@ti.func
def turned(grid: ti.template(), gained: ti.template(), v: ti.template(), C: ti.template(), H: ti.template(), dt: float):
    """Return what C takes so that a velocity v that a particle keeps, and C with it, turn no angular momentum.

    It is dt (g v^T - v g^T) / (2 D) + dt (C H^T - H C^T) / 2: g is what the nodes gained since, but from
    gravity, and H the gradient of the share that is kept, both without what was lost (docs/theory.md, 2.3).
    """
    d = ti.static(grid.dimension)
    result, scale = ti.Matrix.zero(float, d, d), 0.5 * dt * grid.gradient_scale * grid.inverse_spacing
    sheared = C @ H.transpose()
    for c, a in ti.static(ti.ndrange(d, d)):
        result[c, a] = scale * (gained[c] * v[a] - v[c] * gained[a]) + 0.5 * dt * (sheared[c, a] - sheared[a, c])
    return result


@ti.func
def deformed_gradient(H: ti.template(), C: ti.template(), dt: float):
    """Return F - I after a step from H = F - I before it, d rows: it grows by dt C + dt C H."""
    new = H
    for i in ti.static(range(H.n)):
        for k in ti.static(range(H.n)):
            rate = dt * C[i, k]
            new[i, k] += rate
            for j in ti.static(range(H.m)):
                new[i, j] += rate * H[k, j]
    return new
