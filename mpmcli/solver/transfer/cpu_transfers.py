"""P2G and G2P on the CPU, LANES particles at a time (see `lanes`). Additions to nodes are particle by particle.

The last functions are the loops of a step over the nodes or particles of one thread; `at` is a `Part`. On a sparse grid
particles are scattered and gathered tile by tile in the window of the thread, and a window is added to the blocks as a
whole. The sum of a node is therefore a sum over tiles in fixed order, for any number of threads.
"""

from mpmcli.boundaries.feature import changed
from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.arrays import VOLUME
from mpmcli.solver.particles.loop import over
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.particles.state_bounds import NOTHING, volume_ratio
from mpmcli.solver.transfer.lanes import (
    LANES,
    constants_of,
    deformation_of,
    internal_entries,
    load_entry,
    load_lanes,
    load_layers,
    load_rows,
    load_vectors,
    matrix_of,
    node_rows_of,
    node_values_of,
    repeat_first,
    set_deformation,
    set_matrix,
    set_vector,
    store_lanes,
    stored_entries,
    stored_of,
    vector_of,
    weights_of,
    zero_lanes,
)
from mpmcli.solver.transfer.particle_step import Loads, Sender, loads_on, p2g
from mpmcli.solver.transfer.particle_update import SMALLEST_J, scatter_volume
from mpmcli.solver.transfer.splines import bounded
from mpmcli.solver.transfer.stencils import add_linear


@ti.func
def scatter_range(
    particles: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int, kick: float, relaxed: float
):
    """Scatter particles first to last - 1 of the g-th group; no other thread may write to their nodes."""
    grid, near = ti.static((particles.grid, particles.near))
    d = ti.static(group.dimension)
    width = ti.static(grid.width)
    nodes = ti.static(grid.scheme.spline.nodes)
    inners = ti.static(internal_entries(group))
    # Positions on the grid, and positions in the domain where they differ.
    places, heres = zero_lanes(d), zero_lanes(ti.static(d if group.total else 1))
    speeds, affine = zero_lanes(d), zero_lanes(ti.static(d * d))
    deformation, internal = zero_lanes(ti.static(stored_entries(group))), zero_lanes(inners)
    rows, ratios = zero_lanes(ti.static(group.table.n)), ti.Vector.zero(float, LANES)
    shares, missing = ti.Vector.zero(float, LANES), ti.Vector.zero(float, LANES)
    pushes = zero_lanes(ti.static(d + d * d if group.is_pushed else 1))
    touches = zero_lanes(ti.static(d if particles.repels else 1))
    frictions = zero_lanes(ti.static(d if group.has_wall_friction else 1))
    shares_borne = zero_lanes(1)
    loaded = ti.static(
        group.uses_f_bar
        or particles.repels
        or group.has_wall_friction
        or group.is_pushed
        or grid.scheme.keeps_flip_velocity
    )
    first_node, behind = ti.Vector.zero(int, LANES), ti.Vector.zero(int, LANES)
    weights = zero_lanes(ti.static(nodes * d))
    middles, changes = ti.Matrix.zero(float, LANES, width), ti.Matrix.zero(float, LANES, ti.static(d * width))
    if ti.static(not group.many_bodies):
        load_rows(group, first, 1, rows)
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        load_lanes(group, begin, count, affine, deformation, internal)
        if ti.static(group.many_bodies):
            load_rows(group, begin, count, rows)
        origin = bounded(begin)
        load_vectors(places, group.place_on_grid, origin)
        load_vectors(speeds, group.v, origin)
        if ti.static(group.eased):
            load_entry(shares_borne, 0, group.borne, (), origin)
        if ti.static(group.total):
            load_vectors(heres, group.x, origin)
        if count < LANES:
            repeat_first(places, count)
            repeat_first(speeds, count)
            repeat_first(heres, count)
        load_layers(behind, grid, group, begin, count)
        for lane in range(ti.static(LANES * loaded)):
            # Loads read tables by particle, so that lanes beyond the last particle repeat it.
            p = begin + ti.min(lane, count - 1)
            share, lacking, push, slope, touch, friction = loads_on(particles, g, group, p, kick, lane < count)
            shares[lane], missing[lane] = share, lacking
            set_vector(pushes, 0, push, lane)
            set_matrix(pushes, d, slope, lane)
            set_vector(touches, 0, touch, lane)
            set_vector(frictions, 0, friction, lane)

        for lane in range(LANES):
            place, v, C = vector_of(places, 0, d, lane), vector_of(speeds, 0, d, lane), matrix_of(affine, 0, d, lane)
            here = place
            if ti.static(group.total):
                here = vector_of(heres, 0, d, lane)
            state, inner = stored_of(group, deformation, lane), vector_of(internal, 0, inners, lane)
            row, constants = vector_of(rows, 0, ti.static(group.table.n), lane), constants_of(rows, lane)
            share, lacking = shares[lane], missing[lane]
            push, slope = vector_of(pushes, 0, d, lane), matrix_of(pushes, d, d, lane)
            touch, friction = vector_of(touches, 0, d, lane), vector_of(frictions, 0, d, lane)
            (loads,) = ti.static((Loads(share, lacking, push, slope, touch, friction),))
            borne = shares_borne[0, lane]
            (own,) = ti.static((Sender(place, here, v, C, state, inner, row, constants, loads, borne),))
            base, distance = grid.scheme.spline.stencil(place, grid.inverse_spacing)
            middle, change, plastic, inner_after = p2g(particles, group, own, distance, kick)
            ratios[lane] = volume_ratio(group, state)
            if ti.static(group.law.projects):
                set_deformation(group, deformation, deformation_of(group, deformation, lane) + plastic, lane)
                set_vector(internal, 0, inner_after, lane)
            first_node[lane] = near.linear_index(base) + behind[lane]
            w = grid.scheme.spline.weights(distance)
            for k in ti.static(range(nodes)):
                for a in ti.static(range(d)):
                    weights[k * d + a, lane] = w[k, a]
            for c in ti.static(range(width)):
                middles[lane, c] = middle[c]
                for a in ti.static(range(d)):
                    changes[lane, a * width + c] = change[a, c]

        if ti.static(group.law.projects):
            store_projected(group, begin, count, deformation, internal, ratios)
        for lane in range(count):
            p = begin + lane
            # The stress of a crushed or inverted particle would spread NaN over the grid.
            if ratios[lane] > SMALLEST_J:
                w = weights_of(weights, nodes, d, lane)
                middle = node_values_of(middles, 0, width, lane)
                change = node_rows_of(changes, d, width, 0, width, lane)
                add_linear(near.nodes, near, first_node[lane], w, middle, change, False)
            else:
                ti.atomic_min(particles.lost[particles.first_lost + g], p)
            if ti.static(grid.keeps_filling):
                if relaxed > 0.0:
                    scatter_volume(group.x[p], group.row(p)[VOLUME], near, False)
        begin += LANES


@ti.func
def store_projected(
    group: ti.template(),
    begin: int,
    count: int,
    deformation: ti.template(),
    internal: ti.template(),
    ratios: ti.template(),
):
    """Store the states that a law has projected, except those of crushed or inverted particles."""
    d = ti.static(group.dimension)
    keeps_F = ti.static(group.law.deformation == "F")
    sound = 0
    for lane in range(LANES):
        sound += ti.cast(ratios[lane] > SMALLEST_J, int)
    if count == LANES and sound == LANES:
        # Entry by entry, so that entries of neighbouring particles are stored at once.
        origin = bounded(begin)
        if ti.static(keeps_F):
            for i, j in ti.static(ti.ndrange(d, d)):
                store_lanes(group.displacement_gradient, (i, j), origin, deformation, i * d + j)
        else:
            store_lanes(group.J_minus_1, (), origin, deformation, 0)
        for i in ti.static(range(len(group.internal))):
            store_lanes(group.internal[i], (), origin, internal, i)
    else:
        for lane in range(count):
            p = begin + lane
            stay_rolled(group.id, p)
            if ratios[lane] > SMALLEST_J:
                if ti.static(keeps_F):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        group.displacement_gradient[p][i, j] = deformation[i * d + j, lane]
                else:
                    group.J_minus_1[p] = deformation[0, lane]
                for i in ti.static(range(len(group.internal))):
                    group.internal[i][p] = internal[i, lane]


@ti.func
def scatter_pencils(at: ti.template(), first: int, last: int, kick: float, relaxed: float):
    for r in range(first, last):
        pencil = at.order.pencil_of(at.turn, r)
        if ti.static(at.grid.sparse):
            scatter_tiles(at, at.order.first_tile_of(pencil), at.order.first_tile_of(pencil + 1), kick, relaxed)
        else:
            begin, after = at.order.first_particle_of(pencil), at.order.first_particle_of(pencil + 1)
            scatter_range(at.particles, at.g, at.group, begin, after, kick, relaxed)


@ti.func
def scatter_tiles(at: ti.template(), first: int, after: int, kick: float, relaxed: float):
    (window,) = ti.static((at.grid.window,))
    for tile in range(first, after):
        begin, end = at.order.start[tile], at.order.start[tile + 1]
        if begin < end:
            place = at.grid.tile_place(at.grid.tile_at[tile])
            first_node = window.first_of(at.t, place)
            (near,) = ti.static((at.particles.with_nodes(window.seen_from(at.grid, first_node)),))
            window.clear(at.t, relaxed)
            scatter_range(near, at.g, at.group, begin, end, kick, relaxed)
            window.add(at.grid, at.t, place, relaxed)


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
def nodes_of_rows(at: ti.template(), first: int, last: int, kick: float):
    """Apply the function of a phase to each node in rows first to last - 1 of the box in use."""
    for row in range(first, last):
        node = at.grid.row_start(row)
        count = at.grid.row_length(node)
        if ti.static(at.wanted):
            if not ti.static(at.wanted)(at, node):
                count = 0
        for _ in range(count):
            ti.static(at.item)(at, node, kick)
            node[ti.static(at.grid.dimension - 1)] += 1


@ti.func
def nodes_of_blocks(at: ti.template(), first: int, after: int, kick: float):
    """Apply the function of a phase to each node of blocks `first` to `after` - 1."""
    grid, d = ti.static((at.grid, at.grid.dimension))
    for b in range(first, after):
        node = grid.tile_place(grid.tile_at[b])
        place = node
        for q in range(ti.static(grid.block)):
            for a in ti.static(range(d)):
                along = q // ti.static(grid.tile ** (d - 1 - a)) % ti.static(grid.tile)
                node[a] = place[a] * ti.static(grid.tile) + along
            ti.static(at.item)(at, node, kick)


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
