"""The loops of a step on a sparse grid over a share of its blocks, as one CPU thread runs them; see `cpu_loops`.

Particles are scattered and gathered tile by tile, in the window of the thread, and a window is added to the blocks as a
whole: so are the sums of a node those of tiles, in their order, for any number of threads.
"""

import taichi as ti

from mpmcli.solver.advance_range import advance_range
from mpmcli.solver.scatter_range import scatter_range
from mpmcli.solver.state_bounds import NOTHING


@ti.func
def clear_blocks(grid: ti.template(), first: int, after: int):
    """Clear the nodes of blocks `first` to `after` - 1."""
    for node in range(first * ti.static(grid.block), after * ti.static(grid.block)):
        grid.clear(node)


@ti.func
def scatter_tiles(
    particles: ti.template(),
    g: ti.template(),
    group: ti.template(),
    order: ti.template(),
    first: int,
    after: int,
    t: int,
    kick: float,
    relaxed: float,
):
    """Scatter the particles of the g-th group in tiles `first` to `after` - 1, as thread t."""
    grid, window = ti.static((particles.grid, particles.grid.window))
    for tile in range(first, after):
        begin, end = order.start[tile], order.start[tile + 1]
        if begin < end:
            place = grid.tile_place(grid.tile_at[tile])
            first_node = window.first_of(t, place)
            (near,) = ti.static((particles.beside(window.seen_from(grid, first_node)),))
            window.clear(window.nodes, t)
            if ti.static(grid.scheme.keeps_before):
                window.clear(window.before, t)
            if ti.static(grid.keeps_filling):
                if relaxed > 0.0:
                    window.clear(window.filling, t)
            scatter_range(near, g, group, begin, end, kick, relaxed)
            window.add(window.nodes, grid.nodes, grid, t, place)
            if ti.static(grid.scheme.keeps_before):
                window.add(window.before, grid.before, grid, t, place)
            if ti.static(grid.keeps_filling):
                if relaxed > 0.0:
                    window.add(window.filling, grid.filling, grid, t, place)


@ti.func
def update_blocks(grid: ti.template(), nodes: ti.template(), first: int, after: int, gravity_step: ti.template()):
    """Update the nodes of blocks `first` to `after` - 1 in the box; return the square of the largest velocity."""
    d = ti.static(grid.dimension)
    speed_squared = 0.0
    for b in range(first, after):
        place = grid.tile_place(grid.tile_at[b])
        for q in range(ti.static(grid.block)):
            node, inside = place, True
            for a in ti.static(range(d)):
                along = q // ti.static(grid.tile ** (d - 1 - a)) % ti.static(grid.tile)
                node[a] = place[a] * ti.static(grid.tile) + along
                inside = inside and node[a] >= grid.box[0, a] and node[a] < grid.box[0, a] + grid.box[1, a]
            if inside:
                index = b * ti.static(grid.block) + q
                squared = nodes.update(node, index, gravity_step)
                # As in `update_rows`.
                if squared > speed_squared:
                    speed_squared = squared
    return speed_squared


@ti.func
def advance_tiles(
    particles: ti.template(),
    g: ti.template(),
    group: ti.template(),
    order: ti.template(),
    first: int,
    after: int,
    t: int,
    dt: float,
):
    """Gather and move the particles of the g-th group in tiles; return their largest rate of deformation, 1/s."""
    grid, window = ti.static((particles.grid, particles.grid.window))
    sharpest = NOTHING
    for tile in range(first, after):
        begin, end = order.start[tile], order.start[tile + 1]
        if begin < end:
            place = grid.tile_place(grid.tile_at[tile])
            first_node = window.first_of(t, place)
            (near,) = ti.static((particles.beside(window.seen_from(grid, first_node)),))
            window.load(window.nodes, grid.nodes, grid, t, place)
            if ti.static(grid.scheme.keeps_before):
                window.load(window.before, grid.before, grid, t, place)
            sharpest = ti.max(sharpest, advance_range(near, g, group, begin, end, dt))
    return sharpest
