"""Bounds on expressions over intervals: interval arithmetic on their trees (Moore, Kearfott and Cloud 2009, ch. 2-5).

Bounds contain every finite value that an expression takes, up to rounding of the last digits. They are the exact range
where each name occurs once. A truth value is an interval of 0 and 1.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from mpmcli.scene.expression import Apply, Name, Number, Tree
from mpmcli.scene.functions import FUNCTIONS, OPERATORS

# Lower and upper ends, arrays of one shape.
Interval = tuple[np.ndarray, np.ndarray]


def bounds_of(tree: Tree, ranges: Mapping[str, Interval]) -> Interval:
    """Return bounds on a tree where each name lies within its range; an end that is not known is infinite."""
    with np.errstate(all="ignore"):
        low, high = _bounds(tree, ranges)
    low, high = np.broadcast_arrays(np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64))
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _bounds(tree: Tree, ranges: Mapping[str, Interval]) -> Interval:
    if isinstance(tree, Number):
        return np.float64(tree.value), np.float64(tree.value)
    if isinstance(tree, Name):
        return ranges[tree.name]
    assert isinstance(tree, Apply)
    return _RULES[tree.function](*[_bounds(argument, ranges) for argument in tree.arguments])


def _hull(*values: np.ndarray) -> Interval:
    """Return the smallest interval that holds some values; one that is not a number counts as unknown."""
    stacked = np.stack(np.broadcast_arrays(*values))
    unknown = np.isnan(stacked).any(axis=0)
    return np.where(unknown, -np.inf, stacked.min(axis=0)), np.where(unknown, np.inf, stacked.max(axis=0))


def _rising(name: str) -> Callable[..., Interval]:
    """Return the rule of a function that never falls; outside its domain nothing is known."""
    compute = FUNCTIONS[name].compute

    def rule(a: Interval) -> Interval:
        low, high = compute(a[0]), compute(a[1])
        return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)

    return rule


def _plus(a: Interval, b: Interval) -> Interval:
    return a[0] + b[0], a[1] + b[1]


def _minus(a: Interval, b: Interval) -> Interval:
    return a[0] - b[1], a[1] - b[0]


def _times(a: Interval, b: Interval) -> Interval:
    # 0 times infinity is 0 here: the other factor is 0.
    products = [np.where((x == 0) | (y == 0), 0.0, x * y) for x in a for y in b]
    return _hull(*products)


def _over(a: Interval, b: Interval) -> Interval:
    low, high = _times(a, (1 / b[1], 1 / b[0]))
    crosses = (b[0] <= 0) & (b[1] >= 0)
    return np.where(crosses, -np.inf, low), np.where(crosses, np.inf, high)


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
    pole = crosses & (b[0] < 0)
    # A negative base with a power that is not whole is not a number, and one that varies may be anything.
    unknown = pole | ((a[0] < 0) & ~(fixed & whole))
    return np.where(unknown, -np.inf, low), np.where(unknown, np.inf, ends[1])


def _sine(a: Interval, shift: float = 0.0) -> Interval:
    """Return the range of sin(a + shift), with the peaks that lie within."""
    low, high = a[0] + shift, a[1] + shift
    ends = np.sin(low), np.sin(high)
    turn = 2 * math.pi
    peak = np.floor((high - math.pi / 2) / turn) >= np.ceil((low - math.pi / 2) / turn)
    trough = np.floor((high + math.pi / 2) / turn) >= np.ceil((low + math.pi / 2) / turn)
    unknown = ~np.isfinite(high - low)
    return (
        np.where(trough | unknown, -1.0, np.minimum(*ends)),
        np.where(peak | unknown, 1.0, np.maximum(*ends)),
    )


def _tangent(a: Interval) -> Interval:
    low, high = np.tan(a[0]), np.tan(a[1])
    branch = np.floor(a[0] / math.pi + 0.5) == np.floor(a[1] / math.pi + 0.5)
    return np.where(branch, low, -np.inf), np.where(branch, high, np.inf)


def _absolute(a: Interval) -> Interval:
    low, high = np.minimum(np.abs(a[0]), np.abs(a[1])), np.maximum(np.abs(a[0]), np.abs(a[1]))
    return np.where((a[0] <= 0) & (a[1] >= 0), 0.0, low), high


def _cosh(a: Interval) -> Interval:
    low, high = _absolute(a)
    return np.cosh(low), np.cosh(high)


def _hypot(a: Interval, b: Interval) -> Interval:
    (a0, a1), (b0, b1) = _absolute(a), _absolute(b)
    return np.hypot(a0, b0), np.hypot(a1, b1)


def _acos(a: Interval) -> Interval:
    low, high = _rising("asin")(a)
    return math.pi / 2 - high, math.pi / 2 - low


def _atan2(a: Interval, b: Interval) -> Interval:
    ends = _hull(*(np.arctan2(y, x) for y in a for x in b))
    # Across the negative x axis it jumps; around the origin it is anything.
    cut = (b[0] <= 0) & (a[0] <= 0) & (a[1] >= 0)
    return np.where(cut, -math.pi, ends[0]), np.where(cut, math.pi, ends[1])


def _smaller(*a: Interval) -> Interval:
    return np.minimum.reduce(np.broadcast_arrays(*[x[0] for x in a])), np.minimum.reduce(
        np.broadcast_arrays(*[x[1] for x in a])
    )


def _larger(*a: Interval) -> Interval:
    return np.maximum.reduce(np.broadcast_arrays(*[x[0] for x in a])), np.maximum.reduce(
        np.broadcast_arrays(*[x[1] for x in a])
    )


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


def _choose(condition: Interval, a: Interval, b: Interval) -> Interval:
    sure, never = condition[0] >= 1, condition[1] <= 0
    low = np.where(sure, a[0], np.where(never, b[0], np.minimum(a[0], b[0])))
    return low, np.where(sure, a[1], np.where(never, b[1], np.maximum(a[1], b[1])))


_RULES: dict[str, Callable[..., Interval]] = {
    "+": _plus,
    "-": _minus,
    "*": _times,
    "/": _over,
    "%": _modulo,
    "**": _power,
    "pow": _power,
    "negative": lambda a: (-a[1], -a[0]),
    "<": _less,
    "<=": _at_most,
    ">": lambda a, b: _less(b, a),
    ">=": lambda a, b: _at_most(b, a),
    "==": _equal,
    "!=": lambda a, b: _not(_equal(a, b)),
    "and": lambda a, b: _smaller(a, b),
    "or": lambda a, b: _larger(a, b),
    "not": _not,
    "if": _choose,
    "sin": _sine,
    "cos": lambda a: _sine(a, math.pi / 2),
    "tan": _tangent,
    "acos": _acos,
    "atan2": _atan2,
    "cosh": _cosh,
    "abs": _absolute,
    "min": _smaller,
    "max": _larger,
    "clamp": lambda x, low, high: _smaller(_larger(x, low), high),
    "hypot": _hypot,
    **{
        name: _rising(name)
        for name in ("asin", "atan", "sinh", "tanh", "exp", "log", "log10", "sqrt", "floor", "ceil", "sign", "step")
    },
}
assert set(_RULES) == {*OPERATORS, *FUNCTIONS}
