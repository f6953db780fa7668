"""Carries out steps on the CPU: a launch takes many steps of each run, and records frames, until its host is needed.

The functions of a step take the grid, the walls and so on as objects; `views` returns copies of them for one run, whose
numbers are variables of the kernel. A run has the same bytes in any batch and on any number of threads.
"""

import time
from collections import Counter

import numpy as np

from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.contact.obstacles import Obstacles
from mpmcli.solver.engine.cpu_phases import CpuPhases, RunInts, RunReals, Shown
from mpmcli.solver.engine.cpu_threads import LOOKS_IN_VAIN, CpuThreads
from mpmcli.solver.engine.device import Device, views
from mpmcli.solver.engine.emission import CpuEmission
from mpmcli.solver.engine.run_numbers import ATTEND, CROWDED, GOING, LOST, MEASURE, NOTES, Layout
from mpmcli.solver.engine.step_size import StepSize
from mpmcli.solver.frames.reader import SOUND, sum_entries, sum_range
from mpmcli.solver.grid.grid import box_of
from mpmcli.solver.particles.sort import CHUNK, find_places, scratch_offset, stay_rolled
from mpmcli.solver.particles.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state
from mpmcli.solver.transfer.redistribution import farthest_shift
from mpmcli.solver.transfer.splines import PAD

Notes = ti.types.ndarray(ti.f64, 3)
# What the profile calls the phases beside those of a step; a sort is any of its phases.
BESIDE = {"forget": "sort", "mark": "sort", "average_shown": "frame", "show": "frame"}


@ti.data_oriented
class CpuLaunch:
    """The kernels of a batch on the CPU, w being the number of a run; numbers, counts, shown and notes as of `Batch`.

    phases: their bodies; steps: how a step is chosen; team: the threads that share a run.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.layout = device, layout
        self.real, self.count = layout.real, layout.count
        self.dimension, self.room = device.grid.dimension, tuple(device.room)
        self.members, self.stencils = tuple(enumerate(device.groups)), device.stencils
        drifts = device.particles.touches or not all(group.total for group in device.groups)
        shift = farthest_shift(device.grid.fine)
        self.steps = StepSize(layout, device.groups, device.values, device.grid.scheme, drifts=drifts, shift=shift)
        self.phases = CpuPhases(device, layout)
        self.team = CpuThreads(self.phases, device.runs)
        self.emission = CpuEmission(device, layout, device.stencils)
        self.noted = tuple(
            (k, getattr(layout.real, name)) for k, name in enumerate(NOTES) if hasattr(layout.real, name)
        )
        self.counted = tuple(
            (k, getattr(layout.count, name)) for k, name in enumerate(NOTES) if hasattr(layout.count, name)
        )
        self.alone, self.collides = device.threads == 1, device.colliders is not None
        self.sum_count = sum_entries(self.dimension)
        self.next_run = ti.field(int, shape=())
        # Numbers that make this kernel another one for Taichi; see `kernel_store`.
        self.token: tuple[int, ...] = ()

    @ti.kernel
    def launch(self, numbers: RunReals, counts: RunInts, shown: Shown, notes: Notes):
        """Advance every run."""
        for number in ti.static(self.token):
            self.next_run[None] = number
        ti.loop_config(serialize=True)
        for w in range(self.device.runs):
            self.team.open(w)
        self.next_run[None] = 0
        ti.loop_config(serialize=self.alone)
        for q in range(CHUNK * self.device.threads):
            if q % CHUNK == 0:
                w = ti.atomic_add(self.next_run[None], 1)
                if ti.static(self.phases.shared):
                    # The first thread to come leads: a system may let threads run one after another.
                    self.advance_run(0, w, numbers, counts, shown, notes)
                else:
                    # Threads take runs as they become free: no number depends on which one.
                    while w < self.device.runs:
                        self.advance_run(w, 0, numbers, counts, shown, notes)
                        w = ti.atomic_add(self.next_run[None], 1)

    @ti.func
    def advance_run(
        self,
        w: int,
        t: int,
        numbers: ti.template(),
        counts: ti.template(),
        shown: ti.template(),
        notes: ti.template(),
    ):
        """Advance a run, record frames, and measure it where the host needs that; threads but t = 0 only help."""
        status = counts[w, self.count.status]
        self.team.enter(w)
        goes_on = True
        phase, idle = -1, 0
        if t == 0:
            counts[w, self.count.frame_is_noted] = 0
        while goes_on:
            if t == 0 and self.team.finished(w):
                phase = self.lead(w, phase, numbers, counts, notes)
                if phase >= 0:
                    self.team.publish(w, phase)
                else:
                    goes_on = False
            if goes_on:
                found = self.team.help(w, t, idle, numbers, counts, shown)
                idle = 0 if found == 1 else idle + 1
                if found < 0 or (idle > LOOKS_IN_VAIN and t > 0):
                    goes_on = False
        self.team.leave(w)
        if t == 0:
            self.team.close(w)
            if status == MEASURE or (status == GOING and counts[w, self.count.status] == ATTEND):
                counts[w, self.count.status] = ATTEND
                self.measure(w, numbers, counts)

    @ti.func
    def lead(self, w: int, done: int, numbers: ti.template(), counts: ti.template(), notes: ti.template()):
        """Do what follows on a phase that is done, -1 at the start of a launch; return the next one, -1 for none."""
        phase = done
        if phase == self.phases.last_of_step:
            dt = numbers[w, self.real.step]
            speed = self.phases.end_step(w, dt, numbers)
            splits, deformation = numbers[w, self.real.splits], numbers[w, self.real.deformation]
            self.steps.end(w, dt, splits, counts[w, self.count.step_limit], deformation, speed, numbers, counts)
            counts[w, self.count.frame_is_noted] = 0
        elif phase == self.phases.last_of_sort:
            self.end_sort(w, numbers, counts)
        elif phase == self.phases.showing:
            self.record(w, numbers, counts, notes)
            counts[w, self.count.frame_is_noted] = 1
        elif phase >= self.phases.sorts:
            self.sort_on(w, phase, numbers, counts)
        inside = phase >= 0 and phase != self.phases.showing and counts[w, self.count.status] != CROWDED
        if inside and phase != self.phases.last_of_step and phase != self.phases.last_of_sort:
            phase += 1
        else:
            phase = -1
            arrived, going = counts[w, self.count.arrived] == 1, counts[w, self.count.status] == GOING
            noted = counts[w, self.count.frame_is_noted] == 1
            if arrived and counts[w, self.count.records] == 1 and counts[w, self.count.status] != LOST and not noted:
                phase = self.phases.before_showing
            elif going and not arrived and counts[w, self.count.budget] > 0:
                if ti.static(self.emission.needed):
                    self.enter(w, numbers, counts)
                drift = numbers[w, self.real.drift] + self.steps.shift_ahead(w, counts)
                if drift >= numbers[w, self.real.drift_allowed]:
                    phase = self.phases.sorts
                elif self.begin_step(w, numbers, counts):
                    phase = self.phases.first_of_step(w)
        return phase

    @ti.func
    def begin_step(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Choose the next step; return whether it can be taken."""
        dt, kick, splits, limit, deformation, _stable = self.steps.begin(w, numbers, counts)
        numbers[w, self.real.step], numbers[w, self.real.splits] = dt, splits
        numbers[w, self.real.deformation] = deformation
        counts[w, self.count.step_limit] = limit
        if dt > 0:
            relaxed = self.steps.relaxed_in(w, dt, numbers, counts)
            self.find_box(w, numbers, counts)
            self.phases.begin_step(w, dt, kick, relaxed, numbers)
            if ti.static(self.phases.separates):
                self.find_meetings(w, numbers, counts)
        return dt > 0

    @ti.func
    def measure(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Store the maxima of each group."""
        for g, group in ti.static(self.members):
            own = ti.Vector([NOTHING] * ti.static(entries(group)))
            first = w * ti.static(self.room[g])
            for p in range(first, first + counts[w, self.count.particles[g]]):
                stay_rolled(self.device.orders[g].buffers.real, p)
                v, C = group.motion(p)
                widen_motion(own, v, deformation_rate(group, C))
                widen_state(group, own, p)
            for k in ti.static(range(entries(group))):
                numbers[w, self.real.maxima[g] + k] = ti.cast(own[k], ti.f64)

    # Sorts.

    @ti.func
    def sort_on(self, w: int, phase: int, numbers: ti.template(), counts: ti.template()):
        """Do what follows on a phase of a sort before the next one."""
        h, inverse, scale, box, last, extent = self.phases.view_numbers(w, numbers, counts)
        grid, _nodes, _particles, orders, _groups = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        if ti.static(grid.sparse):
            if phase == self.phases.marking:
                if not grid.number():
                    counts[w, self.count.status] = CROWDED
        for g in ti.static(range(len(self.members))):
            if phase == ti.static(self.phases.sorts_of[g]):
                find_places(orders[g], w, w * ti.static(self.room[g]))

    @ti.func
    def end_sort(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Find the range of the stencils of particles that were sorted."""
        low = ti.Vector([2**30] * self.dimension)
        high = ti.Vector([-1] * self.dimension)
        self.emission.count_active(w, counts)
        if ti.static(self.phases.separates):
            self.device.contact.surfaces.forget(w)
        h, inverse, scale, box, last, extent = self.phases.view_numbers(w, numbers, counts)
        _grid, _nodes, _particles, orders, groups = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        if ti.static(self.device.particles.touches):
            self.device.particles.contact.fill(w, w * self.room[0], counts[w, self.count.particles[0]], h)
        for g in ti.static(range(len(self.members))):
            first, own = w * ti.static(self.room[g]), counts[w, self.count.particles[g]]
            for p in range(first, first + own):
                base = orders[g].first_node_of(p)
                low, high = ti.min(low, base), ti.max(high, base)
                if ti.static(self.phases.separates):
                    layer = w * ti.static(self.device.grid.layers) + groups[g].layer_of(p)
                    self.device.contact.surfaces.widen(layer, base)
            if ti.static(self.phases.shared):
                self.phases.places.divide(g, own)
        if ti.static(self.device.comes_and_goes):
            # Where none takes part there is a box all the same.
            if high[0] < 0:
                for a in ti.static(range(self.dimension)):
                    low[a], high[a] = PAD, PAD
        for a in ti.static(range(self.dimension)):
            self.stencils[w * 2, a], self.stencils[w * 2 + 1, a] = low[a], high[a]
        numbers[w, self.real.drift] = 0.0

    @ti.func
    def find_box(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Find the nodes that the next step uses."""
        drift = ti.cast(ti.ceil(numbers[w, self.real.drift]), int)
        for a in ti.static(range(self.dimension)):
            last_wall = PAD + counts[w, self.count.cells[a]]
            low, high = self.stencils[w * 2, a], self.stencils[w * 2 + 1, a]
            first, last = box_of(self.device.grid, a, low, high, drift, last_wall)
            self.device.grid.box[w * 2, a] = first
            self.device.grid.box[w * 2 + 1, a] = last - first + 1
        if ti.static(self.phases.shared and not self.device.grid.sparse):
            self.phases.places.divide_rows()

    @ti.func
    def find_meetings(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Find where bodies may meet in the step, with colliders where they are in it."""
        drift = ti.cast(ti.ceil(numbers[w, self.real.drift]), int)
        h, inverse, scale, box, last, extent = self.phases.view_numbers(w, numbers, counts)
        _grid, nodes, _particles, _orders, _groups = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        (obstacles,) = ti.static((Obstacles(nodes.images.walls, nodes.colliders, h),))
        self.device.contact.surfaces.find_box(self.device.grid, obstacles, w, drift, last)

    @ti.func
    def enter(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Let the sheets of emitters enter that are due."""
        if numbers[w, self.real.due] <= numbers[w, self.real.time]:
            h, inverse, scale, box, last, extent = self.phases.view_numbers(w, numbers, counts)
            _grid, _nodes, _particles, orders, _all = ti.static(
                views(self.device, w, h, inverse, scale, box, last, extent)
            )
            before = numbers[w, self.real.due]
            self.emission.enter(orders, w, numbers, counts)
            if ti.static(self.device.grid.sparse):
                # What has come in may reach tiles without a number.
                if numbers[w, self.real.due] != before:
                    numbers[w, self.real.drift] = numbers[w, self.real.drift_allowed]

    @ti.kernel
    def share_work(self, counts: RunInts):
        """Divide particles among threads anew after they were loaded."""
        ti.loop_config(serialize=True)
        for w in range(self.device.runs):
            if ti.static(self.phases.shared):
                for g in ti.static(range(len(self.members))):
                    self.phases.places.divide(g, counts[w, self.count.particles[g]])

    # Frames.

    def takers(self) -> list[tuple[Loads | RigidBodies | BodyContact, int]]:
        """Return what notes on a frame have behind the sums of each group, and from which column on."""
        device, column = self.device, len(NOTES) + len(self.members) * self.sum_count
        found = []
        if device.colliders is not None:
            found.append((device.colliders.loads, column))
            column += device.colliders.loads.room * device.colliders.loads.width
        # Those that separate and those that move freely are not in one scene.
        return found + [(each, column) for each in (device.rigid, device.contact) if each is not None]

    @ti.func
    def record(self, w: int, numbers: ti.template(), counts: ti.template(), notes: ti.template()):
        """Note what belongs to a frame that is shown, and aim at the next one if there is one."""
        frame = counts[w, self.count.recorded]
        sound = True
        for g, group in ti.static(self.members):
            scratch, seen = ti.static((self.device.orders[g].buffers, group.seen_from(w)))
            offset = scratch_offset(scratch, g, w, ti.static(self.room[g]))
            first = w * ti.static(self.room[g])
            sums = sum_range(seen, first, counts[w, self.count.particles[g]], scratch.real, offset)
            for k in ti.static(range(self.sum_count)):
                notes[w, frame, ti.static(len(NOTES) + g * self.sum_count) + k] = sums[k]
            if sums[ti.static(SOUND)] == 0:
                sound = False
        for takers, column in ti.static(self.takers()):
            takers.sum_up(w, frame, column, notes)
        for k, column in ti.static(self.noted):
            notes[w, frame, k] = numbers[w, column]
        for k, column in ti.static(self.counted):
            notes[w, frame, k] = ti.cast(counts[w, column], ti.f64)
        if sound:
            counts[w, self.count.recorded] = frame + 1
            for g in ti.static(range(len(self.members))):
                counts[w, self.count.row] += counts[w, self.count.capacity[g]]
            if counts[w, self.count.frame] < counts[w, self.count.frames]:
                counts[w, self.count.frame] += 1
                self.steps.aim(w, numbers, counts)
                if frame + 1 == counts[w, self.count.room] and counts[w, self.count.status] == GOING:
                    counts[w, self.count.status] = ATTEND
            else:
                counts[w, self.count.status] = ATTEND
        else:
            counts[w, self.count.status] = LOST

    # The profile: the same phases, a launch for each.

    def launch_by_phase(
        self, numbers: np.ndarray, counts: np.ndarray, shown: np.ndarray, notes: np.ndarray, seconds: Counter
    ) -> None:
        """Advance the only run as `launch` does; add the wall time of each phase to `seconds` by its name."""
        status, phase = counts[0, self.count.status], -1
        counts[0, self.count.frame_is_noted] = 0
        while (phase := self.next_phase(phase, numbers, counts, notes)) >= 0:
            began = time.perf_counter()
            self.work(phase, numbers, counts, shown)
            names = [kind.name for kind in self.phases.kinds if kind.first <= phase < kind.after]
            seconds[BESIDE.get(names[0], names[0])] += time.perf_counter() - began
        began = time.perf_counter()
        if status == MEASURE or (status == GOING and counts[0, self.count.status] == ATTEND):
            counts[0, self.count.status] = ATTEND
            self.measure_run(numbers, counts)
        seconds["measure"] += time.perf_counter() - began

    @ti.kernel
    def next_phase(self, phase: int, numbers: RunReals, counts: RunInts, notes: Notes) -> int:
        """Do what follows on a phase of the only run; return the next one."""
        return self.lead(0, phase, numbers, counts, notes)

    @ti.kernel
    def work(self, phase: int, numbers: RunReals, counts: RunInts, shown: Shown):
        """Do all parts of a phase of the only run."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.team.open(0)
            self.team.publish(0, phase)
        ti.loop_config(serialize=self.alone)
        for q in range(CHUNK * self.device.threads):
            if q % CHUNK == 0:
                self.team.enter(0)
                while not self.team.finished(0):
                    _found = self.team.help(0, q // CHUNK, 0, numbers, counts, shown)
                self.team.leave(0)

    @ti.kernel
    def measure_run(self, numbers: RunReals, counts: RunInts):
        """Store the maxima of each group of the only run."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.measure(0, numbers, counts)
