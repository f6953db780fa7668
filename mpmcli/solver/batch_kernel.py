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
from mpmcli.solver.batch_layout import ATTEND, COLLAPSED, GOING, LIMITS, LOST, MEASURE, Layout
from mpmcli.solver.box import box_of
from mpmcli.solver.cpu_loops import clear_rows, scatter_pencils, update_rows
from mpmcli.solver.grid import DRIFT
from mpmcli.solver.ordering import CHUNK
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.sorting import sort_serially, tiles_in_use
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state
from mpmcli.stability.limits import COURANT, DEFORMATION

DEFORMING, FORCED, MAXIMUM, CROSSING = (LIMITS.index(name) for name in ("deformation", "forced", "maximum", "speed"))


def build_batch_kernel(device: Device, layout: Layout) -> Callable[[np.ndarray, np.ndarray], None]:
    """Compile-ready kernel: (numbers, counts) of all runs, see `batch_layout`; it advances and changes both."""
    d = device.grid.dimension
    groups, room, threads = tuple(device.groups), tuple(device.room), device.threads
    members = tuple(enumerate(groups))
    real, count = layout.real, layout.count
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
    def stable_step(w: int, numbers: ti.template(), counts: ti.template()):
        """Return the step, s, and the code of its bound, as `Run.stable_step` does, and the bound by deformation, s."""
        value = numbers[w, real.stiffness]
        limit = counts[w, count.stiffness_limit]
        sharpest = numbers[w, real.rate[0]]
        for g in ti.static(range(1, len(groups))):
            sharpest = ti.max(sharpest, numbers[w, real.rate[g]])
        deformation = numbers[w, real.infinity]
        if sharpest > 0:
            deformation = DEFORMATION / sharpest
        if deformation < value or (deformation == value and limit > DEFORMING):
            value = deformation
            limit = DEFORMING
        value = ti.min(value, numbers[w, real.eased])
        speed = numbers[w, real.speed]
        pull = numbers[w, real.pull]
        h = numbers[w, real.spacing]
        crossing = numbers[w, real.infinity]
        if speed != 0 or pull != 0:
            crossing = 2 * COURANT * h / (speed + ti.sqrt(speed * speed + 4 * pull * COURANT * h))
        if crossing < value or (crossing == value and limit > CROSSING):
            value = crossing
            limit = CROSSING
        value = numbers[w, real.safety] * value
        maximum = numbers[w, real.maximum]
        if maximum < value:
            value = maximum
            limit = MAXIMUM
        elif counts[w, count.forced] == 1:
            value = maximum
            limit = FORCED
        return value, limit, deformation

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
        dt: float,
        kick: float,
        numbers: ti.template(),
        counts: ti.template(),
    ):
        """Take a step; return the largest speed of a node, -1 where a particle was lost. Rates are stored."""
        gravity_step = ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            gravity_step[a] = kick * ti.cast(numbers[w, real.gravity[a]], float)
        rows = grid.row_count()
        clear_rows(grid, 0, rows)
        for g, group in ti.static(members):
            for colour in range(ti.static(device.orders[g].colours)):
                pencils = orders[g].pencil_count(colour)
                scatter_pencils(particles, g, group, orders[g], colour, 0, pencils, kick)
        if ti.static(nodes.needs_contact):
            for q in range(nodes.images.plane_nodes(grid)):
                nodes.images.find_contact(grid, q, gravity_step)
        speed = ti.sqrt(update_rows(grid, nodes, 0, rows, gravity_step))
        for g, group in ti.static(members):
            sharpest = NOTHING
            first = w * room[g]
            for p in range(first, first + counts[w, count.particles[g]]):
                sharpest = ti.max(sharpest, particles.advance(g, group, p, dt))
            numbers[w, real.rate[g]] = ti.cast(sharpest, ti.f64)
            if lost[particles.first_lost + g] != NOT_LOST:
                speed = -1.0
        return speed

    @ti.func
    def control(w: int, dt: ti.f64, numbers: ti.template(), counts: ti.template()):
        """Count a step, as `StepControl.after_step` does; return whether the host must measure."""
        due = False
        for g in ti.static(range(len(groups))):
            counts[w, count.unwatched[g]] += 1
            strain = dt * numbers[w, real.rate[g]]
            numbers[w, real.change[g]] = numbers[w, real.change[g]] + strain * numbers[w, real.sensitivity[g]]
            numbers[w, real.hardened[g]] = numbers[w, real.hardened[g]] + strain * numbers[w, real.hardening[g]]
            allowed = numbers[w, real.growth_allowed]
            if counts[w, count.unwatched[g]] >= counts[w, count.longest]:
                due = True
            if numbers[w, real.change[g]] >= allowed or numbers[w, real.hardened[g]] >= allowed:
                due = True
        return due

    @ti.func
    def book(w: int, dt: ti.f64, courant: ti.f64, limit: int, numbers: ti.template(), counts: ti.template()):
        """Keep the smallest step with its bound, the largest one, and the largest Courant number, for the ledger."""
        smallest = numbers[w, real.smallest]
        between = numbers[w, real.smallest_courant]
        same = dt == smallest and (courant < between or (courant == between and limit < counts[w, count.limit]))
        if dt < smallest or same:
            numbers[w, real.smallest] = dt
            numbers[w, real.smallest_courant] = courant
            counts[w, count.limit] = limit
        numbers[w, real.largest] = ti.max(numbers[w, real.largest], dt)
        numbers[w, real.largest_courant] = ti.max(numbers[w, real.largest_courant], courant)

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
        grid, nodes, particles, orders = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        while counts[w, count.status] == GOING and counts[w, count.budget] > 0:
            if numbers[w, real.drift] >= numbers[w, real.drift_allowed]:
                sort(w, box, last, orders, numbers, counts)
            largest, limit, deformation = stable_step(w, numbers, counts)
            left = numbers[w, real.target] - numbers[w, real.time]
            if largest < numbers[w, real.collapse]:
                counts[w, count.status] = COLLAPSED
            else:
                splits = ti.max(ti.ceil(left / largest - numbers[w, real.slack]), 1.0)
                dt = left / splits
                kick = ti.min(0.5 * (numbers[w, real.last_step] + dt), dt / numbers[w, real.safety_squared])
                speed = ti.cast(
                    move(w, grid, nodes, particles, orders, ti.cast(dt, float), ti.cast(kick, float), numbers, counts),
                    ti.f64,
                )
                numbers[w, real.time] = numbers[w, real.time] + dt
                numbers[w, real.last_step] = dt
                counts[w, count.steps] += 1
                counts[w, count.budget] -= 1
                if speed >= 0:
                    courant = dt * speed / numbers[w, real.spacing]
                    numbers[w, real.speed] = speed
                    numbers[w, real.courant] = courant
                    numbers[w, real.drift] = numbers[w, real.drift] + courant
                    eased = ti.min(numbers[w, real.easing] * numbers[w, real.eased], numbers[w, real.stiffness])
                    numbers[w, real.eased] = ti.min(eased, deformation)
                    due = control(w, dt, numbers, counts)
                    book(w, dt, courant, limit, numbers, counts)
                    if splits == 1:
                        counts[w, count.arrived] = 1
                    if due or splits == 1:
                        counts[w, count.status] = ATTEND
                else:
                    counts[w, count.status] = LOST
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
