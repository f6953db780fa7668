"""Expressions inside kernels: each node of a tree is an object whose `evaluate` is inlined where it is called.

What depends on time alone is no part of a kernel, which reads its mean over the kick from the numbers of the run.
Conditions are integers, 0 or 1, or for a condition of time the share of the kick for which it holds. Both branches of
`a if c else b` are computed.
"""

from collections.abc import Callable

import taichi as ti

from mpmcli.scene.expression import INITIAL, POSITION, Name, Number, Tree
from mpmcli.solver.expression_functions import KERNELS
from mpmcli.solver.run_values import DeviceValues, Place, whole_power


@ti.data_oriented
class Constant:
    """A number."""

    def __init__(self, value: float) -> None:
        self.value = value

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return ti.cast(self.value, float)


@ti.data_oriented
class Coordinate:
    """A coordinate of the position, or of the initial one."""

    def __init__(self, axis: int, *, initial: bool) -> None:
        self.axis = axis
        self.initial = initial

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        value = x[self.axis]
        if ti.static(self.initial):
            value = X[self.axis]
        return value


@ti.data_oriented
class Reading:
    """A number of the run; of a condition of time the share of the kick for which it is true."""

    def __init__(self, values: DeviceValues, index: int) -> None:
        self.values = values
        self.index = index

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return self.values.field[run, self.index]


@ti.data_oriented
class Power:
    """A whole power, by squaring."""

    def __init__(self, base: object, exponent: int) -> None:
        self.base = base
        self.inverse = exponent < 0
        self.bits = tuple(bit == "1" for bit in bin(abs(exponent))[2:])

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        base = self.base.evaluate(x, X, run)
        result = ti.cast(1.0, float)
        for bit in ti.static(self.bits):
            result *= result
            if ti.static(bit):
                result *= base
        if ti.static(self.inverse):
            result = 1.0 / result
        return result


@ti.data_oriented
class Unary:
    """A function of one value."""

    def __init__(self, function: Callable, a: object) -> None:
        self.function = function
        self.a = a

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return self.function(self.a.evaluate(x, X, run))


@ti.data_oriented
class Binary:
    """A function of two values."""

    def __init__(self, function: Callable, a: object, b: object) -> None:
        self.function = function
        self.a = a
        self.b = b

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return self.function(self.a.evaluate(x, X, run), self.b.evaluate(x, X, run))


@ti.data_oriented
class Ternary:
    """A function of three values."""

    def __init__(self, function: Callable, a: object, b: object, c: object) -> None:
        self.function = function
        self.a = a
        self.b = b
        self.c = c

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return self.function(self.a.evaluate(x, X, run), self.b.evaluate(x, X, run), self.c.evaluate(x, X, run))


NODES = (None, Unary, Binary, Ternary)


def node_of(tree: "Tree | Place", values: DeviceValues | None) -> object:
    """Return the node that evaluates a tree of `Entries` at x and X, (d,), m, with the numbers of a run."""
    if isinstance(tree, Place):
        return Reading(values, tree.index)
    if isinstance(tree, Number):
        return Constant(tree.value)
    if isinstance(tree, Name):
        names = INITIAL if tree.name in INITIAL else POSITION
        return Coordinate(names.index(tree.name), initial=names is INITIAL)
    exponent = whole_power(tree)
    if exponent is not None:
        return Power(node_of(tree.arguments[0], values), exponent)
    function = KERNELS[tree.function]
    nodes = [node_of(argument, values) for argument in tree.arguments]
    if tree.function in ("min", "max"):
        result = nodes[0]
        for node in nodes[1:]:
            result = Binary(function, result, node)
        return result
    return NODES[len(nodes)](function, *nodes)
