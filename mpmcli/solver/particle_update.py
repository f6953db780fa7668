"""What a step does with one particle: scatter it to the nodes, and move it with them."""

from collections.abc import Sequence
from copy import copy

import taichi as ti

from mpmcli.boundaries.moving_faces import STILL, MovingFaces
from mpmcli.boundaries.rough_faces import RoughFaces
from mpmcli.boundaries.walls import SMOOTH
from mpmcli.solver.grid import Grid, LinearNodes
from mpmcli.solver.particle_arrays import VOLUME
from mpmcli.solver.particle_contact import ParticleContact
from mpmcli.solver.rounding import opaque
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import deformation_rate, volume_growth, volume_ratio
from mpmcli.solver.transfer import gather, scatter, scatter_volume
from mpmcli.solver.volume_relaxation import relax_volume

NOT_LOST = 2**31 - 1
# A particle crushed to less than this fraction of its volume is lost: near zero J is round-off, not physics.
SMALLEST_J = 1e-6
# Cells beyond an open face at which particles stay until the next sort retires them: as far as nodes reach.
BEYOND = 1.99


@ti.data_oriented
class ParticleUpdate:
    """Both halves of a step of a particle, as a GPU takes them; `scatter_range` and `advance_range` do on the CPU.

    Attributes:
        near: the nodes that stencils find: those of the grid, or on a sparse one those of a window.
        extent: size of the domain, m; last: node of the upper walls, per axis; faces: words of the walls, per axis.
        contact: between elastic bodies that are `total`; touches: whether there is any.
        friction, moving: coefficients and velocities of the walls.
        run: number of the run that a view is for.
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
        contact: ParticleContact | None = None,
        friction: RoughFaces = SMOOTH,
        moving: MovingFaces = STILL,
        *,
        watches_box: bool,
    ) -> None:
        self.contact, self.touches = contact, contact is not None
        self.friction, self.moving = friction, moving
        self.run = 0
        self.grid = self.near = grid
        self.faces = tuple(tuple(pair) for pair in faces)
        self.dimension = grid.dimension
        self.extent = tuple(n * grid.spacing for n in grid.cells)
        self.last = tuple(PAD + n for n in grid.cells)
        self.watches_box = watches_box
        self.lost = ti.field(int, shape=group_count)
        self.lost.fill(NOT_LOST)
        self.first_lost = 0

    def beside(self, nodes: LinearNodes) -> "ParticleUpdate":
        """Return an update whose stencils find these nodes."""
        result = copy(self)
        result.near = nodes
        return result

    def any_lost(self) -> bool:
        """Return whether any particle is lost."""
        return bool((self.lost.to_numpy() != NOT_LOST).any())

    @ti.func
    def scatter(self, g: ti.template(), group: ti.template(), p: int, kick: float, relaxed: float):
        """Scatter one particle, with atomics.

        One that is crushed or inverted is lost: its stress would spread NaN over the grid.
        """
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
    def advance(self, g: ti.template(), group: ti.template(), p: int, dt: float):
        """Gather and move one particle, x += dt v and F <- (I + dt C) F or J *= det(I + dt C).

        On the grid of the state at rest it is F += dt dv/dX.

        Returns:
            Its rate of deformation, 1/s (see `deformation_rate`).
        """
        d = ti.static(self.dimension)

        # Gather.
        x = group.x[p]
        v, gradient = gather(group.on_grid(p), self.grid, self.grid.nodes)
        C = ti.Matrix.zero(float, d, d)
        for c in ti.static(range(d)):
            for a in ti.static(range(d)):
                C[c, a] = gradient[a, c]
        remainder = ti.Vector.zero(float, d)
        if ti.static(group.carries):
            for c in ti.static(range(d)):
                remainder[c] = group.gradient[p][c, d]
        inside, after, beyond = self.moved(group, x, remainder, v, dt)
        if ti.static(self.grid.scheme.keeps_before):
            kept = self.unseen_velocity(group, p)
            for c in ti.static(range(d)):
                v[c] += kept[c]

        # Motion.
        for c in ti.static(range(group.v.n)):
            group.v[p][c] = v[c]
        if ti.static(group.total):
            for c, a in ti.static(ti.ndrange(d, d)):
                group.displacement_gradient[p][c, a] += dt * C[c, a]
            # Entry by entry: Taichi loses matrices that are assigned as a whole here.
            in_space = C @ group.stored(p).inverse()
            for c, a in ti.static(ti.ndrange(d, d)):
                C[c, a] = in_space[c, a]
                gradient[a, c] = in_space[c, a]
        for a in ti.static(range(d)):
            for c in ti.static(range(group.v.n)):
                group.gradient[p][a, c] = gradient[a, c]
            if ti.static(group.carries):
                group.gradient[p][a, d] = after[a]

        # Deformation. The rate here, where C is at hand, takes half the time that it would take at the end.
        deforming = deformation_rate(group, C)
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
        """Note that a particle is lost."""
        if ti.static(self.grid.deterministic):
            ti.atomic_min(self.lost[self.first_lost + g], group.id[p])
        else:
            ti.atomic_min(self.lost[self.first_lost + g], p)

    @ti.func
    def moved(self, group: ti.template(), x: ti.template(), remainder: ti.template(), v: ti.template(), dt: float):
        """Return where a particle at x moves in dt, clamped to the domain, and how far it would leave it, m.

        Along a periodic axis it may leave it.

        Args:
            remainder: what rounding took from x, m; the one after the move is returned in between. Their sum loses
                nothing (Dekker 1971; docs/theory.md, 8.3).
        """
        inside = ti.Vector.zero(float, self.dimension)
        after = ti.Vector.zero(float, self.dimension)
        beyond = 0.0
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
    def unseen_velocity(self, group: ti.template(), p: int):
        """Return the share that particle p keeps of the velocity of its own that the nodes do not see.

        AFLIP adds it to APIC's velocity: v <- sum w v_i + flip (v - sum w v_i^before) (Fei et al. 2021;
        docs/theory.md, 2.3). C, positions and deformations follow the nodes. As positions do, and not the particle's
        own velocity, angular momentum is kept to first order in the step only.
        """
        before, _ = gather(group.on_grid(p), self.near, self.near.before)
        kept = ti.Vector.zero(float, self.dimension)
        for c in ti.static(range(self.dimension)):
            kept[c] = self.grid.scheme.flip * (group.v[p][c] - before[c])
        return kept


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
