"""Operations on particles: each is written for one particle, and `over` carries it out for a range of them.

An operation is a list of passes. A pass is a function of a particle that takes values by the names of its parameters,
and returns others: columns of the particles that the operation reads, and what earlier passes gave. On a GPU, and on a
sparse grid, a particle goes through all passes by itself. On a dense grid on the CPU each pass is a loop over LANES
particles.

The compiler vectorises such a loop, including its branches, if it accesses only local arrays and calls no functions. It
does not vectorise a loop that stores to fields, because Taichi reloads the address of a field after every store.
Therefore columns are copied to and from local arrays with a row per number and a column per lane, by one short loop per
number, so that the compiler copies all lanes at once. Each lane computes the same result as a particle alone. Lanes
beyond the last particle repeat the first one: their results are not used, but laws may iterate until convergence.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.columns import column_of, entry_of_field, set_entry
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.particles.state_bounds import NOTHING
from mpmcli.solver.transfer.splines import bounded

LANES = 8
# Parameters of a pass before its values: the work of a thread, the index of the particle, and the argument of `over`.
ALWAYS = 3
# Sizes of values that are integers: an index, and the address of a stencil, which has several on a sparse grid.
INDEX, STENCIL = ("index",), ("stencil",)


# Compared by identity, like all that is given to kernels.
@dataclass(frozen=True, eq=False)
class Pass:
    """A function of one particle, `body(at, p, how, *values)`.

    Attributes:
        body: the function; the names of its parameters after the third are those of the values that it takes. Without
            one the values given are zero.
        gives: the values that it returns, in order, with their sizes: numbers, "d" for the dimension, "nodes" for the
            nodes of a stencil along an axis, "width" for the numbers of a node; a second size is that of the rows of a
            matrix; () for a number, INDEX or STENCIL for an integer, None for a value of the size of its column.
        in_lanes: whether the body accesses only its values and constants of `at`, and may thus run for a lane without a
            particle.
    """

    body: Callable | None
    gives: dict[str, tuple | None] = field(default_factory=dict)
    in_lanes: bool = False

    @property
    def takes(self) -> tuple[str, ...]:
        """The names of the values that the body takes."""
        return tuple(inspect.signature(self.body).parameters)[ALWAYS:]


@dataclass(frozen=True, eq=False)
class Operation:
    """An operation on the particles of a group.

    Attributes:
        reads: columns of the particles, see `ParticleArrays.column`; passes take zeros for those that are not read.
        passes: what is done, in order.
        writes: columns that take the values with their names at the end.
        guarded: columns that are written only if the value "sound" of the particle is 1. Else it is lost.
        largest: a value of which the largest is returned.
        near: whether its passes address nodes by `at.particles.near`: on a sparse grid those of the window of a thread.
    """

    reads: tuple[str, ...]
    passes: tuple[Pass, ...]
    writes: tuple[str, ...] = ()
    guarded: tuple[str, ...] = ()
    largest: str = ""
    near: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a column is written that nothing gives: it would be written as it was."""
        given = {name for step in self.passes for name in step.gives}
        if missing := sorted({*self.writes, *self.guarded, *([self.largest] if self.largest else [])} - given):
            raise ValueError(f"an operation writes {', '.join(missing)}, which none of its passes gives")

    @property
    def loses(self) -> bool:
        """Whether it finds particles that are not sound."""
        return any("sound" in step.gives for step in self.passes)

    @property
    def steps(self) -> tuple[Pass, ...]:
        """The passes with a body."""
        return tuple(step for step in self.passes if step.body is not None)

    def shapes(self, grid: Any, group: Any) -> dict[str, tuple[int | str, ...]]:
        """Return the shapes of all values."""
        sizes = {"d": grid.dimension, "nodes": grid.scheme.spline.nodes, "width": grid.width}
        found = {name: group.column(name).shape for name in self.reads}
        for step in self.passes:
            for name, shape in step.gives.items():
                own = group.column(name).shape if shape is None else tuple(sizes.get(n, n) for n in shape)
                found[name] = own
        return found


class ParticleValues:
    """The values of one particle by name, variables of a kernel."""

    def __init__(self, op: Operation, at: Any, p: Any) -> None:
        self.shapes, self.group = op.shapes(at.grid, at.group), at.group
        self.values = {name: column_of(at.group, name, p) for name in op.reads}

    def take(self, names: Sequence[str], _lane: Any) -> tuple:
        """Return values of the particle."""
        return tuple(self.values[name] if name in self.values else zeros(self, name) for name in names)

    def give(self, names: Sequence[str], given: tuple, _lane: Any) -> None:
        """Set values of the particle."""
        self.values |= zip(names, given, strict=True)


class LaneValues:
    """The values of LANES particles by name: an array for each, with a row per entry, variables of a kernel.

    Sums over nodes have a row per lane instead, because the numbers of a node are added at once.
    """

    def __init__(self, op: Operation, at: Any) -> None:
        self.shapes, self.group = op.shapes(at.grid, at.group), at.group
        self.by_lane = {name for step in op.passes for name, shape in step.gives.items() if "width" in (shape or ())}
        held = [*self.group.distinct(op.reads), *(name for step in op.steps for name in step.gives)]
        self.arrays = {
            name: ti.lang.impl.expr_init(empty(self.shapes[name], name in self.by_lane)) for name in dict.fromkeys(held)
        }
        if "place" in op.reads and "place" not in self.arrays:
            # An operation that moves particles uses it before.
            self.arrays["place"] = self.arrays["x"]

    def take(self, names: Sequence[str], lane: Any) -> tuple:
        """Return values of a lane."""
        return tuple(
            value_of(self.arrays[name], self.shapes[name], lane, name in self.by_lane)
            if name in self.arrays
            else zeros(self, name)
            for name in names
        )

    def give(self, names: Sequence[str], given: tuple, lane: Any) -> None:
        """Set values of a lane."""
        for name, value in zip(names, given, strict=True):
            set_value(self.arrays[name], self.shapes[name], lane, name in self.by_lane, value)


def zeros(values: ParticleValues | LaneValues, name: str) -> Any:
    """Return zeros in place of a column that is not read or of a value that no pass gives."""
    shape = values.shapes[name] if name in values.shapes else values.group.column(name).shape
    return ti.Matrix.zero(float, *shape) if shape else 0.0


def empty(shape: tuple, by_lane: bool) -> ti.Matrix:
    """Return an array of lanes for values of a shape."""
    if shape in (INDEX, STENCIL):
        return ti.Matrix.zero(int, 1, LANES)
    entries = math.prod(shape)
    return ti.Matrix.zero(float, *((LANES, entries) if by_lane else (entries, LANES)))


@ti.func
def value_of(lanes: ti.template(), shape: ti.template(), lane: int, by_lane: ti.template()):
    """Return a value of a lane, in its shape."""
    if ti.static(len(shape) == 2):
        value = ti.Matrix.zero(float, shape[0], shape[1])
        for i, j in ti.static(ti.ndrange(shape[0], shape[1])):
            value[i, j] = entry_at(lanes, i * shape[1] + j, lane, by_lane)
        return value
    elif ti.static(len(shape) == 1 and shape not in (INDEX, STENCIL)):
        value = ti.Vector.zero(float, shape[0])
        for i in ti.static(range(shape[0])):
            value[i] = entry_at(lanes, i, lane, by_lane)
        return value
    else:
        return lanes[0, lane]


@ti.func
def entry_at(lanes: ti.template(), k: ti.template(), lane: int, by_lane: ti.template()):
    if ti.static(by_lane):
        return lanes[lane, k]
    else:
        return lanes[k, lane]


@ti.func
def set_value(lanes: ti.template(), shape: ti.template(), lane: int, by_lane: ti.template(), value: ti.template()):
    if ti.static(len(shape) == 0 or shape in (INDEX, STENCIL)):
        lanes[0, lane] = value
    else:
        for k in ti.static(range(math.prod(shape))):
            if ti.static(by_lane):
                lanes[lane, k] = number_of(value, shape, k)
            else:
                lanes[k, lane] = number_of(value, shape, k)


@ti.func
def number_of(value: ti.template(), shape: ti.template(), k: ti.template()):
    """Return entry k, row by row, of a value."""
    if ti.static(len(shape) == 2):
        return value[k // shape[1], k % shape[1]]
    elif ti.static(len(shape) == 1):
        return value[k]
    else:
        return value


@ti.func
def carry_out(at: ti.template(), step: ti.template(), p: int, how: float, values: ti.template(), lane: int):
    """Carry out a pass for particle p, the one of a lane."""
    (taken,) = ti.static((values.take(step.takes, lane),))
    if ti.static(len(step.gives) == 0):
        ti.static(step.body)(at, p, how, *taken)
    elif ti.static(len(step.gives) == 1):
        given = ti.static(step.body)(at, p, how, *taken)
        ti.static(values.give(tuple(step.gives), (given,), lane))
    else:
        given = ti.static(step.body)(at, p, how, *taken)
        ti.static(values.give(tuple(step.gives), given, lane))


@ti.func
def one(at: ti.template(), op: ti.template(), p: int, how: float):
    """Carry out an operation on particle p; return its value for `largest`."""
    most = NOTHING
    if ti.static(isinstance(op, Operation)):
        (values,) = ti.static((ParticleValues(op, at, p),))
        for step in ti.static(op.steps):
            carry_out(at, step, p, how, values, 0)
        for name in ti.static(op.writes):
            write_one(ti.static(at.group.column(name)), p, values.values[name])
        if ti.static(op.loses):
            if values.values["sound"] == 1.0:
                for name in ti.static(op.guarded):
                    write_one(ti.static(at.group.column(name)), p, values.values[name])
            else:
                at.particles.lose(at.g, at.group, p)
        if ti.static(len(op.largest) > 0):
            most = values.values[op.largest]
    else:
        ti.static(op)(at, p, how)
    return most


@ti.func
def write_one(column: ti.template(), p: int, value: ti.template()):
    """Set a column of particle p."""
    for k in ti.static(range(len(column.entries))):
        set_entry(column.entries[k], p, number_of(value, column.shape, k))


def in_window(op: Operation | Callable, grid: Any) -> bool:
    """Return whether an operation is carried out tile by tile."""
    return grid.sparse and isinstance(op, Operation) and op.near


def goes_in_lanes(op: Operation | Callable, grid: Any) -> bool:
    """Return whether passes are loops over lanes, which hold no addresses of stencils on a sparse grid."""
    if not isinstance(op, Operation):
        return False
    return not grid.sparse or all(STENCIL not in step.gives.values() for step in op.passes)


@ti.func
def over(at: ti.template(), op: ti.template(), first: int, last: int, how: float):
    """Carry out an operation on particles first to last - 1, on the CPU; return the largest value of `largest`."""
    most = NOTHING
    if ti.static(goes_in_lanes(op, at.grid)):
        most = over_lanes(at, op, first, last, how)
    else:
        for p in range(first, last):
            stay_rolled(at.order.buffers.real, p)
            one(at, op, p, how)
    return most


@ti.func
def over_lanes(at: ti.template(), op: ti.template(), first: int, last: int, how: float):
    """Carry out an operation on particles first to last - 1, LANES at a time."""
    (values,) = ti.static((LaneValues(op, at),))
    begin, most = first, NOTHING
    if ti.static("row" in op.reads and not at.group.many_bodies):
        load_rows(at.group, first, 1, values.arrays["row"])
    while begin < last:
        count, origin = ti.min(LANES, last - begin), bounded(begin)
        for name in ti.static(at.group.distinct(op.reads)):
            (column, lanes) = ti.static((at.group.column(name), values.arrays[name]))
            for k in ti.static(range(len(column.entries))):
                load_lanes(column.entries[k], origin, lanes, k)
            if ti.static(name == "row"):
                if ti.static(at.group.many_bodies):
                    load_rows(at.group, begin, count, lanes)
            elif count < LANES:
                repeat_first(lanes, count)
        for step in ti.static(op.steps):
            if ti.static(step.in_lanes):
                for lane in range(LANES):
                    carry_out(at, step, begin + lane, how, values, lane)
            else:
                for lane in range(count):
                    stay_rolled(at.order.buffers.real, begin + lane)
                    carry_out(at, step, begin + lane, how, values, lane)
        sound = count
        if ti.static(op.loses):
            sound = 0
            for lane in range(LANES):
                sound += ti.cast(values.arrays["sound"][0, lane], int)
        if ti.static(len(op.largest) > 0):
            for lane in range(count):
                most = ti.max(most, values.arrays[op.largest][0, lane])
        if count == LANES and sound == LANES:
            # Entry by entry, so that entries of neighbouring particles are stored at once.
            for name in ti.static(op.writes + op.guarded):
                (column,) = ti.static((at.group.column(name),))
                for k in ti.static(range(len(column.entries))):
                    store_lanes(column.entries[k], origin, values.arrays[name], k)
        else:
            for lane in range(count):
                stay_rolled(at.order.buffers.real, begin + lane)
                write_lane(at, op.writes, values, begin + lane, lane)
                if ti.static(op.loses):
                    if values.arrays["sound"][0, lane] == 1.0:
                        write_lane(at, op.guarded, values, begin + lane, lane)
                    else:
                        at.particles.lose(at.g, at.group, begin + lane)
        begin += LANES
    return most


@ti.func
def write_lane(at: ti.template(), names: ti.template(), values: ti.template(), p: int, lane: int):
    """Set columns of particle p from a lane."""
    for name in ti.static(names):
        (column,) = ti.static((at.group.column(name),))
        for k in ti.static(range(len(column.entries))):
            set_entry(column.entries[k], p, values.arrays[name][k, lane])


@ti.func
def load_lanes(entry: ti.template(), origin: int, lanes: ti.template(), k: ti.template()):
    """Copy an entry of the particles from `origin` on to row k of an array; all are read before any is written."""
    row = ti.Vector.zero(float, LANES)
    for lane in range(LANES):
        row[lane] = entry_of_field(entry, origin + lane)
    for lane in range(LANES):
        lanes[k, lane] = row[lane]


@ti.func
def store_lanes(entry: ti.template(), origin: int, lanes: ti.template(), k: ti.template()):
    """Store row k of an array as an entry of the particles from `origin` on; all are read before any is stored."""
    row = ti.Vector.zero(float, LANES)
    for lane in range(LANES):
        row[lane] = lanes[k, lane]
    for lane in range(LANES):
        set_entry(entry, origin + lane, row[lane])


@ti.func
def repeat_first(lanes: ti.template(), count: int):
    """Copy lane 0 to the lanes from `count` on, which were loaded from memory beyond the last particle."""
    for lane in range(count, LANES):
        for k in ti.static(range(lanes.n)):
            lanes[k, lane] = lanes[k, 0]


@ti.func
def load_rows(group: ti.template(), begin: int, count: int, rows: ti.template()):
    """Copy the table rows of `count` particles from `begin` on; with one body all lanes have the same row."""
    for lane in range(LANES):
        # Memory beyond the last particle holds no row number of the table.
        row = group.row(begin + ti.min(lane, count - 1))
        for k in ti.static(range(row.n)):
            rows[k, lane] = row[k]
