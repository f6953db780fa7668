"""The phases of bodies with their own velocity fields, see `body_contact`: a part on the CPU, an item on a GPU."""

from collections.abc import Sequence

from mpmcli.boundaries.feature import Phase
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.surfaces import Obstacles, position_of
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays

PUSH = "let bodies push each other"


def contact_phases(groups: Sequence[ParticleArrays], *, serial: bool, couples: bool) -> tuple[Phase, ...]:
    """Return the phases between the relaxation of volumes and the walls; for `serial` see `Feature.phases`.

    If the contact `couples` with rigid bodies, their velocities are found before all impulses.
    """
    shown = [g for g, group in enumerate(groups) if group.surfaced]
    lists = (
        (Phase("link_surfaces", "particles", "exchange", part=link_part),)
        if serial
        else (
            Phase("reserve", "nodes", "exchange", item=reserve_item),
            *(Phase("store", "particles", "exchange", g, item=store_item) for g in shown),
            Phase("link_slots", "nodes", "exchange", item=link_item),
        )
    )
    return (
        Phase("find_bodies", "nodes", "exchange", part=find_part, item=find_item, words="find bodies that meet"),
        *(
            Phase("find_surface", "particles", "exchange", g, part=find_surface_part, item=find_surface_item)
            for g in shown
        ),
        *lists,
        *(
            Phase("find_partners", "particles", "exchange", g, part=find_partners_part, item=find_partners_item)
            for g in shown
        ),
        *(rigid_phases() if couples else ()),
        Phase("exchange", "nodes", "exchange", part=exchange_part, item=exchange_item, words=PUSH),
        *[Phase("absorb", "runs", "exchange", part=absorb_part, item=absorb_item)] * couples,
    )


def rigid_phases() -> tuple[Phase, ...]:
    """Return the phases that find the velocities of rigid bodies after their contact with bodies."""
    return (
        Phase("weigh_rigid", "rows", "exchange", part=weigh_part, item=weigh_item, words="meet rigid bodies"),
        Phase("find_rigid", "runs", "exchange", part=find_rigid_part, item=find_rigid_item),
    )


def obstacles_of(view: object) -> Obstacles:
    """Return the walls and colliders of a run."""
    return Obstacles(view.nodes.images.walls, view.nodes.colliders, view.grid.spacing)


class ContactNode:
    """A node of a run where bodies may be in contact with each other or with obstacles.

    Attributes:
        grid, obstacles, step, w: grid restricted to such nodes, walls and colliders, step, and index of the run.
        gravity_step: change of velocity by gravity in the step, m/s.
        node, index: the node, and its index in layer 0; variables of a kernel that may change.
        rigid: the rigid bodies of the run, None without any.
    """

    def __init__(self, at: object, grid: Grid, gravity_step: object, node: object, index: object) -> None:
        self.grid, self.obstacles, self.step, self.w = grid, obstacles_of(at), at.step, at.w
        self.gravity_step, self.node, self.index = gravity_step, node, index
        self.rigid = at.features.rigid

    @ti.func
    def rigid_of(self, o: int):
        """Return the number of the rigid body that is obstacle o, or -1."""
        k, _i = self.obstacles.collider_of(o)
        result = -1
        for j in range(self.rigid.count):
            if self.rigid.numbers[j] == k:
                result = j
        return result

    @ti.func
    def swing(self, o: int, stiffness: float):
        """Return k dt^2 / m of the springs on all of obstacle o, an upper bound; 0 unless it is a rigid body.

        `stiffness` is that of a spring per volume of cells, times dt^2, kg/m^3 m^2.
        """
        j, result = self.rigid_of(o), 0.0
        if j >= 0:
            _k, i = self.obstacles.collider_of(o)
            mass = ti.cast(self.rigid.mass[self.w * self.rigid.count + j], float)
            width = 2.0 * self.rigid.colliders.reach[i][1, 0]
            result = stiffness / self.grid.spacing * width ** ti.static(self.grid.dimension - 1) / mass
        return result

    @ti.func
    def weigh(self, o: int, impulse: ti.template(), n: ti.template(), yields: float, holds: float):
        """Add to the sums of obstacle o, a rigid body, an impulse that it would take, N s.

        The impulse decreases with the velocity of the body by `yields` along the normal n, and by `holds` across, kg.
        """
        rigid, loads, d = ti.static((self.rigid, self.rigid.colliders.loads, self.grid.dimension))
        _k, i = self.obstacles.collider_of(o)
        arm = position_of(self.node, self.grid.spacing) - rigid.colliders.place[i]
        row = (self.w * loads.rows + loads.row_of(self.node)) * rigid.count + self.rigid_of(o)
        load = loads.of(impulse, arm)
        for a in ti.static(range(rigid.loads)):
            rigid.sums[row, a] = rigid.sums[row, a] + ti.cast(load[a], ti.f64)
        rigid.resist(row, ti.cast(loads.of(n, arm), ti.f64), yields - holds)
        if holds > 0.0:
            for c in ti.static(range(d)):
                along = ti.Vector.unit(d, c, float)
                rigid.resist(row, ti.cast(loads.of(along, arm), ti.f64), holds)


@ti.func
def near_bodies(phases: ti.template(), at: ti.template()):
    """Return, in a tuple, the view of the grid restricted to the box in which bodies may be in contact."""
    box = ti.Matrix.zero(int, 2, phases.dimension)
    for i, a in ti.static(ti.ndrange(2, phases.dimension)):
        box[i, a] = phases.device.features.contact.surfaces.box[at.w * 2 + i, a]
    return ti.static((at.grid.within(box),))


@ti.func
def rows_near_bodies(phases: ti.template(), grid: ti.template(), at: ti.template()):
    """Return the first row of a part of the nodes where bodies may be in contact, and the one after the last."""
    return phases.places.part_of(at, grid.row_count())


@ti.func
def clear_part(phases: ti.template(), at: ti.template()):
    """Clear the bins of a part of the nodes."""
    (grid,) = ti.static(near_bodies(phases, at))
    first, after = rows_near_bodies(phases, grid, at)
    phases.device.features.contact.surfaces.clear_rows(grid, at.w, first, after)


@ti.func
def find_part(phases: ti.template(), at: ti.template()):
    """Find the nodes where bodies are in contact."""
    (grid,) = ti.static(near_bodies(phases, at))
    (obstacles,) = ti.static((obstacles_of(at),))
    first, after = rows_near_bodies(phases, grid, at)
    phases.device.features.contact.surfaces.find_rows(grid, obstacles, at.w, first, after)


@ti.func
def find_item(phases: ti.template(), at: ti.template()):
    """Find which bodies are at a node, and whether they are in contact."""
    (grid,) = ti.static(near_bodies(phases, at))
    (obstacles,) = ti.static((obstacles_of(at),))
    if at.q < grid.box_nodes():
        phases.device.features.contact.surfaces.find(grid, obstacles, at.w, grid.box_node(at.q))


@ti.func
def find_surface_part(phases: ti.template(), at: ti.template()):
    """Find the surface data of particles of the g-th group."""
    (surfaces,) = ti.static((phases.device.features.contact.surfaces,))
    (grid,) = ti.static(near_bodies(phases, at))
    first, after = phases.places.part_of(at, surfaces.tile_count(grid, at.w))
    for q in range(first, after):
        surfaces.find_surface_points(at.g, grid, at.w, q)


@ti.func
def find_surface_item(phases: ti.template(), at: ti.template()):
    """Find the surface data of a particle."""
    (grid,) = ti.static(near_bodies(phases, at))
    phases.device.features.contact.surfaces.count_particle(at.g, grid, at.w, at.q)


@ti.func
def find_partners_part(phases: ti.template(), at: ti.template()):
    """Find what the surface points of the g-th group are inside of."""
    (surfaces,) = ti.static((phases.device.features.contact.surfaces,))
    (grid,) = ti.static(near_bodies(phases, at))
    (obstacles,) = ti.static((obstacles_of(at),))
    first, after = phases.places.part_of(at, surfaces.tile_count(grid, at.w))
    for q in range(first, after):
        surfaces.find_partners_in(at.g, grid, obstacles, at.w, q)


@ti.func
def find_partners_item(phases: ti.template(), at: ti.template()):
    """Find what the surface point of a particle is inside of."""
    (grid,) = ti.static(near_bodies(phases, at))
    (obstacles,) = ti.static((obstacles_of(at),))
    phases.device.features.contact.surfaces.find_partners(at.g, grid, obstacles, at.w, at.q)


@ti.func
def link_part(phases: ti.template(), at: ti.template()):
    """Insert the surface data of particles into the bins of their nodes, in order, on one thread."""
    if at.region == 0 and at.part == 0:
        (surfaces,) = ti.static((phases.device.features.contact.surfaces,))
        (grid,) = ti.static(near_bodies(phases, at))
        for q in range(surfaces.tile_count(grid, at.w)):
            for g in ti.static(surfaces.surfaced):
                surfaces.link(g, grid, at.w, q)


@ti.func
def reserve_item(phases: ti.template(), at: ti.template()):
    """Reserve space for the surface data at a node."""
    at_bins(phases, at, phases.device.features.contact.surfaces.reserve)


@ti.func
def store_item(phases: ti.template(), at: ti.template()):
    """Store a particle in its reserved space."""
    (grid,) = ti.static(near_bodies(phases, at))
    phases.device.features.contact.surfaces.store_particle(at.g, grid, at.w, at.q)


@ti.func
def link_item(phases: ti.template(), at: ti.template()):
    """Make lists of the surface data at a node."""
    at_bins(phases, at, phases.device.features.contact.surfaces.link_slots)


@ti.func
def at_bins(phases: ti.template(), at: ti.template(), do: ti.template()):
    """Call `do` for the bins of a node where bodies may be in contact."""
    (grid,) = ti.static(near_bodies(phases, at))
    if at.q < grid.box_nodes():
        (surfaces,) = ti.static((phases.device.features.contact.surfaces,))
        place = surfaces.index_in_batch(grid, at.w, grid.linear_index(grid.box_node(at.q)))
        ti.static(do)(at.w, place)


@ti.func
def exchange_part(phases: ti.template(), at: ti.template()):
    """Exchange momentum between bodies in contact at nodes, and with walls and colliders."""
    exchange_in_part(phases, at, False)


@ti.func
def weigh_part(phases: ti.template(), at: ti.template()):
    """Sum what rigid bodies would take."""
    exchange_in_part(phases, at, True)


@ti.func
def exchange_in_part(phases: ti.template(), at: ti.template(), weighs: ti.template()):
    """Visit the nodes of a part."""
    (grid,) = ti.static(near_bodies(phases, at))
    first, after = rows_near_bodies(phases, grid, at)
    for row in range(first, after):
        exchange_in_row(phases, at, row, weighs)


@ti.func
def exchange_in_row(phases: ti.template(), at: ti.template(), row: int, weighs: ti.template()):
    """Visit the nodes of a row."""
    (grid,) = ti.static(near_bodies(phases, at))
    gravity_step, node = phases.gravity_of(at.step), grid.row_start(row)
    index = grid.linear_index(node)
    (here,) = ti.static((ContactNode(at, grid, gravity_step, node, index),))
    for _ in range(grid.row_length(node)):
        phases.device.features.contact.exchange_all(here, weighs)
        node[ti.static(phases.dimension - 1)] += 1
        index += 1


@ti.func
def weigh_item(phases: ti.template(), at: ti.template()):
    """Sum what rigid bodies would take from a row."""
    (grid,) = ti.static(near_bodies(phases, at))
    if at.q < grid.row_count():
        exchange_in_row(phases, at, at.q, True)


@ti.func
def find_rigid_part(phases: ti.template(), at: ti.template()):
    """Find the velocities of rigid bodies."""
    if at.region == 0 and at.part == 0:
        at.features.rigid.solve(at.w, at.run.dt)


@ti.func
def find_rigid_item(phases: ti.template(), at: ti.template()):
    """Find the velocities of rigid bodies of a run."""
    at.features.rigid.solve(at.w, at.run.dt)


@ti.func
def absorb_part(phases: ti.template(), at: ti.template()):
    """Give rigid bodies what bodies have lost."""
    if at.region == 0 and at.part == 0:
        at.features.rigid.absorb_all(at.w, at.run.dt)


@ti.func
def absorb_item(phases: ti.template(), at: ti.template()):
    """Give rigid bodies of a run what bodies have lost."""
    at.features.rigid.absorb_all(at.w, at.run.dt)


@ti.func
def exchange_item(phases: ti.template(), at: ti.template()):
    """Exchange momentum between bodies at a node, and with walls and colliders."""
    (grid,) = ti.static(near_bodies(phases, at))
    if at.q < grid.box_nodes():
        gravity_step, node = phases.gravity_of(at.step), grid.box_node(at.q)
        index = grid.linear_index(node)
        (here,) = ti.static((ContactNode(at, grid, gravity_step, node, index),))
        phases.device.features.contact.exchange_all(here, False)
