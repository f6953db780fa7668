"""Operations on particles: each is written for one particle, and `over` carries it out for a range of them.

An operation is a list of passes. A pass is a function of a particle that takes values by the names of its parameters,
and returns others: columns of the particles that the operation reads, and what earlier passes gave. On a GPU, and on a
sparse grid, a particle goes through all passes by itself. On a dense grid on the CPU each pass is a loop over LANES
particles, which the compiler vectorises if the pass accesses its values only; see `lanes`.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.sort import stay_rolled
from mpmcli.solver.transfer.lanes import (
    LANES,
    load_entry,
    repeat_first,
    set_matrix,
    set_vector,
    store_lanes,
    vector_of,
)
from mpmcli.solver.transfer.splines import bounded

# Parameters of a pass before its values: the work of a thread, the index of the particle, and the argument of `over`.
ALWAYS = 3
# Sizes of values that are integers: an index, and the address of a stencil, which has several on a sparse grid.
INDEX, STENCIL = ("index",), ("stencil",)


# Compared by identity, like all that is given to kernels.
@dataclass(frozen=True, eq=False)
class Pass:
    """A function of one particle, `body(at, p, how, *values)`.

    Attributes:
        body: the function; the names of its parameters after the third are those of the values that it takes.
        gives: the values that it returns, in order, with their sizes: numbers, "d" for the dimension, "nodes" for the
            nodes of a stencil along an axis; a second size is that of the rows of a matrix; () for a number, INDEX or
            STENCIL for an integer.
        in_lanes: whether the body accesses only its values and constants of `at`, and may thus run for a lane without a
            particle.
    """

    body: Callable
    gives: dict[str, tuple] = field(default_factory=dict)
    in_lanes: bool = False

    @property
    def takes(self) -> tuple[str, ...]:
        """The names of the values that the body takes."""
        return tuple(inspect.signature(self.body).parameters)[ALWAYS:]


@dataclass(frozen=True, eq=False)
class Operation:
    """An operation on the particles of a group.

    Attributes:
        reads: columns of the particles that passes take, see `ParticleArrays.column`.
        passes: what is done, in order.
        writes: columns that take the values with their names at the end.
    """

    reads: tuple[str, ...]
    passes: tuple[Pass, ...]
    writes: tuple[str, ...] = ()


class ParticleValues:
    """The values of one particle by name, variables of a kernel."""

    def __init__(self, op: Operation, group: Any, p: Any) -> None:
        self.values = {name: column_of(group.column(name), p) for name in op.reads}

    def take(self, names: Sequence[str], _lane: Any) -> tuple:
        """Return values of the particle."""
        return tuple(self.values[name] for name in names)

    def give(self, names: Sequence[str], given: tuple, _lane: Any) -> None:
        """Set values of the particle."""
        self.values |= zip(names, given, strict=True)


class LaneValues:
    """The values of LANES particles by name: an array for each, with a row per entry, variables of a kernel."""

    def __init__(self, op: Operation, at: Any) -> None:
        sizes = {"d": at.grid.dimension, "nodes": at.grid.scheme.spline.nodes}
        self.shapes = {name: at.group.column(name).shape for name in op.reads}
        for step in op.passes:
            self.shapes |= {name: tuple(sizes.get(n, n) for n in shape) for name, shape in step.gives.items()}
        self.arrays = {name: ti.lang.impl.expr_init(empty(shape)) for name, shape in self.shapes.items()}

    def take(self, names: Sequence[str], lane: Any) -> tuple:
        """Return values of a lane."""
        return tuple(value_of(self.arrays[name], self.shapes[name], lane) for name in names)

    def give(self, names: Sequence[str], given: tuple, lane: Any) -> None:
        """Set values of a lane."""
        for name, value in zip(names, given, strict=True):
            set_value(self.arrays[name], self.shapes[name], lane, value)


def empty(shape: tuple) -> ti.Matrix:
    """Return an array of lanes for values of a shape."""
    if shape in (INDEX, STENCIL):
        return ti.Matrix.zero(int, 1, LANES)
    return ti.Matrix.zero(float, math.prod(shape), LANES)


@ti.func
def value_of(lanes: ti.template(), shape: ti.template(), lane: int):
    if ti.static(len(shape) == 2):
        value = ti.Matrix.zero(float, shape[0], shape[1])
        for i, j in ti.static(ti.ndrange(shape[0], shape[1])):
            value[i, j] = lanes[i * shape[1] + j, lane]
        return value
    elif ti.static(len(shape) == 1 and shape not in (INDEX, STENCIL)):
        return vector_of(lanes, 0, ti.static(shape[0]), lane)
    else:
        return lanes[0, lane]


@ti.func
def set_value(lanes: ti.template(), shape: ti.template(), lane: int, value: ti.template()):
    if ti.static(len(shape) == 2):
        set_matrix(lanes, 0, value, lane)
    elif ti.static(len(shape) == 1 and shape not in (INDEX, STENCIL)):
        set_vector(lanes, 0, value, lane)
    else:
        lanes[0, lane] = value


@ti.func
def column_of(column: ti.template(), p: int):
    """Return the value of a column of particle p."""
    field, shape = ti.static((column.field, column.shape))
    if ti.static(len(shape) == 2):
        value = ti.Matrix.zero(float, shape[0], shape[1])
        for k in ti.static(range(len(column.entries))):
            value[k // shape[1], k % shape[1]] = field[p][column.entries[k]]
        return value
    elif ti.static(len(shape) == 1):
        value = ti.Vector.zero(float, shape[0])
        for k in ti.static(range(len(column.entries))):
            value[k] = field[p][column.entries[k]]
        return value
    else:
        return field[p]


@ti.func
def set_column(column: ti.template(), p: int, k: ti.template(), number: float):
    """Set entry k of a column of particle p."""
    if ti.static(len(column.shape) == 0):
        column.field[p] = number
    else:
        column.field[p][ti.static(column.entries[k])] = number


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
    """Carry out an operation on particle p."""
    if ti.static(isinstance(op, Operation)):
        (values,) = ti.static((ParticleValues(op, at.group, p),))
        for step in ti.static(op.passes):
            carry_out(at, step, p, how, values, 0)
        for name in ti.static(op.writes):
            (column, value) = ti.static((at.group.column(name), values.values[name]))
            for k in ti.static(range(len(column.entries))):
                set_column(column, p, k, entry_of(value, column.shape, k))
    else:
        ti.static(op)(at, p, how)


@ti.func
def entry_of(value: ti.template(), shape: ti.template(), k: ti.template()):
    if ti.static(len(shape) == 2):
        return value[k // shape[1], k % shape[1]]
    elif ti.static(len(shape) == 1):
        return value[k]
    else:
        return value


def goes_in_lanes(op: Operation | Callable, grid: Any) -> bool:
    """Return whether passes are loops over lanes, which hold no addresses of stencils on a sparse grid."""
    if not isinstance(op, Operation):
        return False
    return not grid.sparse or all(STENCIL not in step.gives.values() for step in op.passes)


@ti.func
def over(at: ti.template(), op: ti.template(), first: int, last: int, how: float):
    """Carry out an operation on particles first to last - 1, on the CPU."""
    if ti.static(goes_in_lanes(op, at.grid)):
        over_lanes(at, op, first, last, how)
    else:
        for p in range(first, last):
            stay_rolled(at.order.buffers.real, p)
            one(at, op, p, how)


@ti.func
def over_lanes(at: ti.template(), op: ti.template(), first: int, last: int, how: float):
    """Carry out an operation on particles first to last - 1, LANES at a time."""
    (values,) = ti.static((LaneValues(op, at),))
    begin = first
    while begin < last:
        count, origin = ti.min(LANES, last - begin), bounded(begin)
        for name in ti.static(op.reads):
            (column,) = ti.static((at.group.column(name),))
            for k in ti.static(range(len(column.entries))):
                load_entry(values.arrays[name], k, column.field, ti.static(column.entries[k]), origin)
            if count < LANES:
                repeat_first(values.arrays[name], count)
        for step in ti.static(op.passes):
            if ti.static(step.in_lanes):
                for lane in range(LANES):
                    carry_out(at, step, begin + lane, how, values, lane)
            else:
                for lane in range(count):
                    stay_rolled(at.order.buffers.real, begin + lane)
                    carry_out(at, step, begin + lane, how, values, lane)
        if count == LANES:
            # Entry by entry, so that entries of neighbouring particles are stored at once.
            for name in ti.static(op.writes):
                (column,) = ti.static((at.group.column(name),))
                for k in ti.static(range(len(column.entries))):
                    store_lanes(column.field, ti.static(column.entries[k]), origin, values.arrays[name], k)
        else:
            for lane in range(count):
                stay_rolled(at.order.buffers.real, begin + lane)
                for name in ti.static(op.writes):
                    (column,) = ti.static((at.group.column(name),))
                    for k in ti.static(range(len(column.entries))):
                        set_column(column, begin + lane, k, values.arrays[name][k, lane])
        begin += LANES
