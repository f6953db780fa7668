"""Transfers of some particles at once on the CPU, LANES of them: see `lane_state`.

What is added to nodes, or stored, follows particle by particle.
"""

import taichi as ti

from mpmcli.solver.lane_state import (
    LANES,
    constants_of,
    internal_entries,
    load_deformation,
    load_lanes,
    matrix_of,
    stored_entries,
    stored_of,
    vector_of,
    zero_lanes,
)
from mpmcli.solver.particle_arrays import CONSTANTS, MASS, VOLUME
from mpmcli.solver.particle_friction import friction_of_walls
from mpmcli.solver.particle_update import SMALLEST_J, deformed_gradient
from mpmcli.solver.reference_grid import pulled_back, push_of_walls
from mpmcli.solver.state_bounds import NOTHING, deformation_rate, volume_growth, volume_ratio
from mpmcli.solver.transfer import add_linear, centred, gather_linear, momentum, scatter_before, scatter_volume
from mpmcli.solver.volume_average import missing_to_mean, stretch_to


@ti.func
def scatter_range(
    particles: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int, kick: float, relaxed: float
):
    """Scatter particles first to last - 1 of the g-th group; no other thread may write their nodes."""
    grid = particles.grid
    d = ti.static(group.dimension)
    width = ti.static(group.v.n)
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
        for lane in range(LANES):
            p = begin + ti.min(lane, count - 1)
            at = group.on_grid(p)
            for c in ti.static(range(d)):
                x[c, lane] = at[c]
                v[c, lane] = group.v[p][c]
                if ti.static(group.total):
                    here[c, lane] = group.x[p][c]
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
            first_node[lane] = grid.linear_index(base)
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
                add_linear(grid.nodes, grid, first_node[lane], w, middle, slope, False)
                if ti.static(grid.scheme.keeps_before):
                    own_v, own_C = group.motion_on_grid(p)
                    scatter_before(group.on_grid(p), group.row(p)[MASS], own_v, own_C, grid, False)
            else:
                ti.atomic_min(particles.lost[particles.first_lost + g], p)
            if ti.static(grid.keeps_filling):
                if relaxed > 0.0:
                    scatter_volume(group.x[p], group.row(p)[VOLUME], grid, False)
        begin += LANES


@ti.func
def advance_range(particles: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int, dt: float):
    """Gather and move particles first to last - 1 of the g-th group; return their largest rate of deformation, 1/s."""
    grid = particles.grid
    d = ti.static(group.dimension)
    width = ti.static(group.v.n)
    nodes = ti.static(grid.scheme.spline.nodes)
    keeps_F = ti.static(group.law.deformation == "F")
    x, distances, deformation = zero_lanes(d), zero_lanes(d), zero_lanes(ti.static(stored_entries(group)))
    first_node, weights = ti.Vector.zero(int, LANES), zero_lanes(ti.static(nodes * d))
    velocities = ti.Matrix.zero(float, LANES, width)
    moments = ti.Matrix.zero(float, LANES, ti.static(d * width))
    gradients, rates = ti.Matrix.zero(float, LANES, ti.static(d * width)), ti.Vector.zero(float, LANES)
    moved, beyond, after = zero_lanes(d), ti.Vector.zero(float, LANES), zero_lanes(ti.static(stored_entries(group)))
    here = zero_lanes(ti.static(d if group.total else 1))
    remainders = zero_lanes(d)
    rows = zero_lanes(ti.static(group.table.n if group.law.grows_by_constants else CONSTANTS + 1))
    sharpest = NOTHING
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        for lane in range(LANES):
            p = begin + ti.min(lane, count - 1)
            at = group.on_grid(p)
            for c in ti.static(range(d)):
                x[c, lane] = at[c]
                if ti.static(group.total):
                    here[c, lane] = group.x[p][c]
                if ti.static(group.carries):
                    remainders[c, lane] = group.gradient[p][c, d]
            load_deformation(group, p, lane, deformation)
            if ti.static(group.law.grows_by_constants):
                row = group.row(p)
                for k in ti.static(range(row.n)):
                    rows[k, lane] = row[k]

        for lane in range(LANES):
            base, distance = grid.scheme.spline.stencil(vector_of(x, 0, d, lane), grid.inverse_spacing)
            first_node[lane] = grid.linear_index(base)
            w = grid.scheme.spline.weights(distance)
            for a in ti.static(range(d)):
                distances[a, lane] = distance[a]
                for k in ti.static(range(nodes)):
                    weights[k * d + a, lane] = w[k, a]

        for lane in range(count):
            w = weights_of(weights, nodes, d, lane)
            velocity, moment = gather_linear(grid.nodes, grid, first_node[lane], w)
            for c in ti.static(range(width)):
                velocities[lane, c] = velocity[c]
                for a in ti.static(range(d)):
                    moments[lane, a * width + c] = moment[a, c]

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
                gradients[lane, a * width + c] = C[c, a]
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

        for lane in range(count):
            p = begin + lane
            kept = ti.Vector.zero(float, d)
            if ti.static(grid.scheme.keeps_before):
                kept = particles.unseen_velocity(group, p)
            for c in ti.static(range(d)):
                group.v[p][c] = velocities[lane, c] + kept[c]
            for a in ti.static(range(d)):
                for c in ti.static(range(width)):
                    group.gradient[p][a, c] = gradients[lane, a * width + c]
                if ti.static(group.carries):
                    group.gradient[p][a, d] = remainders[a, lane]
            if ti.static(keeps_F):
                for i, j in ti.static(ti.ndrange(d, d)):
                    group.displacement_gradient[p][i, j] = after[i * d + j, lane]
            else:
                group.J_minus_1[p] = after[0, lane]
            # Written so that a NaN is not sound; then it stays, and no later step writes outside the grid.
            if beyond[lane] <= 0.5 * grid.spacing:
                for c in ti.static(range(d)):
                    group.x[p][c] = moved[c, lane]
            else:
                ti.atomic_min(particles.lost[particles.first_lost + g], p)
            sharpest = ti.max(sharpest, rates[lane])
        begin += LANES
    return sharpest


@ti.func
def node_rows_of(lanes: ti.template(), d: ti.template(), width: ti.template(), columns: ti.template(), lane: int):
    """Return the d rows, each as wide as a node, that a lane has one after another; of each the first `columns`."""
    result = ti.Matrix.zero(float, d, columns)
    for c in ti.static(range(columns)):
        for a in ti.static(range(d)):
            result[a, c] = lanes[lane, a * width + c]
    return result


@ti.func
def weights_of(weights: ti.template(), nodes: ti.template(), d: ti.template(), lane: int):
    """Return the weights of a lane as a spline returns them."""
    w = ti.Matrix.zero(float, nodes, d)
    for k in ti.static(range(nodes)):
        for a in ti.static(range(d)):
            w[k, a] = weights[k * d + a, lane]
    return w
