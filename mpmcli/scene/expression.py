"""Expressions as trees of named quantities: value, bounds and derivative; one table row for each function.

A derivative refers to parts of its tree, so that a part may occur many times; every walk visits it once (`_folded`).

`expression_reader` reads them from text; `solver.drive.expressions` has each function in a kernel, by the same name.

Bounds follow from interval arithmetic (Moore, Kearfott and Cloud 2009, ch. 2-5). They contain every finite value up to
rounding, and are the exact range where each name occurs once. A truth value is an interval of 0 and 1. A jump (floor,
ceil, sign, step, comparisons) has slope zero, and a kink (abs, min, max, clamp) the slope of one side. Central
differences are not used: they are wrong within a step of a singular point, elsewhere by up to 3e-9 of the largest.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np

# Names whose value varies within a step, from particle to particle.
POSITION = ("x", "y", "z")
INITIAL = ("X", "Y", "Z")
QUANTITIES = ("t", *POSITION, *INITIAL)
# In forces alone; constants may have these names.
VELOCITY = ("vx", "vy", "vz")
CONSTANTS = {"pi": math.pi, "e": math.e}
# Largest number of arguments of a variadic function.
MANY = 64

Kind = Literal["number", "truth"]
# Lower and upper ends, arrays of one shape.
Interval = tuple[np.ndarray, np.ndarray]


class ExpressionError(ValueError):
    """A fault of an expression, and its correction."""


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float


@dataclass(frozen=True)
class Name:
    """A quantity by its name."""

    name: str


@dataclass(frozen=True, eq=False, repr=False)
class Apply:
    """An operator or a function, and its arguments; equal to itself alone."""

    function: str
    arguments: tuple["Tree", ...]

    @cached_property
    def names(self) -> frozenset[str]:
        """The names in the arguments."""
        return frozenset().union(*map(names_in, self.arguments))

    @cached_property
    def order(self) -> tuple["Tree", ...]:
        """Itself and the nodes below it, each once, arguments before their function."""
        found: dict[int, Tree] = {}
        waiting: list[Tree] = [self]
        while waiting:
            node = waiting[-1]
            missing = [a for a in node.arguments if id(a) not in found] if isinstance(node, Apply) else []
            waiting += missing[::-1]
            if not missing:
                found[id(waiting.pop())] = node
        return tuple(found.values())


Tree = Number | Name | Apply
ZERO, ONE = Number(0.0), Number(1.0)


@dataclass(frozen=True)
class Expression:
    """An expression of at least one name: its text with constants inserted, its tree, and the text as written."""

    text: str
    tree: Tree = field(compare=False, repr=False)
    source: str = field(compare=False, repr=False)

    @property
    def names(self) -> frozenset[str]:
        """The quantities that it depends on."""
        return names_in(self.tree)

    def __call__(self, **values: np.ndarray | float) -> np.ndarray:
        """Return its value in float64; arrays are broadcast, and values out of range become inf or nan, silently."""
        return evaluate(self.tree, values)


def evaluate(tree: Tree, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
    """Return the value of a tree in float64, from the values of its names."""
    with np.errstate(all="ignore"):
        return _folded(
            tree, np.float64, lambda name: np.asarray(values[name], dtype=np.float64), lambda f: _function(f).compute
        )


def bounds_of(tree: Tree, ranges: Mapping[str, Interval]) -> Interval:
    """Return bounds on a tree where each name lies within its range; an unknown end is infinite."""
    with np.errstate(all="ignore"):
        low, high = _folded(
            tree, lambda value: (np.float64(value),) * 2, ranges.__getitem__, lambda f: _function(f).bounds
        )
    return _known(*np.broadcast_arrays(np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)))


def derivative(tree: Tree, name: str) -> Tree:
    """Return the partial derivative of a tree by a name."""

    def rule(f: Apply) -> Callable[..., Tree]:
        if kind_of(f) == "truth":
            return lambda *_: ZERO
        return lambda *slopes: ZERO if all(slope == ZERO for slope in slopes) else _function(f).slope(f, *slopes)

    return _folded(tree, lambda _: ZERO, lambda own: ONE if own == name else ZERO, rule)


def _folded(
    tree: Tree, number: Callable[[float], Any], name: Callable[[str], Any], rule: Callable[[Apply], Callable[..., Any]]
) -> Any:
    """Return what the rules make of a tree: of a number, of a name, and of a function, from that of its arguments."""
    found: dict[int, Any] = {}
    order = tree.order if isinstance(tree, Apply) else (tree,)
    left = Counter(id(a) for node in order if isinstance(node, Apply) for a in node.arguments)
    for node in order:
        if isinstance(node, Apply):
            found[id(node)] = rule(node)(*[found[id(a)] for a in node.arguments])
            # A result may be an array over all particles, and is kept until its last use.
            for a in node.arguments:
                left[id(a)] -= 1
                if not left[id(a)]:
                    del found[id(a)]
        else:
            found[id(node)] = number(node.value) if isinstance(node, Number) else name(node.name)
    return found[id(tree)]


def names_in(tree: Tree) -> frozenset[str]:
    """Return the names in a tree."""
    if isinstance(tree, Apply):
        return tree.names
    return frozenset([tree.name] if isinstance(tree, Name) else [])


def kind_of(tree: Tree) -> Kind:
    """Return whether a tree is a number or a truth value."""
    return _function(tree).result if isinstance(tree, Apply) else "number"


def apply(function: str, *arguments: Tree) -> Tree:
    """Return a function applied to trees; constant arguments are evaluated at once if the value is finite."""
    made = Apply(function, arguments)
    if kind_of(made) == "number" and not names_in(made):
        value = float(evaluate(made, {}))
        if math.isfinite(value):
            return Number(value)
    return made


@dataclass(frozen=True)
class Function:
    """An operator or a function."""

    compute: Callable[..., np.ndarray]  # of arrays or numbers, broadcast against each other
    bounds: Callable[..., Interval]  # of the values, from those of the arguments
    slope: Callable[..., Tree] | None  # from the tree of the function and the derivatives of its arguments
    least: int  # number of arguments, and the largest number of them
    most: int
    result: Kind = "number"


def _function(tree: Apply) -> Function:
    return OPERATORS.get(tree.function) or FUNCTIONS[tree.function]


# Values


def _step(x: np.ndarray) -> np.ndarray:
    """Heaviside's function, 1 at 0; nan stays nan."""
    return np.where(np.isnan(x), x, np.where(np.greater_equal(x, 0), 1.0, 0.0))


# Bounds


def _known(low: np.ndarray, high: np.ndarray, unknown: np.ndarray | None = None) -> Interval:
    """Return an interval whose unknown ends are infinite; by default nan ends are unknown."""
    no_low, no_high = (np.isnan(low), np.isnan(high)) if unknown is None else (unknown, unknown)
    return np.where(no_low, -np.inf, low), np.where(no_high, np.inf, high)


def _hull(*values: np.ndarray) -> Interval:
    """Return the smallest interval that contains the values; nan counts as unknown."""
    stacked = np.stack(np.broadcast_arrays(*values))
    return _known(stacked.min(axis=0), stacked.max(axis=0), np.isnan(stacked).any(axis=0))


def _rising(compute: Callable[..., np.ndarray]) -> Callable[[Interval], Interval]:
    """Return the rule of a nondecreasing function; outside its domain the bounds are unknown."""
    return lambda a: _known(compute(a[0]), compute(a[1]))


def _extreme_of(choose: np.ufunc) -> Callable[..., Interval]:
    """Return the rule of the smallest or the largest of some intervals."""
    return lambda *a: tuple(choose.reduce(np.broadcast_arrays(*ends)) for ends in zip(*a, strict=True))


_smallest, _largest = _extreme_of(np.minimum), _extreme_of(np.maximum)


def _product(a: Interval, b: Interval) -> Interval:
    # 0 times infinity is 0 here: the other factor is 0.
    return _hull(*(np.where((x == 0) | (y == 0), 0.0, x * y) for x in a for y in b))


def _quotient(a: Interval, b: Interval) -> Interval:
    return _known(*_product(a, (1 / b[1], 1 / b[0])), unknown=(b[0] <= 0) & (b[1] >= 0))


def _modulo(a: Interval, b: Interval) -> Interval:
    """Return a - b floor(a / b): within one period where a stays in it, between 0 and b otherwise."""
    turns = np.floor(a[0] / b[0])
    same = (b[0] == b[1]) & (b[0] > 0) & (turns == np.floor(a[1] / b[0]))
    low, high = np.where(b[0] > 0, 0.0, np.minimum(b[0], 0.0)), np.maximum(b[1], 0.0)
    return np.where(same, a[0] - b[0] * turns, low), np.where(same, a[1] - b[0] * turns, high)


def _power(a: Interval, b: Interval) -> Interval:
    ends = _hull(*(np.power(x, y) for x in a for y in b))
    fixed, whole = b[0] == b[1], b[0] == np.floor(b[0])
    even = fixed & whole & (b[0] % 2 == 0)
    crosses = (a[0] <= 0) & (a[1] >= 0)
    low = np.where(even & crosses & (b[0] >= 0), np.minimum(ends[0], 0.0), ends[0])
    # At a pole. A negative base to a power that is not whole is nan; with a varying power nothing is known.
    return _known(low, ends[1], unknown=(crosses & (b[0] < 0)) | ((a[0] < 0) & ~(fixed & whole)))


def _sine(a: Interval, shift: float = 0.0) -> Interval:
    """Return the range of sin(a + shift), including the peaks within a."""
    low, high = a[0] + shift, a[1] + shift
    ends = np.sin(low), np.sin(high)
    turn = 2 * math.pi
    peak = np.floor((high - math.pi / 2) / turn) >= np.ceil((low - math.pi / 2) / turn)
    trough = np.floor((high + math.pi / 2) / turn) >= np.ceil((low + math.pi / 2) / turn)
    unknown = ~np.isfinite(high - low)
    least, most = np.minimum(*ends), np.maximum(*ends)
    return np.where(trough | unknown, -1.0, least), np.where(peak | unknown, 1.0, most)


def _tangent(a: Interval) -> Interval:
    branch = np.floor(a[0] / math.pi + 0.5) == np.floor(a[1] / math.pi + 0.5)
    return _known(np.tan(a[0]), np.tan(a[1]), unknown=~branch)


def _absolute(a: Interval) -> Interval:
    low, high = np.minimum(np.abs(a[0]), np.abs(a[1])), np.maximum(np.abs(a[0]), np.abs(a[1]))
    return np.where((a[0] <= 0) & (a[1] >= 0), 0.0, low), high


def _of_absolutes(compute: Callable[..., np.ndarray]) -> Callable[..., Interval]:
    """Return the rule of an even function that rises with the size of each argument."""
    return lambda *a: tuple(compute(*ends) for ends in zip(*map(_absolute, a), strict=True))


def _acos(a: Interval) -> Interval:
    low, high = _rising(np.arcsin)(a)
    return math.pi / 2 - high, math.pi / 2 - low


def _atan2(a: Interval, b: Interval) -> Interval:
    ends = _hull(*(np.arctan2(y, x) for y in a for x in b))
    # It jumps across the negative x axis and takes every value around the origin.
    cut = (b[0] <= 0) & (a[0] <= 0) & (a[1] >= 0)
    return np.where(cut, -math.pi, ends[0]), np.where(cut, math.pi, ends[1])


def _truth(always: np.ndarray, possible: np.ndarray) -> Interval:
    return np.where(always, 1.0, 0.0), np.where(possible, 1.0, 0.0)


def _less(a: Interval, b: Interval) -> Interval:
    return _truth(a[1] < b[0], ~(a[0] >= b[1]))


def _at_most(a: Interval, b: Interval) -> Interval:
    return _truth(a[1] <= b[0], ~(a[0] > b[1]))


def _equal(a: Interval, b: Interval) -> Interval:
    same = (a[0] == a[1]) & (b[0] == b[1]) & (a[0] == b[0])
    return _truth(same, ~((a[1] < b[0]) | (a[0] > b[1])))


def _not(a: Interval) -> Interval:
    return 1.0 - a[1], 1.0 - a[0]


def _choice(condition: Interval, a: Interval, b: Interval) -> Interval:
    sure, never = condition[0] >= 1, condition[1] <= 0
    low = np.where(sure, a[0], np.where(never, b[0], np.minimum(a[0], b[0])))
    return low, np.where(sure, a[1], np.where(never, b[1], np.maximum(a[1], b[1])))


# Slopes; zeros and ones are removed from the trees of sums and products.


def plus(a: Tree, b: Tree) -> Tree:
    return b if a == ZERO else a if b == ZERO else apply("+", a, b)


def minus(a: Tree, b: Tree) -> Tree:
    return a if b == ZERO else apply("negative", b) if a == ZERO else apply("-", a, b)


def times(a: Tree, b: Tree) -> Tree:
    if ZERO in (a, b):
        return ZERO
    return b if a == ONE else a if b == ONE else apply("*", a, b)


def over(a: Tree, b: Tree) -> Tree:
    return ZERO if a == ZERO else apply("/", a, b)


def squared(a: Tree) -> Tree:
    return times(a, a)


def _chained(outer: Tree, inner: Tree) -> Tree:
    """Return the product of two slopes, 0 where the inner one is 0, although the outer one may be infinite there.

    Examples are the tip of hypot(X, Y) and the flat part of max(X, 0)**0.5.
    """
    if isinstance(inner, Number):
        return times(outer, inner)
    return Apply("if", (Apply("==", (inner, ZERO)), ZERO, times(outer, inner)))


def _power_slope(f: Tree, a: Tree, b: Tree, da: Tree, db: Tree) -> Tree:
    # b a^(b-1) a' + a^b log(a) b', each term omitted where it is 0, because it may be undefined there.
    return plus(_chained(times(b, apply("**", a, minus(b, ONE))), da), _chained(times(f, apply("log", a)), db))


def _clamp_slope(f: Apply, *slopes: Tree) -> Tree:
    x, low, high = f.arguments
    risen = _extreme("max", (x, low), slopes[:2])
    return _extreme("min", (risen[0], high), (risen[1], slopes[2]))[1]


def _extreme(name: str, values: tuple[Tree, ...], slopes: tuple[Tree, ...]) -> tuple[Tree, Tree]:
    """Return the largest or the smallest of some values, by "max" or "min", and its slope: that of the chosen value."""
    if len(values) == 1:
        return values[0], slopes[0]
    # By halves, because a tree's depth is limited where it is compiled.
    half = len(values) // 2
    (a, da), (b, db) = _extreme(name, values[:half], slopes[:half]), _extreme(name, values[half:], slopes[half:])
    chosen = Apply(">=" if name == "max" else "<=", (a, b))
    return Apply(name, (a, b)), da if da == db else Apply("if", (chosen, da, db))


# Rows


def _of_one(
    compute: Callable[..., np.ndarray], slope: Callable[[Tree, Tree], Tree], bounds: Callable | None = None
) -> Function:
    """Return the row of f(u), nondecreasing by default; `slope` is its derivative by u, from u and f."""
    return Function(
        compute, bounds or _rising(compute), lambda f, du: _chained(slope(f.arguments[0], f), du), least=1, most=1
    )


def _of_two(compute: Callable[..., np.ndarray], bounds: Callable, slope: Callable[..., Tree]) -> Function:
    """Return the row of f(a, b); `slope` is a function of f, a, b and the slopes of a and b."""
    return Function(compute, bounds, lambda f, da, db: slope(f, *f.arguments, da, db), least=2, most=2)


def _truth_of(compute: Callable[..., np.ndarray], bounds: Callable, count: int = 2) -> Function:
    return Function(compute, bounds, None, count, count, "truth")


def _extreme_row(choose: np.ufunc, name: str) -> Function:
    return Function(
        lambda *values: reduce(choose, values),
        _extreme_of(choose),
        lambda f, *slopes: _extreme(name, f.arguments, slopes)[1],
        least=2,
        most=MANY,
    )


def _flat(u: Tree, f: Tree) -> Tree:
    return ZERO


_POWER = _of_two(np.power, _power, _power_slope)

# Operators by their sign.
OPERATORS: dict[str, Function] = {
    "+": _of_two(np.add, lambda a, b: (a[0] + b[0], a[1] + b[1]), lambda f, a, b, da, db: plus(da, db)),
    "-": _of_two(np.subtract, lambda a, b: (a[0] - b[1], a[1] - b[0]), lambda f, a, b, da, db: minus(da, db)),
    "*": _of_two(np.multiply, _product, lambda f, a, b, da, db: plus(times(da, b), times(a, db))),
    "/": _of_two(np.divide, _quotient, lambda f, a, b, da, db: minus(over(da, b), over(times(f, db), b))),
    "%": _of_two(np.mod, _modulo, lambda f, a, b, da, db: minus(da, times(apply("floor", apply("/", a, b)), db))),
    "**": _POWER,
    "negative": _of_one(np.negative, lambda u, f: Number(-1.0), lambda a: (-a[1], -a[0])),
    "<": _truth_of(np.less, _less),
    "<=": _truth_of(np.less_equal, _at_most),
    ">": _truth_of(np.greater, lambda a, b: _less(b, a)),
    ">=": _truth_of(np.greater_equal, lambda a, b: _at_most(b, a)),
    "==": _truth_of(np.equal, _equal),
    "!=": _truth_of(np.not_equal, lambda a, b: _not(_equal(a, b))),
    "and": _truth_of(np.logical_and, _smallest),
    "or": _truth_of(np.logical_or, _largest),
    "not": _truth_of(np.logical_not, _not, 1),
    "if": Function(
        np.where, _choice, lambda f, _, a, b: a if a == b else Apply("if", (f.arguments[0], a, b)), least=3, most=3
    ),
}

# Functions by the name that an expression calls.
FUNCTIONS: dict[str, Function] = {
    "sin": _of_one(np.sin, lambda u, f: apply("cos", u), _sine),
    "cos": _of_one(np.cos, lambda u, f: apply("negative", apply("sin", u)), lambda a: _sine(a, math.pi / 2)),
    "tan": _of_one(np.tan, lambda u, f: plus(ONE, squared(f)), _tangent),
    "asin": _of_one(np.arcsin, lambda u, f: over(ONE, apply("sqrt", minus(ONE, squared(u))))),
    "acos": _of_one(np.arccos, lambda u, f: over(Number(-1.0), apply("sqrt", minus(ONE, squared(u)))), _acos),
    "atan": _of_one(np.arctan, lambda u, f: over(ONE, plus(ONE, squared(u)))),
    "atan2": _of_two(
        np.arctan2,
        _atan2,
        lambda f, a, b, da, db: over(minus(times(b, da), times(a, db)), plus(squared(a), squared(b))),
    ),
    "sinh": _of_one(np.sinh, lambda u, f: apply("cosh", u)),
    "cosh": _of_one(np.cosh, lambda u, f: apply("sinh", u), _of_absolutes(np.cosh)),
    "tanh": _of_one(np.tanh, lambda u, f: minus(ONE, squared(f))),
    "exp": _of_one(np.exp, lambda u, f: f),
    "log": _of_one(np.log, lambda u, f: over(ONE, u)),
    "log10": _of_one(np.log10, lambda u, f: over(Number(1 / math.log(10)), u)),
    "sqrt": _of_one(np.sqrt, lambda u, f: over(Number(0.5), f)),
    "abs": _of_one(np.abs, lambda u, f: apply("sign", u), _absolute),
    "floor": _of_one(np.floor, _flat),
    "ceil": _of_one(np.ceil, _flat),
    "sign": _of_one(np.sign, _flat),
    "step": _of_one(_step, _flat),
    "min": _extreme_row(np.minimum, "min"),
    "max": _extreme_row(np.maximum, "max"),
    "clamp": Function(
        lambda x, low, high: np.minimum(np.maximum(x, low), high),
        lambda x, low, high: _smallest(_largest(x, low), high),
        _clamp_slope,
        least=3,
        most=3,
    ),
    "hypot": _of_two(
        np.hypot,
        _of_absolutes(np.hypot),
        lambda f, a, b, da, db: _chained(over(ONE, f), plus(times(a, da), times(b, db))),
    ),
    "pow": _POWER,
}
