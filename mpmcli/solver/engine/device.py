"""What a batch has on the device, and the view of it that one run has in the kernel."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

from mpmcli.boundaries.colliders import ColliderMotion, Colliders
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.boundaries.rigid_contact import RigidContact
from mpmcli.boundaries.walls import MovingFaces, RoughFaces, Walls
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.drive.forces import DriveValues, Gravity
from mpmcli.solver.engine.phases import Phase, step_phases
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.particles.inflow import Emission
from mpmcli.solver.particles.sort import TileOrder
from mpmcli.solver.transfer.node_update import NodeUpdate
from mpmcli.solver.transfer.particle_update import ParticleUpdate


@dataclass(frozen=True)
class Device:
    """What a batch has on the device.

    Attributes:
        runs: number of runs; room: particles of each, per group.
        groups, orders: of each law, with the particles of all runs.
        friction, moving: coefficients and velocities of the walls of each run.
        colliders, motion: those of each run, and how they move; None where there are none.
        rigid, rigid_contact: those that move freely, and what else than material they meet; None where there are none.
        values, gravity: numbers that expressions read, and gravity where it varies.
        emission: the mouths of emitters, None where there are none.
        contact: of bodies with layers of nodes of their own, None where all share one.
        stencils: (2 runs, d) int, of each run the first and the last node per axis at which a stencil began when
            particles were sorted; None on a GPU.
        sorts: whether particles are sorted; several small runs on a GPU use all nodes of their domains instead.
    """

    runs: int
    room: Sequence[int]
    threads: int
    grid: Grid
    groups: Sequence[ParticleArrays]
    orders: Sequence[TileOrder]
    walls: Walls
    friction: RoughFaces
    moving: MovingFaces
    nodes: NodeUpdate
    particles: ParticleUpdate
    values: DriveValues
    gravity: Gravity
    colliders: Colliders | None = None
    motion: ColliderMotion | None = None
    rigid: RigidBodies | None = None
    rigid_contact: RigidContact | None = None
    emission: Emission | None = None
    contact: BodyContact | None = None
    stencils: ti.Field | None = None
    sorts: bool = True

    @property
    def comes_and_goes(self) -> bool:
        """Whether particles come or go."""
        return self.groups[0].comes_and_goes

    @property
    def phases(self) -> tuple[Phase, ...]:
        """What a step consists of."""
        return step_phases(
            [group.law for group in self.groups],
            [group.averaged for group in self.groups],
            contact=self.nodes.needs_contact and (self.contact is None or self.contact.surfaces.shares),
            friction=self.nodes.needs_friction,
            deterministic=self.grid.deterministic,
            loads=self.grid.deterministic and self.nodes.collides,
            shifts=self.grid.dimension if self.grid.fine else 0,
            separates=self.contact is not None,
            rigid=self.rigid is not None,
        )


def _changed(thing: object, **attributes: object) -> object:
    result = copy(thing)
    for name, value in attributes.items():
        setattr(result, name, value)
    return result


def views(
    device: Device, w: object, h: object, inverse: object, scale: object, box: object, last: object, extent: object
) -> tuple[Grid, NodeUpdate, ParticleUpdate, tuple[TileOrder, ...], tuple[ParticleArrays, ...]]:
    """Return the grid, the updates, the orders and the groups of one run.

    w: its number. This and what follows are variables of the kernel; h, inverse, scale: spacing, inverse_spacing and
    gradient_scale of the `Grid`; box: its box; last: node of the upper walls per axis; extent: size of the domain, m.
    """
    fixed, fine = device.grid.fixed, device.grid.fine
    grid = _changed(
        device.grid,
        fixed=None if fixed is None else _changed(fixed, run=w),
        fine=None if fine is None else _changed(fine, first_node=w * fine.node_count),
        spacing=h,
        inverse_spacing=inverse,
        gradient_scale=scale,
        box=box,
        first_node=w * (device.grid.layers * device.grid.node_count),
        period=device.grid.period.seen_from(w),
    )
    friction = _changed(device.friction, first=w * len(device.friction.faces))
    moving = _changed(device.moving, first=w * len(device.moving.faces))
    walls = _changed(device.walls, last=last, friction=friction, moving=moving)
    walls.first_plane = w * (device.grid.layers * len(walls.separating))
    walls.first_rough = w * (device.grid.layers * len(walls.rough))
    images = _changed(device.nodes.images, walls=walls)
    colliders, rigid = device.colliders, device.rigid
    if colliders is not None:
        colliders = _changed(colliders, run=w, spacing=h)
    if rigid is not None:
        rigid = _changed(rigid, run=w, colliders=colliders)
    nodes = _changed(device.nodes, grid=grid, images=images, colliders=colliders, rigid=rigid)
    particles = _changed(
        device.particles,
        grid=grid,
        near=grid,
        extent=extent,
        last=last,
        first_lost=w * len(device.groups),
        friction=friction,
        moving=moving,
        run=w,
    )
    orders = tuple(
        _changed(order, grid=grid, extent=extent, first_tile=w * (order.bins + 1)) for order in device.orders
    )
    groups = tuple(group.seen_from(w) if group.pushed or group.repeats else group for group in device.groups)
    return grid, nodes, particles, orders, groups
