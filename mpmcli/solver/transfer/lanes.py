"""Particle state for LANES particles at a time on the CPU, so that the compiler vectorises loops.

The compiler vectorises a loop over lanes, including its branches, if the loop accesses only local arrays and calls no
functions. It does not vectorise a loop that stores to fields, because Taichi reloads the address of a field after every
store. Therefore particles are copied to local arrays with a row per quantity and a column per lane, by one short loop
per entry, so that the compiler copies all lanes at once. Each lane computes the same result as a particle alone. Lanes
beyond the last particle of a range repeat the first one: their results are not used, but laws may iterate until
convergence.
"""

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.arrays import CONSTANTS
from mpmcli.solver.transfer.splines import bounded

LANES = 8


@ti.func
def repeat_first(lanes: ti.template(), count: int):
    """Copy lane 0 to the lanes from `count` on, which were loaded from memory beyond the last particle."""
    for lane in range(count, LANES):
        for k in ti.static(range(lanes.n)):
            lanes[k, lane] = lanes[k, 0]


@ti.func
def zero_lanes(rows: ti.template()):
    return ti.Matrix.zero(float, rows, LANES)


def stored_entries(group: object) -> int:
    """Return how many numbers a particle stores for its deformation."""
    return group.dimension**2 if group.law.deformation == "F" else 1


def internal_entries(group: object) -> int:
    """Return the length of the vector that `ParticleArrays.inner` returns."""
    return max(len(group.internal), 1)


@ti.func
def load_lanes(
    group: ti.template(), begin: int, count: int, C: ti.template(), stored: ti.template(), inner: ti.template()
):
    """Copy C, the stored deformation and the internal variables of `count` particles from `begin` on."""
    d = ti.static(group.dimension)
    origin = bounded(begin)
    for c, a in ti.static(ti.ndrange(d, d)):
        load_entry(C, c * d + a, group.gradient, (a, c), origin)
    load_deformation(group, origin, stored)
    for i in ti.static(range(len(group.internal))):
        load_entry(inner, i, group.internal[i], (), origin)
    if count < LANES:
        repeat_first(C, count)
        repeat_first(stored, count)
        repeat_first(inner, count)


@ti.func
def load_deformation(group: ti.template(), origin: int, deformation: ti.template()):
    """Copy F - I or J - 1 of the particles from `origin` on."""
    d = ti.static(group.dimension)
    if ti.static(group.law.deformation == "F"):
        for i, j in ti.static(ti.ndrange(d, d)):
            load_entry(deformation, i * d + j, group.displacement_gradient, (i, j), origin)
    else:
        load_entry(deformation, 0, group.J_minus_1, (), origin)


@ti.func
def load_entry(lanes: ti.template(), k: ti.template(), field: ti.template(), entry: ti.template(), origin: int):
    """Copy an entry of the particles from `origin` on to row k of an array; all are read before any is written."""
    row = ti.Vector.zero(float, LANES)
    for lane in range(LANES):
        if ti.static(len(entry) == 0):
            row[lane] = field[origin + lane]
        else:
            row[lane] = field[origin + lane][entry]
    for lane in range(LANES):
        lanes[k, lane] = row[lane]


@ti.func
def store_lanes(field: ti.template(), entry: ti.template(), origin: int, lanes: ti.template(), k: ti.template()):
    """Store row k of an array of lanes as an entry of particles from `origin` on; all are read before any is stored."""
    row = ti.Vector.zero(float, LANES)
    for lane in range(LANES):
        row[lane] = lanes[k, lane]
    for lane in range(LANES):
        if ti.static(len(entry) == 0):
            field[origin + lane] = row[lane]
        else:
            field[origin + lane][entry] = row[lane]


@ti.func
def load_rows(group: ti.template(), begin: int, count: int, rows: ti.template()):
    """Copy the table rows of `count` particles from `begin` on; with one body all lanes have the same row."""
    for lane in range(LANES):
        # Memory beyond the last particle holds no row number of the table.
        row = group.row(begin + ti.min(lane, count - 1))
        for k in ti.static(range(row.n)):
            rows[k, lane] = row[k]


@ti.func
def matrix_of(lanes: ti.template(), first: ti.template(), d: ti.template(), lane: int):
    """Return a d x d matrix of a lane from the rows from `first` on; zero if there are no such rows."""
    result = ti.Matrix.zero(float, d, d)
    if ti.static(first + d * d <= lanes.n):
        for i, j in ti.static(ti.ndrange(d, d)):
            result[i, j] = lanes[first + i * d + j, lane]
    return result


@ti.func
def vector_of(lanes: ti.template(), first: ti.template(), size: ti.template(), lane: int):
    """Return `size` entries of a lane from row `first` on; zero if there are no such rows."""
    result = ti.Vector.zero(float, size)
    if ti.static(first + size <= lanes.n):
        for i in ti.static(range(size)):
            result[i] = lanes[first + i, lane]
    return result


@ti.func
def stored_of(group: ti.template(), deformation: ti.template(), lane: int):
    """Return J, or F as a d x d matrix, of a lane."""
    if ti.static(group.law.deformation == "F"):
        d = ti.static(group.dimension)
        return ti.Matrix.identity(float, d) + matrix_of(deformation, 0, d, lane)
    else:
        return 1.0 + deformation[0, lane]


@ti.func
def constants_of(rows: ti.template(), lane: int):
    return vector_of(rows, CONSTANTS, ti.static(rows.n - CONSTANTS), lane)
