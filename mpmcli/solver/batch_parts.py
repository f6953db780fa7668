"""What threads do in the phases of a batch on the CPU, each a part at a time.

No number depends on who does a part: parts of a phase write disjoint memory, and maxima know no order.

The time to compile a function grows with the square of its length. Each kind of part is therefore in a function of its
own for Taichi as well (`ti.real_func`). Such a function knows nothing of its caller but its arguments, so that each one
asks for the numbers of the run anew.
"""

import taichi as ti

from mpmcli.solver.advance_range import advance_range
from mpmcli.solver.batch_device import views
from mpmcli.solver.batch_nodes import NodeParts
from mpmcli.solver.batch_phases import KICK, MOVED, RELAXED, BatchPhases
from mpmcli.solver.block_loops import advance_tiles, scatter_tiles
from mpmcli.solver.cpu_loops import average_pencils, scatter_pencils
from mpmcli.solver.frame_reader import show_range
from mpmcli.solver.ordering import scratch_offset
from mpmcli.solver.scatter_range import scatter_range
from mpmcli.solver.sorting import count_tiles, keep, place_particles, take
from mpmcli.solver.sparse_grid import BLOCKS
from mpmcli.solver.volume_average import average_for_frame, average_range

# Of all runs: numbers, counts and what particles show, see `Batch`.
Numbers = ti.types.ndarray(ti.f64, 2)
Counts = ti.types.ndarray(ti.i32, 2)
Shown = ti.types.ndarray(ndim=2)


@ti.data_oriented
class BatchParts(NodeParts):
    """The parts of the phases, w being the number of a run, region and part those of the part.

    Attributes:
        phases: their numbers.
        kinds: of the parts: name, number of the group, first phase, and the phase after the last.
    """

    def __init__(self, phases: BatchPhases) -> None:
        super().__init__(phases)
        self.device, self.shared = phases.device, phases.shared
        self.members, self.count, self.real = phases.members, phases.count, phases.real
        numbers = range(len(phases.members))
        laws, nodes = [group.law for _, group in phases.members], phases.device.nodes
        kinds = [("clear", 0, 0, 1)]
        kinds += [("average", g, begin, begin + phases.passes) for g, begin in phases.averages.items()]
        kinds += [("scatter", g, begin, begin + phases.passes) for g, begin in phases.scatters.items()]
        kinds += [("relax", g, phases.relaxing, phases.relaxing + 1) for g in numbers if laws[g].relaxes]
        kinds += [("find contact", 0, phases.contact, phases.contact + 1)] * nodes.needs_contact
        kinds += [("find friction", 0, phases.friction, phases.friction + 1)] * nodes.needs_friction
        kinds += [("update", 0, phases.updating, phases.updating + 1)]
        kinds += [("advance", g, phases.last_of_step, phases.last_of_step + 1) for g in numbers]
        kinds += [("forget", 0, phases.sorts, phases.sorts + 1)] * phases.numbers_tiles
        kinds += [("mark", g, phases.marking, phases.marking + 1) for g in numbers if phases.numbers_tiles]
        kinds += [("sort", g, phases.sorts_of[g], phases.sorts_of[g] + phases.sort_length[g]) for g in numbers]
        kinds += [("average shown", g, phases.before_showing, phases.before_showing + 1) for g in phases.averages]
        kinds += [("show", g, phases.showing, phases.showing + 1) for g in numbers]
        self.kinds = tuple(kinds)

    @ti.real_func
    def do(
        self,
        k: ti.template(),
        w: int,
        phase: int,
        region: int,
        part: int,
        t: int,
        numbers: Numbers,
        counts: Counts,
        shown: Shown,
    ):
        """Do a part of a phase in a region as thread t, if it belongs to the k-th of the `kinds` or to a later one.

        A function calls the next one: of several that it calls, Taichi 1.7.4 puts the code into the key of its cache in
        the order of their addresses, so that the next process would find nothing.
        """
        what, g, first, after = ti.static(self.kinds[k])
        if phase >= first and phase < after:
            h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
            run = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
            if ti.static(what == "clear"):
                self.clear(run, region, part)
            if ti.static(what == "average"):
                self.average(run, g, w, phase - first, region, part, counts)
            if ti.static(what == "scatter"):
                self.scatter(run, g, w, phase - first, region, part, t, counts)
            if ti.static(what == "relax"):
                self.relax(run, g, w, region, part, counts)
            if ti.static(what == "find contact"):
                self.find_contact(run, w, region, part)
            if ti.static(what == "find friction"):
                self.find_friction(run, w, region, part)
            if ti.static(what == "update"):
                self.update(run, w, region, part)
            if ti.static(what == "advance"):
                self.advance(run, g, w, region, part, t, counts)
            if ti.static(what == "forget"):
                self.forget(run, region)
            if ti.static(what == "mark"):
                self.mark(run, g, w, region, counts)
            if ti.static(what == "sort"):
                self.sort(run, g, w, phase - first, region, counts)
            if ti.static(what == "average shown"):
                self.average_shown(run, g, w, region, counts)
            if ti.static(what == "show"):
                self.show(run, g, w, region, part, numbers, counts, shown)
        if ti.static(k + 1 < len(self.kinds)):
            self.do(ti.static(k + 1), w, phase, region, part, t, numbers, counts, shown)

    @ti.func
    def average(
        self, run: ti.template(), g: ti.template(), w: int, colour: int, region: int, part: int, counts: ti.template()
    ):
        """Add particles of the g-th group to the averages of their cells."""
        grid, _nodes, _particles, orders, seen = ti.static(run)
        if colour < self.phases.colours:
            first, after = self.pencils(orders[g], colour, region, part)
            average_pencils(grid, g, seen[g], orders[g], colour, first, after)
        elif region == 0 and part == 0:
            first, after = self.come_in(g, orders[g], w, counts)
            average_range(grid, g, seen[g], first, after)

    @ti.func
    def scatter(
        self,
        run: ti.template(),
        g: ti.template(),
        w: int,
        colour: int,
        region: int,
        part: int,
        t: int,
        counts: ti.template(),
    ):
        """Scatter particles of the g-th group."""
        grid, _nodes, particles, orders, seen = ti.static(run)
        kick, relaxed = self.values[w, KICK], self.values[w, RELAXED]
        if colour < self.phases.colours:
            first, after = self.pencils(orders[g], colour, region, part)
            if ti.static(grid.sparse):
                for q in range(first, after):
                    pencil = orders[g].pencil_of(colour, q)
                    begin, end = orders[g].first_tile_of(pencil), orders[g].first_tile_of(pencil + 1)
                    scatter_tiles(particles, g, seen[g], orders[g], begin, end, t, kick, relaxed)
            else:
                scatter_pencils(particles, g, seen[g], orders[g], colour, first, after, kick, relaxed)
        # On a sparse grid a sort follows on what comes in.
        if ti.static(self.device.comes_and_goes and not grid.sparse):
            if colour == self.phases.colours and region == 0 and part == 0:
                first, after = self.come_in(g, orders[g], w, counts)
                scatter_range(particles, g, seen[g], first, after, kick, relaxed)

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
    def relax(self, run: ti.template(), g: ti.template(), w: int, region: int, part: int, counts: ti.template()):
        """Relax the volumes of particles of the g-th group, in the steps that do."""
        _grid, _nodes, particles, _orders, _seen = ti.static(run)
        relaxed = self.values[w, RELAXED]
        if relaxed > 0.0:
            first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
            first, after = self.phases.share(first, after, part)
            change = 0.0
            for p in range(first, after):
                change = ti.max(change, particles.relax(self.device.groups[g], p, relaxed))
            ti.atomic_max(self.values[w, self.phases.rates + 2 * g + 1], change)

    @ti.func
    def advance(
        self, run: ti.template(), g: ti.template(), w: int, region: int, part: int, t: int, counts: ti.template()
    ):
        """Gather and move particles of the g-th group."""
        grid, _nodes, particles, orders, _seen = ti.static(run)
        dt, rate = self.values[w, MOVED], self.phases.rates + 2 * g
        if ti.static(grid.sparse):
            first, after = self.places.pencils_of(g, region)
            first, after = self.phases.share(first, after, part)
            begin, end = orders[g].first_tile_of(first), orders[g].first_tile_of(after)
            ti.atomic_max(
                self.values[w, rate], advance_tiles(particles, g, self.device.groups[g], orders[g], begin, end, t, dt)
            )
        else:
            first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
            first, after = self.phases.share(first, after, part)
            ti.atomic_max(self.values[w, rate], advance_range(particles, g, self.device.groups[g], first, after, dt))

    @ti.func
    def forget(self, run: ti.template(), region: int):
        """Take the numbers of the share of a region in the tiles."""
        grid, _nodes, _particles, _orders, _seen = ti.static(run)
        first, after = self.places.even_part(grid.sizes[BLOCKS], region)
        grid.forget(first, after)

    @ti.func
    def mark(self, run: ti.template(), g: ti.template(), w: int, region: int, counts: ti.template()):
        """Mark the tiles of the share of a region in the particles of the g-th group."""
        grid, _nodes, _particles, orders, _seen = ti.static(run)
        first, after = self.places.even_part(counts[w, self.count.capacity[g]], region)
        grid.mark(orders[g], first, after)

    @ti.func
    def average_shown(self, run: ti.template(), g: ti.template(), w: int, region: int, counts: ti.template()):
        """Average the volumes of the g-th group for a frame."""
        grid, _nodes, _particles, _orders, seen = ti.static(run)
        if region == 0:
            first = w * ti.static(self.device.room[g])
            average_for_frame(grid, g, seen[g], first, first + counts[w, self.count.particles[g]])

    @ti.func
    def show(
        self,
        run: ti.template(),
        g: ti.template(),
        w: int,
        region: int,
        part: int,
        numbers: ti.template(),
        counts: ti.template(),
        shown: ti.template(),
    ):
        """Write what particles of the g-th group show."""
        _grid, _nodes, _particles, _orders, seen = ti.static(run)
        first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
        if ti.static(self.device.comes_and_goes):
            # All of them, those that wait and those that left included.
            first, after = self.places.even_part(counts[w, self.count.capacity[g]], region)
            first += w * ti.static(self.device.room[g])
            after += w * ti.static(self.device.room[g])
        first, after = self.phases.share(first, after, part)
        row, last_step = counts[w, self.count.row], ti.cast(numbers[w, self.real.last_step], float)
        affine, gradient = counts[w, self.count.affine], counts[w, self.count.gradient]
        tau, activity = counts[w, self.count.tau], counts[w, self.count.activity]
        scratch, room = ti.static((self.device.orders[g].buffers, self.device.room[g]))
        offset = scratch_offset(scratch, g, w, room)
        show_range(
            seen[g], first, after - first, last_step, row, affine, gradient, tau, activity, shown, scratch.real, offset
        )

    @ti.func
    def sort(self, run: ti.template(), g: ti.template(), w: int, turn: int, region: int, counts: ti.template()):
        """Do the share of a region in a phase of the sort of the g-th group."""
        _grid, _nodes, _particles, orders, _seen = ti.static(run)
        first = w * ti.static(self.device.room[g])
        begin, end = self.places.even_part(counts[w, self.count.capacity[g]], region)
        # Other runs may be at other groups, which begin elsewhere: the scratch memory of a run is that of no other.
        own = w * ti.static(self.device.orders[g].buffers.room)
        if turn == 0:
            count_tiles(orders[g], w, region, first, begin, end)
        if turn == 1:
            place_particles(orders[g], w, region, first, begin, end)
        for i, field in ti.static(enumerate(self.phases.moved[g])):
            if turn == ti.static(2 + 2 * i):
                for q in range(begin, end):
                    keep(orders[g].buffers, field, own, q, orders[g].buffers.order[own + q])
            if turn == ti.static(3 + 2 * i):
                for q in range(begin, end):
                    take(orders[g].buffers, field, own, q, first + q)
