"""What the kernel of a batch does on the CPU between two decisions, in phases: a step, a sort, and a frame.

A phase has parts that any thread may do. No number depends on who does one: parts of a phase write disjoint memory, and
maxima know no order.
"""

import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.advance_range import advance_range
from mpmcli.solver.batch_device import Device, views
from mpmcli.solver.batch_layout import Layout
from mpmcli.solver.batch_regions import BatchRegions
from mpmcli.solver.cpu_loops import average_pencils, clear_rows, scatter_pencils, update_rows
from mpmcli.solver.frame_reader import show_range
from mpmcli.solver.ordering import share_start
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.scatter_range import scatter_range
from mpmcli.solver.sorting import count_tiles, keep, place_particles, take
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING
from mpmcli.solver.volume_average import average_for_frame, average_range

# Parts of a loop over the particles or the nodes of a region.
SHARES = 4
# Numbers of a step: its size and its kick, s, the time over which volumes relax, s, and the largest speed squared.
MOVED, KICK, RELAXED, SPEED, VECTORS = range(5)


@ti.data_oriented
class BatchPhases:
    """The phases of the runs of a batch, w being the number of a run.

    Attributes:
        shared: whether several threads work on one run; regions: of each run, one for each of them.
        places: of the regions in the particles and the nodes.
        last_of_step, sorts, last_of_sort, showing: places of phases. A step begins with phase 0, a sort with `sorts`.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.dimension = device, device.grid.dimension
        self.members = tuple(enumerate(device.groups))
        self.real, self.count = layout.real, layout.count
        self.shared = device.runs == 1 and device.threads > 1
        self.regions = device.threads if self.shared else 1
        self.places = BatchRegions(device, self.regions)
        # Behind VECTORS gravity's change of velocity, and per group the largest rate and change by relaxation.
        self.rates = VECTORS + self.dimension
        self.values = ti.field(float, shape=(device.runs, self.rates + 2 * len(device.groups)))
        self.colours = device.orders[0].colours
        self.moves = device.motion is not None
        # What has come in since the sort follows all colours, on one thread.
        passes = self.colours + device.comes_and_goes
        self.relaxes = any(group.law.relaxes for group in device.groups)
        # The first of the phases that average the volumes of a group, and of those that scatter it.
        averaged = [g for g, group in self.members if group.averaged]
        self.averages = {g: 1 + n * passes for n, g in enumerate(averaged)}
        begun = 1 + len(averaged) * passes
        self.scatters = {g: begun + g * passes for g, _ in self.members}
        # (group, first phase) of all phases that go over its pencils, colour by colour.
        self.coloured = (*self.averages.items(), *self.scatters.items())
        self.relaxing = begun + len(device.groups) * passes
        self.contact = self.relaxing + self.relaxes
        self.friction = self.contact + device.nodes.needs_contact
        self.updating = self.friction + device.nodes.needs_friction
        self.last_of_step = self.updating + 1
        # Of each group: count, place, and for each of its fields keep and take.
        self.moved = tuple((*group.state, *group.labels) for group in device.groups)
        self.sorts = self.last_of_step + 1
        firsts = [self.sorts]
        for fields in self.moved:
            firsts.append(firsts[-1] + 2 + 2 * len(fields))
        self.sorts_of, self.last_of_sort = tuple(firsts[:-1]), firsts[-1] - 1
        # Before a frame is shown volumes are averaged once more.
        self.before_showing = firsts[-1]
        self.showing = self.before_showing + bool(averaged)

    @ti.func
    def place(self, w: int, numbers: ti.template(), counts: ti.template()):
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
        for g in ti.static(range(len(self.members))):
            # A law may have no particle yet.
            self.values[w, self.rates + 2 * g] = 0.0 if ti.static(self.device.comes_and_goes) else NOTHING
            self.values[w, self.rates + 2 * g + 1] = 0.0

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

    @ti.func
    def parts_of(self, phase: int, region: int):
        """Return the number of parts of a phase in a region."""
        parts = 1
        if ti.static(self.shared):
            if phase < self.sorts or phase == self.showing:
                parts = SHARES
            for g, begin in ti.static(self.coloured):
                colour = phase - begin
                if colour >= 0 and colour < self.colours:
                    last = self.device.orders[g].work[colour, region + 1]
                    parts = last - self.device.orders[g].work[colour, region]
        return parts

    @ti.func
    def share(self, first: int, after: int, part: int):
        """Return the part of a range."""
        size, shares = after - first, ti.static(SHARES if self.shared else 1)
        return first + share_start(size, part, shares), first + share_start(size, part + 1, shares)

    @ti.func
    def do(
        self,
        w: int,
        phase: int,
        region: int,
        part: int,
        numbers: ti.template(),
        counts: ti.template(),
        shown: ti.template(),
    ):
        """Do a part of a phase in a region."""
        h, inverse, scale, box, last, extent = self.place(w, numbers, counts)
        grid, nodes, particles, orders, seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        kick, relaxed = self.values[w, KICK], self.values[w, RELAXED]
        gravity_step = ti.Vector.zero(float, ti.static(self.dimension))
        for a in ti.static(range(self.dimension)):
            gravity_step[a] = self.values[w, VECTORS + a]
        if phase == 0 or phase == self.updating:
            first, after = self.places.rows_of(grid, region)
            first, after = self.share(first, after, part)
            if phase == 0:
                clear_rows(grid, first, after)
            else:
                ti.atomic_max(self.values[w, SPEED], update_rows(grid, nodes, first, after, gravity_step))
        for g, begin in ti.static(self.coloured):
            colour = phase - begin
            if colour >= 0 and colour < self.colours:
                first, after = 0, orders[g].pencil_count(colour)
                if ti.static(self.shared):
                    first = orders[g].work[colour, region] + part
                    after = first + 1
                if ti.static(begin == self.scatters[g]):
                    scatter_pencils(particles, g, seen[g], orders[g], colour, first, after, kick, relaxed)
                else:
                    average_pencils(grid, g, seen[g], orders[g], colour, first, after)
            if ti.static(self.device.comes_and_goes):
                if colour == self.colours and region == 0 and part == 0:
                    first = orders[g].start[orders[g].first_tile + orders[g].tiles]
                    after = w * ti.static(self.device.room[g]) + counts[w, self.count.particles[g]]
                    if ti.static(begin == self.scatters[g]):
                        scatter_range(particles, g, seen[g], first, after, kick, relaxed)
                    else:
                        average_range(grid, g, seen[g], first, after)
        for g in ti.static(tuple(self.averages)):
            if phase == self.before_showing and region == 0:
                first = w * ti.static(self.device.room[g])
                average_for_frame(grid, g, seen[g], first, first + counts[w, self.count.particles[g]])
        if ti.static(nodes.needs_contact):
            if phase == self.contact:
                first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
                first, after = self.share(first, after, part)
                for q in range(first, after):
                    nodes.images.find_contact(grid, q, gravity_step)
        if ti.static(nodes.needs_friction):
            if phase == self.friction:
                first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
                first, after = self.share(first, after, part)
                for q in range(first, after):
                    find_friction(nodes.images, grid, q, gravity_step)
        for g, group in ti.static(self.members):
            first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
            first, after = self.share(first, after, part)
            if ti.static(group.law.relaxes):
                if phase == self.relaxing and relaxed > 0.0:
                    change = 0.0
                    for p in range(first, after):
                        change = ti.max(change, particles.relax(group, p, relaxed))
                    ti.atomic_max(self.values[w, self.rates + 2 * g + 1], change)
            if phase == self.last_of_step:
                sharpest = advance_range(particles, g, group, first, after, self.values[w, MOVED])
                ti.atomic_max(self.values[w, self.rates + 2 * g], sharpest)
            if phase == self.showing:
                if ti.static(self.device.comes_and_goes):
                    # All of them, those that wait and those that left included.
                    first, after = self.places.even_part(counts[w, self.count.capacity[g]], region)
                    first += w * ti.static(self.device.room[g])
                    after += w * ti.static(self.device.room[g])
                    first, after = self.share(first, after, part)
                row, last_step = counts[w, self.count.row], ti.cast(numbers[w, self.real.last_step], float)
                affine, gradient = counts[w, self.count.affine], counts[w, self.count.gradient]
                tau, activity = counts[w, self.count.tau], counts[w, self.count.activity]
                show_range(seen[g], first, after - first, last_step, row, affine, gradient, tau, activity, shown)
        if phase >= self.sorts and phase <= self.last_of_sort:
            self.do_sort(orders, w, phase, region, counts)

    @ti.func
    def do_sort(self, orders: ti.template(), w: int, phase: int, region: int, counts: ti.template()):
        """Do the share of a region in a phase of the sort."""
        for g, group in ti.static(self.members):
            first, count = w * ti.static(self.device.room[g]), counts[w, self.count.capacity[g]]
            begin, end = self.places.even_part(count, region)
            # Other runs may be at other groups, which begin elsewhere: the scratch memory of a run is that of no other.
            own = w * ti.static(self.device.orders[g].buffers.room)
            if phase == ti.static(self.sorts_of[g]):
                count_tiles(orders[g], w, region, first, begin, end)
            if phase == ti.static(self.sorts_of[g] + 1):
                place_particles(orders[g], w, region, first, begin, end)
            for i, field in ti.static(enumerate(self.moved[g])):
                if phase == ti.static(self.sorts_of[g] + 2 + 2 * i):
                    for q in range(begin, end):
                        keep(orders[g].buffers, field, own, q, orders[g].buffers.order[own + q])
                if phase == ti.static(self.sorts_of[g] + 3 + 2 * i):
                    for q in range(begin, end):
                        take(orders[g].buffers, field, own, q, first + q)
