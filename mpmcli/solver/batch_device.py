"""What a batch has on the device, and the view of it that one run has in the kernel."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

from mpmcli.boundaries.rough_faces import RoughFaces
from mpmcli.boundaries.walls import Walls
from mpmcli.boundaries.zeroed_walls import ZeroedWalls
from mpmcli.solver.batch_values import BatchValues
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.ordering import TileOrder
from mpmcli.solver.particle_arrays import ParticleArrays
from mpmcli.solver.particle_update import ParticleUpdate


@dataclass(frozen=True)
class Device:
    """What a batch has on the device.

    Attributes:
        runs: number of runs; room: particles of each, per group.
        groups, orders: of each law, with the particles of all runs.
        friction: coefficients of the walls of each run.
        values, gravity: numbers that expressions read, and gravity where it varies.
    """

    runs: int
    room: Sequence[int]
    threads: int
    grid: Grid
    groups: Sequence[ParticleArrays]
    orders: Sequence[TileOrder]
    walls: Walls | ZeroedWalls
    friction: RoughFaces
    nodes: NodeUpdate
    particles: ParticleUpdate
    values: BatchValues
    gravity: Gravity


def _changed(thing: object, **attributes: object) -> object:
    result = copy(thing)
    for name, value in attributes.items():
        setattr(result, name, value)
    return result


def views(
    device: Device, w: object, h: object, inverse: object, scale: object, box: object, last: object, extent: object
) -> tuple[Grid, NodeUpdate, ParticleUpdate, tuple[TileOrder, ...], tuple[ParticleArrays, ...]]:
    """Return the grid, the updates, the orders and the groups of one run.

    Args:
        w: its number. This and what follows are variables of the kernel.
        h, inverse, scale: spacing, inverse_spacing and gradient_scale of the `Grid`; box: its box.
        last: node of the upper walls per axis; extent: size of the domain, m.
    """
    grid = _changed(
        device.grid,
        spacing=h,
        inverse_spacing=inverse,
        gradient_scale=scale,
        box=box,
        first_node=w * device.grid.node_count,
    )
    friction = _changed(device.friction, first=w * len(device.friction.faces))
    walls = _changed(device.walls, last=last, friction=friction)
    images = device.nodes.images
    if images is not None:
        walls.first_plane = w * len(walls.separating)
        walls.first_rough = w * len(walls.rough)
        images = _changed(images, walls=walls)
    nodes = _changed(device.nodes, grid=grid, images=images, boundaries=(walls,))
    particles = _changed(
        device.particles,
        grid=grid,
        extent=extent,
        last=last,
        first_lost=w * len(device.groups),
        friction=friction,
        run=w,
    )
    orders = tuple(_changed(order, grid=grid, first_tile=w * (order.tiles + 1)) for order in device.orders)
    groups = tuple(group.seen_from(w) if group.pushed else group for group in device.groups)
    return grid, nodes, particles, orders, groups
