"""P2G and G2P on the CPU, LANES particles at once: see `lanes`. What is added to nodes follows particle by particle.

At the end the loops of a step over a share of the nodes or of the particles, as one thread runs them; `at` is a `Part`.
On a sparse grid particles are scattered and gathered tile by tile, in the window of the thread, and a window is added
to the blocks as a whole: so are the sums of a node those of tiles, in their order, for any number of threads.
"""

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.arrays import CONSTANTS, MASS, VOLUME
from mpmcli.solver.particles.state_bounds import NOTHING, deformation_rate, volume_growth, volume_ratio
from mpmcli.solver.solids.reference_grid import friction_of_walls, pulled_back, push_of_walls
from mpmcli.solver.transfer.lanes import (
    LANES,
    constants_of,
    internal_entries,
    load_deformation,
    load_entry,
    load_lanes,
    load_layers,
    load_rows,
    load_vectors,
    matrix_of,
    node_rows_of,
    node_values_of,
    repeat_first,
    store_lanes,
    stored_entries,
    stored_of,
    vector_of,
    weights_of,
    zero_lanes,
)
from mpmcli.solver.transfer.particle_update import (
    SMALLEST_J,
    add_kept,
    centred,
    deformed_gradient,
    momentum,
    scatter_volume,
    turned,
)
from mpmcli.solver.transfer.splines import bounded
from mpmcli.solver.transfer.stencils import add_linear, gather_linear
from mpmcli.solver.transfer.volume_average import (
    average_range,
    even,
    log_volume,
    missing_growth,
    missing_to_mean,
    stretch_to,
)


@ti.func
def scatter_range(
    particles: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int, kick: float, relaxed: float
):
    """Scatter particles first to last - 1 of the g-th group; no other thread may write their nodes."""
    grid, near = ti.static((particles.grid, particles.near))
    d = ti.static(group.dimension)
    width = ti.static(grid.width)
    nodes = ti.static(grid.scheme.spline.nodes)
    keeps_F = ti.static(group.law.deformation == "F")
    inners = ti.static(internal_entries(group))
    x, v, affine = zero_lanes(d), zero_lanes(d), zero_lanes(ti.static(d * d))
    touches = zero_lanes(ti.static(d if particles.touches else 1))
    frictions = zero_lanes(ti.static(d if group.slips else 1))
    # Where particles are, if that is not where they are on the grid.
    here = zero_lanes(ti.static(d if group.total else 1))
    deformation, internal = zero_lanes(ti.static(stored_entries(group))), zero_lanes(inners)
    rows = zero_lanes(ti.static(group.table.n))
    pushes = zero_lanes(ti.static(d + d * d if group.pushed else 1))
    ratios = ti.Vector.zero(float, LANES)
    missing = ti.Vector.zero(float, LANES)
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    middles, slopes = ti.Matrix.zero(float, LANES, width), ti.Matrix.zero(float, LANES, ti.static(d * width))
    keeps = ti.static(grid.scheme.keeps_before)
    shares, behind = ti.Vector.zero(float, LANES), ti.Vector.zero(int, LANES)
    if ti.static(not group.several):
        load_rows(group, first, 1, rows)
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        load_lanes(group, begin, count, affine, deformation, internal)
        if ti.static(group.several):
            load_rows(group, begin, count, rows)
        origin = bounded(begin)
        load_vectors(x, group.place_on_grid, origin)
        load_vectors(v, group.v, origin)
        if ti.static(group.total):
            load_vectors(here, group.x, origin)
        if count < LANES:
            repeat_first(x, count)
            repeat_first(v, count)
            repeat_first(here, count)
        load_layers(behind, grid, group, begin, count)
        more = ti.static(group.averaged or particles.touches or group.slips or group.pushed or keeps)
        for lane in range(ti.static(LANES * more)):
            # What reads more than arrays: lanes beyond the last particle repeat it.
            p = begin + ti.min(lane, count - 1)
            if ti.static(group.averaged):
                missing[lane] = missing_to_mean(grid, g, group, p)
            if ti.static(keeps):
                shares[lane] = group.kept[group.row_number(p)]
            if ti.static(particles.touches):
                push = particles.contact.push(group, p, grid.spacing, particles.run)
                for c in ti.static(range(d)):
                    touches[c, lane] = push[c]
            if ti.static(group.slips):
                friction = friction_of_walls(particles, group, p, kick, lane < count)
                for c in ti.static(range(d)):
                    frictions[c, lane] = friction[c]
            if ti.static(group.pushed):
                push, slope = group.force.acceleration(group, p, group.force.spreads)
                for c in ti.static(range(d)):
                    pushes[c, lane] = push[c]
                    for a in ti.static(range(d)):
                        pushes[d + c * d + a, lane] = slope[c, a]

        # The law, and what the nodes get; see `transfer.scatter`.
        for lane in range(LANES):
            C = matrix_of(affine, d, lane)
            place, own = vector_of(x, 0, d, lane), vector_of(v, 0, d, lane)
            state = stored_of(group, deformation, lane)
            seen, share = state, 1.0
            if ti.static(group.averaged):
                share = stretch_to(missing[lane], d)
                seen = share * state
            stress, _, state_after, inner_after = group.law.respond(
                seen, vector_of(internal, 0, inners, lane), C, kick, constants_of(rows, lane)
            )
            ratios[lane] = volume_ratio(group, state)
            if ti.static(group.law.projects):
                difference = state_after - seen
                if ti.static(group.averaged):
                    difference /= share
                if ti.static(keeps_F):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        deformation[i * d + j, lane] += difference[i, j]
                else:
                    deformation[0, lane] += difference
                for i in ti.static(range(inners)):
                    internal[i, lane] = inner_after[i]
            if ti.static(group.pushed):
                own += kick * vector_of(pushes, 0, d, lane)
                for c, a in ti.static(ti.ndrange(d, d)):
                    C[c, a] += kick * pushes[d + c * d + a, lane]
            if ti.static(group.total):
                row = vector_of(rows, 0, ti.static(group.table.n), lane)
                if ti.static(particles.touches):
                    own += kick * vector_of(touches, 0, d, lane)
                if ti.static(group.slips):
                    own += kick * vector_of(frictions, 0, d, lane)
                at = vector_of(here, 0, d, lane)
                own += kick * push_of_walls(particles, group, at, place, state, row, constants_of(rows, lane))
                C = C @ state
                stress = pulled_back(stress, state)
            base, distance = grid.scheme.spline.stencil(place, grid.inverse_spacing)
            first_node[lane] = near.linear_index(base) + behind[lane]
            w = grid.scheme.spline.weights(distance)
            for k in ti.static(range(nodes)):
                for a in ti.static(range(d)):
                    weights[k * d + a, lane] = w[k, a]
            middle, slope = momentum(grid, distance, rows[MASS, lane], rows[VOLUME, lane], own, C, stress, kick)
            if ti.static(keeps):
                kept_C = matrix_of(affine, d, lane)
                if ti.static(group.total):
                    kept_C = kept_C @ state
                add_kept(
                    grid, distance, shares[lane] * rows[MASS, lane], vector_of(v, 0, d, lane), kept_C, middle, slope
                )
            for c in ti.static(range(width)):
                middles[lane, c] = middle[c]
                for a in ti.static(range(d)):
                    slopes[lane, a * width + c] = slope[a, c]

        if ti.static(group.law.projects):
            store_projected(group, begin, count, deformation, internal, ratios)
        for lane in range(count):
            p = begin + lane
            # The stress of a particle that is crushed or inverted would spread NaN over the grid.
            if ratios[lane] > SMALLEST_J:
                w = weights_of(weights, nodes, d, lane)
                middle = node_values_of(middles, 0, width, lane)
                slope = node_rows_of(slopes, d, width, 0, width, lane)
                add_linear(near.nodes, near, first_node[lane], w, middle, slope, False)
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
    """Store the states that a law has projected, but not those of particles that are crushed or inverted."""
    d = ti.static(group.dimension)
    keeps_F = ti.static(group.law.deformation == "F")
    sound = 0
    for lane in range(LANES):
        sound += ti.cast(ratios[lane] > SMALLEST_J, int)
    if count == LANES and sound == LANES:
        # Entry by entry: those of neighbouring particles are stored at once.
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
            if ratios[lane] > SMALLEST_J:
                if ti.static(keeps_F):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        group.displacement_gradient[p][i, j] = deformation[i * d + j, lane]
                else:
                    group.J_minus_1[p] = deformation[0, lane]
                for i in ti.static(range(len(group.internal))):
                    group.internal[i][p] = internal[i, lane]


@ti.func
def advance_range(
    particles: ti.template(),
    g: ti.template(),
    group: ti.template(),
    first: int,
    last: int,
    dt: float,
    gravity_step: ti.template(),
):
    """Gather and move particles first to last - 1 of the g-th group; return their largest rate of deformation, 1/s."""
    grid, near = ti.static((particles.grid, particles.near))
    d = ti.static(group.dimension)
    width = ti.static(grid.width)
    nodes = ti.static(grid.scheme.spline.nodes)
    keeps_F = ti.static(group.law.deformation == "F")
    x, distances, deformation = zero_lanes(d), zero_lanes(d), zero_lanes(ti.static(stored_entries(group)))
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    velocities = ti.Matrix.zero(float, LANES, width)
    # Of particles whose body keeps a share of its motion.
    keeps, kept = ti.static((grid.scheme.keeps_before, grid.kept))
    v, affine = zero_lanes(ti.static(d if keeps else 1)), zero_lanes(ti.static(d * d if keeps else 1))
    shares, behind = ti.Vector.zero(float, LANES), ti.Vector.zero(int, LANES)
    moments = ti.Matrix.zero(float, LANES, ti.static(d * width))
    speeds, gradients, rates = zero_lanes(d), zero_lanes(ti.static(d * d)), ti.Vector.zero(float, LANES)
    moved, beyond, after = zero_lanes(d), ti.Vector.zero(float, LANES), zero_lanes(ti.static(stored_entries(group)))
    here = zero_lanes(ti.static(d if group.total else 1))
    remainders, missing, growths = zero_lanes(d), zero_lanes(1), zero_lanes(1)
    rows = zero_lanes(ti.static(group.table.n if group.law.grows_by_constants else CONSTANTS + 1))
    sharpest = NOTHING
    if ti.static(group.law.grows_by_constants and not group.several):
        load_rows(group, first, 1, rows)
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        origin = bounded(begin)
        load_vectors(x, group.place_on_grid, origin)
        if ti.static(group.total):
            load_vectors(here, group.x, origin)
        if ti.static(group.carries):
            for c in ti.static(range(d)):
                load_entry(remainders, c, group.gradient, (c, d), origin)
        load_deformation(group, origin, deformation)
        if ti.static(keeps):
            load_vectors(v, group.v, origin)
            for c, a in ti.static(ti.ndrange(d, d)):
                load_entry(affine, c * d + a, group.gradient, (a, c), origin)
        if ti.static(group.law.grows_by_constants and group.several):
            load_rows(group, begin, count, rows)
        if count < LANES:
            repeat_first(x, count)
            repeat_first(here, count)
            repeat_first(deformation, count)
        load_layers(behind, grid, group, begin, count)

        for lane in range(LANES):
            base, distance = grid.scheme.spline.stencil(vector_of(x, 0, d, lane), grid.inverse_spacing)
            first_node[lane] = near.linear_index(base) + behind[lane]
            w = grid.scheme.spline.weights(distance)
            for a in ti.static(range(d)):
                distances[a, lane] = distance[a]
                for k in ti.static(range(nodes)):
                    weights[k * d + a, lane] = w[k, a]

        for lane in range(count):
            if ti.static(group.evened):
                missing[0, lane] = missing_growth(grid, g, group, begin + lane)
            w = weights_of(weights, nodes, d, lane)
            velocity, moment = gather_linear(near.nodes, near, first_node[lane], w)
            for c in ti.static(range(width)):
                velocities[lane, c] = velocity[c]
                for a in ti.static(range(d)):
                    moments[lane, a * width + c] = moment[a, c]
            if ti.static(keeps):
                shares[lane] = group.kept[group.row_number(begin + lane)]

        for lane in range(LANES):
            velocity = node_values_of(velocities, 0, d, lane)
            moment = node_rows_of(moments, d, width, 0, d, lane)
            distance = vector_of(distances, 0, d, lane)
            C = centred(grid, distance, velocity, moment).transpose()
            place = vector_of(x, 0, d, lane)
            if ti.static(group.total):
                place = vector_of(here, 0, d, lane)
                grown = matrix_of(deformation, d, lane) + dt * C
                for i, j in ti.static(ti.ndrange(d, d)):
                    after[i * d + j, lane] = grown[i, j]
                C = C @ (grown + ti.Matrix.identity(float, d)).inverse()
            for c, a in ti.static(ti.ndrange(d, d)):
                gradients[a * d + c, lane] = C[c, a]
            for c in ti.static(range(d)):
                speeds[c, lane] = velocity[c]
            if ti.static(keeps):
                before = node_values_of(velocities, kept, d, lane)
                slope = node_rows_of(moments, d, width, kept, d, lane)
                before_C = centred(grid, distance, before, slope).transpose()
                own_C = matrix_of(affine, d, lane)
                if ti.static(group.total):
                    own_C = own_C @ stored_of(group, deformation, lane)
                unseen, unseen_C = shares[lane] * (vector_of(v, 0, d, lane) - before), shares[lane] * (own_C - before_C)
                turn = turned(grid, velocity - before - gravity_step, unseen, unseen_C, before_C, dt)
                if ti.static(group.total):
                    unseen_C = unseen_C @ (matrix_of(after, d, lane) + ti.Matrix.identity(float, d)).inverse()
                for c in ti.static(range(d)):
                    speeds[c, lane] += unseen[c]
                    for a in ti.static(range(d)):
                        gradients[a * d + c, lane] += unseen_C[c, a] + turn[c, a]
            inside, left, outside = particles.moved(group, place, vector_of(remainders, 0, d, lane), velocity, dt)
            for c in ti.static(range(d)):
                moved[c, lane] = inside[c]
                if ti.static(group.carries):
                    remainders[c, lane] = left[c]
            beyond[lane] = outside
            rates[lane] = deformation_rate(group, C)
            if ti.static(keeps_F and not group.total):
                stored = matrix_of(deformation, d, lane)
                if ti.static(group.evened):
                    stored = even(stored, missing[0, lane])
                    growths[0, lane] = log_volume(dt * C)
                deformed = deformed_gradient(stored, C, dt)
                for i, j in ti.static(ti.ndrange(d, d)):
                    after[i * d + j, lane] = deformed[i, j]
            if ti.static(not keeps_F):
                after[0, lane] = group.law.grown(deformation[0, lane], volume_growth(C, dt), constants_of(rows, lane))

        # Written so that a NaN is not sound; then it stays, and no later step writes outside the grid.
        sound = count
        for lane in range(count):
            sound -= ti.cast(beyond[lane] <= 0.5 * grid.spacing, int)
            sharpest = ti.max(sharpest, rates[lane])
        if count == LANES and sound == 0:
            # Entry by entry: those of neighbouring particles are stored at once.
            for c in ti.static(range(d)):
                store_lanes(group.x, (c,), origin, moved, c)
                store_lanes(group.v, (c,), origin, speeds, c)
                for a in ti.static(range(d)):
                    store_lanes(group.gradient, (a, c), origin, gradients, a * d + c)
                if ti.static(group.carries):
                    store_lanes(group.gradient, (c, d), origin, remainders, c)
                if ti.static(keeps_F):
                    for a in ti.static(range(d)):
                        store_lanes(group.displacement_gradient, (c, a), origin, after, c * d + a)
            if ti.static(group.evened):
                store_lanes(group.growth, (), origin, growths, 0)
            if ti.static(not keeps_F):
                store_lanes(group.J_minus_1, (), origin, after, 0)
        else:
            for lane in range(count):
                p = begin + lane
                for c in ti.static(range(d)):
                    group.v[p][c] = speeds[c, lane]
                    for a in ti.static(range(d)):
                        group.gradient[p][a, c] = gradients[a * d + c, lane]
                    if ti.static(group.carries):
                        group.gradient[p][c, d] = remainders[c, lane]
                if ti.static(keeps_F):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        group.displacement_gradient[p][i, j] = after[i * d + j, lane]
                    if ti.static(group.evened):
                        group.growth[p] = growths[0, lane]
                else:
                    group.J_minus_1[p] = after[0, lane]
                if beyond[lane] <= 0.5 * grid.spacing:
                    for c in ti.static(range(d)):
                        group.x[p][c] = moved[c, lane]
                else:
                    ti.atomic_min(particles.lost[particles.first_lost + g], p)
        begin += LANES
    return sharpest


@ti.func
def average_pencils(at: ti.template(), first: int, last: int):
    """Add the particles in pencils first to last - 1 of a colour to their cells."""
    for r in range(first, last):
        pencil = at.order.pencil_of(at.turn, r)
        begin, after = at.order.first_particle_of(pencil), at.order.first_particle_of(pencil + 1)
        average_range(at.grid, at.g, at.group, begin, after)


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
            (near,) = ti.static((at.particles.beside(window.seen_from(at.grid, first_node)),))
            window.clear(at.t, relaxed)
            scatter_range(near, at.g, at.group, begin, end, kick, relaxed)
            window.add(at.grid, at.t, place, relaxed)


@ti.func
def advance_tiles(at: ti.template(), first: int, after: int, dt: float, gravity_step: ti.template()):
    """Gather and move the particles in tiles; return their largest rate of deformation, 1/s."""
    (window,) = ti.static((at.grid.window,))
    sharpest = NOTHING
    for tile in range(first, after):
        begin, end = at.order.start[tile], at.order.start[tile + 1]
        if begin < end:
            place = at.grid.tile_place(at.grid.tile_at[tile])
            first_node = window.first_of(at.t, place)
            (near,) = ti.static((at.particles.beside(window.seen_from(at.grid, first_node)),))
            window.load(at.grid, at.t, place)
            sharpest = ti.max(sharpest, advance_range(near, at.g, at.group, begin, end, dt, gravity_step))
    return sharpest


@ti.func
def update_rows(at: ti.template(), first: int, last: int, gravity_step: ti.template(), meets: ti.template()):
    """Update the nodes in rows first to last - 1 of the box in use; return the square of the largest velocity.

    `meets` is as of `NodeUpdate.update`.
    """
    d = ti.static(at.grid.dimension)
    speed_squared = 0.0
    for row in range(first, last):
        node = at.grid.row_start(row)
        index, nodes = at.grid.linear_index(node), at.grid.row_length(node)
        if ti.static(meets):
            nodes *= at.nodes.rigid.near(node, d - 1)
        for k in range(nodes):
            squared = at.nodes.update(node, index + k, gravity_step, meets)
            # Not `ti.max`, which takes twice as long for its care of NaN, at every node without mass.
            if squared > speed_squared:
                speed_squared = squared
            node[d - 1] += 1
    return speed_squared


@ti.func
def update_blocks(at: ti.template(), first: int, after: int, gravity_step: ti.template(), meets: ti.template()):
    """Update the nodes of blocks `first` to `after` - 1 in the box; return the square of the largest velocity."""
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
                squared = at.nodes.update(node, b * ti.static(grid.block) + q, gravity_step, meets)
                # As in `update_rows`.
                if squared > speed_squared:
                    speed_squared = squared
    return speed_squared
