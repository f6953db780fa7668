"""Expressions inside kernels: each node of a tree is an object whose `evaluate` is inlined where it is called.

What depends on time alone is no part of a kernel: the host computes its mean over the kick once per step, in double
precision, and the kernel reads it from the clock. Conditions are integers, 0 or 1, or for a condition of time the share
of the kick for which it holds. Both branches of `a if c else b` are computed.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.scene.expression import INITIAL, POSITION, Apply, Name, Number, Tree, names_in
from mpmcli.scene.quadrature import Mean, telling_times
from mpmcli.solver.expression_functions import KERNELS, blend

# Whole exponents up to this one are products: a power of a negative number is undefined on some devices.
LARGEST_PRODUCT = 64


@ti.data_oriented
class Clock:
    """Values that depend on time alone, one set per step: their means over the kick, so that no pulse is skipped.

    Attributes:
        trees: what the values are.
        values: (k) vector field of them, None as long as it was not allocated.
    """

    def __init__(self) -> None:
        self.trees: list[Tree] = []
        self.values: ti.Field | None = None

    def place_of(self, tree: Tree) -> int:
        """Return the index of a value, which is added where it is new."""
        if tree not in self.trees:
            self.trees.append(tree)
        return self.trees.index(tree)

    def allocate(self, end: float) -> Callable[[float, float], None]:
        """Allocate the values, and return what sets them to their means between two times of a run of `end` seconds."""
        if not self.trees:
            return lambda start, end: None
        count = len(self.trees)
        vector, means = ti.types.vector(count, float), [Mean(tree, end) for tree in self.trees]
        values = self.values = ti.Vector.field(count, float, shape=())

        @ti.kernel
        def write(now: vector):
            values[None] = now

        def set_times(start: float, end: float) -> None:
            write(vector([mean(start, end) for mean in means]))

        return set_times

    def telling_times(self, start: float, end: float) -> list[float]:
        """Return the times between two (s) at which any of the values is smallest or largest."""
        return [time for tree in self.trees for time in telling_times(tree, start, end)]


@ti.data_oriented
class Constant:
    """A number."""

    def __init__(self, value: float) -> None:
        self.value = value

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        return ti.cast(self.value, float)


@ti.data_oriented
class Coordinate:
    """A coordinate of the position, or of the initial one, in the coordinates of the scene."""

    def __init__(self, axis: int, origin: float, *, initial: bool) -> None:
        self.axis = axis
        self.origin = origin
        self.initial = initial

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        value = x[self.axis]
        if ti.static(self.initial):
            value = X[self.axis]
        if ti.static(self.origin != 0):
            value += ti.static(self.origin)
        return value


@ti.data_oriented
class Reading:
    """A value of the clock; of a condition the share of the kick for which it is true."""

    def __init__(self, clock: Clock, index: int) -> None:
        self.clock = clock
        self.index = index

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        return self.clock.values[None][self.index]


@ti.data_oriented
class Power:
    """A whole power, by squaring."""

    def __init__(self, base: object, exponent: int) -> None:
        self.base = base
        self.inverse = exponent < 0
        self.bits = tuple(bit == "1" for bit in bin(abs(exponent))[2:])

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        base = self.base.evaluate(x, X)
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
    def evaluate(self, x: ti.template(), X: ti.template()):
        return self.function(self.a.evaluate(x, X))


@ti.data_oriented
class Binary:
    """A function of two values."""

    def __init__(self, function: Callable, a: object, b: object) -> None:
        self.function = function
        self.a = a
        self.b = b

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        return self.function(self.a.evaluate(x, X), self.b.evaluate(x, X))


@ti.data_oriented
class Ternary:
    """A function of three values."""

    def __init__(self, function: Callable, a: object, b: object, c: object) -> None:
        self.function = function
        self.a = a
        self.b = b
        self.c = c

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template()):
        return self.function(self.a.evaluate(x, X), self.b.evaluate(x, X), self.c.evaluate(x, X))


NODES = (None, Unary, Binary, Ternary)


def node_of(tree: Tree, origin: np.ndarray, clock: Clock) -> object:
    """Return the node that evaluates a tree at positions relative to `origin`, (d,), m; its times go to the clock."""
    if isinstance(tree, Number):
        return Constant(tree.value)
    if names_in(tree) == {"t"}:
        return Reading(clock, clock.place_of(tree))
    if isinstance(tree, Name):
        names = INITIAL if tree.name in INITIAL else POSITION
        axis = names.index(tree.name)
        return Coordinate(axis, float(origin[axis]), initial=names is INITIAL)
    return _applied(tree, origin, clock)


def _applied(tree: Apply, origin: np.ndarray, clock: Clock) -> object:
    arguments = tree.arguments
    if tree.function in ("**", "pow") and isinstance(arguments[1], Number):
        exponent = arguments[1].value
        if exponent == int(exponent) and abs(exponent) <= LARGEST_PRODUCT:
            return Power(node_of(arguments[0], origin, clock), int(exponent))
    # A condition of time may hold for a part of the kick.
    shared = tree.function == "if" and "t" in names_in(arguments[0])
    function = blend if shared else KERNELS[tree.function]
    nodes = [node_of(argument, origin, clock) for argument in arguments]
    if tree.function in ("min", "max"):
        result = nodes[0]
        for node in nodes[1:]:
            result = Binary(function, result, node)
        return result
    return NODES[len(nodes)](function, *nodes)
