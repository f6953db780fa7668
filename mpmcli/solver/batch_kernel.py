"""The kernel of a batch: each run advances by steps of its own, on one thread, until the host has to attend to it.

A step is that of `Solver.step` and `step_cpu`, in the same order and precision, so that a run has the same bytes in a
batch, alone, and in a `Solver` on any number of threads. The functions of a step take the grid, the walls and so on as
objects; `views` returns copies of them for one run, whose numbers are variables of the kernel.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.solver.batch_device import Device, views
from mpmcli.solver.batch_emission import BatchEmission
from mpmcli.solver.batch_layout import ATTEND, CROWDED, GOING, LOST, MEASURE, NOTES, Layout
from mpmcli.solver.batch_parts import BatchParts, Counts, Numbers, Shown
from mpmcli.solver.batch_phases import BatchPhases
from mpmcli.solver.batch_steps import BatchSteps
from mpmcli.solver.batch_threads import PATIENCE, BatchThreads
from mpmcli.solver.box import box_of
from mpmcli.solver.frame_reader import SOUND, sum_entries, sum_range
from mpmcli.solver.ordering import CHUNK, scratch_offset
from mpmcli.solver.sorting import find_places
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state


def build_batch_kernel(device: Device, layout: Layout) -> tuple[Callable[..., None], Callable[[np.ndarray], None]]:
    """Return compile-ready kernels.

    Returns:
        (numbers, counts, shown, notes) of all runs, see `Batch`, which advances and changes all; and (counts), which
        divides the particles among threads.
    """
    d = device.grid.dimension
    groups, room, threads = tuple(device.groups), tuple(device.room), device.threads
    members = tuple(enumerate(groups))
    real, count = layout.real, layout.count
    drifts = device.particles.touches or not all(group.total for group in groups)
    steps = BatchSteps(layout, [group.law for group in groups], device.values, drifts=drifts)
    phases = BatchPhases(device, layout)
    team = BatchThreads(BatchParts(phases), device.runs)
    noted = tuple((k, getattr(real, name)) for k, name in enumerate(NOTES) if hasattr(real, name))
    counted = tuple((k, getattr(count, name)) for k, name in enumerate(NOTES) if hasattr(count, name))
    alone, collides = threads == 1, device.colliders is not None
    next_run = ti.field(int, shape=())
    stencils = device.stencils
    emission = BatchEmission(device, layout, stencils)

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
    def end_sort(w: int, numbers: ti.template(), counts: ti.template()):
        """Find the range of the stencils of particles that were sorted."""
        low = ti.Vector([2**30] * d)
        high = ti.Vector([-1] * d)
        emission.count_active(w, counts)
        h, inverse, scale, box, last, extent = phases.place(w, numbers, counts)
        _grid, _nodes, _particles, orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if ti.static(device.particles.touches):
            device.particles.contact.fill(w, w * room[0], counts[w, count.particles[0]], h)
        for g in ti.static(range(len(groups))):
            first, own = w * room[g], counts[w, count.particles[g]]
            for p in range(first, first + own):
                base = orders[g].first_node_of(p)
                low, high = ti.min(low, base), ti.max(high, base)
            if ti.static(phases.shared):
                phases.places.divide(g, own)
        if ti.static(device.comes_and_goes):
            # Where none takes part there is a box all the same.
            if high[0] < 0:
                for a in ti.static(range(d)):
                    low[a], high[a] = PAD, PAD
        for a in ti.static(range(d)):
            stencils[w * 2, a], stencils[w * 2 + 1, a] = low[a], high[a]
        numbers[w, real.drift] = 0.0

    @ti.func
    def enter(w: int, numbers: ti.template(), counts: ti.template()):
        """Let the sheets of emitters enter that are due."""
        if numbers[w, real.due] <= numbers[w, real.time]:
            h, inverse, scale, box, last, extent = phases.place(w, numbers, counts)
            _grid, _nodes, _particles, orders, _all = ti.static(views(device, w, h, inverse, scale, box, last, extent))
            before = numbers[w, real.due]
            emission.enter(orders, w, numbers, counts)
            if ti.static(device.grid.sparse):
                # What has come in may reach tiles without a number.
                if numbers[w, real.due] != before:
                    numbers[w, real.drift] = numbers[w, real.drift_allowed]

    @ti.func
    def sort_on(w: int, phase: int, numbers: ti.template(), counts: ti.template()):
        """Do what follows on a phase of a sort before the next one."""
        h, inverse, scale, box, last, extent = phases.place(w, numbers, counts)
        grid, _nodes, _particles, orders, _groups = ti.static(views(device, w, h, inverse, scale, box, last, extent))
        if ti.static(grid.sparse):
            if phase == phases.marking:
                if not grid.number():
                    counts[w, count.status] = CROWDED
        for g in ti.static(range(len(groups))):
            if phase == ti.static(phases.sorts_of[g]):
                find_places(orders[g], w, w * room[g])

    @ti.func
    def find_box(w: int, numbers: ti.template(), counts: ti.template()):
        """Find the nodes that the next step uses."""
        drift = ti.cast(ti.ceil(numbers[w, real.drift]), int)
        for a in ti.static(range(d)):
            last_wall = PAD + counts[w, count.cells[a]]
            first, last = box_of(device.grid, a, stencils[w * 2, a], stencils[w * 2 + 1, a], drift, last_wall)
            device.grid.box[w * 2, a] = first
            device.grid.box[w * 2 + 1, a] = last - first + 1
        if ti.static(phases.shared and not device.grid.sparse):
            phases.places.divide_rows()

    @ti.func
    def record(w: int, numbers: ti.template(), counts: ti.template(), notes: ti.template()):
        """Note what belongs to a frame that is shown, and aim at the next one if there is one."""
        frame = counts[w, count.recorded]
        sound = True
        for g, group in ti.static(members):
            scratch, seen = ti.static((device.orders[g].buffers, group.seen_from(w)))
            offset = scratch_offset(scratch, g, w, room[g])
            sums = sum_range(seen, w * room[g], counts[w, count.particles[g]], scratch.real, offset)
            for k in ti.static(range(sum_entries(d))):
                notes[w, frame, ti.static(len(NOTES) + g * sum_entries(d)) + k] = sums[k]
            if sums[ti.static(SOUND)] == 0:
                sound = False
        if ti.static(collides):
            device.colliders.sum_up(w, frame, ti.static(len(NOTES) + len(groups) * sum_entries(d)), notes)
        for k, column in ti.static(noted):
            notes[w, frame, k] = numbers[w, column]
        for k, column in ti.static(counted):
            notes[w, frame, k] = ti.cast(counts[w, column], ti.f64)
        if sound:
            counts[w, count.recorded] = frame + 1
            for g in ti.static(range(len(groups))):
                counts[w, count.row] += counts[w, count.capacity[g]]
            if counts[w, count.frame] < counts[w, count.frames]:
                counts[w, count.frame] += 1
                steps.aim(w, numbers, counts)
                if frame + 1 == counts[w, count.room] and counts[w, count.status] == GOING:
                    counts[w, count.status] = ATTEND
            else:
                counts[w, count.status] = ATTEND
        else:
            counts[w, count.status] = LOST

    @ti.func
    def attend(
        w: int, t: int, numbers: ti.template(), counts: ti.template(), shown: ti.template(), notes: ti.template()
    ):
        """Advance a run, record frames, and measure it where the host needs that; threads but t = 0 only help."""
        status = counts[w, count.status]
        team.enter(w)
        goes_on, recorded = True, False
        phase, limit, idle = -1, 0, 0
        dt, splits, deformation = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        while goes_on:
            if t == 0 and team.finished(w):
                if phase == phases.last_of_step:
                    speed = phases.end_step(w, dt, numbers)
                    steps.end(w, dt, splits, limit, deformation, speed, numbers, counts)
                    recorded = False
                elif phase == phases.last_of_sort:
                    end_sort(w, numbers, counts)
                elif phase == phases.showing:
                    record(w, numbers, counts, notes)
                    recorded = True
                elif phase >= phases.sorts:
                    sort_on(w, phase, numbers, counts)
                inside = phase >= 0 and phase != phases.showing and counts[w, count.status] != CROWDED
                if inside and phase != phases.last_of_step and phase != phases.last_of_sort:
                    phase += 1
                else:
                    phase = -1
                    arrived, going = counts[w, count.arrived] == 1, counts[w, count.status] == GOING
                    if arrived and counts[w, count.records] == 1 and counts[w, count.status] != LOST and not recorded:
                        phase = phases.before_showing
                    elif going and not arrived and counts[w, count.budget] > 0:
                        if ti.static(emission.needed):
                            enter(w, numbers, counts)
                        if numbers[w, real.drift] >= numbers[w, real.drift_allowed]:
                            phase = phases.sorts
                        else:
                            dt, kick, splits, limit, deformation = steps.begin(w, numbers, counts)
                            if dt > 0:
                                find_box(w, numbers, counts)
                                relaxed = steps.relaxed_in(w, dt, numbers, counts)
                                phases.begin_step(w, dt, kick, relaxed, numbers)
                                phase = 0
                if phase >= 0:
                    team.publish(w, phase)
                else:
                    goes_on = False
            if goes_on:
                found = team.help(w, t, idle, numbers, counts, shown)
                idle = 0 if found == 1 else idle + 1
                if found < 0 or (idle > PATIENCE and t > 0):
                    goes_on = False
        team.leave(w)
        if t == 0:
            team.close(w)
            if status == MEASURE or (status == GOING and counts[w, count.status] == ATTEND):
                counts[w, count.status] = ATTEND
                measure(w, numbers, counts)

    @ti.kernel
    def launch(
        numbers: Numbers,
        counts: Counts,
        shown: Shown,
        notes: ti.types.ndarray(ti.f64, 3),
    ):
        ti.loop_config(serialize=True)
        for w in range(device.runs):
            team.open(w)
        next_run[None] = 0
        ti.loop_config(serialize=alone)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                w = ti.atomic_add(next_run[None], 1)
                if ti.static(phases.shared):
                    # The first thread to come leads: a system may let threads run one after another.
                    attend(0, w, numbers, counts, shown, notes)
                else:
                    # Threads take runs as they become free: no number depends on which one.
                    while w < device.runs:
                        attend(w, 0, numbers, counts, shown, notes)
                        w = ti.atomic_add(next_run[None], 1)

    @ti.kernel
    def share_work(counts: Counts):
        ti.loop_config(serialize=True)
        for w in range(device.runs):
            if ti.static(phases.shared):
                for g in ti.static(range(len(groups))):
                    phases.places.divide(g, counts[w, count.particles[g]])

    return launch, share_work
