"""How sheets of emitters enter: on the CPU on the thread that leads a run, on a GPU between launches.

A sheet enters at the first step after it was due; the next one is due a period after it was. Particles whose cell of
the lattice is occupied when a layer begins stay out. Where these are half of the layer or more, it tries again after a
share of the time that it takes, and all that follow are due later by as much.
"""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.run_numbers import Layout, Row
from mpmcli.solver.particles.inflow import RETRY, first_ids
from mpmcli.solver.particles.sort import ACTIVE, BLOCKED, WAITING


@ti.data_oriented
class CpuEmission:
    """The sheets of the emitters of the runs of a batch, w being the number of a run.

    needed: whether there are any emitters.
    """

    def __init__(self, device: Device, layout: Layout, stencils: ti.Field) -> None:
        """Prepare; `stencils` has of each run and axis the first and the last node at which a stencil began."""
        self.stencils, self.separates = stencils, device.contact is not None
        self.device, self.real, self.count = device, layout.real, layout.count
        self.emission = device.emission
        self.needed = device.emission is not None
        # Of each its number, that of its law, and its particles.
        self.emitters = tuple((e, g, device.groups[g]) for e, g in (device.emission.members if self.needed else ()))
        self.numbered = tuple(enumerate(device.groups))

    @ti.func
    def enter(self, orders: ti.template(), w: int, numbers: ti.template(), counts: ti.template()):
        """Let all sheets enter that are due and find room."""
        time, due = numbers[w, self.real.time], numbers[w, self.real.infinity]
        for e, g, group in ti.static(self.emitters):
            going = self.is_left(e, w, numbers, counts)
            while going and numbers[w, self.real.due_of[e]] <= time:
                late = ti.cast(time - numbers[w, self.real.due_of[e]], float)
                period = numbers[w, self.real.period[e]]
                sheet, blocked, layer = counts[w, self.count.entered[e]], 0, 1
                first = w * ti.static(self.device.room[g])
                begin, after = first + counts[w, self.count.particles[g]], first + counts[w, self.count.capacity[g]]
                if sheet % self.emission.ids[w, e][2] == 0:
                    self.look(e, w, sheet, late, counts)
                    blocked = self.emission.count_blocked(e, group, w, sheet, begin, after)
                    layer = self.emission.particles_of(e, w, sheet, self.emission.ids[w, e][2])
                if 2 * blocked >= layer:
                    numbers[w, self.real.due_of[e]] = time + RETRY * period * self.emission.ids[w, e][2]
                    if counts[w, self.count.waits[e]] == 0:
                        counts[w, self.count.waits[e]] = 1
                        counts[w, self.count.blocked] += layer
                else:
                    if blocked > 0:
                        self.emission.keep_out(e, group, w, sheet, begin, after)
                    counts[w, self.count.blocked] += blocked
                    end = self.emission.enter(e, group, w, sheet, late, begin, after)
                    counts[w, self.count.particles[g]] = end - first
                    for p in range(begin, end):
                        self.widen(orders[g], w, p)
                    counts[w, self.count.entered[e]] = sheet + 1
                    counts[w, self.count.waits[e]] = 0
                    numbers[w, self.real.due_of[e]] = numbers[w, self.real.due_of[e]] + period
                going = self.is_left(e, w, numbers, counts)
            if going:
                due = ti.min(due, numbers[w, self.real.due_of[e]])
        numbers[w, self.real.due] = due

    @ti.func
    def widen(self, order: ti.template(), w: int, p: int):
        """Let the box of the next steps hold the stencil of particle p."""
        base = order.first_node_of(p)
        for a in ti.static(range(self.device.grid.dimension)):
            self.stencils[w * 2, a] = ti.min(self.stencils[w * 2, a], base[a])
            self.stencils[w * 2 + 1, a] = ti.max(self.stencils[w * 2 + 1, a], base[a])
        if ti.static(self.separates):
            # What comes in is in layer 0.
            self.device.contact.surfaces.widen(w * ti.static(self.device.grid.layers), base)

    @ti.func
    def is_left(self, e: ti.template(), w: int, numbers: ti.template(), counts: ti.template()):
        """Return whether another sheet enters, at whatever time."""
        before = numbers[w, self.real.due_of[e]] < numbers[w, self.real.until[e]]
        return before and counts[w, self.count.entered[e]] < counts[w, self.count.sheets[e]]

    @ti.func
    def look(self, e: ti.template(), w: int, sheet: int, late: float, counts: ti.template()):
        """Find which cells of the layer that begins with a sheet, which was due `late` s ago, hold a particle."""
        self.emission.clear(e, w)
        for g, group in ti.static(self.numbered):
            first = w * ti.static(self.device.room[g])
            for p in range(first, first + counts[w, self.count.particles[g]]):
                self.emission.mark(e, group, w, sheet, late, p)

    @ti.func
    def count_active(self, w: int, counts: ti.template()):
        """Count the particles that take part after a sort."""
        if ti.static(self.device.comes_and_goes):
            for g in ti.static(range(len(self.numbered))):
                after = w * ti.static(self.device.orders[g].bins + 1) + ti.static(self.device.orders[g].tiles)
                counts[w, self.count.particles[g]] = self.device.orders[g].start[after] - w * ti.static(
                    self.device.room[g]
                )


@ti.data_oriented
class GpuEmission:
    """The sheets of the emitters of the runs of a batch on a GPU; a sort follows each of them.

    Attributes:
        counts: (runs, counts) int, those of `Batch` on the device.
        enters: (runs) int, whether the next sheet of an emitter enters; sheet: its number; late: s since it was due.
        blocked: (runs) int, particles of its layer that find no room; layer: particles of that.
    """

    def __init__(self, device: Device, layout: Layout, counts: ti.Field) -> None:
        self.device, self.emission, self.counts, self.runs = device, device.emission, counts, device.runs
        self.real, self.count, self.room = layout.real, layout.count, tuple(device.room)
        self.members = tuple(enumerate(device.groups))
        self.enters, self.sheet, self.blocked, self.layer = (ti.field(int, shape=self.runs) for _ in range(4))
        self.late = ti.field(float, shape=self.runs)

    def enter(self, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Let the sheets enter that are due in these runs."""
        due = going & (numbers[:, self.real.due] <= numbers[:, self.real.time])
        while due.any():
            for e, _ in self.emission.members:
                self._enter_one(e, numbers, counts, due)
            numbers[due, self.real.drift] = np.inf
            for w in np.flatnonzero(due):
                left = [numbers[w, k] for e, k in enumerate(self.real.due_of) if self._is_left(e, w, numbers, counts)]
                numbers[w, self.real.due] = min(left, default=np.inf)
            due &= numbers[:, self.real.due] <= numbers[:, self.real.time]

    def _is_left(self, e: int, w: int, numbers: np.ndarray, counts: np.ndarray) -> bool:
        """Return whether another sheet of an emitter enters, at whatever time."""
        before = numbers[w, self.real.due_of[e]] < numbers[w, self.real.until[e]]
        return bool(before and counts[w, self.count.entered[e]] < counts[w, self.count.sheets[e]])

    def _enter_one(self, e: int, numbers: np.ndarray, counts: np.ndarray, due: np.ndarray) -> None:
        """Let one sheet of an emitter enter in each of these runs where it is due and finds room."""
        time, due_of = numbers[:, self.real.time], numbers[:, self.real.due_of[e]]
        asked = due & (due_of <= time) & [self._is_left(e, w, numbers, counts) for w in range(self.runs)]
        if not asked.any():
            return
        period, sheet, per_layer = (
            numbers[:, self.real.period[e]],
            counts[:, self.count.entered[e]].copy(),
            self.emission.ids.to_numpy()[:, e, 2],
        )
        self.late.from_numpy(np.where(asked, time - due_of, 0.0).astype(self.device.groups[0].real))
        self.enters.from_numpy(asked.astype(np.int32))
        self.sheet.from_numpy(sheet)
        blocked, waits = np.zeros_like(sheet), np.zeros_like(asked)
        if (asked & (sheet % per_layer == 0)).any():
            self.find_blocked(e)
            blocked, layer = self.blocked.to_numpy(), self.layer.to_numpy()
            waits = asked & (2 * blocked >= layer)
            first_wait = waits & (counts[:, self.count.waits[e]] == 0)
            counts[first_wait, self.count.blocked] += layer[first_wait]
        enters = asked & ~waits
        counts[waits, self.count.waits[e]] = 1
        numbers[waits, self.real.due_of[e]] = (time + RETRY * period * per_layer)[waits]
        counts[enters, self.count.blocked] += blocked[enters]
        counts[enters, self.count.entered[e]] += 1
        counts[enters, self.count.waits[e]] = 0
        numbers[enters, self.real.due_of[e]] += period[enters]
        self.enters.from_numpy(enters.astype(np.int32))
        self.let_enter(e)

    @ti.kernel
    def find_blocked(self, e: ti.template()):
        """Find how many particles of the layer that an emitter begins find no room, and how many it has."""
        source = ti.static(self.emission.members[e][1])
        for w in range(self.runs):
            self.emission.clear(e, w)
            self.blocked[w], self.layer[w] = 0, 1
            if self.looks(e, w):
                self.layer[w] = self.emission.particles_of(e, w, self.sheet[w], self.emission.ids[w, e][2])
        for g, group in ti.static(self.members):
            for p in range(self.runs * self.room[g]):
                w = p // self.room[g]
                if self.looks(e, w) and self.is_one(g, w, p) and group.activity[p] == ACTIVE:
                    self.emission.mark(e, group, w, self.sheet[w], self.late[w], p)
        for p in range(self.runs * self.room[source]):
            w = p // self.room[source]
            if self.looks(e, w) and self.is_one(source, w, p):
                self.blocked[w] += ti.cast(
                    self.emission.keeps_out(e, self.device.groups[source], w, p, self.sheet[w]), int
                )

    @ti.func
    def looks(self, e: ti.template(), w: int):
        """Return whether the next sheet of an emitter may enter, and begins a layer."""
        return self.enters[w] == 1 and self.sheet[w] % self.emission.ids[w, e][2] == 0

    @ti.func
    def is_one(self, g: ti.template(), w: int, p: int):
        """Return whether a run has a particle at place p of a group."""
        return p - w * self.room[g] < self.counts[w, self.count.capacity[g]]

    @ti.kernel
    def let_enter(self, e: ti.template()):
        """Let what has room of the next sheet of an emitter take part, and keep out what has none of its layer."""
        g = ti.static(self.emission.members[e][1])
        (group,) = ti.static((self.device.groups[g],))
        for p in range(self.runs * self.room[g]):
            w = p // self.room[g]
            if self.enters[w] == 1 and self.is_one(g, w, p):
                if self.looks(e, w) and self.emission.keeps_out(e, group, w, p, self.sheet[w]):
                    group.activity[p] = BLOCKED
                elif group.activity[p] == WAITING and self.emission.is_due(e, group, w, p, self.sheet[w], 1):
                    self.emission.begin(e, group, w, p, self.late[w])


def begin_emission(batch: object, slot: int, scene: Scene, particles: Sequence[int]) -> None:
    """Store the mouths of the emitters of a run, and when their sheets enter.

    batch: the `Batch`; slot: place of the run in it; particles: number of them, of each source.
    """
    numbers, counts, real, count = batch.numbers[slot], batch.counts[slot], batch.layout.real, batch.layout.count
    row = Row(batch.layout, numbers, counts)
    row.set(due=math.inf, slowest=max((highest_speed(emitter) for emitter in scene.emitters), default=0.0))
    row.set_counts(blocked=0)
    if batch.device.emission is None:
        return
    found = batch.device.emission.write(scene, first_ids(scene, particles), slot)
    for e, (sheets, emitter) in enumerate(zip(found, scene.emitters, strict=True)):
        # A sheet enters at the first step after it was due; none is due from `until` on.
        numbers[real.due_of[e]], numbers[real.period[e]] = sheets.start, sheets.period
        numbers[real.until[e]] = min(scene.time.end, math.inf if emitter.end is None else emitter.end)
        counts[count.entered[e]] = counts[count.waits[e]] = 0
        counts[count.sheets[e]] = sheets.count
        if sheets.count and sheets.start < numbers[real.until[e]]:
            row.set(due=min(row.number("due"), sheets.start))
