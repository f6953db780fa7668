"""Entry of sheets of emitters: on the CPU in the leading thread of a run, on a GPU between launches.

A sheet enters at the first step after its due time; the next sheet is due one period after this due time. Particles
whose lattice cell is occupied when a layer begins are blocked permanently. If half of the layer or more is blocked, the
layer tries again after a fraction of its duration, and all later sheets are delayed accordingly.
"""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.boundaries.doubles import as_double
from mpmcli.frames.frame import ACTIVE, BLOCKED, WAITING
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.scene.sheets import Sheets
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.run_state import Layout, RunState
from mpmcli.solver.particles.inflow import RETRY, first_ids


@ti.data_oriented
class CpuEmission:
    """Entry of sheets for the runs of a batch on the CPU; w is the index of a run.

    Attributes:
        needed: whether there are any emitters.
    """

    def __init__(self, device: Device, stencils: ti.Field) -> None:
        """Store the device; `stencils` holds, per run and axis, the range of first nodes of stencils."""
        self.stencils, self.separates = stencils, device.features.surfaces is not None
        self.device, self.emission = device, device.features.emission
        self.needed = device.features.emission is not None
        # Per emitter: its index, the index of its law, and its group of particles.
        members = self.emission.members if self.needed else ()
        self.emitters = tuple((e, g, device.groups[g]) for e, g in members)
        self.numbered = tuple(enumerate(device.groups))

    @ti.func
    def enter(self, orders: ti.template(), run: ti.template()):
        """Let all due sheets enter whose layers are not blocked."""
        time, due, w = run.time, as_double(math.inf), run.w
        for e, g, group in ti.static(self.emitters):
            going = self.is_left(e, run)
            while going and run.due_of[e] <= time:
                late = ti.cast(time - run.due_of[e], float)
                sheet, blocked, layer = run.entered[e], 0, 1
                first = w * ti.static(self.device.capacity[g])
                begin, after = first + run.particles[g], first + run.capacity[g]
                if sheet % self.emission.ids[w, e][2] == 0:
                    self.look(e, run, sheet, late)
                    blocked = self.emission.count_blocked(e, group, w, sheet, begin, after)
                    layer = self.emission.particles_of(e, w, sheet, self.emission.ids[w, e][2])
                if 2 * blocked >= layer:
                    run.due_of[e] = time + RETRY * run.period[e] * self.emission.ids[w, e][2]
                    if run.waits[e] == 0:
                        run.waits[e] = 1
                        run.blocked += layer
                else:
                    if blocked > 0:
                        self.emission.keep_out(e, group, w, sheet, begin, after)
                    run.blocked += blocked
                    end = self.emission.enter(e, group, w, sheet, late, begin, after)
                    run.particles[g] = end - first
                    for p in range(begin, end):
                        self.widen(orders[g], w, p)
                    run.entered[e] = sheet + 1
                    run.waits[e] = 0
                    run.due_of[e] = run.due_of[e] + run.period[e] * self.emission.stretch(e, w, sheet)
                going = self.is_left(e, run)
            if going:
                due = ti.min(due, run.due_of[e])
        run.due = due

    @ti.func
    def widen(self, order: ti.template(), w: int, p: int):
        """Extend the box of the next steps to the stencil of particle p."""
        base = order.first_node_of(p)
        for a in ti.static(range(self.device.grid.dimension)):
            self.stencils[w * 2, a] = ti.min(self.stencils[w * 2, a], base[a])
            self.stencils[w * 2 + 1, a] = ti.max(self.stencils[w * 2 + 1, a], base[a])
        if ti.static(self.separates):
            # Emitted particles are in layer 0.
            self.device.features.surfaces.widen(w, 0, base)

    @ti.func
    def is_left(self, e: ti.template(), run: ti.template()):
        """Return whether any sheet of an emitter is still to enter."""
        return run.due_of[e] < run.until[e] and run.entered[e] < run.sheets[e]

    @ti.func
    def look(self, e: ti.template(), run: ti.template(), sheet: int, late: float):
        """Mark the cells occupied by particles for the layer that begins with `sheet`, which was due `late` s ago."""
        self.emission.clear(e, run.w)
        for g, group in ti.static(self.numbered):
            first = run.w * ti.static(self.device.capacity[g])
            for p in range(first, first + run.particles[g]):
                self.emission.mark(e, group, run.w, sheet, late, p)

    @ti.func
    def count_active(self, run: ti.template()):
        """Count the active particles after a sort."""
        if ti.static(self.device.particle_count_varies):
            for g in ti.static(range(len(self.numbered))):
                after = run.w * ti.static(self.device.orders[g].bins + 1) + ti.static(self.device.orders[g].tiles)
                run.particles[g] = self.device.orders[g].start[after] - run.w * ti.static(self.device.capacity[g])


@ti.data_oriented
class GpuEmission:
    """Entry of sheets for the runs of a batch on a GPU; a sort follows each entry.

    Attributes:
        counts: (runs, counts) int, `Batch.counts` on the device.
        enters: (runs) int, whether the next sheet of an emitter enters.
        sheet: (runs) int, index of this sheet.
        late: (runs) time since it was due, s.
        blocked: (runs) int, number of blocked particles of its layer.
        layer: (runs) int, number of particles of this layer.
    """

    def __init__(self, device: Device, layout: Layout, counts: ti.Field) -> None:
        self.device, self.emission, self.counts, self.runs = device, device.features.emission, counts, device.runs
        self.layout, self.capacity = layout, tuple(device.capacity)
        self.members = tuple(enumerate(device.groups))
        self.enters, self.sheet, self.blocked, self.layer = (ti.field(int, shape=self.runs) for _ in range(4))
        self.late = ti.field(float, shape=self.runs)

    def enter(self, runs: RunState, going: np.ndarray) -> None:
        """Let all due sheets enter in the advancing runs."""
        due = going & (runs.due <= runs.time)
        while due.any():
            for e, _ in self.emission.members:
                self._enter_one(e, runs, due)
            runs.drift[due] = np.inf
            next_due = [np.where(self._is_left(e, runs), runs.due_of[e], np.inf) for e, _ in self.emission.members]
            runs.due[due] = np.min(next_due, axis=0)[due]
            due &= runs.due <= runs.time

    def _is_left(self, e: int, runs: RunState) -> np.ndarray:
        """Return whether any sheet of an emitter is still to enter."""
        return (runs.due_of[e] < runs.until[e]) & (runs.entered[e] < runs.sheets[e])

    def _enter_one(self, e: int, runs: RunState, due: np.ndarray) -> None:
        """Let one sheet of an emitter enter in each of these runs in which it is due and its layer is not blocked."""
        asked = due & (runs.due_of[e] <= runs.time) & self._is_left(e, runs)
        if not asked.any():
            return
        per_layer, sheet = self.emission.ids.to_numpy()[:, e, 2], runs.entered[e].copy()
        self.late.from_numpy(np.where(asked, runs.time - runs.due_of[e], 0.0).astype(self.device.groups[0].real))
        self.enters.from_numpy(asked.astype(np.int32))
        self.sheet.from_numpy(sheet)
        blocked, waits = np.zeros_like(sheet), np.zeros_like(asked)
        if (asked & (sheet % per_layer == 0)).any():
            self.find_blocked(e)
            blocked, layer = self.blocked.to_numpy(), self.layer.to_numpy()
            waits = asked & (2 * blocked >= layer)
            first_wait = waits & (runs.waits[e] == 0)
            runs.blocked[first_wait] += layer[first_wait]
        enters = asked & ~waits
        runs.waits[e][waits] = 1
        runs.due_of[e][waits] = (runs.time + RETRY * runs.period[e] * per_layer)[waits]
        runs.blocked[enters] += blocked[enters]
        runs.entered[e][enters] += 1
        runs.waits[e][enters] = 0
        stretches = self.emission.known[np.arange(self.runs), e, np.minimum(sheet, self.emission.sheets - 1)]
        runs.due_of[e][enters] += (runs.period[e] * stretches)[enters]
        self.enters.from_numpy(enters.astype(np.int32))
        self.let_enter(e)

    @ti.kernel
    def find_blocked(self, e: ti.template()):
        """Count the blocked particles and all particles of the layer that an emitter begins."""
        source = ti.static(self.emission.members[e][1])
        for w in range(self.runs):
            self.emission.clear(e, w)
            self.blocked[w], self.layer[w] = 0, 1
            if self.looks(e, w):
                self.layer[w] = self.emission.particles_of(e, w, self.sheet[w], self.emission.ids[w, e][2])
        for g, group in ti.static(self.members):
            for p in range(self.runs * self.capacity[g]):
                w = p // self.capacity[g]
                if self.looks(e, w) and self.is_one(g, w, p) and group.activity[p] == ACTIVE:
                    self.emission.mark(e, group, w, self.sheet[w], self.late[w], p)
        for p in range(self.runs * self.capacity[source]):
            w = p // self.capacity[source]
            if self.looks(e, w) and self.is_one(source, w, p):
                self.blocked[w] += ti.cast(
                    self.emission.keeps_out(e, self.device.groups[source], w, p, self.sheet[w]), int
                )

    @ti.func
    def looks(self, e: ti.template(), w: int):
        """Return whether the next sheet of an emitter may enter and begins a layer."""
        return self.enters[w] == 1 and self.sheet[w] % self.emission.ids[w, e][2] == 0

    @ti.func
    def is_one(self, g: ti.template(), w: int, p: int):
        """Return whether entry p of a group is a particle of its run."""
        return p - w * self.capacity[g] < self.counts[w, ti.static(self.layout.counts["capacity"][g])]

    @ti.kernel
    def let_enter(self, e: ti.template()):
        """Activate the unblocked particles of the next sheet of an emitter; block the others of its layer."""
        g = ti.static(self.emission.members[e][1])
        (group,) = ti.static((self.device.groups[g],))
        for p in range(self.runs * self.capacity[g]):
            w = p // self.capacity[g]
            if self.enters[w] == 1 and self.is_one(g, w, p):
                if self.looks(e, w) and self.emission.keeps_out(e, group, w, p, self.sheet[w]):
                    group.activity[p] = BLOCKED
                elif group.activity[p] == WAITING and self.emission.is_due(e, group, w, p, self.sheet[w], 1):
                    self.emission.begin(e, group, w, p, self.late[w])


def begin_emission(batch: object, slot: int, scene: Scene, found: Sequence[Sheets], particles: Sequence[int]) -> None:
    """Store the mouths of the emitters of a run and the times of their sheets.

    Args:
        batch: the `Batch`.
        slot: slot of the run in the batch.
        scene: the scene of the run.
        found: sheets of each emitter.
        particles: number of particles of each source.
    """
    run = batch.state(slot)
    run.slowest = max((highest_speed(emitter, scene.time.end) for emitter in scene.emitters), default=0.0)
    if batch.device.features.emission is None:
        return
    batch.device.features.emission.write(scene, found, first_ids(scene, particles), slot)
    for e, (sheets, emitter) in enumerate(zip(found, scene.emitters, strict=True)):
        # A sheet enters at the first step after its due time; no sheet is due from `until` on.
        start = float(sheets.due[0]) if sheets.count else emitter.start
        run.due_of[e], run.period[e], run.sheets[e] = start, sheets.period, sheets.count
        run.until[e] = min(scene.time.end, math.inf if emitter.end is None else emitter.end - sheets.early)
        if sheets.count and start < run.until[e]:
            run.due = min(run.due, start)
