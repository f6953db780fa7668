"""Scatters particles on the CPU, LANES of them at once: see `lane_state`.

What is added to nodes, or stored, follows particle by particle.
"""

import taichi as ti

from mpmcli.solver.lane_state import (
    LANES,
    constants_of,
    internal_entries,
    load_lanes,
    load_rows,
    load_vectors,
    matrix_of,
    node_rows_of,
    repeat_first,
    store_lanes,
    stored_entries,
    stored_of,
    vector_of,
    weights_of,
    zero_lanes,
)
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particle_friction import friction_of_walls
from mpmcli.solver.particle_update import SMALLEST_J
from mpmcli.solver.reference_grid import pulled_back, push_of_walls
from mpmcli.solver.splines import bounded
from mpmcli.solver.state_bounds import volume_ratio
from mpmcli.solver.stencils import add_linear
from mpmcli.solver.transfer import momentum, scatter_before, scatter_volume
from mpmcli.solver.volume_average import missing_to_mean, stretch_to


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
        more = ti.static(group.averaged or particles.touches or group.slips or group.pushed)
        for lane in range(ti.static(LANES * more)):
            # What reads more than arrays: lanes beyond the last particle repeat it.
            p = begin + ti.min(lane, count - 1)
            if ti.static(group.averaged):
                missing[lane] = missing_to_mean(grid, g, group, p)
            if ti.static(particles.touches):
                push = particles.contact.push(group, p, grid.spacing, particles.run)
                for c in ti.static(range(d)):
                    touches[c, lane] = push[c]
            if ti.static(group.slips):
                friction = friction_of_walls(particles, group, p, kick, lane < count)
                for c in ti.static(range(d)):
                    frictions[c, lane] = friction[c]
            if ti.static(group.pushed):
                push, slope = group.force.acceleration(group, p, ti.static(group.force.spreads and grid.scheme.affine))
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
            first_node[lane] = near.linear_index(base)
            w = grid.scheme.spline.weights(distance)
            for k in ti.static(range(nodes)):
                for a in ti.static(range(d)):
                    weights[k * d + a, lane] = w[k, a]
            middle, slope = momentum(grid, distance, rows[MASS, lane], rows[VOLUME, lane], own, C, stress, kick)
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
                middle = ti.Vector.zero(float, width)
                for c in ti.static(range(width)):
                    middle[c] = middles[lane, c]
                slope = node_rows_of(slopes, d, width, width, lane)
                add_linear(near.nodes, near, first_node[lane], w, middle, slope, False)
                if ti.static(grid.scheme.keeps_before):
                    own_v, own_C = group.motion_on_grid(p)
                    scatter_before(group.on_grid(p), group.row(p)[MASS], own_v, own_C, near, False)
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
