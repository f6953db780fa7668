"""G2P: particles take velocity and its gradient from nodes, and move (docs/theory.md, 2)."""

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.arrays import ParticleArrays, constants_of
from mpmcli.solver.particles.loop import INDEX, Operation, Pass
from mpmcli.solver.transfer.particle_step import NodeSums, Receiver, g2p
from mpmcli.solver.transfer.stencils import columns, gather_linear
from mpmcli.solver.transfer.volume import in_layer, missing_growth


@ti.func
def locate(at: ti.template(), _p: int, _how: float, place: ti.template()):
    """Return the first node of the stencil of a particle in layer 0, its weights, and the distance from that node."""
    (near,) = ti.static((at.particles.near,))
    base, distance = at.grid.scheme.spline.stencil(place, at.grid.inverse_spacing)
    return near.linear_index(base), at.grid.scheme.spline.weights(distance), distance


LOCATE = Pass(locate, {"first": INDEX, "w": ("nodes", "d"), "apart": ("d",)}, in_lanes=True)


def advance_of(group: ParticleArrays, *, keeps: bool) -> Operation:
    """Return the operation that moves particles of a group; `keeps` is whether bodies may keep their motion.

    `at.gravity_step` is the change of velocity by gravity in the step. The largest rate of deformation, 1/s, is
    returned.
    """
    reads = ["x", "place", "deformation"] + ["remainder"] * group.carries
    reads += ["v", "C"] * keeps + ["row"] * group.law.grows_by_constants
    states = dict.fromkeys(("v", "C", "x", "remainder", "deformation", "growth"))
    return Operation(
        reads=tuple(reads),
        passes=(
            LOCATE,
            Pass(gather, {"share": (), "missing": (), "sums": ("width",), "moments": ("d", "width")}),
            Pass(move, states | {"rate": (), "slope": ("d", "d"), "sound": ()}, in_lanes=True),
            *[Pass(carry_surface)] * (group.surfaced and group.law.projects),
        ),
        writes=("v", "C", "deformation", *["remainder"] * group.carries, *["growth"] * group.evened),
        guarded=("x",),
        largest="rate",
        near=True,
    )


@ti.func
def gather(at: ti.template(), p: int, dt: float, first: int, w: ti.template()):
    """Return what a particle keeps of its motion, its missing growth, and sums over its stencil."""
    grid, group, near = ti.static((at.grid, at.group, at.particles.near))
    share, missing = 0.0, 0.0
    if ti.static(grid.scheme.keeps_flip_velocity):
        share = group.kept[group.row_number(p)]
    if ti.static(group.evened):
        missing = missing_growth(grid, at.g, group, p, dt)
    sums, moments = gather_linear(near.nodes, near, in_layer(grid, group, p, first), w)
    return share, missing, sums, moments


@ti.func
def move(
    at: ti.template(),
    _p: int,
    dt: float,
    x: ti.template(),
    remainder: ti.template(),
    v: ti.template(),
    C: ti.template(),
    deformation: ti.template(),
    row: ti.template(),
    share: float,
    missing: float,
    apart: ti.template(),
    sums: ti.template(),
    moments: ti.template(),
):
    """Return the state of a particle after a step, its rate of deformation, velocity gradient, and whether it is sound.

    A particle that has left the domain or is not finite does not move, so that no later step writes outside the grid.
    """
    grid, group, d = ti.static((at.grid, at.group, at.grid.dimension))
    kept = ti.static(grid.kept if grid.scheme.keeps_flip_velocity else 0)
    velocity, moment = columns(sums, moments, 0, d)
    old_velocity, old_moment = columns(sums, moments, kept, d)
    (own,) = ti.static((Receiver(x, remainder, v, C, deformation, constants_of(row), share, missing),))
    (nodes,) = ti.static((NodeSums(apart, velocity, moment, old_velocity, old_moment),))
    v_after, C_after, inside, left, beyond, state, growth, rate, slope = g2p(
        at.particles, group, own, nodes, dt, at.gravity_step
    )
    # Written so that a NaN is not sound.
    sound = beyond <= 0.5 * grid.spacing
    if ti.static(at.particles.watches_box and not group.total):
        base, _ = grid.scheme.spline.stencil(inside, grid.inverse_spacing)
        for a in ti.static(range(d)):
            low, reach = grid.box[0, a], ti.static(grid.scheme.spline.nodes - 1)
            sound = sound and base[a] >= low and base[a] + reach < low + grid.box[1, a]
    return v_after, C_after, inside, left, state, growth, rate, slope, ti.cast(sound, float)


@ti.func
def carry_surface(at: ti.template(), p: int, dt: float, slope: ti.template()):
    """Change the normal and the depth of particle p, whose law projects F, to (I + dt C)^-T n and D, over |n|."""
    group, d = ti.static((at.group, at.grid.dimension))
    N = ti.Vector.zero(float, d)
    for c in ti.static(range(d)):
        N[c] = group.carried[p][c]
    n = (ti.Matrix.identity(float, d) + dt * slope).inverse().transpose() @ N
    for c in ti.static(range(d)):
        group.carried[p][c] = n[c] / n.norm()
    group.carried[p][d] /= n.norm()
