"""Gathers and moves particles on the CPU, LANES of them at once: see `lane_state`."""

import taichi as ti

from mpmcli.solver.lane_state import (
    LANES,
    constants_of,
    load_deformation,
    load_entry,
    load_rows,
    load_vectors,
    matrix_of,
    node_rows_of,
    repeat_first,
    store_lanes,
    stored_entries,
    vector_of,
    weights_of,
    zero_lanes,
)
from mpmcli.solver.particle_arrays import CONSTANTS
from mpmcli.solver.particle_update import deformed_gradient
from mpmcli.solver.splines import bounded
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, volume_growth
from mpmcli.solver.stencils import gather_linear
from mpmcli.solver.transfer import centred


@ti.func
def advance_range(particles: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int, dt: float):
    """Gather and move particles first to last - 1 of the g-th group; return their largest rate of deformation, 1/s."""
    grid, near = ti.static((particles.grid, particles.near))
    d = ti.static(group.dimension)
    width = ti.static(grid.width)
    nodes = ti.static(grid.scheme.spline.nodes)
    keeps_F = ti.static(group.law.deformation == "F")
    x, distances, deformation = zero_lanes(d), zero_lanes(d), zero_lanes(ti.static(stored_entries(group)))
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    velocities, kept = ti.Matrix.zero(float, LANES, width), zero_lanes(ti.static(d if grid.scheme.keeps_before else 1))
    moments = ti.Matrix.zero(float, LANES, ti.static(d * width))
    speeds, gradients, rates = zero_lanes(d), zero_lanes(ti.static(d * d)), ti.Vector.zero(float, LANES)
    moved, beyond, after = zero_lanes(d), ti.Vector.zero(float, LANES), zero_lanes(ti.static(stored_entries(group)))
    here = zero_lanes(ti.static(d if group.total else 1))
    remainders = zero_lanes(d)
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
        if ti.static(group.law.grows_by_constants and group.several):
            load_rows(group, begin, count, rows)
        if count < LANES:
            repeat_first(x, count)
            repeat_first(here, count)
            repeat_first(deformation, count)

        for lane in range(LANES):
            base, distance = grid.scheme.spline.stencil(vector_of(x, 0, d, lane), grid.inverse_spacing)
            first_node[lane] = near.linear_index(base)
            w = grid.scheme.spline.weights(distance)
            for a in ti.static(range(d)):
                distances[a, lane] = distance[a]
                for k in ti.static(range(nodes)):
                    weights[k * d + a, lane] = w[k, a]

        for lane in range(count):
            w = weights_of(weights, nodes, d, lane)
            velocity, moment = gather_linear(near.nodes, near, first_node[lane], w)
            for c in ti.static(range(width)):
                velocities[lane, c] = velocity[c]
                for a in ti.static(range(d)):
                    moments[lane, a * width + c] = moment[a, c]
            if ti.static(grid.scheme.keeps_before):
                unseen = particles.unseen_velocity(group, begin + lane)
                for c in ti.static(range(d)):
                    kept[c, lane] = unseen[c]

        for lane in range(LANES):
            velocity = ti.Vector.zero(float, d)
            for c in ti.static(range(d)):
                velocity[c] = velocities[lane, c]
            moment = node_rows_of(moments, d, width, d, lane)
            gradient = centred(grid, vector_of(distances, 0, d, lane), velocity, moment)
            C = gradient.transpose()
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
                if ti.static(grid.scheme.keeps_before):
                    speeds[c, lane] += kept[c, lane]
            inside, left, outside = particles.moved(group, place, vector_of(remainders, 0, d, lane), velocity, dt)
            for c in ti.static(range(d)):
                moved[c, lane] = inside[c]
                if ti.static(group.carries):
                    remainders[c, lane] = left[c]
            beyond[lane] = outside
            rates[lane] = deformation_rate(group, C)
            if ti.static(keeps_F and not group.total):
                deformed = deformed_gradient(matrix_of(deformation, d, lane), C, dt)
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
                else:
                    group.J_minus_1[p] = after[0, lane]
                if beyond[lane] <= 0.5 * grid.spacing:
                    for c in ti.static(range(d)):
                        group.x[p][c] = moved[c, lane]
                else:
                    ti.atomic_min(particles.lost[particles.first_lost + g], p)
        begin += LANES
    return sharpest
