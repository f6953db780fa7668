"""The phases of the kernel of a batch on the CPU: of a step, a sort, and a frame.

What is done in them, part by part, is in `batch_parts`.
"""

import taichi as ti

from mpmcli.solver.batch_device import Device
from mpmcli.solver.batch_layout import Layout
from mpmcli.solver.batch_regions import BatchRegions
from mpmcli.solver.ordering import share_start
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.splines import PAD
from mpmcli.solver.state_bounds import NOTHING

# Parts of a loop over the particles or the nodes of a region; on a sparse grid, where parts are whole pencils.
SHARES, SPARSE_SHARES = 4, 16
# Numbers of a step: its size and its kick, s, the time over which volumes relax, s, and the largest speed squared.
MOVED, KICK, RELAXED, SPEED, VECTORS = range(5)


@ti.data_oriented
class BatchPhases:
    """The phases of the runs of a batch, w being the number of a run.

    Attributes:
        shared: whether several threads work on one run; regions: of each run, one for each of them.
        places: of the regions in the particles and the nodes.
        shares: parts of a loop over a region.
        last_of_step, sorts, last_of_sort, showing: places of phases. A step begins with phase 0, a sort with `sorts`.
        coloured: (group, first phase) of the phases that go over the pencils of a group, of which there are `passes`.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.dimension = device, device.grid.dimension
        self.members = tuple(enumerate(device.groups))
        self.real, self.count = layout.real, layout.count
        self.shares = SPARSE_SHARES if device.grid.sparse else SHARES
        self.shared = device.runs == 1 and device.threads > 1
        self.regions = device.threads if self.shared else 1
        self.places = BatchRegions(device, self.regions)
        # Behind VECTORS gravity's change of velocity, and per group the largest rate and change by relaxation.
        self.rates = VECTORS + self.dimension
        self.values = ti.field(float, shape=(device.runs, self.rates + 2 * len(device.groups)))
        self.colours = device.orders[0].colours
        self.moves = device.motion is not None
        # What has come in since the sort follows all colours, on one thread.
        self.passes = passes = self.colours + device.comes_and_goes
        self.relaxes = any(group.law.relaxes for group in device.groups)
        # The first of the phases that average the volumes of a group, and of those that scatter it.
        averaged = [g for g, group in self.members if group.averaged]
        self.averages = {g: 1 + n * passes for n, g in enumerate(averaged)}
        begun = 1 + len(averaged) * passes
        self.scatters = {g: begun + g * passes for g, _ in self.members}
        self.coloured = (*self.averages.items(), *self.scatters.items())
        self.relaxing = begun + len(device.groups) * passes
        self.contact = self.relaxing + self.relaxes
        self.friction = self.contact + device.nodes.needs_contact
        self.updating = self.friction + device.nodes.needs_friction
        self.last_of_step = self.updating + 1
        # Of each group: count, place, and for each of its fields keep and take.
        self.moved = tuple((*group.state, *group.labels) for group in device.groups)
        self.sorts = self.last_of_step + 1
        # Tiles are numbered before anything is sorted: old numbers are taken, then tiles that hold particles marked.
        self.numbers_tiles = device.grid.sparse
        self.marking = self.sorts + 1
        self.sort_length = tuple(2 + 2 * len(fields) for fields in self.moved)
        firsts = [self.sorts + 2 * self.numbers_tiles]
        for length in self.sort_length:
            firsts.append(firsts[-1] + length)
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
