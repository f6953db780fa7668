"""The kernels of one time step: clear, scatter, update the grid, gather."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.boundaries.walls import REACH, Walls
from mpmcli.solver.flip import settle_before, unseen_velocity
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid
from mpmcli.solver.ordering import CHUNK, TileOrder, share_start
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.state_bounds import (
    NOTHING,
    StateBounds,
    deformation_rate,
    entries,
    state_bounds_of,
    volume_growth,
    volume_ratio,
    widen_motion,
    widen_state,
)
from mpmcli.solver.transfer import gather, scatter

NOT_LOST = 2**31 - 1
# A particle crushed to less than this fraction of its volume is lost: near zero J is round-off, not physics.
SMALLEST_J = 1e-6


@dataclass(frozen=True)
class StepResult:
    """How fast the state changed in a step.

    Attributes:
        speed: largest speed of a node, m/s, which no particle exceeds; -1 where a particle was lost.
        deformation_rates: of each group, the largest rate of deformation, 1/s (see `deformation_rate`).
        state_bounds: of each group that hardens, the bounds of its state; None of the others, which change less.
    """

    speed: float
    deformation_rates: list[float]
    state_bounds: list[StateBounds | None]


@dataclass(frozen=True)
class StepKernels:
    """Compiled steps.

    Attributes:
        step: (dt, kick) -> how fast the state changed. Positions move on by dt, s, velocities by kick, s: from the
            middle of the last step to the middle of this one (leapfrog). On a GPU nothing is read back, and None.
        find_box: set the grid's box in use from the sorted tiles.
        lost: per group, the first particle (in solver order) that left the domain, inverted or became
            non-finite, or NOT_LOST.
        any_lost: () -> whether there is one.
    """

    step: Callable[[float, float], StepResult | None]
    find_box: Callable[[], None]
    lost: ti.Field
    any_lost: Callable[[], bool]


def build_step(
    grid: Grid,
    walls: Walls,
    groups: Sequence[ParticleGroup],
    orders: Sequence[TileOrder],
    gravity: Gravity,
    *,
    on_cpu: bool,
    drift: int,
) -> StepKernels:
    """Build the kernels for these groups and nothing else.

    Args:
        gravity: what it adds to velocities.
        on_cpu: scatter by coloured pencils without atomics, and read the largest speed back.
        drift: cells that a particle may move away from the tile that it was sorted into.
    """
    d = grid.dimension
    h = grid.spacing
    threads = orders[0].threads
    pairs = tuple(zip(range(len(groups)), groups, orders, strict=True))
    fastest = ti.field(float, shape=())
    # What is read back of each group: its rate of deformation, and all bounds where it hardens.
    sharpest = tuple(ti.field(float, shape=()) for _ in groups)
    hardens = tuple(group.law.hardening > 0 for group in groups)
    farthest = tuple(
        tuple(ti.field(float, shape=()) for _ in range(entries(group) * hardened))
        for group, hardened in zip(groups, hardens, strict=True)
    )
    read_back = (*sharpest, *(field for fields in farthest for field in fields))
    found = ti.types.vector(1 + len(read_back), float)
    lost = ti.field(int, shape=len(groups))
    tile_low = ti.field(int, shape=d)
    tile_high = ti.field(int, shape=d)
    extent = tuple(n * h for n in grid.cells)
    # Colours written out in one kernel: four would double the compile time of 3D scenes, two that of what scatters
    # more than is usual.
    together = 2 if grid.scheme.plain else 1
    # Nodes from the first to the last of a stencil.
    reach = grid.scheme.spline.nodes - 1

    @ti.func
    def advance(g: ti.template(), group: ti.template(), p: int, dt: float):
        """Gather and move one particle, x += dt v and F <- (I + dt C) F or J *= det(I + dt C); return its rate."""
        x = group.x[p]
        v, gradient = gather(x, grid, grid.nodes)
        C = ti.Matrix.zero(float, d, d)
        inside = x
        beyond = 0.0
        for c in ti.static(range(d)):
            for a in ti.static(range(d)):
                C[c, a] = gradient[a, c]
            moved = x[c] + dt * v[c]
            inside[c] = ti.select(moved > 0.0, moved, 0.0)
            inside[c] = ti.select(inside[c] < extent[c], inside[c], extent[c])
            beyond += ti.abs(moved - inside[c])
        if ti.static(grid.scheme.keeps_before):
            kept = unseen_velocity(group, p, x, grid)
            for c in ti.static(range(d)):
                v[c] += kept[c]
        for c in ti.static(range(group.v.n)):
            group.v[p][c] = v[c]
        for a in ti.static(range(d)):
            for c in ti.static(range(group.v.n)):
                group.gradient[p][a, c] = gradient[a, c]
        # Here, where C is at hand, it takes half the time that it would take at the end.
        rate_now = deformation_rate(group, C)
        if ti.static(group.law.deformation == "F"):
            # F - I grows by dt C + dt C (F - I).
            old = group.displacement_gradient[p]
            new = old
            for i in ti.static(range(d)):
                for k in ti.static(range(d)):
                    rate = dt * C[i, k]
                    new[i, k] += rate
                    for j in ti.static(range(old.m)):
                        new[i, j] += rate * old[k, j]
            group.displacement_gradient[p] = new
        else:
            growth = volume_growth(C, dt)
            group.J_minus_1[p] += growth + growth * group.J_minus_1[p]
        # Written so that a NaN is not sound; then the position stays, and no later step writes outside the grid.
        sound = beyond <= 0.5 * h
        if ti.static(not on_cpu):
            # Speeds are not read back at every step there: a stencil may have outrun the nodes in use.
            base, _ = grid.scheme.spline.stencil(inside, 1 / h)
            for a in ti.static(range(d)):
                low = grid.box[0, a]
                sound = sound and base[a] >= low and base[a] + reach < low + grid.box[1, a]
        for c in ti.static(range(d)):
            group.x[p][c] = ti.select(sound, inside[c], x[c])
        if not sound:
            ti.atomic_min(lost[g], p)
        return rate_now

    @ti.func
    def spread_one(g: ti.template(), group: ti.template(), p: int, kick: float, atomic: ti.template()):
        """Scatter one particle, unless it is crushed or inverted: its stress would spread NaN over the grid."""
        if volume_ratio(group, group.stored(p)) > SMALLEST_J:
            scatter(group, grid, p, kick, atomic)
        else:
            ti.atomic_min(lost[g], p)

    @ti.func
    def update_node(node: ti.template(), index: int, gravity_step: ti.template()):
        """Turn momentum into velocity and return its square; 0 at a node that a wall leaves to its mirror image."""
        owned = True
        if walls.near(node):
            owned = walls.update(grid, node, gravity_step)
        else:
            value = grid.nodes[index]
            if value[d] > 0:
                for a in ti.static(range(d)):
                    value[a] = value[a] / value[d] + gravity_step[a]
                grid.nodes[index] = value
                if ti.static(grid.scheme.keeps_before):
                    settle_before(grid, index)
        speed_squared = 0.0
        if owned and grid.nodes[index][d] > 0:
            for a in ti.static(range(d)):
                speed_squared += grid.nodes[index][a] ** 2
        return speed_squared

    @ti.kernel
    def p2g(part: int, kick: float):
        """Scatter some colours, after clearing the grid for the first ones."""
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                rows = grid.row_count() if part == 0 else 0
                for row in range(share_start(rows, t, threads), share_start(rows, t + 1, threads)):
                    first = grid.linear_index(grid.row_start(row))
                    for k in range(grid.box[1, d - 1]):
                        grid.clear(first + k)
        for g, group, order in ti.static(pairs):
            for parity in ti.static(range(together)):
                for q in range(CHUNK * threads):
                    if q % CHUNK == 0:
                        t = q // CHUNK
                        colour = parity + together * part
                        for r in range(order.work[colour, t], order.work[colour, t + 1]):
                            first = order.pencil_start(colour, r)
                            for p in range(order.start[first], order.start[first + order.pencil]):
                                spread_one(g, group, p, kick, False)

    @ti.kernel
    def update_and_g2p(dt: float, kick: float) -> found:
        """Update the grid, gather, and return the numbers of a `StepResult`."""
        fastest[None] = 0.0
        for k in ti.static(range(len(read_back))):
            read_back[k][None] = NOTHING
        if ti.static(len(walls.separating) > 0):
            for q in range(walls.plane_nodes(grid)):
                walls.find_contact(grid, q, gravity.in_step(kick))
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                rows = grid.row_count()
                gravity_step = gravity.in_step(kick)
                speed_squared = 0.0
                for row in range(share_start(rows, t, threads), share_start(rows, t + 1, threads)):
                    node = grid.row_start(row)
                    first = grid.linear_index(node)
                    for k in range(grid.box[1, d - 1]):
                        speed_squared = ti.max(speed_squared, update_node(node, first + k, gravity_step))
                        node[d - 1] += 1
                ti.atomic_max(fastest[None], speed_squared)
        for g, group, _order in ti.static(pairs):
            # Each thread keeps its own maxima and merges them once: with Taichi's own reduction, two threads took as
            # long as one, as if they shared cache lines.
            for q in range(CHUNK * threads):
                if q % CHUNK == 0:
                    t = q // CHUNK
                    sharp = NOTHING
                    own = ti.Vector([NOTHING] * ti.static(max(len(farthest[g]), 1)))
                    for p in range(share_start(group.count, t, threads), share_start(group.count, t + 1, threads)):
                        rate = advance(g, group, p, dt)
                        sharp = ti.max(sharp, rate)
                        if ti.static(hardens[g]):
                            v, _ = group.motion(p)
                            widen_motion(own, v, rate)
                            widen_state(group, own, p)
                    ti.atomic_max(sharpest[g][None], sharp)
                    for k in ti.static(range(len(farthest[g]))):
                        ti.atomic_max(farthest[g][k][None], own[k])
        result = found(0.0)
        result[0] = ti.sqrt(fastest[None])
        for k in ti.static(range(len(read_back))):
            result[1 + k] = read_back[k][None]
        for g in ti.static(range(len(groups))):
            if lost[g] != NOT_LOST:
                result[0] = -1.0
        return result

    def step_cpu(dt: float, kick: float) -> StepResult:
        for part in range(orders[0].colours // together):
            p2g(part, kick)
        speed, *values = update_and_g2p(dt, kick).to_list()
        bounds, first = [], len(groups)
        for group, fields in zip(groups, farthest, strict=True):
            own = values[first : first + len(fields)]
            bounds.append(state_bounds_of(group, own) if own else None)
            first += len(fields)
        return StepResult(speed, values[: len(groups)], bounds)

    @ti.kernel
    def step_gpu(dt: float, kick: float):
        for q in range(grid.box_nodes()):
            grid.clear(grid.linear_index(grid.box_node(q)))
        for g, group, _order in ti.static(pairs):
            for p in range(group.count):
                spread_one(g, group, p, kick, True)
        if ti.static(len(walls.separating) > 0):
            for q in range(walls.plane_nodes(grid)):
                walls.find_contact(grid, q, gravity.in_step(kick))
        for q in range(grid.box_nodes()):
            node = grid.box_node(q)
            update_node(node, grid.linear_index(node), gravity.in_step(kick))
        for g, group, _order in ti.static(pairs):
            for p in range(group.count):
                advance(g, group, p, dt)

    @ti.kernel
    def clear_lost():
        for g in ti.static(range(len(groups))):
            lost[g] = NOT_LOST

    @ti.kernel
    def find_box():
        for a in ti.static(range(d)):
            tile_low[a] = 2**30
            tile_high[a] = -1
        for _g, _group, order in ti.static(pairs):
            for tile in range(order.tiles):
                if order.start[tile + 1] > order.start[tile]:
                    rest = tile
                    for b in ti.static(range(d)):
                        a = ti.static(d - 1 - b)
                        ti.atomic_min(tile_low[a], rest % ti.static(grid.tiles[a]))
                        ti.atomic_max(tile_high[a], rest % ti.static(grid.tiles[a]))
                        rest = rest // ti.static(grid.tiles[a])
        for a in ti.static(range(d)):
            # A stencil starts up to `drift` cells outside its tile and reaches so many nodes further up.
            first = grid.tile * tile_low[a] - drift
            last = grid.tile * tile_high[a] + grid.tile - 1 + drift + reach
            # A box that comes near a wall holds the images beyond it too: they are read and written.
            if first <= walls.first + REACH:
                first = walls.first - REACH
            if last >= walls.last[a] - REACH:
                last = walls.last[a] + REACH
            grid.box[0, a] = first
            grid.box[1, a] = last - first + 1

    def any_lost() -> bool:
        return bool((lost.to_numpy() != NOT_LOST).any())

    clear_lost()
    return StepKernels(step_cpu if on_cpu else step_gpu, find_box, lost, any_lost)
