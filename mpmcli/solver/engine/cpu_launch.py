"""Carries out steps on the CPU: a launch takes many steps of each run and records frames until the host is needed.

The results of a run are identical in every byte in any batch and on any number of threads.
"""

import time
from collections import Counter
from itertools import accumulate

import numpy as np

from mpmcli.boundaries.doubles import as_double
from mpmcli.boundaries.feature import Feature
from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.cpu_phases import CpuPhases, FrameBuffer, RunInts, RunReals
from mpmcli.solver.engine.cpu_threads import LOOKS_IN_VAIN, CpuThreads
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.emission import CpuEmission
from mpmcli.solver.engine.run_state import (
    ATTEND,
    CROWDED,
    FRAME_NUMBERS,
    GOING,
    LOST,
    MEASURE,
    Layout,
    RunState,
)
from mpmcli.solver.engine.step_size import StepSize
from mpmcli.solver.frames.reader import SOUND, sum_entries, sum_range
from mpmcli.solver.grid.grid import box_of
from mpmcli.solver.particles.sort import CHUNK, find_places, scratch_offset, stay_rolled
from mpmcli.solver.particles.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state
from mpmcli.solver.transfer.splines import PAD

FrameStats = ti.types.ndarray(ti.f64, 3)
# Names in the profile of phases outside a step.
BESIDE = {"forget": "sort", "mark": "sort", "average_for_frame": "frame", "write_frame": "frame"}


@ti.data_oriented
class CpuLaunch:
    """The kernels of a batch on the CPU; w is the index of a run, and their arrays are those of `Batch`.

    Attributes:
        phases: bodies of the phases.
        steps: choice of steps.
        team: threads that share a run.
        token: numbers that make the kernel unique for Taichi; see `kernel_store`.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        """Build the phases, the team of threads and the choice of steps of a device."""
        self.device, self.layout = device, layout
        self.dimension, self.capacity = device.grid.dimension, tuple(device.capacity)
        self.members, self.stencils = tuple(enumerate(device.groups)), device.stencils
        self.steps = StepSize.of(device, layout, device.values)
        self.phases = CpuPhases(device, layout)
        self.team = CpuThreads(self.phases, device.runs)
        self.emission = CpuEmission(device, device.stencils)
        self.alone = device.threads == 1
        self.sum_count = sum_entries(self.dimension)
        self.next_run = ti.field(int, shape=())
        self.token: tuple[int, ...] = ()

    @ti.kernel
    def launch(self, numbers: RunReals, counts: RunInts, frame_buffer: FrameBuffer, frame_stats: FrameStats):
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
                    # The first thread to arrive is the leader, because the operating system may run threads one after
                    # another.
                    self.advance_run(0, w, numbers, counts, frame_buffer, frame_stats)
                else:
                    # Threads take runs as they become free; results do not depend on the thread.
                    while w < self.device.runs:
                        self.advance_run(w, 0, numbers, counts, frame_buffer, frame_stats)
                        w = ti.atomic_add(self.next_run[None], 1)

    @ti.func
    def advance_run(
        self,
        w: int,
        t: int,
        numbers: ti.template(),
        counts: ti.template(),
        frame_buffer: ti.template(),
        frame_stats: ti.template(),
    ):
        """Advance a run, record frames, and measure it if the host needs that; threads other than t = 0 only help."""
        (run,) = ti.static((self.phases.state(w, numbers, counts),))
        status = run.status
        self.team.enter(w)
        goes_on = True
        phase, idle = -1, 0
        if t == 0:
            run.frame_recorded = 0
        while goes_on:
            if t == 0 and self.team.finished(w):
                phase = self.finish_phase(run, phase, frame_stats)
                if phase >= 0:
                    self.team.publish(w, phase)
                else:
                    goes_on = False
            if goes_on:
                found = self.team.process_part(w, t, idle, numbers, counts, frame_buffer)
                idle = 0 if found == 1 else idle + 1
                if found < 0 or (idle > LOOKS_IN_VAIN and t > 0):
                    goes_on = False
        self.team.leave(w)
        if t == 0:
            self.team.close(w)
            if status == MEASURE or (status == GOING and run.status == ATTEND):
                run.status = ATTEND
                self.measure(run)

    @ti.func
    def finish_phase(self, run: ti.template(), done: int, frame_stats: ti.template()):
        """Do the work after phase `done`, -1 at the start of a launch; return the next phase, -1 for none."""
        phase = done
        if phase < 0:
            self.phases.begin_launch(run)
        elif phase == self.phases.last_of_step:
            self.steps.end(run, self.phases.end_step(run))
            run.frame_recorded = 0
        elif phase == self.phases.last_of_sort:
            self.end_sort(run)
        elif phase == self.phases.last_of_frame:
            self.record(run, frame_stats)
            run.frame_recorded = 1
        elif phase >= self.phases.sorts:
            self.sort_on(run, phase)
        inside = phase >= 0 and phase != self.phases.last_of_frame and run.status != CROWDED
        if inside and phase != self.phases.last_of_step and phase != self.phases.last_of_sort:
            phase += 1
        else:
            phase = -1
            arrived = run.arrived == 1
            if arrived and run.records == 1 and run.status != LOST and run.frame_recorded == 0:
                phase = self.phases.first_of_frame
            elif run.status == GOING and not arrived and run.budget > 0:
                if ti.static(self.emission.needed):
                    self.enter(run)
                if run.drift + self.steps.shift_ahead(run) >= as_double(self.device.drift_allowed):
                    phase = self.phases.sorts
                elif self.steps.begin(run):
                    self.begin_step(run)
                    phase = self.phases.first_of_step(run)
        return phase

    @ti.func
    def begin_step(self, run: ti.template()):
        """Prepare the chosen step."""
        self.find_box(run)
        self.phases.begin_step(run)

    @ti.func
    def measure(self, run: ti.template()):
        """Store the maxima of each group."""
        for g, group in ti.static(self.members):
            own = ti.Vector([NOTHING] * ti.static(entries(group)))
            first = run.w * ti.static(self.capacity[g])
            for p in range(first, first + run.particles[g]):
                stay_rolled(self.device.orders[g].buffers.real, p)
                v, C = group.motion(p)
                widen_motion(own, v, deformation_rate(group, C))
                widen_state(group, own, p)
            for k in ti.static(range(entries(group))):
                run.maxima[g][k] = ti.cast(own[k], ti.f64)

    # Sorts.

    @ti.func
    def sort_on(self, run: ti.template(), phase: int):
        """Do the work between a phase of a sort and the next one."""
        (view,) = ti.static(self.phases.see(run))
        if ti.static(view.grid.sparse):
            if phase == self.phases.marking:
                if not view.grid.number():
                    run.status = CROWDED
        for g in ti.static(range(len(self.members))):
            if phase == ti.static(self.phases.sorts_of[g]):
                find_places(view.orders[g], run.w, run.w * ti.static(self.capacity[g]))

    @ti.func
    def end_sort(self, run: ti.template()):
        """Find the range of stencils of the sorted particles."""
        low = ti.Vector([2**30] * self.dimension)
        high = ti.Vector([-1] * self.dimension)
        self.emission.count_active(run)
        if ti.static(self.phases.separates):
            self.device.features.surfaces.forget(run.w)
        (view,) = ti.static(self.phases.see(run))
        if ti.static(self.device.particles.repels):
            self.device.features.repulsion.fill(run.w, run.w * self.capacity[0], run.particles[0], view.grid.spacing)
        for g in ti.static(range(len(self.members))):
            first, own = run.w * ti.static(self.capacity[g]), run.particles[g]
            for p in range(first, first + own):
                base = view.orders[g].first_node_of(p)
                low, high = ti.min(low, base), ti.max(high, base)
                if ti.static(self.phases.separates):
                    self.device.features.surfaces.widen(run.w, view.groups[g].layer_of(p), base)
            if ti.static(self.phases.shared):
                self.phases.places.divide(g, own)
        for a in ti.static(range(self.dimension)):
            self.stencils[run.w * 2, a], self.stencils[run.w * 2 + 1, a] = low[a], high[a]
        run.drift = 0.0

    @ti.func
    def find_box(self, run: ti.template()):
        """Find the nodes that the next step uses."""
        drift = ti.cast(ti.ceil(run.drift), int)
        for a in ti.static(range(self.dimension)):
            low, high = self.stencils[run.w * 2, a], self.stencils[run.w * 2 + 1, a]
            first, last = box_of(self.device.grid, a, low, high, drift, PAD + run.cells[a])
            self.device.grid.box[run.w * 2, a] = first
            # Without active particles the box is empty.
            self.device.grid.box[run.w * 2 + 1, a] = ti.max(last - first + 1, 0)
        if ti.static(self.phases.shared and not self.device.grid.sparse):
            self.phases.places.divide_rows()

    @ti.func
    def enter(self, run: ti.template()):
        """Let due sheets of emitters enter."""
        if run.due <= run.time:
            (view,) = ti.static(self.phases.see(run))
            before = run.due
            self.emission.enter(view.orders, run)
            if ti.static(self.device.grid.sparse):
                # Particles that entered may reach tiles without a number.
                if run.due != before:
                    run.drift = as_double(self.device.drift_allowed)

    @ti.kernel
    def share_work(self, counts: RunInts):
        """Divide particles among threads again after loading a state."""
        ti.loop_config(serialize=True)
        for w in range(self.device.runs):
            if ti.static(self.phases.shared):
                for g in ti.static(range(len(self.members))):
                    self.phases.places.divide(g, counts[w, ti.static(self.layout.counts["particles"][g])])

    # Frames.

    def noting(self) -> list[tuple[Feature, int]]:
        """Return the features with values in the statistics of a frame, and the first column of each."""
        found = [one for one in self.device.features if one.noted]
        columns = accumulate(
            (one.noted for one in found), initial=len(FRAME_NUMBERS) + len(self.members) * self.sum_count
        )
        return list(zip(found, columns, strict=False))

    @ti.func
    def record(self, run: ti.template(), frame_stats: ti.template()):
        """Store the statistics of a frame, and set the target to the next frame if there is one."""
        frame = run.recorded
        sound = True
        for g, group in ti.static(self.members):
            scratch, seen = ti.static((self.device.orders[g].buffers, group.seen_from(run.w)))
            offset = scratch_offset(scratch, g, run.w, ti.static(self.capacity[g]))
            sums = sum_range(seen, run.w * ti.static(self.capacity[g]), run.particles[g], scratch.real, offset)
            for k in ti.static(range(self.sum_count)):
                frame_stats[run.w, frame, ti.static(len(FRAME_NUMBERS) + g * self.sum_count) + k] = sums[k]
            if sums[ti.static(SOUND)] == 0:
                sound = False
        for feature, column in ti.static(self.noting()):
            feature.note(run.w, frame, column, frame_stats)
        for k, value in ti.static(enumerate(self.noted(run))):
            frame_stats[run.w, frame, k] = ti.cast(value, ti.f64)
        if sound:
            run.recorded = frame + 1
            for g in ti.static(range(len(self.members))):
                run.row += run.capacity[g]
            if run.frame < run.frames:
                run.frame += 1
                self.steps.next_frame(run)
                if frame + 1 == run.frame_capacity and run.status == GOING:
                    run.status = ATTEND
            else:
                run.status = ATTEND
        else:
            run.status = LOST

    def noted(self, run: RunState) -> list[object]:
        """Return the numbers of a run that are stored with a frame."""
        return [getattr(run, name) for name in FRAME_NUMBERS]

    # The profile: the same phases, with a launch for each.

    def launch_by_phase(
        self,
        numbers: np.ndarray,
        counts: np.ndarray,
        frame_buffer: np.ndarray,
        frame_stats: np.ndarray,
        seconds: Counter,
    ) -> None:
        """Advance the only run like `launch`; add the wall time of each phase to `seconds` under its name."""
        run, phase = self.phases.state(0, numbers, counts), -1
        status = run.status
        run.frame_recorded = 0
        while (phase := self.next_phase(phase, numbers, counts, frame_stats)) >= 0:
            began = time.perf_counter()
            self.work(phase, numbers, counts, frame_buffer)
            names = [kind.name for kind in self.phases.kinds if kind.first <= phase < kind.after]
            seconds[BESIDE.get(names[0], names[0])] += time.perf_counter() - began
        began = time.perf_counter()
        if status == MEASURE or (status == GOING and run.status == ATTEND):
            run.status = ATTEND
            self.measure_run(numbers, counts)
        seconds["measure"] += time.perf_counter() - began

    @ti.kernel
    def next_phase(self, phase: int, numbers: RunReals, counts: RunInts, frame_stats: FrameStats) -> int:
        """Do the work after a phase of the only run; return the next phase."""
        (run,) = ti.static((self.phases.state(0, numbers, counts),))
        return self.finish_phase(run, phase, frame_stats)

    @ti.kernel
    def work(self, phase: int, numbers: RunReals, counts: RunInts, frame_buffer: FrameBuffer):
        """Process all parts of a phase of the only run."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.team.open(0)
            self.team.publish(0, phase)
        ti.loop_config(serialize=self.alone)
        for q in range(CHUNK * self.device.threads):
            if q % CHUNK == 0:
                self.team.enter(0)
                while not self.team.finished(0):
                    _found = self.team.process_part(0, q // CHUNK, 0, numbers, counts, frame_buffer)
                self.team.leave(0)

    @ti.kernel
    def measure_run(self, numbers: RunReals, counts: RunInts):
        """Store the maxima of each group of the only run."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            (run,) = ti.static((self.phases.state(0, numbers, counts),))
            self.measure(run)
