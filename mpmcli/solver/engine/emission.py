"""What the kernel of a batch does for particles that come and go, on the thread that leads a run.

A sheet enters at the first step after it was due; the next one is due a period after it was. Particles whose cell of
the lattice is occupied stay out. Where these are half of the sheet or more, it tries again after a share of the period,
and all that follow are due later by as much. `GpuLaunch` does the same.
"""

import math
from collections.abc import Sequence

from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.run_numbers import Layout, Row
from mpmcli.solver.particles.inflow import RETRY, first_ids


@ti.data_oriented
class CpuEmission:
    """The sheets of the emitters of the runs of a batch, w being the number of a run.

    needed: whether there are any emitters.
    """

    def __init__(self, device: Device, layout: Layout, stencils: ti.Field) -> None:
        """Prepare; `stencils` has of each run and axis the first and the last node at which a stencil began."""
        self.stencils = stencils
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
                self.look(e, w, late, counts)
                blocked, size = self.emission.occupied(e, w), self.emission.ids[w, e][1]
                if 2 * blocked >= size:
                    numbers[w, self.real.due_of[e]] = time + RETRY * period
                    if counts[w, self.count.waits[e]] == 0:
                        counts[w, self.count.waits[e]] = 1
                        counts[w, self.count.blocked] += size
                else:
                    counts[w, self.count.blocked] += blocked
                    sheet = counts[w, self.count.entered[e]]
                    first = w * ti.static(self.device.room[g])
                    begin, after = first + counts[w, self.count.particles[g]], first + counts[w, self.count.capacity[g]]
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

    @ti.func
    def is_left(self, e: ti.template(), w: int, numbers: ti.template(), counts: ti.template()):
        """Return whether another sheet enters, at whatever time."""
        before = numbers[w, self.real.due_of[e]] < numbers[w, self.real.until[e]]
        return before and counts[w, self.count.entered[e]] < counts[w, self.count.sheets[e]]

    @ti.func
    def look(self, e: ti.template(), w: int, late: float, counts: ti.template()):
        """Find which cells of a sheet that was due `late` s ago hold a particle."""
        self.emission.clear(e, w)
        for g, group in ti.static(self.numbered):
            first = w * ti.static(self.device.room[g])
            for p in range(first, first + counts[w, self.count.particles[g]]):
                self.emission.mark(e, w, late, group.x[p])

    @ti.func
    def count_active(self, w: int, counts: ti.template()):
        """Count the particles that take part after a sort."""
        if ti.static(self.device.comes_and_goes):
            for g in ti.static(range(len(self.numbered))):
                after = w * ti.static(self.device.orders[g].bins + 1) + ti.static(self.device.orders[g].tiles)
                counts[w, self.count.particles[g]] = self.device.orders[g].start[after] - w * ti.static(
                    self.device.room[g]
                )


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
