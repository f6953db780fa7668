"""Reads the particle columns of a frame, and on the CPU the sums of the ledger."""

from typing import Any, NamedTuple

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.solver.frames.builder import Sums, axis_pairs
from mpmcli.solver.frames.columns import FrameColumns, stress_entries
from mpmcli.solver.particles.arrays import MASS, VOLUME, ParticleArrays, constants_of
from mpmcli.solver.particles.loop import Operation, Pass
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.particles.state_bounds import SMALLEST_J, volume_ratio
from mpmcli.solver.transfer.volume import stretch_to

# Index of the sum that is 0 if a particle is crushed, inverted or not finite, else 1.
SOUND = 5
# Optional columns of a frame.
CHOSEN = ("affine", "gradient", "tau", "activity")


class FrameRows(NamedTuple):
    """Where the particles of a group are shown, attribute `rows` of the work of `show_of`, variables of a kernel.

    The rows of neighbouring particles are far apart, because particles are sorted. The energy, J/m^3, of particle p is
    therefore also stored in entry `offset` + p of the field `energies`, if it is not None, for the sums.

    Attributes:
        buffer: the `FrameColumns` of a frame.
        row: row of the particle with id 0.
        affine, gradient, tau, activity: first columns, -1 if omitted.
        dt: the last step, s.
        energies, offset: see above.
    """

    buffer: Any
    row: Any
    affine: Any
    gradient: Any
    tau: Any
    activity: Any
    dt: Any
    energies: Any = None
    offset: Any = 0


class Showing(NamedTuple):
    """The work of `show_of` on a GPU: a grid, a group of particles, and where they are shown."""

    grid: Any
    group: ParticleArrays
    rows: FrameRows


def show_of(group: ParticleArrays) -> Operation:
    """Return the operation that writes the `FrameColumns` of particles, to `at.rows`.

    It is carried out `turns` times, with the number of the turn as argument: in the first half a step back, at the time
    of the velocities, for the energy. A loop, so that the law is compiled once. The state does not change: the next
    step applies the plastic flow that is already included in the frame.
    """
    reads = ("C", "deformation", "inner", "row", *["to_mean"] * group.uses_f_bar, *["borne"] * group.eased)
    state = {"inner": None, "deformation": None}
    gives = {"energy": (), "J": (), **state, "tau": (len(stress_entries(group.dimension)),)}
    return Operation(reads, (Pass(respond, gives, in_lanes=True), Pass(write_row)))


@ti.func
def turns(group: ti.template(), rows: ti.template()):
    """Return the number of turns of `show_of`."""
    count = 1
    if ti.static(group.law.projects) or rows.tau >= 0:
        count = 2
    return count


@ti.func
def respond(
    at: ti.template(),
    _p: int,
    turn: float,
    C: ti.template(),
    deformation: ti.template(),
    inner: ti.template(),
    row: ti.template(),
    to_mean: float,
    borne: float,
):
    """Return energy, J/m^3, J, internal variables and J or F of a particle after plastic flow, and tau, Pa."""
    group, d, law = ti.static((at.group, at.group.dimension, at.group.law))
    stored, constants = group.whole(deformation), constants_of(row)
    if ti.static(group.uses_f_bar):
        stored *= stretch_to(to_mean, d)
    later, state = 0.5 * (turn - 1.0) * at.rows.dt, stored
    if ti.static(law.deformation == "F"):
        state += later * (C @ stored)
    else:
        state *= 1.0 + later * C.trace()
    tau, tau_zz, after, inner_after = law.respond(state, inner, C, at.rows.dt, constants)
    share = 1.0
    if ti.static(group.eased):
        share = borne
        tau, tau_zz = law.eased(tau, tau_zz, borne)
    energy = share * law.energy(after, inner_after, constants)
    if ti.static(not law.projects):
        after = stored
        inner_after = inner
    J = 0.0
    if ti.static(law.deformation == "F"):
        J = after.determinant()
    else:
        J = after
    shown = ti.Vector.zero(float, ti.static(len(stress_entries(d))))
    for column, place in ti.static(enumerate(stress_entries(d))):
        if ti.static(place[0] < d and place[1] < d):
            shown[column] = tau[place[0], place[1]]
        else:
            shown[column] = tau_zz
    return energy, J, inner_after, after, shown


@ti.func
def write_row(
    at: ti.template(),
    p: int,
    turn: float,
    energy: float,
    J: float,
    inner: ti.template(),
    deformation: ti.template(),
    tau: ti.template(),
):
    """Write the energy of a particle in the first turn, and all else in the last one."""
    group, rows, buffer, d = ti.static((at.group, at.rows, at.rows.buffer, at.group.dimension))
    r = rows.row + group.id[p]
    if turn == 0.0:
        buffer[r, 2 * d] = energy
        if ti.static(isinstance(rows.energies, ti.Field)):
            rows.energies[rows.offset + p] = energy
    if turn == ti.cast(turns(group, rows) - 1, float):
        velocity, C = group.motion(p)
        place = group.place(p)
        for c in ti.static(range(d)):
            buffer[r, c] = place[c]
            buffer[r, d + c] = velocity[c]
        buffer[r, 2 * d + 1] = J
        for i in ti.static(range(len(group.internal))):
            buffer[r, 2 * d + 2 + i] = inner[i]
        if rows.affine >= 0:
            for i, j in ti.static(ti.ndrange(d, d)):
                buffer[r, rows.affine + i * d + j] = C[i, j]
        if rows.gradient >= 0:
            for i, j in ti.static(ti.ndrange(d, d)):
                if ti.static(group.law.deformation == "F"):
                    buffer[r, rows.gradient + i * d + j] = deformation[i, j]
                else:
                    # The isotropic F with this volume ratio.
                    buffer[r, rows.gradient + i * d + j] = J ** ti.static(1.0 / d) if ti.static(i == j) else 0.0
        if rows.tau >= 0:
            for column in ti.static(range(tau.n)):
                buffer[r, rows.tau + column] = tau[column]
        if ti.static(group.particle_count_varies):
            buffer[r, rows.activity] = ti.cast(group.activity[p], float)


def sum_entries(dimension: int) -> int:
    return 6 + 2 * dimension + 2 * len(axis_pairs(dimension))


@ti.func
def sum_range(group: ti.template(), first: int, count: int, energies: ti.template(), offset: int):
    """Return float64 sums over some particles in fixed order, see `sums_of`; for `energies` see `FrameRows`."""
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
