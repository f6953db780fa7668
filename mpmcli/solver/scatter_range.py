"""Scatters particles on the CPU, LANES of them at once: see `lane_state`.

What is added to nodes, or stored, follows particle by particle.
"""

import taichi as ti

from mpmcli.solver.lane_state import (
    LANES,
    constants_of,
    internal_entries,
    load_lanes,
    matrix_of,
    node_rows_of,
    repeat_first,
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
    change, after = zero_lanes(ti.static(stored_entries(group))), zero_lanes(inners)
    missing = ti.Vector.zero(float, LANES)
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    middles, slopes = ti.Matrix.zero(float, LANES, width), ti.Matrix.zero(float, LANES, ti.static(d * width))
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        load_lanes(group, begin, count, affine, deformation, internal, rows)
        origin = bounded(begin)
        for lane in range(LANES):
            at = group.on_grid(origin + lane)
            for c in ti.static(range(d)):
                x[c, lane] = at[c]
                v[c, lane] = group.v[origin + lane][c]
                if ti.static(group.total):
                    here[c, lane] = group.x[origin + lane][c]
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
            difference = state_after - seen
            if ti.static(group.averaged):
                difference /= share
            if ti.static(keeps_F):
                for i, j in ti.static(ti.ndrange(d, d)):
                    change[i * d + j, lane] = difference[i, j]
            else:
                change[0, lane] = difference
            for i in ti.static(range(inners)):
                after[i, lane] = inner_after[i]
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

        for lane in range(count):
            p = begin + lane
            # The stress of a particle that is crushed or inverted would spread NaN over the grid.
            if volume_ratio(group, group.stored(p)) > SMALLEST_J:
                if ti.static(group.law.projects):
                    if ti.static(keeps_F):
                        for i, j in ti.static(ti.ndrange(d, d)):
                            group.displacement_gradient[p][i, j] += change[i * d + j, lane]
                    else:
                        group.J_minus_1[p] += change[0, lane]
                    for i in ti.static(range(len(group.internal))):
                        group.internal[i][p] = after[i, lane]
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
