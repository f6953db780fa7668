"""The kernel of a batch: each run advances by steps of its own, on one thread, until the host has to attend to it.

A step is that of `Solver.step` and `step_cpu`, in the same order and precision, so that a run has the same bytes in a
batch, alone, and in a `Solver` on any number of threads. The functions of a step take the grid, the walls and so on as
objects; `views` returns copies of them for one run, whose numbers are variables of the kernel.
"""

import math
from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.solver.batch_device import Device, views
from mpmcli.solver.batch_layout import ATTEND, GOING, MEASURE, Layout
from mpmcli.solver.batch_steps import BatchSteps
from mpmcli.solver.box import box_of
from mpmcli.solver.cpu_loops import clear_rows, scatter_pencils, update_rows
from mpmcli.solver.grid import DRIFT
from mpmcli.solver.lanes import advance_range
from mpmcli.solver.ordering import CHUNK
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.sorting import sort_serially, tiles_in_use
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state


def build_batch_kernel(device: Device, layout: Layout) -> Callable[[np.ndarray, np.ndarray], None]:
    """Compile-ready kernel: (numbers, counts) of all runs, see `batch_layout`; it advances and changes both."""
    d = device.grid.dimension
    groups, room, threads = tuple(device.groups), tuple(device.room), device.threads
    members = tuple(enumerate(groups))
    real, count = layout.real, layout.count
    steps = BatchSteps(layout, [group.law for group in groups], device.values)
    lost = device.particles.lost
    alone = threads == 1
    next_run = ti.field(int, shape=())

    @ti.func
    def measure(w: int, numbers: ti.template(), counts: ti.template()):
        """Store the maxima of each group."""
        for g, group in ti.static(members):
            own = ti.Vector([NOTHING] * ti.static(entries(group)))
            first = w * room[g]
            for p in range(first, first + counts[w, count.particles[g]]):
                v, C = group.motion(p)
                widen_motion(own, v, deformation_rate(group, C))
                widen_state(group, own, p)
            for k in ti.static(range(entries(group))):
                numbers[w, real.maxima[g] + k] = ti.cast(own[k], ti.f64)

    @ti.func
    def sort(
        w: int,
        box: ti.template(),
        last: ti.template(),
        orders: ti.template(),
        numbers: ti.template(),
        counts: ti.template(),
    ):
        """Sort the particles of a run, and find the nodes in use."""
        low = ti.Vector([2**30] * d)
        high = ti.Vector([-1] * d)
        for g in ti.static(range(len(groups))):
            first = w * room[g]
            sort_serially(orders[g], first, counts[w, count.particles[g]], w)
            tiles_in_use(orders[g], low, high)
        for a in ti.static(range(d)):
            first_node, last_node = box_of(device.grid, low[a], high[a], ti.static(math.ceil(DRIFT)), last[a])
            box[0, a] = first_node
            box[1, a] = last_node - first_node + 1
        numbers[w, real.drift] = 0.0

    @ti.func
    def move(
        w: int,
        grid: ti.template(),
        nodes: ti.template(),
        particles: ti.template(),
        orders: ti.template(),
        seen: ti.template(),
        dt: ti.f64,
        moved: float,
        kick: float,
        relaxed: float,
        numbers: ti.template(),
        counts: ti.template(),
    ):
        """Take a step; return the largest speed of a node, -1 where a particle was lost. Rates are stored."""
        gravity_step = ti.Vector.zero(float, d)
        if ti.static(device.values.gravity_varies):
            gravity_step = device.gravity.in_step(kick, w)
        else:
            for a in ti.static(range(d)):
                gravity_step[a] = kick * ti.cast(numbers[w, real.gravity[a]], float)
        rows = grid.row_count()
        clear_rows(grid, 0, rows)
        for g, group in ti.static(enumerate(seen)):
            for colour in range(ti.static(device.orders[g].colours)):
                pencils = orders[g].pencil_count(colour)
                scatter_pencils(particles, g, group, orders[g], colour, 0, pencils, kick, relaxed)
        for g, group in ti.static(members):
            relaxation = 0.0
            if ti.static(group.law.relaxes):
                if relaxed > 0.0:
                    first = w * room[g]
                    for p in range(first, first + counts[w, count.particles[g]]):
                        relaxation = ti.max(relaxation, particles.relax(group, p, relaxed))
            # What the relaxation adds to the rate of deformation.
            numbers[w, real.rate[g]] = ti.cast(relaxation, ti.f64) / dt
        if ti.static(nodes.needs_contact):
            for q in range(nodes.images.plane_nodes(grid)):
                nodes.images.find_contact(grid, q, gravity_step)
        speed = ti.sqrt(update_rows(grid, nodes, 0, rows, gravity_step))
        for g, group in ti.static(members):
            first = w * room[g]
            sharpest = advance_range(particles, g, group, first, first + counts[w, count.particles[g]], moved)
            numbers[w, real.rate[g]] = numbers[w, real.rate[g]] + ti.cast(sharpest, ti.f64)
            if lost[particles.first_lost + g] != NOT_LOST:
                speed = -1.0
        return speed

    @ti.func
    def advance(w: int, numbers: ti.template(), counts: ti.template()):
        """Take the steps of one run."""
        h = ti.cast(numbers[w, real.spacing], float)
        inverse = ti.cast(numbers[w, real.inverse_spacing], float)
        scale = ti.cast(numbers[w, real.gradient_scale], float)
        last = ti.Vector.zero(int, d)
        extent = ti.Vector.zero(float, d)
        box = ti.Matrix.zero(int, 2, d)
        for a in ti.static(range(d)):
            last[a] = PAD + counts[w, count.cells[a]]
            extent[a] = ti.cast(numbers[w, real.extent[a]], float)
            for i in ti.static(range(2)):
                box[i, a] = device.grid.box[w * 2 + i, a]
        grid, nodes, particles, orders, seen = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        while counts[w, count.status] == GOING and counts[w, count.budget] > 0:
            if numbers[w, real.drift] >= numbers[w, real.drift_allowed]:
                sort(w, box, last, orders, numbers, counts)
            dt, kick, splits, limit, deformation = steps.begin(w, numbers, counts)
            if dt > 0:
                relaxed = ti.cast(steps.relaxed_in(w, dt, numbers, counts), float)
                moved, kicked = ti.cast(dt, float), ti.cast(kick, float)
                speed = move(w, grid, nodes, particles, orders, seen, dt, moved, kicked, relaxed, numbers, counts)
                steps.end(w, dt, splits, limit, deformation, ti.cast(speed, ti.f64), numbers, counts)
        for a in ti.static(range(d)):
            for i in ti.static(range(2)):
                device.grid.box[w * 2 + i, a] = box[i, a]

    @ti.func
    def attend(w: int, numbers: ti.template(), counts: ti.template()):
        """Advance a run, and measure it where the host needs that."""
        status = counts[w, count.status]
        if status == GOING:
            advance(w, numbers, counts)
        if status == MEASURE or (status == GOING and counts[w, count.status] == ATTEND):
            counts[w, count.status] = ATTEND
            measure(w, numbers, counts)

    @ti.kernel
    def launch(numbers: ti.types.ndarray(ti.f64, 2), counts: ti.types.ndarray(ti.i32, 2)):
        next_run[None] = 0
        ti.loop_config(serialize=alone)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                # Threads take runs as they become free: no number depends on which one.
                w = ti.atomic_add(next_run[None], 1)
                while w < device.runs:
                    attend(w, numbers, counts)
                    w = ti.atomic_add(next_run[None], 1)

    return launch
