"""The bodies of the phases on the CPU, a part at a time, and the numbers that threads know phases by.

No number depends on who does a part: parts of a phase write disjoint memory, and maxima know no order.

The time to compile a function grows with the square of its length. Each kind of part is therefore in a function of its
own for Taichi as well (`ti.real_func`). Such a function knows nothing of its caller but its arguments, so that each one
asks for the numbers of the run anew.
"""

from mpmcli.boundaries.mirror_images import find_friction
from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.cpu_contact import CpuContact
from mpmcli.solver.engine.cpu_parts import KICK, MOVED, RELAXED, SPEED, VECTORS, Part, PartKind
from mpmcli.solver.engine.cpu_regions import CpuRegions
from mpmcli.solver.engine.device import Device, views
from mpmcli.solver.engine.phases import Phase, sorted_fields
from mpmcli.solver.engine.run_numbers import Layout
from mpmcli.solver.frames.reader import show_range
from mpmcli.solver.grid.grid import clear_blocks, clear_rows
from mpmcli.solver.grid.sparse_grid import BLOCKS, PENCILS
from mpmcli.solver.particles.sort import count_tiles, keep_all, place_particles, scratch_offset, share_start, take_all
from mpmcli.solver.particles.state_bounds import NOTHING
from mpmcli.solver.transfer.cpu_transfers import (
    advance_range,
    advance_tiles,
    average_pencils,
    scatter_pencils,
    scatter_range,
    update_blocks,
    update_rows,
)
from mpmcli.solver.transfer.particle_update import NOT_LOST
from mpmcli.solver.transfer.splines import PAD
from mpmcli.solver.transfer.volume_average import average_for_frame, average_range

# Of all runs: numbers, counts and what particles show, see `Batch`.
RunReals = ti.types.ndarray(ti.f64, 2)
RunInts = ti.types.ndarray(ti.i32, 2)
Shown = ti.types.ndarray(ndim=2)
# Parts of a loop over the particles or the nodes of a region; on a sparse grid, where parts are whole pencils.
SHARES, SPARSE_SHARES = 4, 16


@ti.data_oriented
class CpuPhases(CpuContact):
    """The phases of the runs of a batch, w being the number of a run, region and part those of a part.

    A step begins with `first_of_step`, a sort with `sorts`, the end of what comes before a frame is `showing`.

    Attributes:
        shared: whether several threads work on one run; regions: of each run, one for each of them.
        places: of the regions in the particles and the nodes; shares: parts of a loop over a region.
        kinds: of the parts.
        clears: number of the first phase of steps that shift no particles.
        last_of_step, sorts, marking, last_of_sort, before_showing, showing: numbers of phases.
        coloured: (group, first phase) of the phases that go over the pencils of a group, of which there are `passes`.
        values: numbers of the step of each run.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.dimension = device, device.grid.dimension
        self.members = tuple(enumerate(device.groups))
        self.real, self.count = layout.real, layout.count
        self.shares = SPARSE_SHARES if device.grid.sparse else SHARES
        self.shared = device.runs == 1 and device.threads > 1
        self.regions = device.threads if self.shared else 1
        self.places = CpuRegions(device, self.regions)
        # Behind VECTORS gravity's change of velocity, and per group the largest rate and change by relaxation.
        self.rates = VECTORS + self.dimension
        self.values = ti.field(float, shape=(device.runs, self.rates + 2 * len(device.groups)))
        self.colours = device.orders[0].colours
        self.moves, self.separates = device.motion is not None, device.contact is not None
        self.rigid = device.rigid is not None
        # What has come in since the sort follows all colours, on one thread.
        self.passes = self.colours + device.comes_and_goes
        self.kinds: tuple[PartKind, ...] = ()
        coloured, end = [], 0
        for phase in device.phases:
            length = self.passes if phase.adds else phase.turns
            if self.kinds and not phase.adds and self.kinds[-1].name == phase.name:
                end -= 1
            end = self._add(phase.name, phase.group, end, length, phase)
            if phase.adds:
                coloured.append((phase.group, end - length))
        self.coloured, self.last_of_step, self.sorts = tuple(coloured), end - 1, end
        self.clears = next(kind.first for kind in self.kinds if kind.name == "clear")
        # Tiles of a sparse grid are numbered before anything is sorted: old numbers are taken, then tiles that hold
        # particles marked.
        self.marking = self.sorts + 1
        if device.grid.sparse:
            self._add("forget", 0, self.sorts, 1)
            for g, _ in self.members:
                end = self._add("mark", g, self.marking, 1)
        # Of each group: count, place, and for each of its fields keep and take.
        self.moved = sorted_fields(device.groups)
        self.sorts_of = ()
        for g, fields in enumerate(self.moved):
            self.sorts_of += (end,)
            end = self._add("sort", g, end, 2 + 2 * len(fields))
        self.last_of_sort, self.before_showing = end - 1, end
        # Before a frame is shown volumes are averaged once more.
        for g, group in self.members:
            if group.averaged:
                end = self._add("average_shown", g, self.before_showing, 1)
        self.showing = end
        for g, _ in self.members:
            self._add("show", g, self.showing, 1)

    def _add(self, name: str, group: int, first: int, length: int, phase: Phase | None = None) -> int:
        """Number phases, and return the number after the last."""
        item, body = phase and (phase.ranged or phase.body), name
        if item:
            body = "each_node" if phase.over == "nodes" else "each_in_pencils" if phase.adds else "each_particle"
        self.kinds += (PartKind(name, group, first, first + length, body, item),)
        return first + length

    def body(self, kind: PartKind) -> object:
        """Return the method of a kind of parts."""
        return getattr(self, kind.body)

    # A step as a whole, on the thread that leads.

    @ti.func
    def view_numbers(self, w: int, numbers: ti.template(), counts: ti.template()):
        """Return what `views` takes of a run: spacing, its inverse, the gradient's scale, box, last node, extent."""
        d = ti.static(self.dimension)
        last = ti.Vector.zero(int, d)
        extent = ti.Vector.zero(float, d)
        box = ti.Matrix.zero(int, 2, d)
        for a in ti.static(range(d)):
            last[a] = PAD + counts[w, self.count.cells[a]]
            extent[a] = ti.cast(numbers[w, self.real.extent[a]], float)
            for i in ti.static(range(2)):
                box[i, a] = self.device.grid.box[w * 2 + i, a]
        h = ti.cast(numbers[w, self.real.spacing], float)
        inverse = ti.cast(numbers[w, self.real.inverse_spacing], float)
        scale = ti.cast(numbers[w, self.real.gradient_scale], float)
        return h, inverse, scale, box, last, extent

    @ti.func
    def begin_step(self, w: int, dt: ti.f64, kick: ti.f64, relaxed: ti.f64, numbers: ti.template()):
        """Store the numbers of a step."""
        self.values[w, MOVED] = ti.cast(dt, float)
        self.values[w, KICK] = ti.cast(kick, float)
        self.values[w, RELAXED] = ti.cast(relaxed, float)
        self.values[w, SPEED] = 0.0
        if ti.static(self.device.values.gravity_varies):
            pulled = self.device.gravity.in_step(self.values[w, KICK], w)
            for a in ti.static(range(self.dimension)):
                self.values[w, VECTORS + a] = pulled[a]
        else:
            for a in ti.static(range(self.dimension)):
                pull = ti.cast(numbers[w, self.real.gravity[a]], float)
                self.values[w, VECTORS + a] = self.values[w, KICK] * pull
        if ti.static(self.moves):
            start = numbers[w, self.real.time]
            self.device.values.set_motions(w, self.device.motion, start, start + dt)
            self.device.motion.advance(w, dt)
        if ti.static(self.rigid):
            self.device.rigid.begin(w, dt, self.values[w, KICK], self.gravity_step(w))
        for g in ti.static(range(len(self.members))):
            # A law may have no particle yet.
            self.values[w, self.rates + 2 * g] = 0.0 if ti.static(self.device.comes_and_goes) else NOTHING
            self.values[w, self.rates + 2 * g + 1] = 0.0

    @ti.func
    def first_of_step(self, w: int):
        """Return the first phase of the step: only where it relaxes volumes are particles shifted before all else."""
        phase = 0
        if self.values[w, RELAXED] == 0.0:
            phase += ti.static(self.clears)
        return phase

    @ti.func
    def end_step(self, w: int, dt: ti.f64, numbers: ti.template()):
        """Store the rates of a step; return the largest speed of a node, m/s, -1 where a particle was lost."""
        speed = ti.sqrt(self.values[w, SPEED])
        for g in ti.static(range(len(self.members))):
            # What the relaxation adds to the rate of deformation.
            added = ti.cast(self.values[w, self.rates + 2 * g + 1], ti.f64) / dt
            numbers[w, self.real.rate[g]] = added + ti.cast(self.values[w, self.rates + 2 * g], ti.f64)
            if self.device.particles.lost[w * ti.static(len(self.members)) + g] != NOT_LOST:
                speed = -1.0
        return ti.cast(speed, ti.f64)

    # Parts.

    @ti.func
    def parts_of(self, phase: int, region: int):
        """Return the number of parts of a phase in a region."""
        parts = 1
        if ti.static(self.shared):
            if phase < self.sorts or phase == self.showing:
                parts = self.shares
            for g, begin in ti.static(self.coloured):
                colour = phase - begin
                if colour >= 0 and colour < self.colours:
                    last = self.device.orders[g].work[colour, region + 1]
                    parts = last - self.device.orders[g].work[colour, region]
        return parts

    @ti.func
    def share(self, first: int, after: int, part: int):
        """Return the part of a range."""
        size, shares = after - first, ti.static(self.shares if self.shared else 1)
        return first + share_start(size, part, shares), first + share_start(size, part + 1, shares)

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
        shown: Shown,
    ):
        """Do a part of a phase in a region as thread t, if it belongs to the k-th of the `kinds` or to a later one.

        A function calls the next one: of several that it calls, Taichi 1.7.4 puts the code into the key of its cache in
        the order of their addresses, so that the next process would find nothing.
        """
        if phase >= ti.static(self.kinds[k].first) and phase < ti.static(self.kinds[k].after):
            h, inverse, scale, box, last, extent = self.view_numbers(w, numbers, counts)
            run = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
            turn = phase - ti.static(self.kinds[k].first)
            (at,) = ti.static((Part(run, self.kinds[k], w, turn, region, part, t, numbers, counts, shown),))
            ti.static(self.body(self.kinds[k]))(at)
        if ti.static(k + 1 < len(self.kinds)):
            self.do(ti.static(k + 1), w, phase, region, part, t, numbers, counts, shown)

    # Parts of phases that say what they do for each node or particle.

    @ti.func
    def each_node(self, at: ti.template()):
        """Go through nodes."""
        first, after = self.places.rows_of(at.grid, at.region)
        first, after = self.share(first, after, at.part)
        last_axis = ti.static(self.dimension - 1)
        for row in range(first, after):
            node = at.grid.row_start(row)
            for _ in range(at.grid.row_length(node)):
                ti.static(at.item)(at, node, self.values[at.w, RELAXED])
                node[last_axis] += 1

    @ti.func
    def each_in_pencils(self, at: ti.template()):
        """Go through particles that add to nodes."""
        first, after = 0, 0
        if at.turn < self.colours:
            first, after = self.pencils(at.order, at.turn, at.region, at.part)
            for r in range(first, after):
                pencil = at.order.pencil_of(at.turn, r)
                begin, end = at.order.first_particle_of(pencil), at.order.first_particle_of(pencil + 1)
                ti.static(at.item)(at, begin, end, self.values[at.w, RELAXED])
        if ti.static(self.device.comes_and_goes and not at.grid.sparse):
            if at.turn == self.colours and at.region == 0 and at.part == 0:
                first, after = self.come_in(at.g, at.order, at.w, at.counts)
                ti.static(at.item)(at, first, after, self.values[at.w, RELAXED])

    @ti.func
    def each_particle(self, at: ti.template()):
        """Go through particles."""
        first, after = self.places.particles_of(at.g, at.w, at.region, at.counts[at.w, self.count.particles[at.g]])
        first, after = self.share(first, after, at.part)
        ti.static(at.item)(at, first, after, self.values[at.w, RELAXED])

    @ti.func
    def clear(self, at: ti.template()):
        """Clear nodes."""
        if ti.static(at.grid.sparse):
            first, after = self.places.even_part(at.grid.sizes[BLOCKS], at.region)
            first, after = self.share(first, after, at.part)
            clear_blocks(at.grid, first, after)
        else:
            first, after = self.places.rows_of(at.grid, at.region)
            first, after = self.share(first, after, at.part)
            for layer in range(self.layer_count(at)):
                own = self.used_by(at, layer)
                (inner,) = ti.static((at.in_layer(layer, own),))
                clear_rows(inner.grid, first, after)
            if ti.static(self.separates):
                box = self.near_bodies(at)
                (near,) = ti.static((at.grid.within(box),))
                first, after = self.rows_near_bodies(near, at)
                self.device.contact.surfaces.clear_rows(near, at.w, first, after)

    @ti.func
    def pencils(self, order: ti.template(), colour: int, region: int, part: int):
        """Return the first pencil of a part of a colour, and the one after the last."""
        first, after = 0, order.pencil_count(colour)
        if ti.static(self.shared):
            first = order.work[colour, region] + part
            after = first + 1
        return first, after

    @ti.func
    def come_in(self, g: ti.template(), order: ti.template(), w: int, counts: ti.template()):
        """Return the first particle that came in since the last sort, and the one after the last."""
        first = order.start[order.first_tile + order.tiles]
        return first, w * ti.static(self.device.room[g]) + counts[w, self.count.particles[g]]

    @ti.func
    def average(self, at: ti.template()):
        """Add particles of the g-th group to the averages of their cells."""
        if at.turn < self.colours:
            first, after = self.pencils(at.order, at.turn, at.region, at.part)
            average_pencils(at, first, after)
        elif at.region == 0 and at.part == 0:
            first, after = self.come_in(at.g, at.order, at.w, at.counts)
            average_range(at.grid, at.g, at.group, first, after)

    @ti.func
    def scatter(self, at: ti.template()):
        """Scatter particles of the g-th group."""
        kick, relaxed = self.values[at.w, KICK], self.values[at.w, RELAXED]
        if at.turn < self.colours:
            first, after = self.pencils(at.order, at.turn, at.region, at.part)
            scatter_pencils(at, first, after, kick, relaxed)
        # On a sparse grid a sort follows on what comes in.
        if ti.static(self.device.comes_and_goes and not at.grid.sparse):
            if at.turn == self.colours and at.region == 0 and at.part == 0:
                first, after = self.come_in(at.g, at.order, at.w, at.counts)
                scatter_range(at.particles, at.g, at.group, first, after, kick, relaxed)

    @ti.func
    def relax(self, at: ti.template()):
        """Relax the volumes of particles of the g-th group, in the steps that do."""
        relaxed = self.values[at.w, RELAXED]
        if relaxed > 0.0:
            first, after = self.places.particles_of(at.g, at.w, at.region, at.counts[at.w, self.count.particles[at.g]])
            first, after = self.share(first, after, at.part)
            change = 0.0
            for p in range(first, after):
                change = ti.max(change, at.particles.relax(self.device.groups[at.g], p, relaxed))
            ti.atomic_max(self.values[at.w, self.rates + 2 * at.g + 1], change)

    @ti.func
    def gravity_step(self, w: int):
        """Return by how much gravity changes velocities in this step, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = self.values[w, VECTORS + a]
        return result

    @ti.func
    def find_contact(self, at: ti.template()):
        """Find where walls that let go are pressed."""
        self.each_plane_node(at, False)

    @ti.func
    def find_friction(self, at: ti.template()):
        """Find the friction of walls."""
        self.each_plane_node(at, True)

    @ti.func
    def each_plane_node(self, at: ti.template(), rubs: ti.template()):
        """Find friction, or else contact, at the nodes in use of the planes of faces."""
        gravity_step = self.gravity_step(at.w)
        layers = 1
        if ti.static(rubs):
            # Where bodies meet walls by their surfaces walls do not find whether they press.
            layers = self.layer_count(at)
        for layer in range(layers):
            own = self.used_by(at, layer)
            (inner,) = ti.static((at.in_layer(layer, own),))
            (grid,) = ti.static((inner.grid.within(own) if at.grid.layers > 1 else at.grid,))
            first, after = self.places.even_part(inner.nodes.images.plane_nodes(grid), at.region)
            first, after = self.share(first, after, at.part)
            for q in range(first, after):
                if ti.static(rubs):
                    find_friction(inner.nodes.images, grid, q, gravity_step)
                else:
                    inner.nodes.images.find_contact(grid, q, gravity_step)

    @ti.func
    def update(self, at: ti.template()):
        """Turn the momentum of nodes into velocity."""
        ti.atomic_max(self.values[at.w, SPEED], self.updated(at, False))

    @ti.func
    def updated(self, at: ti.template(), meets: ti.template()):
        """Update nodes, or let them meet rigid bodies; return the square of the largest velocity."""
        speed_squared = 0.0
        if ti.static(at.grid.sparse):
            # Whole pencils: what colliders take is added up row by row.
            first, after = self.places.even_part(at.grid.sizes[PENCILS], at.region)
            first, after = self.share(first, after, at.part)
            begin, end = at.grid.pencils[first], at.grid.pencils[after]
            speed_squared = update_blocks(at, begin, end, self.gravity_step(at.w), meets)
        else:
            first, after = self.places.rows_of(at.grid, at.region)
            first, after = self.share(first, after, at.part)
            for layer in range(self.layer_count(at)):
                own = self.used_by(at, layer)
                (inner,) = ti.static((at.in_layer(layer, own),))
                speed_squared = ti.max(speed_squared, update_rows(inner, first, after, self.gravity_step(at.w), meets))
        return speed_squared

    @ti.func
    def meet(self, at: ti.template()):
        """Find the velocities of rigid bodies: add up what nodes would give them, and then solve for it."""
        if at.turn % 2 == 0:
            self.updated(at, True)
        elif at.region == 0 and at.part == 0:
            at.nodes.rigid.solve(at.w, at.numbers[at.w, self.real.step])

    @ti.func
    def move_bodies(self, at: ti.template()):
        """Move rigid bodies, with what the nodes lost to them."""
        if at.region == 0 and at.part == 0:
            dt = at.numbers[at.w, self.real.step]
            at.nodes.rigid.take(at.w, dt)
            self.device.rigid_contact.resolve(at.w, dt, at.particles.extent, at.nodes.colliders)
            speed_squared = at.nodes.rigid.move(at.w, dt)
            ti.atomic_max(self.values[at.w, SPEED], speed_squared)

    @ti.func
    def advance(self, at: ti.template()):
        """Gather and move particles of the g-th group."""
        dt, rate, gravity_step = self.values[at.w, MOVED], self.rates + 2 * at.g, self.gravity_step(at.w)
        if ti.static(at.grid.sparse):
            first, after = self.places.pencils_of(at.g, at.region)
            first, after = self.share(first, after, at.part)
            begin, end = at.order.first_tile_of(first), at.order.first_tile_of(after)
            ti.atomic_max(self.values[at.w, rate], advance_tiles(at, begin, end, dt, gravity_step))
        else:
            first, after = self.places.particles_of(at.g, at.w, at.region, at.counts[at.w, self.count.particles[at.g]])
            first, after = self.share(first, after, at.part)
            sharpest = advance_range(at.particles, at.g, self.device.groups[at.g], first, after, dt, gravity_step)
            ti.atomic_max(self.values[at.w, rate], sharpest)

    @ti.func
    def forget(self, at: ti.template()):
        """Take the numbers of the share of a region in the tiles."""
        first, after = self.places.even_part(at.grid.sizes[BLOCKS], at.region)
        at.grid.forget(first, after)

    @ti.func
    def mark(self, at: ti.template()):
        """Mark the tiles of the share of a region in the particles of the g-th group."""
        first, after = self.places.even_part(at.counts[at.w, self.count.capacity[at.g]], at.region)
        at.grid.mark(at.order, first, after)

    @ti.func
    def sort(self, at: ti.template()):
        """Do the share of a region in a phase of the sort of the g-th group."""
        first = at.w * ti.static(self.device.room[at.g])
        begin, end = self.places.even_part(at.counts[at.w, self.count.capacity[at.g]], at.region)
        # Other runs may be at other groups, which begin elsewhere: the scratch memory of a run is that of no other.
        own = at.w * ti.static(self.device.orders[at.g].buffers.room)
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
    def average_shown(self, at: ti.template()):
        """Average the volumes of the g-th group for a frame."""
        if at.region == 0:
            first = at.w * ti.static(self.device.room[at.g])
            average_for_frame(at.grid, at.g, at.group, first, first + at.counts[at.w, self.count.particles[at.g]])

    @ti.func
    def show(self, at: ti.template()):
        """Write what particles of the g-th group show."""
        first, after = self.places.particles_of(at.g, at.w, at.region, at.counts[at.w, self.count.particles[at.g]])
        if ti.static(self.device.comes_and_goes):
            # All of them, those that wait and those that left included.
            first, after = self.places.even_part(at.counts[at.w, self.count.capacity[at.g]], at.region)
            first += at.w * ti.static(self.device.room[at.g])
            after += at.w * ti.static(self.device.room[at.g])
        first, after = self.share(first, after, at.part)
        row, last_step = at.counts[at.w, self.count.row], ti.cast(at.numbers[at.w, self.real.last_step], float)
        affine, gradient = at.counts[at.w, self.count.affine], at.counts[at.w, self.count.gradient]
        tau, activity = at.counts[at.w, self.count.tau], at.counts[at.w, self.count.activity]
        scratch, room = ti.static((self.device.orders[at.g].buffers, self.device.room[at.g]))
        offset = scratch_offset(scratch, at.g, at.w, room)
        show_range(
            at.group,
            first,
            after - first,
            last_step,
            row,
            affine,
            gradient,
            tau,
            activity,
            at.shown,
            scratch.real,
            offset,
        )
