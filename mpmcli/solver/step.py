"""The kernels of one time step: clear, scatter, update the grid, gather."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.boundaries.walls import REACH, Walls
from mpmcli.solver.grid import TILE, Grid
from mpmcli.solver.ordering import CHUNK, TileOrder
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.transfer import gather, scatter

# Per group, what a step reports: squared speed, smallest and largest J, squared stretch, velocity gradient.
SPEED_SQUARED, J_MIN, J_MAX, STRETCH_SQUARED, GRADIENT = range(5)
REPORT = 5
NOT_LOST = 2**31 - 1


@dataclass(frozen=True)
class StepKernels:
    """Compiled steps.

    Attributes:
        step: (dt) -> report: one step; the report is a vector of REPORT entries per group and
            one that is 1 where a particle was lost. On a GPU the report is empty.
        measure: () -> report, of the state as it is.
        find_box: set the grid's box in use from the sorted tiles.
        lost: per group, the first particle (in solver order) that left the domain, inverted or became
            non-finite, or NOT_LOST.
    """

    step: Callable[[float], ti.Matrix]
    measure: Callable[[], ti.Matrix]
    find_box: Callable[[], None]
    lost: ti.Field


def build_step(
    grid: Grid,
    walls: Walls,
    groups: Sequence[ParticleGroup],
    orders: Sequence[TileOrder],
    gravity: Sequence[float],
    *,
    on_cpu: bool,
    drift: int,
) -> StepKernels:
    """Build the kernels for these groups and nothing else.

    Args:
        gravity: m/s^2 per axis.
        on_cpu: scatter by coloured pencils without atomics and report every step.
        drift: cells that a particle may move away from the tile that it was sorted into.
    """
    d = grid.dimension
    h = grid.spacing
    threads = orders[0].threads
    pairs = tuple(zip(range(len(groups)), groups, orders, strict=True))
    size = REPORT * len(groups) + 1
    report_type = ti.types.vector(size, float)
    # One field each: only atomics on such a field become sums per thread instead of contended ones.
    report = tuple(ti.field(float, shape=()) for _ in range(size))
    lost = ti.field(int, shape=len(groups))
    tile_low = ti.field(int, shape=d)
    tile_high = ti.field(int, shape=d)
    extent = tuple(n * h for n in grid.cells)

    @ti.func
    def clear_report():
        for g in ti.static(range(len(groups))):
            lost[g] = NOT_LOST
            for i in ti.static(range(REPORT)):
                report[REPORT * g + i][None] = 1e30 if ti.static(i == J_MIN) else 0.0
        report[size - 1][None] = 0.0

    @ti.func
    def read_report():
        result = report_type(0.0)
        for i in ti.static(range(size)):
            result[i] = report[i][None]
        for g in ti.static(range(len(groups))):
            if lost[g] != NOT_LOST:
                result[size - 1] = 1.0
        return result

    @ti.func
    def note(g: ti.template(), v: ti.template(), C: ti.template(), deformation: ti.template(), J: float):
        """Add one particle to the report."""
        ti.atomic_max(report[REPORT * g + SPEED_SQUARED][None], v.norm_sqr())
        ti.atomic_min(report[REPORT * g + J_MIN][None], J)
        ti.atomic_max(report[REPORT * g + J_MAX][None], J)
        if ti.static(groups[g].law.deformation == "F"):
            # Gershgorin's bound on the largest eigenvalue of b = F F^T: exact at rest, in any rotation.
            b = deformation @ deformation.transpose()
            bound = 0.0
            for i in ti.static(range(d)):
                row = 0.0
                for j in ti.static(range(d)):
                    row += ti.abs(b[i, j])
                bound = ti.max(bound, row)
            ti.atomic_max(report[REPORT * g + STRETCH_SQUARED][None], bound)
            gradient = 0.0
            for i in ti.static(range(d)):
                row = 0.0
                for j in ti.static(range(d)):
                    row += ti.abs(C[i, j])
                gradient = ti.max(gradient, row)
            ti.atomic_max(report[REPORT * g + GRADIENT][None], gradient)
        else:
            ti.atomic_max(report[REPORT * g + GRADIENT][None], ti.abs(C.trace()))

    @ti.func
    def volume_ratio(group: ti.template(), deformation: ti.template()):
        J = 1.0
        if ti.static(group.law.deformation == "F"):
            J = deformation.determinant()
        else:
            J = deformation
        return J

    @ti.func
    def advance(g: ti.template(), group: ti.template(), p: int, dt: float):
        """Gather and move one particle: x += dt v, J *= 1 + dt tr C or F <- (I + dt C) F."""
        x = group.x[p]
        v, C = gather(x, grid)
        x_new = x + dt * v
        fine = True
        for a in ti.static(range(d)):
            # Written so that a NaN is not fine.
            fine = fine and x_new[a] > -0.5 * h and x_new[a] < extent[a] + 0.5 * h
        deformation = group.deformation[p]
        if ti.static(group.law.deformation == "F"):
            deformation = deformation + dt * (C @ deformation)
        else:
            deformation = deformation * (1.0 + dt * C.trace())
        J = volume_ratio(group, deformation)
        fine = fine and J > 0.0
        group.v[p] = v
        group.C[p] = C
        group.deformation[p] = deformation
        if fine:
            for a in ti.static(range(d)):
                x_new[a] = ti.min(ti.max(x_new[a], 0.0), extent[a])
            group.x[p] = x_new
        else:
            # The position stays, so that no later step can write outside the grid.
            ti.atomic_min(lost[g], p)
        return v, C, deformation, J

    @ti.func
    def update_node(node: ti.template(), index: int, gravity_step: ti.template()):
        if walls.near(node):
            walls.update(grid, node, gravity_step)
        else:
            value = grid.nodes[index]
            if value[d] > 0:
                for a in ti.static(range(d)):
                    value[a] = value[a] / value[d] + gravity_step[a]
                grid.nodes[index] = value

    @ti.func
    def gravity_of(dt: float):
        result = ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            result[a] = dt * ti.static(gravity[a])
        return result

    @ti.kernel
    def spread(half: int, dt: float):
        """Scatter two colours, after clearing the grid for the first two.

        Four colours written out in one kernel would double the compile time of 3D scenes.
        """
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                rows = grid.row_count() if half == 0 else 0
                for row in range(rows * t // threads, rows * (t + 1) // threads):
                    first = grid.first_node(grid.row_start(row))
                    for k in range(grid.box[1, d - 1]):
                        grid.nodes[first + k] = ti.Vector.zero(float, d + 1)
        for _g, group, order in ti.static(pairs):
            for parity in ti.static(range(2)):
                for q in range(CHUNK * threads):
                    if q % CHUNK == 0:
                        t = q // CHUNK
                        colour = parity + 2 * half
                        for r in range(order.work[colour, t], order.work[colour, t + 1]):
                            first = order.pencil_start(colour, r)
                            for p in range(order.start[first], order.start[first + order.pencil]):
                                scatter(group, grid, p, dt, False)

    @ti.kernel
    def collect(dt: float) -> report_type:
        """Update the grid, gather, and report."""
        clear_report()
        if ti.static(len(walls.separating) > 0):
            for q in range(walls.plane_nodes(grid)):
                walls.find_contact(grid, q, gravity_of(dt))
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                rows = grid.row_count()
                gravity_step = gravity_of(dt)
                for row in range(rows * t // threads, rows * (t + 1) // threads):
                    node = grid.row_start(row)
                    first = grid.first_node(node)
                    for k in range(grid.box[1, d - 1]):
                        update_node(node, first + k, gravity_step)
                        node[d - 1] += 1
        for g, group, _order in ti.static(pairs):
            for p in range(group.count):
                v, C, deformation, J = advance(g, group, p, dt)
                note(g, v, C, deformation, J)
        return read_report()

    def step_cpu(dt: float) -> ti.Matrix:
        for half in range(orders[0].colours // 2):
            spread(half, dt)
        return collect(dt)

    @ti.kernel
    def step_gpu(dt: float):
        for q in range(grid.box_nodes()):
            grid.nodes[grid.first_node(grid.box_node(q))] = ti.Vector.zero(float, d + 1)
        for _g, group, _order in ti.static(pairs):
            for p in range(group.count):
                scatter(group, grid, p, dt, True)
        if ti.static(len(walls.separating) > 0):
            for q in range(walls.plane_nodes(grid)):
                walls.find_contact(grid, q, gravity_of(dt))
        for q in range(grid.box_nodes()):
            node = grid.box_node(q)
            update_node(node, grid.first_node(node), gravity_of(dt))
        for g, group, _order in ti.static(pairs):
            for p in range(group.count):
                advance(g, group, p, dt)

    @ti.kernel
    def clear_lost():
        for g in ti.static(range(len(groups))):
            lost[g] = NOT_LOST

    @ti.kernel
    def measure() -> report_type:
        for g in ti.static(range(len(groups))):
            for i in ti.static(range(REPORT)):
                report[REPORT * g + i][None] = 1e30 if ti.static(i == J_MIN) else 0.0
        report[size - 1][None] = 0.0
        for g, group, _order in ti.static(pairs):
            for p in range(group.count):
                deformation = group.deformation[p]
                note(g, group.v[p], group.C[p], deformation, volume_ratio(group, deformation))
        return read_report()

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
            # A stencil starts up to `drift` cells outside its tile and reaches two nodes further up.
            first = TILE * tile_low[a] - drift
            last = TILE * tile_high[a] + TILE - 1 + drift + 2
            # A box that comes near a wall holds the images beyond it too: they are read and written.
            if first <= walls.first + REACH:
                first = walls.first - REACH
            if last >= walls.last[a] - REACH:
                last = walls.last[a] + REACH
            grid.box[0, a] = first
            grid.box[1, a] = last - first + 1

    clear_lost()
    return StepKernels(step_cpu if on_cpu else step_gpu, measure, find_box, lost)
