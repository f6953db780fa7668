"""Reads the particle columns of a frame, and on the CPU the sums of the ledger."""

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.solver.frames.builder import Sums, axis_pairs
from mpmcli.solver.frames.columns import FrameColumns, stress_entries
from mpmcli.solver.particles.arrays import MASS, VOLUME
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.particles.state_bounds import SMALLEST_J, volume_ratio
from mpmcli.solver.transfer.lanes import (
    LANES,
    constants_of,
    internal_entries,
    load_lanes,
    load_rows,
    matrix_of,
    stored_entries,
    stored_of,
    vector_of,
    zero_lanes,
)
from mpmcli.solver.transfer.volume import stretch_to

# Index of the sum that is 0 if a particle is crushed, inverted or not finite, else 1.
SOUND = 5
# Optional columns of a frame.
CHOSEN = ("affine", "gradient", "tau", "activity")


@ti.func
def deformed_on(law: ti.template(), stored: ti.template(), C: ti.template(), later: float):
    """Return the deformation of a particle at a time `later`, s, after the stored one."""
    state = stored
    if ti.static(law.deformation == "F"):
        state += later * (C @ stored)
    else:
        state *= 1.0 + later * C.trace()
    return state


def is_there(field: object) -> bool:
    return field is not None


@ti.func
def write_range(
    group: ti.template(),
    first: int,
    count: int,
    dt: float,
    row: int,
    affine_at: int,
    gradient_at: int,
    tau_at: int,
    activity_at: int,
    frame_buffer: ti.template(),
    energies: ti.template(),
    offset: int,
):
    """Write the `FrameColumns` of some particles, each to row `row` plus its id.

    The rows of neighbouring particles are far apart, because particles are sorted. The energy, J/m^3, of particle p is
    therefore also stored in entry `offset` + p of the field `energies`, if it is not None, for the sums. The state does
    not change: the next step applies the plastic flow that is already included in the frame.

    Args:
        group: the group of particles.
        first, count: first particle and number of particles.
        dt: the last step, s.
        row: row of the particle with id 0.
        affine_at, gradient_at, tau_at, activity_at: first columns, -1 if omitted.
        frame_buffer: the rows of the frame.
        energies, offset: see above.
    """
    d = ti.static(group.dimension)
    keeps_F = ti.static(group.law.deformation == "F")
    inner_count = ti.static(len(group.internal))
    inners = ti.static(internal_entries(group))
    entries = ti.static(tuple(enumerate(stress_entries(group.dimension))))
    affine, deformation = zero_lanes(ti.static(d * d)), zero_lanes(ti.static(stored_entries(group)))
    internal, rows = zero_lanes(inners), zero_lanes(ti.static(group.table.n))
    # Energy, J, internal variables, and entries of the deformation and of the stress.
    found = zero_lanes(ti.static(2 + inners + d * d + len(entries)))
    missing = ti.Vector.zero(float, LANES)
    turns = 1
    if ti.static(group.law.projects) or tau_at >= 0:
        turns = 2
    begin = first
    while begin < first + count:
        own = ti.min(LANES, first + count - begin)
        load_lanes(group, begin, own, affine, deformation, internal)
        load_rows(group, begin, own, rows)
        if ti.static(group.uses_f_bar):
            for lane in range(own):
                missing[lane] = group.to_mean[begin + lane]
        # Half a step back, at the time of the velocities, and now; a loop, so that the law is compiled once.
        for k in range(turns):
            for lane in range(LANES):
                C, inner = matrix_of(affine, 0, d, lane), vector_of(internal, 0, inners, lane)
                stored, constants = stored_of(group, deformation, lane), constants_of(rows, lane)
                if ti.static(group.uses_f_bar):
                    stored *= stretch_to(missing[lane], d)
                state = deformed_on(group.law, stored, C, 0.5 * (k - 1) * dt)
                tau, tau_zz, after, inner_after = group.law.respond(state, inner, C, dt, constants)
                borne = 1.0
                if ti.static(group.eased):
                    borne = group.borne[begin + ti.min(lane, own - 1)]
                    tau, tau_zz = group.law.eased(tau, tau_zz, borne)
                if k == 0:
                    found[0, lane] = borne * group.law.energy(after, inner_after, constants)
                if ti.static(not group.law.projects):
                    after = stored
                    inner_after = inner
                for i in ti.static(range(inners)):
                    found[2 + i, lane] = inner_after[i]
                if ti.static(keeps_F):
                    found[1, lane] = after.determinant()
                    for i, j in ti.static(ti.ndrange(d, d)):
                        found[2 + inners + i * d + j, lane] = after[i, j]
                else:
                    found[1, lane] = after
                for column, place in ti.static(entries):
                    if ti.static(place[0] < d and place[1] < d):
                        found[2 + inners + d * d + column, lane] = tau[place[0], place[1]]
                    else:
                        found[2 + inners + d * d + column, lane] = tau_zz
        for lane in range(own):
            p = begin + lane
            r = row + group.id[p]
            if ti.static(is_there(energies)):
                energies[offset + p] = found[0, lane]
            velocity, C = group.motion(p)
            place = group.place(p)
            for c in ti.static(range(d)):
                frame_buffer[r, c] = place[c]
                frame_buffer[r, d + c] = velocity[c]
            for i in ti.static(range(2 + inner_count)):
                frame_buffer[r, 2 * d + i] = found[i, lane]
            if affine_at >= 0:
                for i, j in ti.static(ti.ndrange(d, d)):
                    frame_buffer[r, affine_at + i * d + j] = C[i, j]
            if gradient_at >= 0:
                if ti.static(keeps_F):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        frame_buffer[r, gradient_at + i * d + j] = found[2 + inners + i * d + j, lane]
                else:
                    # The isotropic F with this volume ratio.
                    stretch = found[1, lane] ** ti.static(1.0 / group.dimension)
                    for i, j in ti.static(ti.ndrange(d, d)):
                        frame_buffer[r, gradient_at + i * d + j] = stretch if ti.static(i == j) else 0.0
            if tau_at >= 0:
                for column in ti.static(range(len(entries))):
                    frame_buffer[r, tau_at + column] = found[2 + inners + d * d + column, lane]
            if ti.static(group.particle_count_varies):
                frame_buffer[r, activity_at] = ti.cast(group.activity[p], float)
        begin += LANES


def sum_entries(dimension: int) -> int:
    return 6 + 2 * dimension + 2 * len(axis_pairs(dimension))


@ti.func
def sum_range(group: ti.template(), first: int, count: int, energies: ti.template(), offset: int):
    """Return float64 sums over some particles in fixed order, see `sums_of`; for `energies` see `write_range`."""
    d = ti.static(group.dimension)
    pairs = ti.static(axis_pairs(group.dimension))
    turns = ti.static(len(axis_pairs(group.dimension)))
    total = ti.Vector.zero(ti.f64, ti.static(sum_entries(group.dimension)))
    fastest, sound = 0.0, 1
    for p in range(first, first + count):
        stay_rolled(energies, p)
        table = group.row(p)
        m = ti.cast(table[MASS], ti.f64)
        velocity, C = group.motion(p)
        place = ti.cast(group.place(p), ti.f64)
        speed = ti.cast(velocity, ti.f64)
        affine = ti.cast(C, ti.f64)
        total[0] += m
        total[1] += m * speed.norm_sqr()
        if ti.static(group.total):
            # Nodes are at F (X_i - X_p) relative to the particle and have the relative velocity C F (X_i - X_p).
            F = ti.cast(group.stored(p), ti.f64)
            total[2] += m * (affine @ F).norm_sqr()
            affine = affine @ F @ F.transpose()
        else:
            total[2] += m * affine.norm_sqr()
        total[3] += ti.cast(table[VOLUME], ti.f64) * ti.cast(energies[offset + p], ti.f64)
        for c in ti.static(range(d)):
            total[6 + c] += m * place[c]
            total[6 + d + c] += m * speed[c]
        for k in ti.static(range(turns)):
            a, b = ti.static(pairs[k])
            total[6 + 2 * d + k] += m * (place[a] * speed[b] - place[b] * speed[a])
            total[6 + 2 * d + turns + k] += m * (affine[b, a] - affine[a, b])
        fastest = ti.max(fastest, velocity.norm_sqr())
        J = volume_ratio(group, group.stored(p))
        # Written so that a NaN is not sound.
        if not J > SMALLEST_J:
            sound = 0
    total[4] = ti.cast(fastest, ti.f64)
    total[SOUND] = ti.cast(sound, ti.f64)
    return total


def sums_of(found: np.ndarray, dimension: int) -> tuple[Sums, np.ndarray]:
    """Return the `Sums` from results of `sum_range` at T times, (T, k), and whether all particles were sound, (T,)."""
    d = dimension
    turns = len(axis_pairs(d))
    mass, motion, affine, elastic, speed, sound = found.T[:6]
    place, momentum, turning, spin = np.split(found[:, 6:], [d, 2 * d, 2 * d + turns], axis=1)
    return Sums(mass, place, momentum, motion, affine, turning, spin, elastic, speed), sound > 0


def chosen_columns(columns: FrameColumns) -> tuple[int, ...]:
    """Return the first column of each of CHOSEN, -1 if it is omitted."""
    return tuple(columns.first[name] for name in CHOSEN)
