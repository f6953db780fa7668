"""The loops of a step over the nodes or particles of one thread on the CPU; `at` is a `Part`.

On a sparse grid particles are scattered and gathered tile by tile in the window of the thread, and a window is added to
the blocks as a whole. The sum of a node is therefore a sum over tiles in fixed order, for any number of threads.
"""

from mpmcli.boundaries.feature import changed
from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.loop import over
from mpmcli.solver.particles.state_bounds import NOTHING


@ti.func
def add_over_tiles(at: ti.template(), op: ti.template(), first: int, after: int, how: float):
    """Carry out an operation that adds to nodes on the particles in tiles."""
    (window,) = ti.static((at.grid.window,))
    for tile in range(first, after):
        begin, end = at.order.start[tile], at.order.start[tile + 1]
        if begin < end:
            place = at.grid.tile_place(at.grid.tile_at[tile])
            first_node = window.first_of(at.t, place)
            (near,) = ti.static((at.particles.with_nodes(window.seen_from(at.grid, first_node)),))
            (inner,) = ti.static((changed(at, particles=near),))
            window.clear(at.t, at.step.relaxed)
            over(inner, op, begin, end, how)
            window.add(at.grid, at.t, place, at.step.relaxed)


@ti.func
def over_tiles(at: ti.template(), op: ti.template(), first: int, after: int, how: float):
    """Carry out an operation that reads nodes on the particles in tiles; return the largest value of `largest`."""
    (window,) = ti.static((at.grid.window,))
    most = NOTHING
    for tile in range(first, after):
        begin, end = at.order.start[tile], at.order.start[tile + 1]
        if begin < end:
            place = at.grid.tile_place(at.grid.tile_at[tile])
            first_node = window.first_of(at.t, place)
            (near,) = ti.static((at.particles.with_nodes(window.seen_from(at.grid, first_node)),))
            window.load(at.grid, at.t, place)
            (inner,) = ti.static((changed(at, particles=near),))
            most = ti.max(most, over(inner, op, begin, end, how))
    return most


@ti.func
def update_rows(at: ti.template(), first: int, last: int, gravity_step: ti.template()):
    """Update the nodes in rows first to last - 1 of the box in use; return the largest squared speed."""
    d = ti.static(at.grid.dimension)
    speed_squared = 0.0
    for row in range(first, last):
        node = at.grid.row_start(row)
        index, nodes = at.grid.linear_index(node), at.grid.row_length(node)
        for k in range(nodes):
            squared = at.nodes.update(node, index + k, gravity_step)
            # Not `ti.max`: its handling of NaN takes twice as long, at every node without mass.
            if squared > speed_squared:
                speed_squared = squared
            node[d - 1] += 1
    return speed_squared


@ti.func
def nodes_of_rows(at: ti.template(), first: int, last: int, time: float):
    """Apply the function of a phase to each node in rows first to last - 1 of the box in use."""
    for row in range(first, last):
        node = at.grid.row_start(row)
        count = at.grid.row_length(node)
        if ti.static(at.phase.wanted):
            if not ti.static(at.phase.wanted)(at, node):
                count = 0
        for _ in range(count):
            ti.static(at.phase.body)(at, node, time)
            node[ti.static(at.grid.dimension - 1)] += 1


@ti.func
def nodes_of_blocks(at: ti.template(), first: int, after: int, time: float):
    """Apply the function of a phase to each node of blocks `first` to `after` - 1."""
    grid, d = ti.static((at.grid, at.grid.dimension))
    for b in range(first, after):
        node = grid.tile_place(grid.tile_at[b])
        place = node
        for q in range(ti.static(grid.block)):
            for a in ti.static(range(d)):
                along = q // ti.static(grid.tile ** (d - 1 - a)) % ti.static(grid.tile)
                node[a] = place[a] * ti.static(grid.tile) + along
            ti.static(at.phase.body)(at, node, time)


@ti.func
def update_blocks(at: ti.template(), first: int, after: int, gravity_step: ti.template()):
    """Update the nodes of blocks `first` to `after` - 1 in the box; return the largest squared speed."""
    grid, d = ti.static((at.grid, at.grid.dimension))
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
                squared = at.nodes.update(node, b * ti.static(grid.block) + q, gravity_step)
                # Not `ti.max`, see `update_rows`.
                if squared > speed_squared:
                    speed_squared = squared
    return speed_squared
