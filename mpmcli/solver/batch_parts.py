"""What threads do in the phases of a batch on the CPU, each a part at a time.

No number depends on who does a part: parts of a phase write disjoint memory, and maxima know no order.

Each phase is a function of its own in Taichi's code as well (`ti.real_func`), because the time to compile a function
grows with the square of its length. Such a function knows nothing of its caller but its arguments, so that each asks
for the numbers of the run anew.
"""

import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.batch_device import views
from mpmcli.solver.batch_phases import KICK, MOVED, RELAXED, SPEED, VECTORS, BatchPhases
from mpmcli.solver.cpu_loops import average_pencils, clear_rows, scatter_pencils, update_rows
from mpmcli.solver.frame_reader import show_range
from mpmcli.solver.lanes import advance_range, scatter_range
from mpmcli.solver.sorting import count_tiles, keep, place_particles, take
from mpmcli.solver.volume_average import average_for_frame, average_range

# Of all runs: numbers, counts and what particles show, see `Batch`.
Numbers = ti.types.ndarray(ti.f64, 2)
Counts = ti.types.ndarray(ti.i32, 2)
Shown = ti.types.ndarray(ndim=2)


@ti.data_oriented
class BatchParts:
    """The parts of the phases, w being the number of a run, region and part those of the part.

    Attributes:
        phases: their numbers.
    """

    def __init__(self, phases: BatchPhases) -> None:
        self.phases, self.device, self.dimension = phases, phases.device, phases.dimension
        self.members, self.count, self.real = phases.members, phases.count, phases.real
        self.shared, self.places, self.values = phases.shared, phases.places, phases.values

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
        if phase == 0:
            self.clear(w, region, part, numbers, counts)
        for g, begin in ti.static(self.phases.coloured):
            if phase >= begin and phase < begin + self.phases.passes:
                if ti.static(begin == self.phases.scatters[g]):
                    self.scatter(g, w, phase - begin, region, part, numbers, counts)
                else:
                    self.average(g, w, phase - begin, region, part, numbers, counts)
        for g, group in ti.static(self.members):
            if ti.static(group.law.relaxes):
                if phase == self.phases.relaxing:
                    self.relax(g, w, region, part, numbers, counts)
        if ti.static(self.device.nodes.needs_contact):
            if phase == self.phases.contact:
                self.find_contact(w, region, part, numbers, counts)
        if ti.static(self.device.nodes.needs_friction):
            if phase == self.phases.friction:
                self.find_friction(w, region, part, numbers, counts)
        if phase == self.phases.updating:
            self.update(w, region, part, numbers, counts)
        for g, group in ti.static(self.members):
            if phase == self.phases.last_of_step:
                self.advance(g, w, region, part, numbers, counts)
            if phase >= self.phases.sorts_of[g] and phase < self.phases.sorts_of[g] + self.phases.sort_length[g]:
                self.sort(g, w, phase, region, numbers, counts)
            if ti.static(group.averaged):
                if phase == self.phases.before_showing and region == 0:
                    self.average_shown(g, w, numbers, counts)
            if phase == self.phases.showing:
                self.show(g, w, region, part, numbers, counts, shown)

    @ti.func
    def gravity_step(self, w: int):
        """Return by how much gravity changes velocities in this step, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = self.values[w, VECTORS + a]
        return result

    @ti.real_func
    def clear(self, w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Clear nodes."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, _nodes, _particles, _orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        first, after = self.places.rows_of(grid, region)
        first, after = self.phases.share(first, after, part)
        clear_rows(grid, first, after)

    @ti.real_func
    def average(self, g: ti.template(), w: int, colour: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Add particles of the g-th group to the averages of their cells."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, _nodes, _particles, orders, seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        if colour < self.phases.colours:
            first, after = self.pencils(orders[g], colour, region, part)
            average_pencils(grid, g, seen[g], orders[g], colour, first, after)
        elif region == 0 and part == 0:
            first, after = self.come_in(g, orders[g], w, counts)
            average_range(grid, g, seen[g], first, after)

    @ti.real_func
    def scatter(self, g: ti.template(), w: int, colour: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Scatter particles of the g-th group."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        _grid, _nodes, particles, orders, seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        kick, relaxed = self.values[w, KICK], self.values[w, RELAXED]
        if colour < self.phases.colours:
            first, after = self.pencils(orders[g], colour, region, part)
            scatter_pencils(particles, g, seen[g], orders[g], colour, first, after, kick, relaxed)
        if ti.static(self.device.comes_and_goes):
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

    @ti.real_func
    def relax(self, g: ti.template(), w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Relax the volumes of particles of the g-th group, in the steps that do."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        _grid, _nodes, particles, _orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        relaxed = self.values[w, RELAXED]
        if relaxed > 0.0:
            first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
            first, after = self.phases.share(first, after, part)
            change = 0.0
            for p in range(first, after):
                change = ti.max(change, particles.relax(self.device.groups[g], p, relaxed))
            ti.atomic_max(self.values[w, self.phases.rates + 2 * g + 1], change)

    @ti.real_func
    def find_contact(self, w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Find where walls that let go are pressed."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, nodes, _particles, _orders, _seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        gravity_step = self.gravity_step(w)
        first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
        first, after = self.phases.share(first, after, part)
        for q in range(first, after):
            nodes.images.find_contact(grid, q, gravity_step)

    @ti.real_func
    def find_friction(self, w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Find the friction of walls."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, nodes, _particles, _orders, _seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        gravity_step = self.gravity_step(w)
        first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
        first, after = self.phases.share(first, after, part)
        for q in range(first, after):
            find_friction(nodes.images, grid, q, gravity_step)

    @ti.real_func
    def update(self, w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Turn the momentum of nodes into velocity."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, nodes, _particles, _orders, _seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        first, after = self.places.rows_of(grid, region)
        first, after = self.phases.share(first, after, part)
        ti.atomic_max(self.values[w, SPEED], update_rows(grid, nodes, first, after, self.gravity_step(w)))

    @ti.real_func
    def advance(self, g: ti.template(), w: int, region: int, part: int, numbers: Numbers, counts: Counts):
        """Gather and move particles of the g-th group."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        _grid, _nodes, particles, _orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        first, after = self.places.particles_of(g, w, region, counts[w, self.count.particles[g]])
        first, after = self.phases.share(first, after, part)
        sharpest = advance_range(particles, g, self.device.groups[g], first, after, self.values[w, MOVED])
        ti.atomic_max(self.values[w, self.phases.rates + 2 * g], sharpest)

    @ti.real_func
    def average_shown(self, g: ti.template(), w: int, numbers: Numbers, counts: Counts):
        """Average the volumes of the g-th group for a frame."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        grid, _nodes, _particles, _orders, seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        first = w * ti.static(self.device.room[g])
        average_for_frame(grid, g, seen[g], first, first + counts[w, self.count.particles[g]])

    @ti.real_func
    def show(self, g: ti.template(), w: int, region: int, part: int, numbers: Numbers, counts: Counts, shown: Shown):
        """Write what particles of the g-th group show."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        _grid, _nodes, _particles, _orders, seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
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
        show_range(seen[g], first, after - first, last_step, row, affine, gradient, tau, activity, shown)

    @ti.real_func
    def sort(self, g: ti.template(), w: int, phase: int, region: int, numbers: Numbers, counts: Counts):
        """Do the share of a region in a phase of the sort of the g-th group."""
        h, inverse, scale, box, last, extent = self.phases.place(w, numbers, counts)
        _grid, _nodes, _particles, orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        first = w * ti.static(self.device.room[g])
        begin, end = self.places.even_part(counts[w, self.count.capacity[g]], region)
        # Other runs may be at other groups, which begin elsewhere: the scratch memory of a run is that of no other.
        own = w * ti.static(self.device.orders[g].buffers.room)
        turn = phase - ti.static(self.phases.sorts_of[g])
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
