"""Carries out steps on a GPU: a launch takes several steps of all runs, with a thread for each particle or node.

Each run takes steps of its own size, and rests where the host has to attend to it: to sort its particles, to let sheets
of emitters enter, or for what its status says. Where the device has no double precision, the host counts the time and
chooses the steps, with the same functions (`step_size.StepSize`), and a launch takes one step.
"""

from collections.abc import Callable

import numpy as np

from mpmcli.boundaries.doubles import double_field
from mpmcli.quick_taichi import ti
from mpmcli.solver.drive.forces import HostValues
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.emission import GpuEmission
from mpmcli.solver.engine.gpu_phases import KICK, PULL, RELAXED, STABLE, STEP, GpuPhases
from mpmcli.solver.engine.phases import Phase, sorted_fields
from mpmcli.solver.engine.run_numbers import ATTEND, GOING, MEASURE, Layout
from mpmcli.solver.engine.step_size import StepSize
from mpmcli.solver.frames.columns import FrameColumns
from mpmcli.solver.frames.reader import chosen_columns, show_range
from mpmcli.solver.grid.grid import box_of
from mpmcli.solver.particles.sort import SPAN, keep, take
from mpmcli.solver.particles.state_bounds import NOTHING, deformation_rate, entries, widen_motion, widen_state
from mpmcli.solver.transfer.lanes import LANES
from mpmcli.solver.transfer.particle_update import NOT_LOST
from mpmcli.solver.transfer.redistribution import farthest_shift
from mpmcli.solver.transfer.splines import PAD
from mpmcli.stability.transfer_factors import INTERVAL

# Most steps of a launch, after which the host attends to the runs that need it.
STEPS = 32
# Of a step under way, per run: columns of float64.
DT, SPLITS, DEFORMATION, WIDTH = range(4)
# What phases run over beside particles: nodes in use, nodes on planes of faces, rows of nodes for each collider.
OVER = ("nodes", "planes", "loads")


@ti.data_oriented
class GpuLaunch:
    """The kernels of a batch on a GPU.

    Attributes:
        phases: their bodies, and the numbers of runs that these read; steps: how a step is chosen.
        doubles: whether the device has double precision; shifts: whether some steps shift particles.
        reach: the largest number of items of a run of each kind, see OVER.
    """

    def __init__(self, device: Device, layout: Layout, *, doubles: bool) -> None:
        self.device, self.layout, self.doubles = device, layout, doubles
        self.real, self.count = layout.real, layout.count
        self.dimension, self.runs, groups = device.grid.dimension, device.runs, device.groups
        self.room, self.members = tuple(device.room), tuple(enumerate(groups))
        self.phases, self.shifts = GpuPhases(device, layout), device.grid.fine is not None
        drifts = device.particles.touches or not all(group.total for group in groups)
        values = device.values if doubles else HostValues(device.values)
        shift = farthest_shift(device.grid.fine)
        self.steps = StepSize(layout, groups, values, device.grid.scheme, drifts=drifts, shift=shift)
        self.sorts, self.moved = device.sorts, sorted_fields(groups)
        self.averages, self.moves = any(group.averaged for group in groups), device.motion is not None
        self.loads = device.colliders.loads.rows * device.colliders.loads.room if device.nodes.collides else 0
        runs, widest = self.runs, max(entries(group) for group in groups)
        self.counts = ti.field(ti.i32, shape=(runs, layout.counts))
        self.numbers = double_field(runs, layout.reals) if doubles else None
        self.under_way = double_field(runs, width=WIDTH) if doubles else None
        self.limits, self.stepping, self.begun, self.sorting = (ti.field(int, shape=runs) for _ in range(4))
        self.active = ti.field(int, shape=(runs, len(groups)))
        self.reach = ti.field(int, shape=len(OVER))
        self.maxima = ti.field(float, shape=(runs, len(groups), widest))
        self.stencils = ti.field(int, shape=(2 * runs, self.dimension))
        self.emission = GpuEmission(device, layout, self.counts) if device.emission is not None else None
        self.readers = [self._reader(g) for g in range(len(groups))]

    # A launch.

    def __call__(self, numbers: np.ndarray, counts: np.ndarray) -> None:
        """Advance all runs; `numbers` and `counts` as of `run_numbers`."""
        going = (counts[:, self.count.status] == GOING) & (counts[:, self.count.budget] > 0)
        self._write_domains(numbers)
        if going.any():
            if self.emission is not None:
                self.emission.enter(numbers, counts, going)
            self.counts.from_numpy(counts)
            self._sort_where_due(numbers, counts, going)
            (self._take_steps if self.doubles else self._take_host_step)(numbers, counts, going)
        else:
            self.counts.from_numpy(counts)
        self._measure(numbers, counts)

    def _write_domains(self, numbers: np.ndarray) -> None:
        columns = [self.real.spacing, self.real.inverse_spacing, self.real.gradient_scale, *self.real.extent]
        self.phases.domain.from_numpy(numbers[:, columns].astype(self.device.groups[0].real))

    def _take_steps(self, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Take steps that the device chooses, until a run has to be sorted."""
        self.numbers.from_numpy(numbers)
        room = numbers[going, self.real.drift_allowed] - numbers[going, self.real.drift]
        steps = np.min(room / np.maximum(numbers[going, self.real.courant], 1e-3), initial=STEPS)
        waited = counts[going, self.count.unrelaxed_steps]
        for k in range(max(1, min(STEPS, int(steps), int(counts[going, self.count.budget].max())))):
            if self.shifts and ((waited + k + 1) % INTERVAL == 0).any():
                self.step(True)
            self.step(False)
        numbers[:], counts[:] = self.numbers.to_numpy(), self.counts.to_numpy()

    def _take_host_step(self, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Take a step that the host chooses."""
        own, dimension = np.zeros((self.runs, PULL + self.dimension)), range(self.dimension)
        stepping, taken = np.zeros(self.runs, np.int32), {}
        for w in np.flatnonzero(going).tolist():
            dt, kick, splits, limit, deformation, stable = self.steps.begin(w, numbers, counts)
            if dt > 0:
                taken[w], stepping[w] = (dt, splits, limit, deformation), 1
                own[w, [STEP, KICK, STABLE]] = dt, kick, stable
                own[w, RELAXED] = self.steps.relaxed_in(w, dt, numbers, counts)
                own[w, [PULL + a for a in dimension]] = [kick * numbers[w, self.real.gravity[a]] for a in dimension]
        self.stepping.from_numpy(stepping)
        self.phases.step.from_numpy(own.astype(self.device.groups[0].real))
        if self.shifts and own[:, RELAXED].any():
            self.step(True)
        self.step(False)
        speeds, lost = self.phases.speed_squared.to_numpy(), self.device.particles.lost.to_numpy()
        rates, changes = self.phases.rates.to_numpy(), self.phases.changes.to_numpy()
        for w, (dt, splits, limit, deformation) in taken.items():
            rate = rates[w].astype(np.float64) + changes[w].astype(np.float64) / dt
            numbers[w, list(self.real.rate)] = rate
            sound = (lost.reshape(self.runs, -1)[w] == NOT_LOST).all()
            speed = float(np.sqrt(speeds[w])) if sound else -1.0
            self.steps.end(w, dt, splits, limit, deformation, speed, numbers, counts)

    @ti.kernel
    def step(self, shifts: ti.template()):
        """Take a step of every run that goes on, or begin it and shift particles alone, which few steps do."""
        for w in range(self.runs):
            if ti.static(self.doubles):
                if self.begun[w] == 0:
                    self.begin(w)
                self.begun[w] = ti.cast(shifts, int) * self.stepping[w]
            self.prepare(w)
        for phase, turn in ti.static(self.listed(shifts)):
            if ti.static(phase.over != "particles"):
                kind = ti.static(OVER.index(phase.over))
                for q in range(self.runs * self.reach[kind]):
                    w = q // self.reach[kind]
                    if self.stepping[w] == 1:
                        self.phases.do(phase, turn, w, q % self.reach[kind], self.counts)
            if ti.static(phase.over == "particles"):
                for p in range(self.runs * self.room[phase.group]):
                    w = p // self.room[phase.group]
                    if self.stepping[w] == 1 and self.takes_part(phase.group, w, p):
                        self.phases.do(phase, turn, w, p, self.counts)
        if ti.static(self.doubles and not shifts):
            for w in range(self.runs):
                if self.stepping[w] == 1:
                    self.end(w)

    def listed(self, shifts: bool) -> list[tuple[Phase, int]]:
        """Return the phases that shift particles, or all others, with their turns."""
        own = [phase for phase in self.device.phases if (phase.body is not None) == shifts]
        return [(phase, turn) for phase in own for turn in range(phase.turns)]

    @ti.func
    def takes_part(self, g: ti.template(), w: int, p: int):
        """Return whether a particle of run w takes part; those that do come first."""
        return p - w * ti.static(self.room[g]) < self.counts[w, self.count.particles[g]]

    @ti.func
    def begin(self, w: int):
        """Choose the step of a run that goes on."""
        self.stepping[w] = 0
        rests = self.numbers[w, self.real.drift] >= self.numbers[w, self.real.drift_allowed]
        rests = rests or self.numbers[w, self.real.due] <= self.numbers[w, self.real.time]
        if self.counts[w, self.count.status] == GOING and self.counts[w, self.count.budget] > 0 and not rests:
            dt, kick, splits, limit, deformation, stable = self.steps.begin(w, self.numbers, self.counts)
            if dt > 0:
                self.stepping[w] = 1
                self.under_way[w] = ti.Vector([dt, splits, deformation])
                self.limits[w] = limit
                self.phases.step[w][STEP] = ti.cast(dt, float)
                self.phases.step[w][KICK] = ti.cast(kick, float)
                self.phases.step[w][STABLE] = ti.cast(stable, float)
                relaxed = self.steps.relaxed_in(w, dt, self.numbers, self.counts)
                self.phases.step[w][RELAXED] = ti.cast(relaxed, float)
                for a in ti.static(range(self.dimension)):
                    pull = ti.cast(self.numbers[w, self.real.gravity[a]], float)
                    self.phases.step[w][PULL + a] = self.phases.step[w][KICK] * pull
                if ti.static(self.moves):
                    start = self.numbers[w, self.real.time]
                    self.device.values.set_motions(w, self.device.motion, start, start + dt)
                    self.device.motion.advance(w, dt)

    @ti.func
    def prepare(self, w: int):
        """Begin the step of a run that was chosen."""
        if self.stepping[w] == 1:
            if ti.static(self.device.values.gravity_varies):
                pulled = self.device.gravity.in_step(self.phases.step[w][KICK], w)
                for a in ti.static(range(self.dimension)):
                    self.phases.step[w][PULL + a] = pulled[a]
            if ti.static(self.device.grid.deterministic):
                longest = ti.max(self.phases.step[w][KICK], self.phases.step[w][STABLE])
                self.device.grid.fixed.set_step(w, longest)
            self.phases.speed_squared[w] = 0.0
            for g in ti.static(range(len(self.members))):
                # A law may have no particle yet.
                self.phases.rates[w, g] = 0.0 if ti.static(self.device.comes_and_goes) else NOTHING
                self.phases.changes[w, g] = 0.0

    @ti.func
    def end(self, w: int):
        """Count the step of a run."""
        speed, dt = ti.sqrt(self.phases.speed_squared[w]), self.under_way[w][DT]
        for g in ti.static(range(len(self.members))):
            # What the relaxation of volumes adds to the rate of deformation.
            added = ti.cast(self.phases.changes[w, g], ti.f64) / dt
            self.numbers[w, self.real.rate[g]] = ti.cast(self.phases.rates[w, g], ti.f64) + added
            if self.device.particles.lost[w * ti.static(len(self.members)) + g] != NOT_LOST:
                speed = -1.0
        splits, deformation = self.under_way[w][SPLITS], self.under_way[w][DEFORMATION]
        speed_64 = ti.cast(speed, ti.f64)
        self.steps.end(w, dt, splits, self.limits[w], deformation, speed_64, self.numbers, self.counts)

    # Measurements of the state.

    def _measure(self, numbers: np.ndarray, counts: np.ndarray) -> None:
        """Store the maxima of each group of the runs that wait for them."""
        waiting = np.isin(counts[:, self.count.status], (MEASURE, ATTEND))
        if not waiting.any():
            return
        self.sorting.from_numpy(waiting.astype(np.int32))
        self.find_maxima()
        maxima = self.maxima.to_numpy()
        for w in np.flatnonzero(waiting):
            counts[w, self.count.status] = ATTEND
            for g, group in self.members:
                first = self.real.maxima[g]
                numbers[w, first : first + entries(group)] = maxima[w, g, : entries(group)]

    @ti.kernel
    def find_maxima(self):
        """Find the maxima of each group of the runs that are marked in `sorting`."""
        for w, g, k in self.maxima:
            self.maxima[w, g, k] = NOTHING
        for g, group in ti.static(self.members):
            for p in range(self.runs * self.room[g]):
                w = p // self.room[g]
                if self.sorting[w] == 1 and self.takes_part(g, w, p):
                    own = ti.Vector([NOTHING] * ti.static(entries(group)))
                    v, C = group.motion(p)
                    widen_motion(own, v, deformation_rate(group, C))
                    widen_state(group, own, p)
                    for k in ti.static(range(entries(group))):
                        if own[k] > self.maxima[w, g, k] or own[k] != own[k]:
                            ti.atomic_max(self.maxima[w, g, k], own[k])

    # Sorts.

    def _sort_where_due(self, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Sort the particles of runs in which they have drifted, and find the nodes in use."""
        due = going & (numbers[:, self.real.drift] >= numbers[:, self.real.drift_allowed])
        if not due.any():
            return
        self.sorting.from_numpy(due.astype(np.int32))
        if self.sorts:
            for g in range(len(self.members)):
                self.sort(g)
            if self.device.comes_and_goes:
                counts[np.ix_(due, self.count.particles)] = self.active.to_numpy()[due]
                self.counts.from_numpy(counts)
        self.find_box()
        numbers[due, self.real.drift] = 0.0

    @ti.kernel
    def sort(self, g: ti.template()):
        """Sort the particles of a group by tile, in the runs that are marked."""
        order, buffers = ti.static((self.device.orders[g], self.device.orders[g].buffers))
        bins, spans, room = ti.static((order.bins, order.spans, self.room[g]))
        for q in range(self.runs * bins):
            if self.sorting[q // bins] == 1:
                order.cursor[q, 0] = 0
        for p in range(self.runs * room):
            w = p // room
            if self.is_sorted(g, w, p):
                place = self.phases.bin_of(g, w, p, self.counts)
                buffers.key[w * buffers.room + p - w * room] = place
                ti.atomic_add(order.cursor[w * bins + place, 0], 1)
        for s in range(self.runs * spans):
            total = 0
            for q in range(s % spans * SPAN, ti.min(bins, (s % spans + 1) * SPAN)):
                total += order.cursor[s // spans * bins + q, 0]
            order.span_sum[s] = total
        for w in range(self.runs):
            if self.sorting[w] == 1:
                before = w * room
                for s in range(w * spans, (w + 1) * spans):
                    size = order.span_sum[s]
                    order.span_sum[s] = before
                    before += size
                order.start[w * (bins + 1) + bins] = before
        for s in range(self.runs * spans):
            w = s // spans
            if self.sorting[w] == 1:
                place = order.span_sum[s]
                for q in range(s % spans * SPAN, ti.min(bins, (s % spans + 1) * SPAN)):
                    size = order.cursor[w * bins + q, 0]
                    order.start[w * (bins + 1) + q] = place
                    order.cursor[w * bins + q, 0] = place
                    place += size
        for p in range(self.runs * room):
            w = p // room
            if self.is_sorted(g, w, p):
                own = w * buffers.room - w * room
                place = ti.atomic_add(order.cursor[w * bins + buffers.key[own + p], 0], 1)
                buffers.order[own + place] = p
        for field in ti.static(self.moved[g]):
            for p in range(self.runs * room):
                w = p // room
                if self.is_sorted(g, w, p):
                    keep(buffers, field, w * buffers.room, p - w * room, buffers.order[w * buffers.room + p - w * room])
            for p in range(self.runs * room):
                w = p // room
                if self.is_sorted(g, w, p):
                    take(buffers, field, w * buffers.room, p - w * room, p)
        for w in range(self.runs):
            self.active[w, g] = order.start[w * (bins + 1) + ti.static(order.tiles)] - w * room

    @ti.func
    def is_sorted(self, g: ti.template(), w: int, p: int):
        """Return whether a particle is of a run that is marked."""
        return self.sorting[w] == 1 and p - w * ti.static(self.room[g]) < self.counts[w, self.count.capacity[g]]

    @ti.kernel
    def find_box(self):
        """Find the nodes that runs use until their next sort; all of them where particles are not sorted."""
        for w, a in ti.ndrange(self.runs, self.dimension):
            self.stencils[2 * w, a], self.stencils[2 * w + 1, a] = 2**30, -1
        if ti.static(self.sorts):
            for g, _group in ti.static(self.members):
                for p in range(self.runs * self.room[g]):
                    w = p // self.room[g]
                    if self.sorting[w] == 1 and self.takes_part(g, w, p):
                        base = self.phases.first_node_of(g, w, p, self.counts)
                        for a in ti.static(range(self.dimension)):
                            # The comparisons may be late, and save most atomics.
                            if base[a] < self.stencils[2 * w, a]:
                                ti.atomic_min(self.stencils[2 * w, a], base[a])
                            if base[a] > self.stencils[2 * w + 1, a]:
                                ti.atomic_max(self.stencils[2 * w + 1, a], base[a])
        for w in range(self.runs):
            if self.sorting[w] == 1:
                for a in ti.static(range(self.dimension)):
                    last_wall = PAD + self.counts[w, self.count.cells[a]]
                    first, last = 0, last_wall + PAD
                    if ti.static(self.sorts):
                        low, high = self.stencils[2 * w, a], self.stencils[2 * w + 1, a]
                        if high < 0:
                            # Where none takes part there is a box all the same.
                            low, high = PAD, PAD
                        drift = ti.static(self.device.grid.tile)
                        first, last = box_of(self.device.grid, a, low, high, drift, last_wall)
                    self.device.grid.box[2 * w, a] = first
                    self.device.grid.box[2 * w + 1, a] = last - first + 1
        for k in range(2):
            self.reach[k] = 0
        self.reach[2] = self.loads
        for w in range(self.runs):
            nodes, planes = self.phases.nodes_in_use(w, self.counts)
            ti.atomic_max(self.reach[0], nodes)
            ti.atomic_max(self.reach[1], planes)

    # Frames.

    def begin_frame(self, numbers: np.ndarray, counts: np.ndarray) -> None:
        """Prepare the device for `read`."""
        if self.averages:
            self._write_domains(numbers)
            self.counts.from_numpy(counts)
            self.average_for_frame()

    @ti.kernel
    def average_for_frame(self):
        """Average volumes over cells."""
        for g, group in ti.static(self.members):
            if ti.static(group.averaged):
                for turn in ti.static(range(3)):
                    for p in range(self.runs * self.room[g]):
                        w = p // self.room[g]
                        if self.takes_part(g, w, p):
                            self.phases.average_for_frame(g, w, p, turn, self.counts)

    def _reader(self, g: int) -> Callable[..., None]:
        """Return the kernel that writes what particles of a group show."""
        group = self.device.groups[g]

        @ti.kernel
        def show(
            run: int,
            first: int,
            count: int,
            dt: float,
            affine: int,
            gradient: int,
            tau: int,
            activity: int,
            shown: ti.types.ndarray(ndim=2),
        ):
            for chunk in range((count + LANES - 1) // LANES):
                begin, own = first + chunk * LANES, ti.min(LANES, count - chunk * LANES)
                (seen,) = ti.static((group.seen_from(run),))
                show_range(seen, begin, own, dt, 0, affine, gradient, tau, activity, shown, None, 0)

        return show

    def read(
        self, g: int, run: int, first: int, count: int, dt: float, columns: FrameColumns, shown: np.ndarray
    ) -> None:
        """Write what particles of the g-th group of a run show into the rows of their numbers, (n, columns)."""
        self.readers[g](run, first, count, dt, *chosen_columns(columns), shown)
