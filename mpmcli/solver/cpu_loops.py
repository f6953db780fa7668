"""The loops of a step over a share of the nodes or of the particles, as one CPU thread runs them."""

import taichi as ti

from mpmcli.solver.scatter_range import scatter_range
from mpmcli.solver.volume_average import average_range


@ti.func
def clear_rows(grid: ti.template(), first: int, last: int):
    """Clear the nodes in rows first to last - 1 of the box in use."""
    for row in range(first, last):
        node = grid.linear_index(grid.row_start(row))
        for k in range(grid.box[1, ti.static(grid.dimension - 1)]):
            grid.clear(node + k)


@ti.func
def average_pencils(
    grid: ti.template(),
    g: ti.template(),
    group: ti.template(),
    order: ti.template(),
    colour: int,
    first: int,
    last: int,
):
    """Add the particles of the g-th group in pencils first to last - 1 of a colour to their cells."""
    for r in range(first, last):
        pencil = order.pencil_of(colour, r)
        average_range(grid, g, group, order.first_particle_of(pencil), order.first_particle_of(pencil + 1))


@ti.func
def scatter_pencils(
    particles: ti.template(),
    g: ti.template(),
    group: ti.template(),
    order: ti.template(),
    colour: int,
    first: int,
    last: int,
    kick: float,
    relaxed: float,
):
    """Scatter the particles of the g-th group in pencils first to last - 1 of a colour."""
    for r in range(first, last):
        pencil = order.pencil_of(colour, r)
        begin, after = order.first_particle_of(pencil), order.first_particle_of(pencil + 1)
        scatter_range(particles, g, group, begin, after, kick, relaxed)


@ti.func
def update_rows(grid: ti.template(), nodes: ti.template(), first: int, last: int, gravity_step: ti.template()):
    """Update the nodes in rows first to last - 1 of the box in use; return the square of the largest velocity."""
    d = ti.static(grid.dimension)
    speed_squared = 0.0
    for row in range(first, last):
        node = grid.row_start(row)
        index = grid.linear_index(node)
        for k in range(grid.box[1, d - 1]):
            squared = nodes.update(node, index + k, gravity_step)
            # Not `ti.max`, which takes twice as long for its care of NaN, at every node without mass.
            if squared > speed_squared:
                speed_squared = squared
            node[d - 1] += 1
    return speed_squared
