"""The operators and functions of expressions as kernels compute them, by the names of `scene.functions`.

Truth is the integer 1, and 0 is not. Each agrees with numpy's to rounding; each has one return, as Taichi requires.
"""

from collections.abc import Callable

import taichi as ti


@ti.func
def _add(a, b):
    return a + b


@ti.func
def _subtract(a, b):
    return a - b


@ti.func
def _multiply(a, b):
    return a * b


@ti.func
def _divide(a, b):
    return a / b


@ti.func
def _modulo(a, b):
    return a - b * ti.floor(a / b)


@ti.func
def _power(a, b):
    size = ti.pow(ti.abs(a), b)
    odd = b - 2.0 * ti.floor(0.5 * b) == 1.0
    whole = ti.select(odd, -size, size)
    # The root of a negative number is not a number.
    negative = ti.select(ti.floor(b) == b, whole, ti.sqrt(a))
    return ti.select(a < 0.0, negative, size)


@ti.func
def _negative(a):
    return -a


@ti.func
def _less(a, b):
    return ti.select(a < b, 1, 0)


@ti.func
def _at_most(a, b):
    return ti.select(a <= b, 1, 0)


@ti.func
def _more(a, b):
    return ti.select(a > b, 1, 0)


@ti.func
def _at_least(a, b):
    return ti.select(a >= b, 1, 0)


@ti.func
def _equal(a, b):
    return ti.select(a == b, 1, 0)


@ti.func
def _unequal(a, b):
    return ti.select(a != b, 1, 0)


# Conditions are integers, 0 or 1.
@ti.func
def _both(a, b):
    return a * b


@ti.func
def _either(a, b):
    return ti.max(a, b)


@ti.func
def _not(a):
    return 1 - a


@ti.func
def _choose(condition, a, b):
    return ti.select(condition != 0, a, b)


@ti.func
def _blend(share, a, b):
    """Return a, b, or their mean where a condition holds for a share of the kick between 0 and 1."""
    # A branch that does not count may be infinite.
    return ti.select(share >= 1, a, ti.select(share <= 0, b, share * a + (1 - share) * b))


# By atan2: a device's own asin and acos may be no better than 1e-4.
@ti.func
def _asin(a):
    return ti.atan2(a, ti.sqrt((1.0 - a) * (1.0 + a)))


@ti.func
def _acos(a):
    return ti.atan2(ti.sqrt((1.0 - a) * (1.0 + a)), a)


@ti.func
def _atan(a):
    return ti.atan2(a, ti.cast(1.0, float))


@ti.func
def _sinh(a):
    grown = ti.exp(ti.abs(a))
    size = 0.5 * (grown - 1.0 / grown)
    if ti.abs(a) < 0.1:
        # The first terms of its series: the difference above cancels.
        square = a * a
        size = ti.abs(a) * (1.0 + square / 6.0 * (1.0 + square / 20.0 * (1.0 + square / 42.0 * (1.0 + square / 72.0))))
    return ti.select(a < 0.0, -size, size)


@ti.func
def _cosh(a):
    grown = ti.exp(ti.abs(a))
    return 0.5 * (grown + 1.0 / grown)


@ti.func
def _log10(a):
    return ti.log(a) / ti.cast(2.302585092994046, float)


@ti.func
def _sign(a):
    return ti.select(a > 0.0, ti.cast(1.0, float), ti.select(a < 0.0, ti.cast(-1.0, float), ti.cast(0.0, float)))


@ti.func
def _step(a):
    return ti.select(a >= 0.0, ti.cast(1.0, float), ti.cast(0.0, float))


@ti.func
def _clamp(a, low, high):
    return ti.min(ti.max(a, low), high)


@ti.func
def _hypot(a, b):
    return ti.sqrt(a * a + b * b)


KERNELS: dict[str, Callable] = {
    "+": _add,
    "-": _subtract,
    "*": _multiply,
    "/": _divide,
    "%": _modulo,
    "**": _power,
    "negative": _negative,
    "<": _less,
    "<=": _at_most,
    ">": _more,
    ">=": _at_least,
    "==": _equal,
    "!=": _unequal,
    "and": _both,
    "or": _either,
    "not": _not,
    "if": _choose,
    # A condition of time.
    "blend": _blend,
    "sin": ti.sin,
    "cos": ti.cos,
    "tan": ti.tan,
    "asin": _asin,
    "acos": _acos,
    "atan": _atan,
    "atan2": ti.atan2,
    "sinh": _sinh,
    "cosh": _cosh,
    "tanh": ti.tanh,
    "exp": ti.exp,
    "log": ti.log,
    "log10": _log10,
    "sqrt": ti.sqrt,
    "abs": ti.abs,
    "floor": ti.floor,
    "ceil": ti.ceil,
    "sign": _sign,
    "step": _step,
    "min": ti.min,
    "max": ti.max,
    "clamp": _clamp,
    "hypot": _hypot,
    "pow": _power,
}
