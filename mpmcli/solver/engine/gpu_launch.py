"""Carries out steps on a GPU: a launch takes several steps of all runs, with a thread per particle or node.

Each run takes steps of its own size, and pauses when it needs the host: to sort its particles, to let sheets of
emitters enter, or as its status requires. On a device without double precision the host accumulates the time and
chooses the steps, with the same functions (`step_size.StepSize`), and a launch takes one step.

Scatters use atomic additions: in floating point, in arbitrary order, so that results differ in rounding from run to
run, or in fixed point (`fixed_point`), which is reproducible.
"""

import time
from collections.abc import Callable

import numpy as np

from mpmcli.boundaries.doubles import as_double, double_field
from mpmcli.boundaries.feature import Phase, changed
from mpmcli.boundaries.mirror_images import find_friction
from mpmcli.quick_taichi import ti
from mpmcli.solver.drive.forces import HostValues
from mpmcli.solver.engine.device import Device, RunPhases, RunView, Work
from mpmcli.solver.engine.emission import GpuEmission
from mpmcli.solver.engine.run_state import ATTEND, GOING, MEASURE, Layout, RunState
from mpmcli.solver.engine.step_size import SLACK, StepSize
from mpmcli.solver.frames.columns import FrameColumns
from mpmcli.solver.frames.reader import FrameRows, Showing, chosen_columns, turns
from mpmcli.solver.grid.grid import box_of
from mpmcli.solver.machine.backend import launcher
from mpmcli.solver.machine.maxima import Maxima
from mpmcli.solver.particles.loop import one
from mpmcli.solver.particles.sort import SPAN, keep, take
from mpmcli.solver.particles.state_bounds import (
    GPU_WORKERS,
    NOTHING,
    deformation_rate,
    entries,
    widen_motion,
    widen_state,
)
from mpmcli.solver.transfer.cpu_transfers import nodes_of_rows
from mpmcli.solver.transfer.particle_update import NOT_LOST
from mpmcli.solver.transfer.run_sums import (
    WARP,
    RunSums,
    flush,
    in_blocks,
    run_length,
    scatters_runs,
    stored_at,
    thread_count,
)
from mpmcli.solver.transfer.splines import PAD
from mpmcli.solver.transfer.volume import AVERAGE, clear_mean, missing_to_mean
from mpmcli.stability.transfer_factors import INTERVAL

# Numbers of a step that keep the largest value of an operation, see `Phase.most`.
PEAKS = ("rate", "volume_change")


class Item(Work):
    """The item q of a thread: a node, a particle or a row of nodes.

    Attributes:
        atomic: whether sums need atomics; True.
        peaks: extremes of the step, see `GpuPhases`.
    """

    atomic = True

    def __init__(self, view: RunView, phase: Phase, turn: int, q: object, peaks: Maxima) -> None:
        """Store a view and a variable of a kernel."""
        super().__init__(view, phase.group, phase, turn)
        self.q, self.peaks = q, peaks


@ti.data_oriented
class GpuPhases(RunPhases):
    """The phases of the runs of a batch; w is the index of a run and q that of a node, a particle or a row.

    Attributes:
        numbers, counts: the arrays of `Batch` on the device; `numbers` is None without double precision.
        peaks: per run, extremes of the step while threads raise them: of the squared speed of nodes, and per group of
            the rate of deformation and of the change by relaxation.
    """

    def __init__(self, device: Device, layout: Layout, *, doubles: bool) -> None:
        super().__init__(device, layout)
        self.counts = ti.field(ti.i32, shape=(device.runs, layout.widths["counts"]))
        self.numbers = double_field(device.runs, layout.widths["numbers"]) if doubles else None
        self.peaks = Maxima(device.runs, 1 + 2 * len(device.groups))
        self.stencil = device.grid.scheme.spline.nodes**device.grid.dimension

    @ti.func
    def forget_peaks(self, w: int):
        """Reset the extremes of a step of a run."""
        for k in ti.static(range(1 + 2 * len(self.members))):
            self.peaks.reset(w, k, NOTHING)

    @ti.func
    def store_peaks(self, w: int):
        """Store the extremes of a step of a run as numbers of the step."""
        (step,) = ti.static((self.step_of(w),))
        step.speed_squared = ti.max(step.speed_squared, self.peaks.value(w, 0))
        for g in ti.static(range(len(self.members))):
            for k, name in ti.static(enumerate(PEAKS)):
                (kept,) = ti.static((getattr(step, name),))
                kept[g] = ti.max(kept[g], self.peaks.value(w, 1 + k + 2 * g))

    def run(self, w: object) -> RunState:
        """Return the numbers of a run."""
        return self.state(w, self.numbers, self.counts)

    @ti.func
    def do(self, phase: ti.template(), turn: ti.template(), w: int, q: int):
        """Process one item of a run in one turn of a phase."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        (at,) = ti.static((Item(view, phase, turn, q, self.peaks),))
        if ti.static(phase.item):
            ti.static(phase.item)(self, at)
        else:
            ti.static(self.body(phase))(at)

    def body(self, phase: Phase) -> object:
        """Return the method of a phase."""
        if phase.body and phase.over == "particles":
            return self.each_particle
        if phase.body and phase.over == "nodes":
            return self.shift_node if phase.shifts else self.each_node
        return getattr(self, phase.name)

    @ti.func
    def in_layers(self, at: ti.template(), node: ti.template(), do: ti.template()):
        """Call `do` at a node for each layer in which the node is in use."""
        if ti.static(at.grid.layers == 1):
            ti.static(do)(at, node)
        else:
            for layer in range(self.layer_count(at)):
                own = self.used_by(at, layer)
                inside = True
                for a in ti.static(range(self.dimension)):
                    inside = inside and node[a] >= own[0, a] and node[a] < own[0, a] + own[1, a]
                if inside:
                    (inner,) = ti.static((at.in_layer(layer, own),))
                    ti.static(do)(inner, node)

    @ti.func
    def each_node(self, at: ti.template()):
        """Apply the function of a phase to a node of all layers."""
        if at.q < at.grid.box_nodes():
            self.in_layers(at, at.grid.box_node(at.q), self.do_item)

    @ti.func
    def each_row(self, at: ti.template()):
        """Apply the function of a phase to the nodes of a row."""
        if at.q < at.grid.row_count():
            nodes_of_rows(at, at.q, at.q + 1, at.step.kick)

    @ti.func
    def do_item(self, at: ti.template(), node: ti.template()):
        """Apply the function of a phase to a node of a layer."""
        ti.static(at.phase.body)(at, node, at.step.kick)

    @ti.func
    def shift_node(self, at: ti.template()):
        """Apply the function of a phase to a node in steps that shift particles."""
        if at.step.relaxed > 0.0 and at.q < at.grid.box_nodes():
            ti.static(at.phase.body)(at, at.grid.box_node(at.q), at.step.relaxed)

    @ti.func
    def each_particle(self, at: ti.template()):
        """Apply the function of a phase to a particle."""
        if self.takes_place(at):
            gravity_step = self.gravity_of(at.step)
            (inner,) = ti.static((changed(at, gravity_step=gravity_step),))
            found = one(inner, at.phase.body, at.q, self.time_of(at))
            if ti.static(len(at.phase.most) > 0):
                self.peaks.include(at.w, ti.static(1 + PEAKS.index(at.phase.most)) + 2 * at.g, found)

    @ti.func
    def clear(self, at: ti.template()):
        """Clear a node of all layers."""
        if at.q < at.grid.box_nodes():
            node = at.grid.box_node(at.q)
            self.in_layers(at, node, self.clear_node)
            if ti.static(self.separates):
                place = self.device.features.surfaces.index_in_batch(at.grid, at.w, at.grid.linear_index(node))
                self.device.features.surfaces.clear(place)

    @ti.func
    def clear_node(self, at: ti.template(), node: ti.template()):
        """Clear a node of a layer."""
        at.grid.clear(at.grid.linear_index(node))

    @ti.func
    def scatter_run(self, phase: ti.template(), w: int, thread: int, length: ti.template()):
        """Scatter the particles of a thread of a run, see `run_sums`."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        sums, stencil = ti.Matrix.zero(float, ti.static(self.stencil), ti.static(self.device.grid.width)), -1
        (own,) = ti.static((RunSums(self.device.grid, sums, stencil),))
        p = thread // WARP * (WARP * length) + thread % WARP
        for _ in range(length):
            if p < run.particles[phase.group]:
                place = w * ti.static(self.device.capacity[phase.group]) + p
                (at,) = ti.static((changed(Item(view, phase, 0, place, self.peaks), sums=own),))
                one(at, phase.body, place, at.step.kick)
            p += WARP
        flush(own)

    @ti.func
    def to_float(self, at: ti.template()):
        """Convert the sums of a node from fixed point."""
        if at.q < at.grid.box_nodes():
            at.grid.fixed.to_float(at.grid, at.grid.linear_index(at.grid.box_node(at.q)), at.step.relaxed)

    @ti.func
    def relaxes(self, w: int):
        """Return whether the step of a run relaxes volumes."""
        (step,) = ti.static((self.step_of(w),))
        return step.relaxed > 0.0

    @ti.func
    def find_contact(self, at: ti.template()):
        """Find whether material presses on a separating wall at a node."""
        if at.q < at.nodes.images.plane_nodes(at.grid):
            at.nodes.images.find_contact(at.grid, at.q, self.gravity_of(at.step))

    @ti.func
    def find_friction(self, at: ti.template()):
        """Find the friction of a wall at a node, for all layers."""
        for layer in range(self.layer_count(at)):
            own = self.used_by(at, layer)
            (inner,) = ti.static((at.in_layer(layer, own),))
            (grid,) = ti.static((inner.grid.within(own),))
            if at.q < inner.nodes.images.plane_nodes(grid):
                find_friction(inner.nodes.images, grid, at.q, self.gravity_of(at.step))

    @ti.func
    def update(self, at: ti.template()):
        """Convert the momentum of a node to velocity in all layers."""
        if at.q < at.grid.box_nodes():
            self.in_layers(at, at.grid.box_node(at.q), self.update_node)

    @ti.func
    def update_node(self, at: ti.template(), node: ti.template()):
        """Convert the momentum of a node of a layer to velocity."""
        squared = at.nodes.update(node, at.grid.linear_index(node), self.gravity_of(at.step))
        self.peaks.include(at.w, 0, squared)

    @ti.func
    def add_loads(self, at: ti.template()):
        """Sum the loads of the nodes of a row on a collider, in order."""
        at.nodes.colliders.add_row(at.q)
        if ti.static(at.nodes.touches):
            at.features.points.add_row(at.grid, at.q)

    # Work outside of steps.

    @ti.func
    def average_for_frame(self, g: ti.template(), w: int, p: int, turn: ti.template()):
        """Average volumes before a frame: clear the cell of a particle (turn 0), add it (1), or take the mean (2)."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        if ti.static(turn == 0):
            clear_mean(view.grid, g, view.groups[g], p)
        if ti.static(turn == 1):
            (at,) = ti.static((Item(view, Phase("average", "particles", "scatter", g), 0, p, self.peaks),))
            one(at, AVERAGE, p, 0.0)
        if ti.static(turn == 2):
            view.groups[g].to_mean[p] = missing_to_mean(view.grid, g, view.groups[g], p)

    @ti.func
    def bin_of(self, g: ti.template(), w: int, p: int):
        """Wrap a particle into a periodic domain and return its bin."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        view.orders[g].wrap(p)
        return view.orders[g].bin_of(p)

    @ti.func
    def first_node_of(self, g: ti.template(), w: int, p: int):
        """Return the first node of the stencil of a particle."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        return view.orders[g].first_node_of(p)

    @ti.func
    def nodes_in_use(self, w: int):
        """Return the numbers of nodes in use, of nodes in use on the planes of faces, and of rows."""
        (run,) = ti.static((self.run(w),))
        (view,) = ti.static(self.see(run))
        planes = 0
        if ti.static(self.device.nodes.needs_contact or self.device.nodes.needs_friction):
            planes = view.nodes.images.plane_nodes(view.grid)
        return view.grid.box_nodes(), planes, view.grid.row_count()


# Largest number of steps of a launch, after which the host handles the runs that need it; at most twice as many as the
# last one took before it waited for the host. It takes as long as some steps of a small scene to exchange the numbers.
STEPS = 128
# Distance, cells, that the fastest particle moves before particles are sorted again, if there are MANY, for the sake of
# `run_sums`: with fewer a sort takes longer than the atomics that it saves.
AGED, MANY = 0.3, 2**19
# Launches of a step: the shift of particles, in few steps; all other phases, or if one has rounds those before it; a
# round of this one. Each turn of a later phase is a launch of its own, because drivers may take minutes to compile
# these phases together with others.
SHIFT, FIRST, ROUND = range(3)
# Most threads of loops whose number of items only the device knows, and nodes of a thread in a small domain: on CUDA to
# fill a large GPU, and elsewhere because software Vulkan takes half a microsecond for each thread.
WORKERS, FEW_WORKERS = (2**17, 1), (2**13, 16)
# Items of phases other than particles, see `Phase`.
OVER = ("nodes", "planes", "rows", "loads", "runs")


@ti.data_oriented
class GpuLaunch:
    """The kernels of a batch on a GPU.

    Attributes:
        phases: bodies of the phases, and the numbers of runs that they read.
        steps: choice of steps.
        parts: phases of each launch of a step, with their turns, apart from `clear` and `relaxing`.
        clear: the first phase, which runs while steps begin.
        relaxing: phases that run while walls find what presses on them.
        by_runs: whether a thread scatters several particles, see `run_sums`.
        doubles: whether the device has double precision.
        shifts: whether some steps shift particles.
        reach: largest number of items per run of each kind, see OVER.
        compile_seconds: wall time of the first call of each kernel of a step, which compiles it, s.
    """

    def __init__(self, device: Device, layout: Layout, *, doubles: bool) -> None:
        """Divide the phases of a step among launches; kernels are compiled when they are called."""
        self.device, self.layout, self.doubles = device, layout, doubles
        self.dimension, self.runs, groups = device.grid.dimension, device.runs, device.groups
        self.capacity, self.members = tuple(device.capacity), tuple(enumerate(groups))
        self.phases = GpuPhases(device, layout, doubles=doubles)
        self.shifts = any(phase.shifts for phase in device.phases)
        self.parts = self._parts()
        on_cuda = ti.lang.impl.current_cfg().arch == ti.cuda
        threads, nodes = WORKERS if on_cuda else FEW_WORKERS
        self.step_threads = in_blocks(min(threads, self.runs * device.grid.node_count // nodes))
        self.turn_threads = in_blocks(self.runs + self.step_threads)
        self.clear = self.parts[FIRST].pop(0)[0]
        phases = [phase for phase, _ in self.parts[FIRST]]
        pressed = any(phase.name == "find_contact" for phase in phases)
        self.relaxing = [phase for phase in phases if phase.name == "relax" and pressed]
        self.parts[FIRST] = [one for one in self.parts[FIRST] if one[0] not in self.relaxing]
        self.steps = StepSize.of(device, layout, device.values if doubles else HostValues(device.values))
        self.sorts, self.moved = device.sorts, tuple(group.moved for group in groups)
        self.by_runs = device.sorts and scatters_runs(device.grid)
        self.averages = any(group.uses_f_bar for group in groups)
        loads = device.features.colliders and device.features.colliders.loads
        self.loads = loads.rows * loads.capacity if loads else 0
        runs, self.widest = self.runs, max(entries(group) for group in groups)
        self.workers = max(1, GPU_WORKERS // runs)
        self.counts, self.numbers = self.phases.counts, self.phases.numbers
        self.stepping, self.begun, self.sorting = (ti.field(int, shape=runs) for _ in range(3))
        self.active = ti.field(int, shape=(runs, len(groups)))
        self.reach = ti.field(int, shape=len(OVER))
        self.maxima = Maxima(runs, len(groups) * self.widest)
        self.stencils = ti.field(int, shape=(2 * runs, self.dimension))
        self.emission = GpuEmission(device, layout, self.counts) if device.features.emission else None
        self.readers = [self._reader(g) for g in range(len(groups))]
        self.compile_seconds = 0.0
        self._launches: dict[tuple, Callable[[], None]] = {}
        self._most_steps = STEPS // 4
        self._domains_written: np.ndarray | None = None
        # Distance, cells, that the fastest particle has moved since particles were sorted.
        self._age = 0.0
        self._sorts_again = self.by_runs and sum(self.capacity) * runs >= MANY and not self.device.particle_count_varies

    # A launch.

    def __call__(self, numbers: np.ndarray, counts: np.ndarray) -> None:
        """Advance all runs; `numbers` and `counts` are those of `Batch`."""
        runs = self.phases.state(slice(None), numbers, counts)
        going = (runs.status == GOING) & (runs.budget > 0)
        self._write_domains(runs)
        if going.any():
            if self.emission is not None:
                self.emission.enter(runs, going)
            self.counts.from_numpy(counts)
            self._sort_where_due(runs, counts, going)
            (self._take_steps if self.doubles else self._take_host_step)(runs, numbers, counts, going)
        else:
            self.counts.from_numpy(counts)
        self._measure(runs)

    def _write_domains(self, runs: RunState) -> None:
        """Write the values of the domains to the numbers of steps if they have changed."""
        values = self._domains(runs)
        if not np.array_equal(values, self._domains_written):
            self.phases.values.from_numpy(values)
            self._domains_written = values

    def _domains(self, runs: RunState) -> np.ndarray:
        """Return the numbers of steps (see STEP) with the values of the domains set."""
        values = np.zeros((self.runs, self.layout.widths["step"]), self.device.groups[0].real)
        steps = self.phases.step_on_host(values)
        steps.spacing, steps.inverse_spacing = runs.spacing, runs.inverse_spacing
        steps.gradient_scale, steps.extent = runs.gradient_scale, np.stack(list(runs.extent), axis=1)
        return values

    def _take_steps(self, runs: RunState, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Take steps chosen by the device until a run must be sorted."""
        self.numbers.from_numpy(numbers)
        waited, before = runs.unrelaxed_steps[going].copy(), runs.step_count[going].copy()
        if self._sorts_again:
            self.sorting.from_numpy(going.astype(np.int32))
        for k in range(self._steps_ahead(runs, going)):
            if self._sorts_again and self._age >= AGED:
                self._sort()
            self._age += float(runs.courant[going].max())
            self._take_step(shifts=self.shifts and ((waited + k + 1) % INTERVAL == 0).any())
        self._call(self.finish)
        numbers[:], counts[:] = self.numbers.to_numpy(), self.counts.to_numpy()
        self._most_steps = min(STEPS, 2 * max(1, int((runs.step_count[going] - before).max())))

    def _steps_ahead(self, runs: RunState, going: np.ndarray) -> int:
        """Return the number of steps until the host visits the runs again."""
        room = self.device.drift_allowed - runs.drift[going]
        steps = np.min(room / np.maximum(runs.courant[going], 1e-3), initial=self._most_steps)
        # Steps of runs that have arrived, or wait for the host, would do nothing.
        pace = np.where(runs.given > 0, runs.given, runs.last_step)[going]
        left = (np.minimum(runs.target, runs.due) - runs.time)[going] / np.maximum(pace, 1e-30)
        left = np.ceil(np.max(np.minimum(left, STEPS)) - SLACK)
        return max(1, int(min(steps, left, runs.budget[going].max())))

    def _take_host_step(self, runs: RunState, numbers: np.ndarray, counts: np.ndarray, going: np.ndarray) -> None:
        """Take a step chosen by the host."""
        stepping, values = np.zeros(self.runs, np.int32), self._domains(runs)
        steps = self.phases.step_on_host(values)
        for w in np.flatnonzero(going).tolist():
            stepping[w] = self.steps.begin(self.phases.state(w, numbers, counts))
        steps.dt, steps.kick, steps.relaxed, steps.stable = runs.dt, runs.kick, runs.relaxed, runs.stable
        steps.gravity = np.stack([runs.kick * gravity for gravity in runs.gravity], axis=1)
        self.stepping.from_numpy(stepping)
        self.phases.values.from_numpy(values)
        self._take_step(shifts=self.shifts and (runs.relaxed[stepping == 1] > 0).any())
        self._call(self.finish)
        steps = self.phases.step_on_host(self.phases.values.to_numpy())
        lost = self.device.particles.lost.to_numpy().reshape(self.runs, -1)
        for w in np.flatnonzero(stepping).tolist():
            run = self.phases.state(w, numbers, counts)
            for g, (rate, change) in enumerate(zip(steps.rate, steps.volume_change, strict=True)):
                run.rate[g] = float(rate[w]) + float(change[w]) / run.dt
            sound = (lost[w] == NOT_LOST).all() and steps.broken[w] == 0
            self.steps.end(run, float(np.sqrt(steps.speed_squared[w])) if sound else -1.0)

    def _take_step(self, *, shifts: bool) -> None:
        """Take a step of every advancing run, launch by launch; few steps shift particles first."""
        if shifts:
            self._call(self.step, SHIFT)
        self._call(self.step, FIRST)
        for part in range(ROUND, len(self.parts)):
            for _ in range(self.parts[part][0][0].rounds):
                self._call(self.step, part)

    def _call(self, kernel: Callable, *arguments: int) -> None:
        """Call a kernel, and measure its first call with these arguments."""
        name = (kernel.__name__, *arguments)
        if name in self._launches:
            self._launches[name]()
        else:
            began = time.perf_counter()
            kernel(*arguments)
            self._launches[name] = launcher(kernel, *arguments)
            self.compile_seconds += time.perf_counter() - began

    def _parts(self) -> list[list[tuple[Phase, int]]]:
        """Return the phases of each launch of a step, with their turns."""
        parts: list[list[tuple[Phase, int]]] = [[], []]
        for phase in self.device.phases:
            turns = [(phase, turn) for turn in range(phase.turns)]
            if phase.shifts:
                parts[SHIFT] += turns
            elif phase.rounds > 1:
                parts.append(turns)
            elif len(parts) == ROUND:
                parts[FIRST] += turns
            else:
                parts += [[one] for one in turns]
        return parts

    @ti.kernel
    def step(self, part: ti.template()):
        """Carry out one launch of a step of all advancing runs; the first begins the step."""
        if ti.static(part in (SHIFT, FIRST)):
            for t in range(ti.static(self.turn_threads if part == FIRST else self.runs)):
                # Few threads update the numbers of runs while others clear the nodes, also those of runs at rest.
                if t < self.runs:
                    self.turn(t, part)
                elif ti.static(part == FIRST):
                    q = t - self.runs
                    while q < self.runs * self.reach[0]:
                        self.phases.do(self.clear, 0, q // self.reach[0], q % self.reach[0])
                        q += ti.static(self.turn_threads - self.runs)
        for phase, turn in ti.static(self.parts[part]):
            if ti.static(phase.over != "particles" or phase.relaxes):
                # A loop over all items would need a kernel that computes their number.
                for t in range(self.step_threads):
                    if ti.static(phase.name == "find_contact"):
                        for beside in ti.static(self.relaxing):
                            self.each_of(beside, 0, t)
                    self.each_of(phase, turn, t)
            elif ti.static(phase.name == "scatter" and self.by_runs):
                threads = ti.static(thread_count(self.capacity[phase.group]))
                for q in range(self.runs * threads):
                    w = q // threads
                    if self.stepping[w] == 1:
                        length = ti.static(run_length(self.capacity[phase.group]))
                        self.phases.scatter_run(phase, w, q % threads, length)
            elif ti.static(phase.over == "particles"):
                for p in range(self.runs * self.capacity[phase.group]):
                    w = p // self.capacity[phase.group]
                    if self.stepping[w] == 1 and self.takes_part(phase.group, w, p):
                        self.phases.do(phase, turn, w, p)

    @ti.kernel
    def finish(self):
        """Finish the last step of a launch."""
        for w in range(self.runs):
            if self.stepping[w] == 1:
                self.end(w)
            self.stepping[w] = 0

    @ti.func
    def each_of(self, phase: ti.template(), turn: ti.template(), t: int):
        """Carry out the share of thread t in one turn of a phase."""
        q = t
        if ti.static(phase.over == "particles"):
            for w in range(self.runs):
                (run,) = ti.static((self.phases.run(w),))
                if self.stepping[w] == 1 and self.phases.relaxes(w):
                    q = t
                    while q < run.particles[phase.group]:
                        self.phases.do(phase, turn, w, w * ti.static(self.capacity[phase.group]) + q)
                        q += self.step_threads
        else:
            kind = ti.static(OVER.index(phase.over))
            while q < self.runs * self.reach[kind]:
                w = q // self.reach[kind]
                if self.stepping[w] == 1:
                    self.phases.do(phase, turn, w, q % self.reach[kind])
                q += self.step_threads

    @ti.func
    def turn(self, w: int, part: ti.template()):
        """Finish the previous step of a run in this launch, if any, and begin the next."""
        if ti.static(self.doubles):
            if self.begun[w] == 0:
                if self.stepping[w] == 1:
                    self.end(w)
                self.begin(w)
            self.begun[w] = ti.static(int(part == SHIFT)) * self.stepping[w]
        self.prepare(w)

    @ti.func
    def takes_part(self, g: ti.template(), w: int, p: int):
        """Return whether particle p of run w is active; active particles precede all others."""
        (run,) = ti.static((self.phases.run(w),))
        return p - w * ti.static(self.capacity[g]) < run.particles[g]

    @ti.func
    def begin(self, w: int):
        """Choose the step of an advancing run."""
        self.stepping[w] = 0
        (run,) = ti.static((self.phases.run(w),))
        rests = run.drift >= as_double(self.device.drift_allowed) or run.due <= run.time
        if run.status == GOING and run.budget > 0 and not rests:
            if self.steps.begin(run):
                self.stepping[w] = 1
                self.phases.begin_step(run)

    @ti.func
    def prepare(self, w: int):
        """Begin the chosen step of a run, which the host chooses without double precision."""
        (step,) = ti.static((self.phases.step_of(w),))
        if self.stepping[w] == 1:
            if ti.static(self.device.values.gravity_varies and not self.doubles):
                pulled = self.device.gravity.in_step(step.kick, w)
                for a in ti.static(range(self.dimension)):
                    step.gravity[a] = pulled[a]
            if ti.static(self.device.grid.deterministic):
                self.device.grid.fixed.set_step(w, ti.max(step.kick, step.stable))
            self.phases.forget_extremes(step, w)
            self.phases.forget_peaks(w)

    @ti.func
    def end(self, w: int):
        """Finish the step of a run, whose time the host updates without double precision."""
        self.phases.store_peaks(w)
        if ti.static(self.doubles):
            (run,) = ti.static((self.phases.run(w),))
            self.steps.end(run, self.phases.end_step(run))

    # Measurements of the state.

    def _measure(self, runs: RunState) -> None:
        """Store the maxima of each group of the runs that require a measurement."""
        waiting = np.isin(runs.status, (MEASURE, ATTEND))
        if not waiting.any():
            return
        self.sorting.from_numpy(waiting.astype(np.int32))
        self.find_maxima()
        maxima = self.maxima.to_numpy()
        runs.status[waiting] = ATTEND
        for g, group in self.members:
            for k in range(entries(group)):
                runs.maxima[g][k][waiting] = maxima[waiting, g * self.widest + k]

    @ti.kernel
    def find_maxima(self):
        """Find the maxima of each group of the runs that are marked in `sorting`."""
        for w in range(self.runs):
            for k in ti.static(range(len(self.members) * self.widest)):
                self.maxima.reset(w, k, NOTHING)
        for g, group in ti.static(self.members):
            for q in range(self.runs * self.workers):
                w, p = q // self.workers, q % self.workers
                (run,) = ti.static((self.phases.run(w),))
                if self.sorting[w] == 1 and p < run.particles[g]:
                    own = ti.Vector([NOTHING] * ti.static(entries(group)))
                    while p < run.particles[g]:
                        at = w * ti.static(self.capacity[g]) + p
                        v, C = group.motion(at)
                        widen_motion(own, v, deformation_rate(group, C))
                        widen_state(group, own, at)
                        p += self.workers
                    for k in ti.static(range(entries(group))):
                        self.maxima.include(w, g * self.widest + k, own[k])

    # Sorts.

    def _sort_where_due(self, runs: RunState, counts: np.ndarray, going: np.ndarray) -> None:
        """Sort the particles of runs with too much drift, and find the nodes in use."""
        due = going & (runs.drift >= self.device.drift_allowed)
        if not due.any():
            return
        self.sorting.from_numpy(due.astype(np.int32))
        if self.sorts:
            self._sort()
            if self.device.particle_count_varies:
                active = self.active.to_numpy()
                for g in range(len(self.members)):
                    runs.particles[g][due] = active[due, g]
                self.counts.from_numpy(counts)
        self._call(self.find_box)
        runs.drift[due] = 0.0
        self.counts.from_numpy(counts)

    def _sort(self) -> None:
        """Sort the particles of the runs that are marked in `sorting`."""
        for g in range(len(self.members)):
            self._call(self.sort, g)
        self._age = 0.0

    @ti.kernel
    def sort(self, g: ti.template()):
        """Sort the particles of a group by tile, in the runs that are marked."""
        order, buffers = ti.static((self.device.orders[g], self.device.orders[g].buffers))
        bins, spans, blocks, room = ti.static((order.bins, order.spans, order.blocks, self.capacity[g]))
        for q in range(self.runs * bins):
            if self.sorting[q // bins] == 1:
                order.cursor[q, 0] = 0
        for p in range(self.runs * room):
            w = p // room
            if self.is_sorted(g, w, p):
                place = self.phases.bin_of(g, w, p)
                buffers.key[w * buffers.capacity + p - w * room] = place
                ti.atomic_add(order.cursor[w * bins + place, 0], 1)
        for s in range(self.runs * spans):
            total = 0
            for q in range(s % spans * SPAN, ti.min(bins, (s % spans + 1) * SPAN)):
                total += order.cursor[s // spans * bins + q, 0]
            order.span_sum[s] = total
        for b in range(self.runs * blocks):
            total = 0
            for s in range(b % blocks * SPAN, ti.min(spans, (b % blocks + 1) * SPAN)):
                total += order.span_sum[b // blocks * spans + s]
            order.block_sum[b] = total
        for s in range(self.runs * spans):
            w = s // spans
            if self.sorting[w] == 1:
                place = w * room
                block = s % spans // SPAN
                for b in range(w * blocks, w * blocks + block):
                    place += order.block_sum[b]
                for t in range(w * spans + block * SPAN, s):
                    place += order.span_sum[t]
                for q in range(s % spans * SPAN, ti.min(bins, (s % spans + 1) * SPAN)):
                    size = order.cursor[w * bins + q, 0]
                    order.start[w * (bins + 1) + q] = place
                    order.cursor[w * bins + q, 0] = place
                    place += size
                if s % spans == spans - 1:
                    order.start[w * (bins + 1) + bins] = place
        for p in range(self.runs * room):
            w = p // room
            if self.is_sorted(g, w, p):
                own = w * buffers.capacity
                place = ti.atomic_add(order.cursor[w * bins + buffers.key[own + p - w * room], 0], 1) - w * room
                if ti.static(self.by_runs):
                    active = order.start[w * (bins + 1) + ti.static(order.tiles)] - w * room
                    place = stored_at(place, active, ti.static(run_length(room)))
                buffers.order[own + place] = p
        for field in ti.static(self.moved[g]):
            for p in range(self.runs * room):
                w = p // room
                if self.is_sorted(g, w, p):
                    own, q = w * buffers.capacity, p - w * room
                    keep(buffers, field, own, q, buffers.order[own + q])
            for p in range(self.runs * room):
                w = p // room
                if self.is_sorted(g, w, p):
                    take(buffers, field, w * buffers.capacity, p - w * room, p)
        for w in range(self.runs):
            self.active[w, g] = order.start[w * (bins + 1) + ti.static(order.tiles)] - w * room

    @ti.func
    def is_sorted(self, g: ti.template(), w: int, p: int):
        """Return whether a particle belongs to a marked run."""
        (run,) = ti.static((self.phases.run(w),))
        return self.sorting[w] == 1 and p - w * ti.static(self.capacity[g]) < run.capacity[g]

    @ti.kernel
    def find_box(self):
        """Find the nodes that runs use until their next sort; all nodes if particles are not sorted."""
        for w, a in ti.ndrange(self.runs, self.dimension):
            self.stencils[2 * w, a], self.stencils[2 * w + 1, a] = 2**30, -1
        if ti.static(self.phases.separates):
            for w in range(self.runs):
                if self.sorting[w] == 1:
                    self.device.features.surfaces.forget(w)
        if ti.static(self.sorts):
            for g, _group in ti.static(self.members):
                for p in range(self.runs * self.capacity[g]):
                    w = p // self.capacity[g]
                    if self.sorting[w] == 1 and self.takes_part(g, w, p):
                        base = self.phases.first_node_of(g, w, p)
                        if ti.static(self.phases.separates):
                            self.device.features.surfaces.widen(w, self.device.groups[g].layer_of(p), base)
                        for a in ti.static(range(self.dimension)):
                            # The comparisons may use old values; they avoid most atomic operations.
                            if base[a] < self.stencils[2 * w, a]:
                                ti.atomic_min(self.stencils[2 * w, a], base[a])
                            if base[a] > self.stencils[2 * w + 1, a]:
                                ti.atomic_max(self.stencils[2 * w + 1, a], base[a])
        for w in range(self.runs):
            if self.sorting[w] == 1:
                (run,) = ti.static((self.phases.run(w),))
                for a in ti.static(range(self.dimension)):
                    last_wall = PAD + run.cells[a]
                    first, last = 0, last_wall + PAD
                    if ti.static(self.sorts):
                        low, high = self.stencils[2 * w, a], self.stencils[2 * w + 1, a]
                        if high < 0:
                            # Without active particles the box must still be valid.
                            low, high = PAD, PAD
                        drift = ti.static(self.device.grid.tile)
                        first, last = box_of(self.device.grid, a, low, high, drift, last_wall)
                    self.device.grid.box[2 * w, a] = first
                    self.device.grid.box[2 * w + 1, a] = last - first + 1
        for k in range(3):
            self.reach[k] = 0
        self.reach[3], self.reach[4] = self.loads, 1
        for w in range(self.runs):
            nodes, planes, rows = self.phases.nodes_in_use(w)
            ti.atomic_max(self.reach[0], nodes)
            ti.atomic_max(self.reach[1], planes)
            ti.atomic_max(self.reach[2], rows)

    # Frames.

    def begin_frame(self, numbers: np.ndarray, counts: np.ndarray) -> None:
        """Prepare the device for `read`."""
        if self.averages:
            self._write_domains(self.phases.state(slice(None), numbers, counts))
            self.counts.from_numpy(counts)
            self.average_for_frame()

    @ti.kernel
    def average_for_frame(self):
        """Average volumes over cells."""
        for g, group in ti.static(self.members):
            if ti.static(group.uses_f_bar):
                for turn in ti.static(range(3)):
                    for p in range(self.runs * self.capacity[g]):
                        w = p // self.capacity[g]
                        if self.takes_part(g, w, p):
                            self.phases.average_for_frame(g, w, p, turn)

    def _reader(self, g: int) -> Callable[..., None]:
        """Return the kernel that writes the frame data of particles of a group."""
        group = self.device.groups[g]

        @ti.kernel
        def write_frame(
            run: int,
            first: int,
            count: int,
            dt: float,
            affine: int,
            gradient: int,
            tau: int,
            activity: int,
            frame_buffer: ti.types.ndarray(ndim=2),
        ):
            """Write the `FrameColumns` of particles from `first` on."""
            for q in range(count):
                (rows,) = ti.static((FrameRows(frame_buffer, 0, affine, gradient, tau, activity, dt),))
                (at, op) = ti.static((Showing(self.device.grid, group.seen_from(run), rows), self.device.shows[g]))
                for turn in range(turns(group, rows)):
                    one(at, op, first + q, ti.cast(turn, float))

        return write_frame

    def read(
        self, g: int, run: int, first: int, count: int, dt: float, columns: FrameColumns, frame_buffer: np.ndarray
    ) -> None:
        """Write the frame data of particles of the g-th group of a run to the rows of their ids, (n, columns)."""
        self.readers[g](run, first, count, dt, *chosen_columns(columns), frame_buffer)
