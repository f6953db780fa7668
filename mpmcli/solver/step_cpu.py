"""The step on the CPU: P2G colour by colour without atomics, then nodes and G2P in one kernel.

Every loop over shares runs `threads` times CHUNK iterations, of which one in CHUNK works: Taichi gives a thread at
least CHUNK iterations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.advance_range import advance_range
from mpmcli.solver.cpu_loops import average_pencils, clear_rows, scatter_pencils, update_rows
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.ordering import CHUNK, TileOrder, share_start
from mpmcli.solver.particle_update import NOT_LOST, ParticleUpdate
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.phase_times import profiles
from mpmcli.solver.scatter_range import scatter_range
from mpmcli.solver.state_bounds import (
    NOTHING,
    StateBounds,
    deformation_rate,
    entries,
    state_bounds_of,
    widen_motion,
    widen_state,
)
from mpmcli.solver.volume_average import average_range


@dataclass(frozen=True)
class StepResult:
    """What a step reads back.

    Attributes:
        speed: largest speed of a node, m/s, which no particle exceeds; -1 where a particle was lost.
        deformation_rates: of each group, the largest rate of deformation, 1/s (see `deformation_rate`), and that of the
            relaxation of volumes.
        state_bounds: of each group that hardens, the bounds of its state; None of the others, which change less.
    """

    speed: float
    deformation_rates: list[float]
    state_bounds: list[StateBounds | None]


def build_cpu_step(
    grid: Grid,
    nodes: NodeUpdate,
    particles: ParticleUpdate,
    groups: Sequence[ParticleGroup],
    orders: Sequence[TileOrder],
    gravity: Gravity,
) -> Callable[[float, float, float], StepResult]:
    """Build the kernels of a step (dt, kick, relaxed) for these groups and nothing else."""
    threads = orders[0].threads
    # One thread runs loops itself: a hand-over to a pool of one would take most of a step of few particles. A profiler
    # times only what is handed over.
    alone = threads == 1 and not profiles()
    pairs = tuple(zip(range(len(groups)), groups, orders, strict=True))
    # Colours written out in one kernel: four would double the compile time of 3D scenes, two that of what scatters
    # more than is usual.
    together = 2 if grid.scheme.plain else 1
    # What is read back: the largest speed, and of each group its rate of deformation and all maxima where it hardens.
    largest_speed_squared = ti.field(float, shape=())
    largest_rate = tuple(ti.field(float, shape=()) for _ in groups)
    hardens = tuple(group.law.hardening > 0 for group in groups)
    maxima = tuple(
        tuple(ti.field(float, shape=()) for _ in range(entries(group) * hardened))
        for group, hardened in zip(groups, hardens, strict=True)
    )
    read_back = (*largest_rate, *(field for fields in maxima for field in fields))
    relaxes = any(group.law.relaxes for group in groups)
    averages = any(group.averaged for group in groups)
    largest_change = tuple(ti.field(float, shape=()) for _ in groups)
    changes = ti.types.vector(len(groups), float)
    numbers = ti.types.vector(1 + len(read_back), float)

    @ti.func
    def advance_share(g: ti.template(), group: ti.template(), t: int, dt: float):
        """Move the particles of thread t.

        Each thread keeps its own maxima and merges them once: with Taichi's own reduction, two threads took as long as
        one, as if they shared cache lines.
        """
        own = ti.Vector([NOTHING] * ti.static(max(len(maxima[g]), 1)))
        count = group.present()
        first, last = share_start(count, t, threads), share_start(count, t + 1, threads)
        sharpest = advance_range(particles, g, group, first, last, dt)
        if ti.static(hardens[g]):
            for p in range(first, last):
                v, C = group.motion(p)
                widen_motion(own, v, deformation_rate(group, C))
                widen_state(group, own, p)
        ti.atomic_max(largest_rate[g][None], sharpest)
        for k in ti.static(range(len(maxima[g]))):
            ti.atomic_max(maxima[g][k][None], own[k])

    # A kernel of its own, as all particles of a cell have to be added before one of them is scattered.
    @ti.kernel
    def average(part: int):
        """Add some colours to their cells, after clearing the grid for the first ones."""
        ti.loop_config(serialize=alone)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                rows, t = grid.row_count() if part == 0 else 0, q // CHUNK
                clear_rows(grid, share_start(rows, t, threads), share_start(rows, t + 1, threads))
        for g, group, order in ti.static(pairs):
            if ti.static(group.averaged):
                ti.loop_config(serialize=alone)
                for q in range(CHUNK * threads):
                    if q % CHUNK == 0:
                        t = q // CHUNK
                        first, last = order.work[part, t], order.work[part, t + 1]
                        average_pencils(grid, g, group, order, part, first, last)
                # What has come in since the sort follows.
                if ti.static(group.comes_and_goes):
                    ti.loop_config(serialize=True)
                    for _ in range(1):
                        if part == ti.static(orders[0].colours - 1):
                            average_range(grid, g, group, order.start[order.tiles], group.present())

    @ti.kernel
    def p2g(which: int, part: int, kick: float, relaxed: float):
        """Scatter some colours of one group, after clearing the grid for the first ones of the first."""
        ti.loop_config(serialize=alone)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                rows = grid.row_count() if which + part == ti.static(-1 if averages else 0) else 0
                t = q // CHUNK
                clear_rows(grid, share_start(rows, t, threads), share_start(rows, t + 1, threads))
        for g, group, order in ti.static(pairs):
            for parity in ti.static(range(together)):
                ti.loop_config(serialize=alone)
                for q in range(CHUNK * threads):
                    if q % CHUNK == 0:
                        t, colour = q // CHUNK, parity + together * part
                        first, last = order.work[colour, t], order.work[colour, t + 1]
                        if which != g:
                            last = first
                        scatter_pencils(particles, g, group, order, colour, first, last, kick, relaxed)
            if ti.static(group.comes_and_goes):
                ti.loop_config(serialize=True)
                for _ in range(1):
                    if which == g and part == ti.static(orders[0].colours // together - 1):
                        scatter_range(particles, g, group, order.start[order.tiles], group.present(), kick, relaxed)

    # A kernel of its own: as a loop or a branch beside G2P it took 5 to 25 % of every step's time.
    @ti.kernel
    def relax(relaxed: float) -> changes:
        """Relax volumes over a time, s; return per group the largest change of the logarithm of one."""
        for g, group, _order in ti.static(pairs):
            largest_change[g][None] = 0.0
            if ti.static(group.law.relaxes):
                ti.loop_config(serialize=alone)
                for q in range(CHUNK * threads):
                    if q % CHUNK == 0:
                        t, change = q // CHUNK, 0.0
                        count = group.present()
                        for p in range(share_start(count, t, threads), share_start(count, t + 1, threads)):
                            change = ti.max(change, particles.relax(group, p, relaxed))
                        ti.atomic_max(largest_change[g][None], change)
        result = changes(0.0)
        for g in ti.static(range(len(groups))):
            result[g] = largest_change[g][None]
        return result

    @ti.kernel
    def update_and_g2p(dt: float, kick: float) -> numbers:
        """Update the grid, gather, and return the numbers of a `StepResult`."""
        largest_speed_squared[None] = 0.0
        for k in ti.static(range(len(read_back))):
            read_back[k][None] = NOTHING
        if ti.static(nodes.needs_contact):
            ti.loop_config(serialize=alone)
            for q in range(nodes.images.plane_nodes(grid)):
                nodes.images.find_contact(grid, q, gravity.in_step(kick, 0))
        if ti.static(nodes.needs_friction):
            ti.loop_config(serialize=alone)
            for q in range(nodes.images.plane_nodes(grid)):
                find_friction(nodes.images, grid, q, gravity.in_step(kick, 0))
        ti.loop_config(serialize=alone)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                rows, t = grid.row_count(), q // CHUNK
                first, last = share_start(rows, t, threads), share_start(rows, t + 1, threads)
                ti.atomic_max(
                    largest_speed_squared[None], update_rows(grid, nodes, first, last, gravity.in_step(kick, 0))
                )
        for g, group, _order in ti.static(pairs):
            ti.loop_config(serialize=alone)
            for q in range(CHUNK * threads):
                if q % CHUNK == 0:
                    advance_share(g, group, q // CHUNK, dt)
        result = numbers(0.0)
        result[0] = ti.sqrt(largest_speed_squared[None])
        for k in ti.static(range(len(read_back))):
            result[1 + k] = read_back[k][None]
        for g in ti.static(range(len(groups))):
            if particles.lost[g] != NOT_LOST:
                result[0] = -1.0
        return result

    def step(dt: float, kick: float, relaxed: float) -> StepResult:
        for part in range(orders[0].colours if averages else 0):
            average(part)
        # One group after the other, as the kernel of a batch does: sums at a node depend on the order.
        for which in range(len(groups)):
            for part in range(orders[0].colours // together):
                p2g(which, part, kick, relaxed)
        changed = relax(relaxed).to_list() if relaxes and relaxed > 0 else [0.0] * len(groups)
        speed, *values = update_and_g2p(dt, kick).to_list()
        bounds, first = [], len(groups)
        for group, fields in zip(groups, maxima, strict=True):
            own = values[first : first + len(fields)]
            bounds.append(state_bounds_of(group, own) if own else None)
            first += len(fields)
        # A law may have no particle yet.
        rates = [max(rate, 0.0) + change / dt for rate, change in zip(values[: len(groups)], changed, strict=True)]
        return StepResult(speed, rates, bounds)

    return step
