"""The bodies of the phases of a step on a GPU: what a thread does for one node or one particle of a run.

Scatters add atomically: in any order, so that bytes differ from run to run, or in fixed point (`fixed_point`).
"""

from mpmcli.boundaries.mirror_images import find_friction
from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.device import Device, views
from mpmcli.solver.engine.phases import Phase
from mpmcli.solver.engine.run_numbers import Layout
from mpmcli.solver.transfer.splines import PAD
from mpmcli.solver.transfer.volume_average import add_volume, clear_mean, missing_to_mean

# Numbers of a run: of its domain, before the extent, and of its step, before gravity's change of velocity.
SPACING, INVERSE, SCALE, EXTENT = range(4)
STEP, KICK, RELAXED, STABLE, PULL = range(5)


class Item:
    """A node, a particle, or a row of nodes that a thread works on, with the view that its run has of the device.

    grid, nodes, particles, order, group: see `views`; the last two are those of a group of particles. g: number of the
    group; w: of the run; turn: of the phase; q: of the item. atomic: whether sums need atomics, True.
    """

    atomic = True

    def __init__(self, run: tuple, phase: Phase, turn: int, *variables: object) -> None:
        """Keep a view, and variables of a kernel."""
        g, self.item, self.turn = phase.group, phase.body, turn
        self.grid, self.nodes, self.particles, orders, groups = run
        self.g, self.group, self.order = g, groups[g], orders[g] if orders else None
        self.w, self.q = variables


@ti.data_oriented
class GpuPhases:
    """The phases of the runs of a batch, w being the number of a run and q that of a node, a particle, or a row.

    Attributes:
        domain: (runs) Vector: spacing, its inverse, the gradient's scale, and the extent.
        step: (runs) Vector: size, kick, time over which volumes relax, stable step, and gravity's change of velocity.
        speed_squared: (runs), the largest of a node; rates, changes: (runs, groups), the largest rate of deformation,
            and change of the logarithm of a volume by relaxation.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.count, self.dimension = device, layout.count, device.grid.dimension
        runs, groups = device.runs, len(device.groups)
        self.domain = ti.Vector.field(EXTENT + self.dimension, float, shape=runs)
        self.step = ti.Vector.field(PULL + self.dimension, float, shape=runs)
        self.speed_squared = ti.field(float, shape=runs)
        self.rates, self.changes = (ti.field(float, shape=(runs, groups)) for _ in range(2))

    @ti.func
    def view_numbers(self, w: int, counts: ti.template()):
        """Return what `views` takes of a run: spacing, its inverse, the gradient's scale, box, last node, extent."""
        d = ti.static(self.dimension)
        own = self.domain[w]
        last = ti.Vector.zero(int, d)
        extent = ti.Vector.zero(float, d)
        box = ti.Matrix.zero(int, 2, d)
        for a in ti.static(range(d)):
            last[a] = PAD + counts[w, self.count.cells[a]]
            extent[a] = own[EXTENT + a]
            for i in ti.static(range(2)):
                box[i, a] = self.device.grid.box[w * 2 + i, a]
        return own[SPACING], own[INVERSE], own[SCALE], box, last, extent

    @ti.func
    def pull(self, w: int):
        """Return the change of velocity by gravity in the step of a run, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = self.step[w][PULL + a]
        return result

    @ti.func
    def do(self, phase: ti.template(), turn: ti.template(), w: int, q: int, counts: ti.template()):
        """Do what a phase does for one item of a run in one of its turns."""
        h, inverse, scale, box, last, extent = self.view_numbers(w, counts)
        run = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        (at,) = ti.static((Item(run, phase, turn, w, q),))
        ti.static(self.body(phase))(at)

    def body(self, phase: Phase) -> object:
        """Return the method of a phase."""
        if phase.body:
            return self.each_node if phase.over == "nodes" else self.each_particle
        return getattr(self, phase.name)

    @ti.func
    def each_node(self, at: ti.template()):
        """Do what the phase says for a node, in the steps that shift particles."""
        if self.step[at.w][RELAXED] > 0.0 and at.q < at.grid.box_nodes():
            ti.static(at.item)(at, at.grid.box_node(at.q), self.step[at.w][RELAXED])

    @ti.func
    def each_particle(self, at: ti.template()):
        """Do what the phase says for a particle, in the steps that shift particles."""
        if self.step[at.w][RELAXED] > 0.0:
            ti.static(at.item)(at, at.q, self.step[at.w][RELAXED])

    @ti.func
    def clear(self, at: ti.template()):
        """Clear a node."""
        if at.q < at.grid.box_nodes():
            at.grid.clear(at.grid.linear_index(at.grid.box_node(at.q)))

    @ti.func
    def average(self, at: ti.template()):
        """Add a particle to the averages of its cell."""
        add_volume(at.grid, at.g, at.group, at.q)

    @ti.func
    def scatter(self, at: ti.template()):
        """Scatter a particle."""
        at.particles.scatter(at.g, at.group, at.q, self.step[at.w][KICK], self.step[at.w][RELAXED])

    @ti.func
    def settle(self, at: ti.template()):
        """Set a node from its sums in fixed point."""
        if at.q < at.grid.box_nodes():
            at.grid.fixed.settle(at.grid, at.grid.linear_index(at.grid.box_node(at.q)), self.step[at.w][RELAXED])

    @ti.func
    def relax(self, at: ti.template()):
        """Relax the volume of a particle, in the steps that do."""
        if self.step[at.w][RELAXED] > 0.0:
            change = at.particles.relax(self.device.groups[at.g], at.q, self.step[at.w][RELAXED])
            if change > self.changes[at.w, at.g]:
                ti.atomic_max(self.changes[at.w, at.g], change)

    @ti.func
    def find_contact(self, at: ti.template()):
        """Find whether a wall that lets go is pressed."""
        if at.q < at.nodes.images.plane_nodes(at.grid):
            at.nodes.images.find_contact(at.grid, at.q, self.pull(at.w))

    @ti.func
    def find_friction(self, at: ti.template()):
        """Find the friction of a wall."""
        if at.q < at.nodes.images.plane_nodes(at.grid):
            find_friction(at.nodes.images, at.grid, at.q, self.pull(at.w))

    @ti.func
    def update(self, at: ti.template()):
        """Turn the momentum of a node into velocity."""
        if at.q < at.grid.box_nodes():
            node = at.grid.box_node(at.q)
            squared = at.nodes.update(node, at.grid.linear_index(node), self.pull(at.w))
            # The comparison may be late, and saves most atomics.
            if squared > self.speed_squared[at.w]:
                ti.atomic_max(self.speed_squared[at.w], squared)

    @ti.func
    def book_loads(self, at: ti.template()):
        """Add up what the nodes of a row gave to a collider, in their order."""
        at.nodes.colliders.book_row(at.q)

    @ti.func
    def advance(self, at: ti.template()):
        """Gather and move a particle."""
        rate = at.particles.advance(at.g, self.device.groups[at.g], at.q, self.step[at.w][STEP], self.pull(at.w))
        if rate > self.rates[at.w, at.g]:
            ti.atomic_max(self.rates[at.w, at.g], rate)

    # What is done beside the steps.

    @ti.func
    def average_for_frame(self, g: ti.template(), w: int, p: int, turn: ti.template(), counts: ti.template()):
        """Average volumes before a frame is read: clear the cell of a particle, add it, and take the mean."""
        h, inverse, scale, box, last, extent = self.view_numbers(w, counts)
        grid, _nodes, _particles, _orders, seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        if ti.static(turn == 0):
            clear_mean(grid, g, seen[g], p)
        if ti.static(turn == 1):
            add_volume(grid, g, seen[g], p)
        if ti.static(turn == 2):
            seen[g].to_mean[p] = missing_to_mean(grid, g, seen[g], p)

    @ti.func
    def bin_of(self, g: ti.template(), w: int, p: int, counts: ti.template()):
        """Put a particle back into the domain where that repeats, and return its bin."""
        h, inverse, scale, box, last, extent = self.view_numbers(w, counts)
        _grid, _nodes, _particles, orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        orders[g].settle(p)
        return orders[g].bin_of(p)

    @ti.func
    def first_node_of(self, g: ti.template(), w: int, p: int, counts: ti.template()):
        """Return the first node of the stencil of a particle."""
        h, inverse, scale, box, last, extent = self.view_numbers(w, counts)
        _grid, _nodes, _particles, orders, _seen = ti.static(
            views(self.device, w, h, inverse, scale, box, last, extent)
        )
        return orders[g].first_node_of(p)

    @ti.func
    def nodes_in_use(self, w: int, counts: ti.template()):
        """Return the number of nodes in use, and of those on the planes of faces."""
        h, inverse, scale, box, last, extent = self.view_numbers(w, counts)
        grid, nodes, _particles, _orders, _seen = ti.static(views(self.device, w, h, inverse, scale, box, last, extent))
        planes = 0
        if ti.static(self.device.nodes.needs_contact or self.device.nodes.needs_friction):
            planes = nodes.images.plane_nodes(grid)
        return grid.box_nodes(), planes
