"""The kernels of a batch on a GPU: a step of all runs in one launch, a thread for each particle or node of each run.

Each run takes steps of its own size, and rests where the host has to attend to it. Scatters add atomically, so that
bytes differ from run to run, as on a GPU always. Particles are not sorted: all nodes of a small domain are in use.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.batch_device import Device, views
from mpmcli.solver.batch_layout import ATTEND, GOING, MEASURE, Layout
from mpmcli.solver.batch_steps import BatchSteps
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state
from mpmcli.solver.volume_average import add_volume, clear_mean, missing_to_mean

# Steps of a launch, after which the host attends to the runs that need it.
STEPS = 32
# Of a run under way, per run: columns of float64, and of the precision of particles before gravity's step and extent.
DT, SPLITS, DEFORMATION, WIDTH = range(4)
SPACING, INVERSE, SCALE, STEP, KICK, RELAXED, VECTORS = range(7)


def build_gpu_launch(device: Device, layout: Layout) -> Callable[[np.ndarray, np.ndarray], None]:
    """Compile-ready launch: (numbers, counts) of all runs, see `batch_layout`; it advances and changes both."""
    d, runs = device.grid.dimension, device.runs
    groups, room = tuple(device.groups), tuple(device.room)
    members = tuple(enumerate(groups))
    real, count = layout.real, layout.count
    drifts = device.particles.touches or not all(group.total for group in groups)
    moves = device.motion is not None
    steps = BatchSteps(layout, [group.law for group in groups], device.values, drifts=drifts)
    lost, node_count = device.particles.lost, device.grid.node_count
    contact, friction = device.nodes.needs_contact, device.nodes.needs_friction
    under_way = ti.Vector.field(WIDTH, ti.f64, shape=runs)
    limits, stepping = ti.field(int, shape=runs), ti.field(int, shape=runs)
    constants = ti.Vector.field(VECTORS + 2 * d, float, shape=runs)
    speed_squared = ti.field(float, shape=runs)
    rates, changes = (ti.field(float, shape=(runs, len(groups))) for _ in range(2))
    widest = max(entries(group) for group in groups)
    maxima = ti.field(float, shape=(runs, len(groups), widest))
    averages = any(group.averaged for group in groups)
    on_device = (ti.ndarray(ti.f64, (runs, layout.reals)), ti.ndarray(ti.i32, (runs, layout.counts)))

    @ti.func
    def place(w: int, counts: ti.template()):
        """Return what `views` takes of a run: spacing, its inverse, the gradient's scale, box, last node, extent."""
        own = constants[w]
        last = ti.Vector.zero(int, d)
        extent = ti.Vector.zero(float, d)
        box = ti.Matrix.zero(int, 2, d)
        for a in ti.static(range(d)):
            last[a] = PAD + counts[w, count.cells[a]]
            extent[a] = own[VECTORS + d + a]
            box[1, a] = last[a] + PAD + 1
        return own[SPACING], own[INVERSE], own[SCALE], box, last, extent

    @ti.func
    def pull(w: int):
        """Return the change of velocity by gravity in the step of a run, m/s."""
        result = ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            result[a] = constants[w][VECTORS + a]
        return result

    @ti.func
    def begin(w: int, numbers: ti.template(), counts: ti.template()):
        """Choose the step of a run that is going."""
        stepping[w] = 0
        if counts[w, count.status] == GOING and counts[w, count.budget] > 0:
            dt, kick, splits, limit, deformation = steps.begin(w, numbers, counts)
            if dt > 0:
                stepping[w] = 1
                under_way[w] = ti.Vector([dt, splits, deformation])
                limits[w] = limit
                speed_squared[w] = 0.0
                own = ti.Vector.zero(float, VECTORS + 2 * d)
                own[SPACING] = ti.cast(numbers[w, real.spacing], float)
                own[INVERSE] = ti.cast(numbers[w, real.inverse_spacing], float)
                own[SCALE] = ti.cast(numbers[w, real.gradient_scale], float)
                own[STEP] = ti.cast(dt, float)
                own[KICK] = ti.cast(kick, float)
                own[RELAXED] = ti.cast(steps.relaxed_in(w, dt, numbers, counts), float)
                for a in ti.static(range(d)):
                    if ti.static(not device.values.gravity_varies):
                        own[VECTORS + a] = own[KICK] * ti.cast(numbers[w, real.gravity[a]], float)
                    own[VECTORS + d + a] = ti.cast(numbers[w, real.extent[a]], float)
                if ti.static(device.values.gravity_varies):
                    pulled = device.gravity.in_step(own[KICK], w)
                    for a in ti.static(range(d)):
                        own[VECTORS + a] = pulled[a]
                constants[w] = own
                if ti.static(moves):
                    start = numbers[w, real.time]
                    device.values.set_motions(w, device.motion, start, start + dt)
                    device.motion.advance(w, dt)
                for g in ti.static(range(len(groups))):
                    rates[w, g] = NOTHING
                    changes[w, g] = 0.0

    @ti.func
    def clear(w: int, q: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, _nodes, _particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if q < grid.box_nodes():
            grid.clear(grid.linear_index(grid.box_node(q)))

    @ti.func
    def start_mean(g: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, _nodes, _particles, _orders, seen = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        clear_mean(grid, g, seen[g], p)

    @ti.func
    def add_to_mean(g: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, _nodes, _particles, _orders, seen = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        add_volume(grid, g, seen[g], p)

    @ti.func
    def take_mean(g: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, _nodes, _particles, _orders, seen = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        seen[g].to_mean[p] = missing_to_mean(grid, g, seen[g], p)

    @ti.func
    def scatter(g: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        _grid, _nodes, particles, _orders, seen = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        particles.scatter(g, seen[g], p, constants[w][KICK], constants[w][RELAXED])

    @ti.func
    def relax(g: ti.template(), group: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        _grid, _nodes, particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        change = particles.relax(group, p, constants[w][RELAXED])
        if change > changes[w, g]:
            ti.atomic_max(changes[w, g], change)

    @ti.func
    def find_contact(w: int, q: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, nodes, _particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if q < nodes.images.plane_nodes(grid):
            nodes.images.find_contact(grid, q, pull(w))

    @ti.func
    def rub(w: int, q: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, nodes, _particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if q < nodes.images.plane_nodes(grid):
            find_friction(nodes.images, grid, q, pull(w))

    @ti.func
    def update(w: int, q: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        grid, nodes, _particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if q < grid.box_nodes():
            node = grid.box_node(q)
            squared = nodes.update(node, grid.linear_index(node), pull(w))
            if squared > speed_squared[w]:
                ti.atomic_max(speed_squared[w], squared)

    @ti.func
    def advance(g: ti.template(), group: ti.template(), w: int, p: int, counts: ti.template()):
        h, inverse, scale, box, last, extent = place(w, counts)
        _grid, _nodes, particles, _orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        rate = particles.advance(g, group, p, constants[w][STEP])
        if rate > rates[w, g]:
            ti.atomic_max(rates[w, g], rate)

    @ti.func
    def end(w: int, numbers: ti.template(), counts: ti.template()):
        """Count the step of a run."""
        speed = ti.sqrt(speed_squared[w])
        for g in ti.static(range(len(groups))):
            # What the relaxation of volumes adds to the rate of deformation.
            added = ti.cast(changes[w, g], ti.f64) / under_way[w][DT]
            numbers[w, real.rate[g]] = ti.cast(rates[w, g], ti.f64) + added
            if lost[w * ti.static(len(groups)) + g] != NOT_LOST:
                speed = -1.0
        dt, splits, deformation = under_way[w][DT], under_way[w][SPLITS], under_way[w][DEFORMATION]
        steps.end(w, dt, splits, limits[w], deformation, ti.cast(speed, ti.f64), numbers, counts)

    @ti.kernel
    def step(numbers: ti.types.ndarray(ti.f64, 2), counts: ti.types.ndarray(ti.i32, 2)):
        for w in range(runs):
            begin(w, numbers, counts)
        for q in range(runs * node_count):
            if stepping[q // node_count] == 1:
                clear(q // node_count, q % node_count, counts)
        for g, group in ti.static(members):
            if ti.static(group.averaged):
                for p in range(runs * room[g]):
                    w = p // room[g]
                    if stepping[w] == 1 and p % room[g] < counts[w, count.particles[g]]:
                        add_to_mean(g, w, p, counts)
        for g, group in ti.static(members):
            for p in range(runs * room[g]):
                w = p // room[g]
                if stepping[w] == 1 and p % room[g] < counts[w, count.particles[g]]:
                    scatter(g, w, p, counts)
        for g, group in ti.static(members):
            if ti.static(group.law.relaxes):
                for p in range(runs * room[g]):
                    w = p // room[g]
                    relaxes = stepping[w] == 1 and constants[w][RELAXED] > 0.0
                    if relaxes and p % room[g] < counts[w, count.particles[g]]:
                        relax(g, group, w, p, counts)
        if ti.static(contact):
            for q in range(runs * node_count):
                if stepping[q // node_count] == 1:
                    find_contact(q // node_count, q % node_count, counts)
        if ti.static(friction):
            for q in range(runs * node_count):
                if stepping[q // node_count] == 1:
                    rub(q // node_count, q % node_count, counts)
        for q in range(runs * node_count):
            if stepping[q // node_count] == 1:
                update(q // node_count, q % node_count, counts)
        for g, group in ti.static(members):
            for p in range(runs * room[g]):
                w = p // room[g]
                if stepping[w] == 1 and p % room[g] < counts[w, count.particles[g]]:
                    advance(g, group, w, p, counts)
        for w in range(runs):
            if stepping[w] == 1:
                end(w, numbers, counts)

    @ti.kernel
    def measure(numbers: ti.types.ndarray(ti.f64, 2), counts: ti.types.ndarray(ti.i32, 2)):
        """Store the maxima of each group of the runs that wait for them."""
        for w, g, k in ti.ndrange(runs, ti.static(len(groups)), widest):
            maxima[w, g, k] = NOTHING
        for g, group in ti.static(members):
            for p in range(runs * room[g]):
                w = p // room[g]
                waits = counts[w, count.status] == MEASURE or counts[w, count.status] == ATTEND
                if waits and p % room[g] < counts[w, count.particles[g]]:
                    own = ti.Vector([NOTHING] * ti.static(entries(group)))
                    v, C = group.motion(p)
                    widen_motion(own, v, deformation_rate(group, C))
                    widen_state(group, own, p)
                    for k in ti.static(range(entries(group))):
                        # The comparison may be late, and saves most atomics.
                        if own[k] > maxima[w, g, k] or own[k] != own[k]:
                            ti.atomic_max(maxima[w, g, k], own[k])
        for w in range(runs):
            if counts[w, count.status] == MEASURE or counts[w, count.status] == ATTEND:
                counts[w, count.status] = ATTEND
                for g, group in ti.static(members):
                    for k in ti.static(range(entries(group))):
                        numbers[w, real.maxima[g] + k] = ti.cast(maxima[w, g, k], ti.f64)

    @ti.kernel
    def average(numbers: ti.types.ndarray(ti.f64, 2), counts: ti.types.ndarray(ti.i32, 2)):
        """Average volumes over cells before frames are read, the first one included, which no step precedes."""
        for w in range(runs):
            constants[w][INVERSE] = ti.cast(numbers[w, real.inverse_spacing], float)
        for g, group in ti.static(members):
            if ti.static(group.averaged):
                for p in range(runs * room[g]):
                    if p % room[g] < counts[p // room[g], count.particles[g]]:
                        start_mean(g, p // room[g], p, counts)
                for p in range(runs * room[g]):
                    if p % room[g] < counts[p // room[g], count.particles[g]]:
                        add_to_mean(g, p // room[g], p, counts)
                for p in range(runs * room[g]):
                    if p % room[g] < counts[p // room[g], count.particles[g]]:
                        take_mean(g, p // room[g], p, counts)

    def launch(numbers: np.ndarray, counts: np.ndarray) -> None:
        own = numbers, counts
        for there, here in zip(on_device, own, strict=True):
            there.from_numpy(here)
        if (counts[:, count.status] == GOING).any():
            for _ in range(STEPS):
                step(*on_device)
        measure(*on_device)
        if averages:
            average(*on_device)
        for there, here in zip(on_device, own, strict=True):
            here[:] = there.to_numpy()

    return launch
