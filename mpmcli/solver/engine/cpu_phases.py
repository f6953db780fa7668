"""The bodies of the phases on the CPU, for one part at a time, and the numbering of the phases.

Results do not depend on which thread processes a part: parts of a phase write disjoint memory, and maxima do not depend
on the order.

The time to compile a function grows with the square of its length. Each kind of part is therefore compiled as a
separate function (`ti.real_func`). Such a function has access only to its arguments, so that each one loads the numbers
of the run again.
"""

from collections.abc import Callable
from typing import NamedTuple

from mpmcli.boundaries.feature import Phase, changed
from mpmcli.boundaries.mirror_images import find_friction
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.contact_phases import clear_part
from mpmcli.solver.engine.device import Device, RunPhases, RunView, Work
from mpmcli.solver.engine.run_state import Layout
from mpmcli.solver.frames.reader import FrameRows, turns
from mpmcli.solver.grid.grid import clear_blocks, clear_rows
from mpmcli.solver.grid.sparse_grid import BLOCKS, PENCILS
from mpmcli.solver.particles.loop import in_window, over
from mpmcli.solver.particles.sort import (
    count_tiles,
    keep_all,
    place_particles,
    scratch_offset,
    share_start,
    stay_rolled,
    take_all,
)
from mpmcli.solver.particles.state_bounds import NOTHING
from mpmcli.solver.transfer.cpu_transfers import (
    add_over_tiles,
    nodes_of_blocks,
    nodes_of_rows,
    over_tiles,
    update_blocks,
    update_rows,
)
from mpmcli.solver.transfer.volume import average_for_frame

# Arrays of all runs: numbers, counts and frame buffer, see `Batch`.
RunReals = ti.types.ndarray(ti.f64, 2)
RunInts = ti.types.ndarray(ti.i32, 2)
FrameBuffer = ti.types.ndarray(ndim=2)
# Number of parts of a loop over the particles or nodes of a region, on a dense grid and on a sparse grid, where parts
# are whole pencils.
PARTS, SPARSE_PARTS = 4, 16


class PartKind(NamedTuple):
    """Parts of consecutive phases with a common body.

    Attributes:
        name: name of the phases.
        group: index of the group of particles.
        first, after: number of the first phase, and of the one after the last.
        body: name of the method, for phases without functions.
        phase: the phase of a step that it is, or None.
    """

    name: str
    group: int
    first: int
    after: int
    body: str
    phase: Phase | None

    @property
    def part(self) -> Callable | None:
        """The function of a part of all items, of phases that divide their work themselves."""
        return self.phase and self.phase.part


class Part(Work):
    """A part of a phase that a thread processes.

    Attributes:
        atomic: whether sums need atomics; False.
        region, part: index of the region, and of the part in it.
        t: index of the thread.
        frame_buffer: see `Batch`.
    """

    atomic = False

    def __init__(self, view: RunView, kind: PartKind, turn: object, *variables: object) -> None:
        """Store a view and variables of a kernel."""
        super().__init__(view, kind.group, kind.phase, turn)
        self.region, self.part, self.t, self.frame_buffer = variables


@ti.data_oriented
class CpuRegions:
    """The regions of a single run; with several runs, each run is one region.

    Attributes:
        regions: number of regions, and `parts` of a loop over each.
        pencils: for each region except the last, the first pencil after it, per group.
        rows: for each region except the last, the first row of nodes after it.
    """

    def __init__(self, device: Device, regions: int, parts: int) -> None:
        self.device, self.regions, self.parts, self.dimension = device, regions, parts, device.grid.dimension
        self.groups = tuple(range(len(device.groups)))
        self.pencils = tuple(ti.field(int, shape=max(regions - 1, 1)) for _ in device.groups)
        self.rows = ti.field(int, shape=max(regions - 1, 1))

    @ti.func
    def even_part(self, count: int, region: int):
        """Return the first index of the share of a region in a range of `count`, and the one after the last."""
        return share_start(count, region, self.regions), share_start(count, region + 1, self.regions)

    @ti.func
    def range_of_part(self, at: ti.template(), first: int, after: int):
        """Return the first index of a part of a range, and the one after the last."""
        size, parts = after - first, ti.static(self.parts)
        return first + share_start(size, at.part, parts), first + share_start(size, at.part + 1, parts)

    @ti.func
    def part_of(self, at: ti.template(), count: int):
        """Return the first index of a part of a region in a range of `count`, and the one after the last."""
        first, after = self.even_part(count, at.region)
        return self.range_of_part(at, first, after)

    @ti.func
    def rows_of(self, at: ti.template()):
        """Return the first row of nodes of a part, and the one after the last."""
        first, after = 0, at.grid.row_count()
        if ti.static(at.grid.sparse):
            first, after = self.even_part(after, at.region)
        elif ti.static(self.regions > 1):
            if at.region > 0:
                first = self.rows[at.region - 1]
            if at.region < self.regions - 1:
                after = self.rows[at.region]
        return self.range_of_part(at, first, after)

    @ti.func
    def particles_of(self, at: ti.template()):
        """Return the first particle of a part of the g-th group, and the one after the last."""
        first = at.w * ti.static(self.device.capacity[at.g])
        after = first + at.run.particles[at.g]
        if ti.static(self.regions > 1):
            if at.region > 0:
                first = at.order.first_particle_of(self.pencils[at.g][at.region - 1])
            if at.region < self.regions - 1:
                after = at.order.first_particle_of(self.pencils[at.g][at.region])
        return self.range_of_part(at, first, after)

    @ti.func
    def pencils_of(self, at: ti.template()):
        """Return the first pencil of a part for the g-th group, and the one after the last."""
        first, after = 0, at.order.pencils()
        if ti.static(self.regions > 1):
            if at.region > 0:
                first = self.pencils[at.g][at.region - 1]
            if at.region < self.regions - 1:
                after = self.pencils[at.g][at.region]
        return self.range_of_part(at, first, after)

    @ti.func
    def divide(self, g: ti.template(), count: int):
        """Divide the `count` sorted particles of a group into regions of about equal numbers of particles."""
        pencils = self.device.orders[g].pencils()
        region = 0
        for r in range(pencils):
            before = self.device.orders[g].first_particle_of(r)
            size = self.device.orders[g].first_particle_of(r + 1) - before
            # The border is before the pencil of which more than half is beyond the share.
            while region < self.regions - 1 and before + size // 2 >= share_start(count, region + 1, self.regions):
                self.pencils[g][region] = r
                region += 1
        while region < self.regions - 1:
            self.pencils[g][region] = pencils
            region += 1
        for colour in range(ti.static(self.device.orders[g].colours)):
            self.device.orders[g].work[colour, 0] = 0
            self.device.orders[g].work[colour, self.regions] = self.device.orders[g].pencil_count(colour)
            region = 0
            for q in range(self.device.orders[g].pencil_count(colour)):
                pencil = self.device.orders[g].pencil_of(colour, q)
                while region < self.regions - 1 and pencil >= self.pencils[g][region]:
                    self.device.orders[g].work[colour, region + 1] = q
                    region += 1
            while region < self.regions - 1:
                self.device.orders[g].work[colour, region + 1] = self.device.orders[g].pencil_count(colour)
                region += 1

    @ti.func
    def divide_rows(self):
        """Divide the nodes in use like the particles of the first group."""
        d = ti.static(self.dimension)
        rows, least = 1, 0
        for a in ti.static(range(d - 1)):
            rows *= self.device.grid.box[1, a]
        for region in range(self.regions - 1):
            rest, row, width = self.pencils[0][region], 0, 1
            for b in ti.static(range(d - 1)):
                a = ti.static(d - 2 - b)
                extent = self.device.grid.box[1, a]
                tile = rest % ti.static(self.device.grid.tiles[a])
                node = tile * ti.static(self.device.grid.tile) - self.device.grid.box[0, a]
                row += width * ti.min(ti.max(node, 0), extent - 1)
                width *= extent
                rest = rest // ti.static(self.device.grid.tiles[a])
            # Beyond the last tile along the first axis.
            if rest > 0:
                row = rows
            least = ti.max(least, ti.min(row, rows))
            self.rows[region] = least


@ti.data_oriented
class CpuPhases(RunPhases):
    """The phases of the runs of a batch; w is the index of a run, region and part those of a part.

    A step begins with `first_of_step`, a sort with `sorts`, and the preparation of a frame ends with `last_of_frame`.

    Attributes:
        shared: whether several threads work on one run.
        regions: number of regions per run, one for each of these threads.
        apart: whether the functions of the parts are kept out of the launch.
        places: ranges of particles and nodes of the regions.
        kinds: kinds of parts.
        clears: number of the first phase of steps that do not shift particles.
        last_of_step, sorts, marking, last_of_sort, first_of_frame, last_of_frame: numbers of phases.
        coloured: (group, first phase) of the phases over the pencils of a group.
        passes: number of consecutive phases over the pencils of a group.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        """Number the phases of a step, of a sort and of a frame."""
        super().__init__(device, layout)
        self.shared = device.runs == 1 and device.threads > 1
        self.regions = device.threads if self.shared else 1
        # LLVM does not inline a function that has a second call, even one that is never executed. Compilation is a
        # quarter shorter, and a step of few particles up to a third longer: for short runs, with few optimisations.
        self.apart = not ti.lang.impl.current_cfg().advanced_optimization
        parts = SPARSE_PARTS if device.grid.sparse else PARTS
        self.places = CpuRegions(device, self.regions, parts if self.shared else 1)
        self.colours = device.orders[0].colours
        # Particles that entered since the sort follow after all colours, on one thread.
        self.passes = self.colours + device.particle_count_varies
        self.kinds: tuple[PartKind, ...] = ()
        coloured, end = [], 0
        for phase in device.phases:
            length = self.passes if phase.adds else phase.turns * phase.rounds
            if self.kinds and not phase.adds and self.kinds[-1].name == phase.name:
                end -= 1
            end = self._add(phase.name, phase.group, end, length, phase)
            if phase.adds:
                coloured.append((phase.group, end - length))
        self.coloured, self.last_of_step, self.sorts = tuple(coloured), end - 1, end
        self.clears = next(kind.first for kind in self.kinds if kind.name == "clear")
        # Tiles of a sparse grid are numbered before the sort: old numbers are removed, then tiles that contain
        # particles are marked.
        self.marking = self.sorts + 1
        if device.grid.sparse:
            self._add("forget", 0, self.sorts, 1)
            for g, _ in self.members:
                end = self._add("mark", g, self.marking, 1)
        # Phases of the sort per group: count, place, and two copies (keep and take) per field.
        self.moved = tuple(group.moved for group in device.groups)
        self.sorts_of = ()
        for g, fields in enumerate(self.moved):
            self.sorts_of += (end,)
            end = self._add("sort", g, end, 2 + 2 * len(fields))
        self.last_of_sort, self.first_of_frame = end - 1, end
        # Volumes are averaged once more before a frame is shown.
        for g, group in self.members:
            if group.uses_f_bar:
                end = self._add("average_for_frame", g, self.first_of_frame, 1)
        self.last_of_frame = end
        for g, _ in self.members:
            self._add("write_frame", g, self.last_of_frame, 1)

    def _add(self, name: str, group: int, first: int, length: int, phase: Phase | None = None) -> int:
        """Number phases, and return the number after the last."""
        body = name
        if phase and phase.body:
            body = "each_particle" if phase.over == "particles" else "shift_nodes" if phase.shifts else "each_node"
        self.kinds += (PartKind(name, group, first, first + length, body, phase),)
        return first + length

    def body(self, kind: PartKind) -> object:
        """Return the method of a kind of parts."""
        return getattr(self, kind.body)

    # A step as a whole, in the leading thread.

    @ti.func
    def begin_launch(self, run: ti.template()):
        """Store the numbers of a run required by its steps in the precision of particles."""
        (step,) = ti.static((self.step_of(run.w),))
        step.spacing = ti.cast(run.spacing, float)
        step.inverse_spacing = ti.cast(run.inverse_spacing, float)
        step.gradient_scale = ti.cast(run.gradient_scale, float)
        for a in ti.static(range(self.dimension)):
            step.extent[a] = ti.cast(run.extent[a], float)

    @ti.func
    def first_of_step(self, run: ti.template()):
        """Return the first phase of the step; the phases of a shift are skipped unless the step relaxes volumes."""
        phase = 0
        if run.relaxed == 0.0:
            phase += ti.static(self.clears)
        return phase

    # Parts.

    @ti.func
    def parts_of(self, phase: int, region: int):
        """Return the number of parts of a phase in a region."""
        parts = 1
        if ti.static(self.shared):
            if phase < self.sorts or phase == self.last_of_frame:
                parts = self.places.parts
            for g, begin in ti.static(self.coloured):
                colour = phase - begin
                if colour >= 0 and colour < self.colours:
                    last = self.device.orders[g].work[colour, region + 1]
                    parts = last - self.device.orders[g].work[colour, region]
        return parts

    @ti.real_func
    def do(
        self,
        k: ti.template(),
        w: int,
        phase: int,
        region: int,
        part: int,
        t: int,
        numbers: RunReals,
        counts: RunInts,
        frame_buffer: FrameBuffer,
    ):
        """Process a part of a phase in a region by thread t, for phases of the k-th of the `kinds` or of a later one.

        Each function calls the next one. If one function called several, Taichi 1.7.4 would order their code in the key
        of its cache by memory address, so that another process would not find the kernel.
        """
        if phase >= ti.static(self.kinds[k].first) and phase < ti.static(self.kinds[k].after):
            (run,) = ti.static((self.state(w, numbers, counts),))
            (view,) = ti.static(self.see(run))
            turn = phase - ti.static(self.kinds[k].first)
            (at,) = ti.static((Part(view, self.kinds[k], turn, region, part, t, frame_buffer),))
            if ti.static(self.kinds[k].part):
                ti.static(self.kinds[k].part)(self, at)
            else:
                ti.static(self.body(self.kinds[k]))(at)
        if ti.static(k + 1 < len(self.kinds)):
            if ti.static(self.apart):
                if phase < 0:
                    self.do(ti.static(k + 1), w, phase, region, part, t, numbers, counts, frame_buffer)
            self.do(ti.static(k + 1), w, phase, region, part, t, numbers, counts, frame_buffer)

    # Loops that apply a function to each node or particle.

    @ti.func
    def each_node(self, at: ti.template()):
        """Apply the function of a phase to the nodes in use of all layers."""
        if ti.static(at.grid.sparse):
            first, after = self.places.part_of(at, at.grid.sizes[PENCILS])
            nodes_of_blocks(at, at.grid.pencils[first], at.grid.pencils[after], at.step.kick)
        else:
            first, after = self.places.rows_of(at)
            if ti.static(at.phase.wanted):
                own = self.used_by(at, 0)
                (inner,) = ti.static((at.in_layer(0, own),))
                nodes_of_rows(inner, first, after, inner.step.kick)
            else:
                for layer in range(self.layer_count(at)):
                    own = self.used_by(at, layer)
                    (inner,) = ti.static((at.in_layer(layer, own),))
                    nodes_of_rows(inner, first, after, inner.step.kick)

    @ti.func
    def shift_nodes(self, at: ti.template()):
        """Apply the function of a phase of a shift to the nodes in use."""
        first, after = self.places.rows_of(at)
        last_axis = ti.static(self.dimension - 1)
        for row in range(first, after):
            node = at.grid.row_start(row)
            for _ in range(at.grid.row_length(node)):
                stay_rolled(at.order.buffers.real, node[last_axis])
                ti.static(at.phase.body)(at, node, at.step.relaxed)
                node[last_axis] += 1

    @ti.func
    def each_particle(self, at: ti.template()):
        """Apply the function of a phase to particles, pencil by pencil if it adds to nodes."""
        (op,) = ti.static((at.phase.body,))
        if self.takes_place(at):
            how, gravity_step = self.time_of(at), self.gravity_of(at.step)
            (inner,) = ti.static((changed(at, gravity_step=gravity_step),))
            if ti.static(at.phase.adds):
                self.in_pencils(inner, op, how)
            else:
                found = NOTHING
                if ti.static(in_window(op, at.grid)):
                    first, after = self.places.pencils_of(at)
                    found = over_tiles(inner, op, at.order.first_tile_of(first), at.order.first_tile_of(after), how)
                else:
                    first, after = self.places.particles_of(at)
                    found = over(inner, op, first, after, how)
                if ti.static(len(at.phase.most) > 0):
                    (kept,) = ti.static((getattr(at.step, at.phase.most),))
                    ti.atomic_max(kept[at.g], found)

    @ti.func
    def in_pencils(self, at: ti.template(), op: ti.template(), how: float):
        """Carry out an operation that adds to nodes, pencil by pencil."""
        first, after = 0, 0
        if at.turn < self.colours:
            first, after = self.pencils(at.order, at.turn, at.region, at.part)
            for r in range(first, after):
                pencil = at.order.pencil_of(at.turn, r)
                if ti.static(in_window(op, at.grid)):
                    add_over_tiles(at, op, at.order.first_tile_of(pencil), at.order.first_tile_of(pencil + 1), how)
                else:
                    begin, end = at.order.first_particle_of(pencil), at.order.first_particle_of(pencil + 1)
                    over(at, op, begin, end, how)
        # On a sparse grid a sort follows each entry of particles.
        if ti.static(self.device.particle_count_varies and not at.grid.sparse):
            if at.turn == self.colours and at.region == 0 and at.part == 0:
                first, after = self.come_in(at.g, at.order, at.run)
                over(at, op, first, after, how)

    @ti.func
    def clear(self, at: ti.template()):
        """Clear nodes."""
        if ti.static(at.grid.sparse):
            first, after = self.places.part_of(at, at.grid.sizes[BLOCKS])
            clear_blocks(at.grid, first, after)
        else:
            first, after = self.places.rows_of(at)
            for layer in range(self.layer_count(at)):
                own = self.used_by(at, layer)
                (inner,) = ti.static((at.in_layer(layer, own),))
                clear_rows(inner.grid, first, after)
            if ti.static(self.separates):
                clear_part(self, at)

    @ti.func
    def pencils(self, order: ti.template(), colour: int, region: int, part: int):
        """Return the first pencil of a part of a colour in a region, and the one after the last."""
        first, after = 0, order.pencil_count(colour)
        if ti.static(self.shared):
            first = order.work[colour, region] + part
            after = first + 1
        return first, after

    @ti.func
    def come_in(self, g: ti.template(), order: ti.template(), run: ti.template()):
        """Return the first particle that entered since the last sort, and the one after the last."""
        first = order.start[order.first_tile + order.tiles]
        return first, run.w * ti.static(self.device.capacity[g]) + run.particles[g]

    @ti.func
    def find_contact(self, at: ti.template()):
        """Find where material presses on separating walls."""
        self.each_plane_node(at, False)

    @ti.func
    def find_friction(self, at: ti.template()):
        """Find the friction of walls."""
        self.each_plane_node(at, True)

    @ti.func
    def each_plane_node(self, at: ti.template(), rubs: ti.template()):
        """Find friction if `rubs`, otherwise contact, at the nodes in use on the planes of faces."""
        gravity_step = self.gravity_of(at.step)
        layers = 1
        if ti.static(rubs):
            # Contact is found only in layer 0: bodies with their own layers are in contact with walls by their
            # surfaces.
            layers = self.layer_count(at)
        for layer in range(layers):
            own = self.used_by(at, layer)
            (inner,) = ti.static((at.in_layer(layer, own),))
            (grid,) = ti.static((inner.grid.within(own),))
            first, after = self.places.part_of(at, inner.nodes.images.plane_nodes(grid))
            for q in range(first, after):
                if ti.static(rubs):
                    find_friction(inner.nodes.images, grid, q, gravity_step)
                else:
                    inner.nodes.images.find_contact(grid, q, gravity_step)

    @ti.func
    def update(self, at: ti.template()):
        """Convert the momentum of nodes to velocity."""
        speed_squared = 0.0
        if ti.static(at.grid.sparse):
            # Whole pencils, because the loads on colliders are summed row by row.
            first, after = self.places.part_of(at, at.grid.sizes[PENCILS])
            begin, end = at.grid.pencils[first], at.grid.pencils[after]
            speed_squared = update_blocks(at, begin, end, self.gravity_of(at.step))
        else:
            first, after = self.places.rows_of(at)
            for layer in range(self.layer_count(at)):
                own = self.used_by(at, layer)
                (inner,) = ti.static((at.in_layer(layer, own),))
                speed_squared = ti.max(speed_squared, update_rows(inner, first, after, self.gravity_of(at.step)))
        ti.atomic_max(at.step.speed_squared, speed_squared)

    # Sorts and frames.

    @ti.func
    def forget(self, at: ti.template()):
        """Remove the numbers of the tiles in the share of a region."""
        first, after = self.places.even_part(at.grid.sizes[BLOCKS], at.region)
        at.grid.forget(first, after)

    @ti.func
    def mark(self, at: ti.template()):
        """Mark the tiles of the particles of the g-th group in the share of a region."""
        first, after = self.places.even_part(at.run.capacity[at.g], at.region)
        at.grid.mark(at.order, first, after)

    @ti.func
    def sort(self, at: ti.template()):
        """Process the share of a region in a phase of the sort of the g-th group."""
        first = at.w * ti.static(self.device.capacity[at.g])
        begin, end = self.places.even_part(at.run.capacity[at.g], at.region)
        # Each run has its own scratch memory, because other runs may be sorting other groups, with other offsets.
        own = at.w * ti.static(self.device.orders[at.g].buffers.capacity)
        if at.turn == 0:
            count_tiles(at.order, at.w, at.region, first, begin, end)
        if at.turn == 1:
            place_particles(at.order, at.w, at.region, first, begin, end)
        for i, field in ti.static(enumerate(self.moved[at.g])):
            if at.turn == ti.static(2 + 2 * i):
                keep_all(at.order.buffers, field, own, begin, end)
            if at.turn == ti.static(3 + 2 * i):
                take_all(at.order.buffers, field, own, begin, end, first)

    @ti.func
    def average_for_frame(self, at: ti.template()):
        """Average the volumes of the g-th group for a frame."""
        if at.region == 0:
            first = at.w * ti.static(self.device.capacity[at.g])
            average_for_frame(at, first, first + at.run.particles[at.g])

    @ti.func
    def write_frame(self, at: ti.template()):
        """Write the frame data of particles of the g-th group."""
        first, after = self.places.particles_of(at)
        if ti.static(self.device.particle_count_varies):
            # All particles, including waiting and retired ones.
            first, after = self.places.part_of(at, at.run.capacity[at.g])
            first += at.w * ti.static(self.device.capacity[at.g])
            after += at.w * ti.static(self.device.capacity[at.g])
        (run, scratch) = ti.static((at.run, self.device.orders[at.g].buffers))
        offset = scratch_offset(scratch, at.g, at.w, ti.static(self.device.capacity[at.g]))
        row, affine, gradient, tau, activity = run.row, run.affine, run.gradient, run.tau, run.activity
        dt = ti.cast(run.last_step, float)
        (rows,) = ti.static(
            (FrameRows(at.frame_buffer, row, affine, gradient, tau, activity, dt, scratch.real, offset),)
        )
        (inner, op) = ti.static((changed(at, rows=rows), self.device.shows[at.g]))
        for turn in range(turns(at.group, rows)):
            over(inner, op, first, after, ti.cast(turn, float))
