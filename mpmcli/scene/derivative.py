"""Differentiates expressions by the rules of calculus, for the gradient of an initial velocity.

A jump (floor, ceil, sign, step, comparisons) has slope zero, and a kink (abs, min, max, clamp) the slope of one side.

Central differences with a step of cbrt(eps) m = 6e-6 m are not used, because of what they give within one step of a
singular point: C = 8e4 1/s on a jump of 1 m/s, where the slope is zero; the mean of both slopes on the kink of
max(X, 0); nan where a finite slope exists but the difference leaves the domain of the function, as for
sqrt(X + 1e-6) at 0. Several steps away their error is 5e-12 to 3e-9 of the largest C for polynomials, sines and
exponentials. In the initial states of the validation cases it is 5e-12 to 1.5e-9, which alters every entry of C that
is not zero in f64, and 1 in 1,000 or fewer in f32.
"""

import math
from collections.abc import Callable

from mpmcli.scene.expression import Apply, Name, Number, Tree, apply

ZERO, ONE = Number(0.0), Number(1.0)


def plus(a: Tree, b: Tree) -> Tree:
    """Return a + b, without a zero in it."""
    return b if a == ZERO else a if b == ZERO else apply("+", a, b)


def minus(a: Tree, b: Tree) -> Tree:
    """Return a - b, without a zero in it."""
    return a if b == ZERO else apply("negative", b) if a == ZERO else apply("-", a, b)


def times(a: Tree, b: Tree) -> Tree:
    """Return a b, without a zero or a one in it."""
    if ZERO in (a, b):
        return ZERO
    return b if a == ONE else a if b == ONE else apply("*", a, b)


def over(a: Tree, b: Tree) -> Tree:
    """Return a / b, without a zero above."""
    return ZERO if a == ZERO else apply("/", a, b)


def squared(a: Tree) -> Tree:
    """Return a a."""
    return times(a, a)


# Slope of a function of one argument, from the argument and from the function's value.
_SLOPES: dict[str, Callable[[Tree, Tree], Tree]] = {
    "negative": lambda u, f: Number(-1.0),
    "sin": lambda u, f: apply("cos", u),
    "cos": lambda u, f: apply("negative", apply("sin", u)),
    "tan": lambda u, f: plus(ONE, squared(f)),
    "asin": lambda u, f: over(ONE, apply("sqrt", minus(ONE, squared(u)))),
    "acos": lambda u, f: over(Number(-1.0), apply("sqrt", minus(ONE, squared(u)))),
    "atan": lambda u, f: over(ONE, plus(ONE, squared(u))),
    "sinh": lambda u, f: apply("cosh", u),
    "cosh": lambda u, f: apply("sinh", u),
    "tanh": lambda u, f: minus(ONE, squared(f)),
    "exp": lambda u, f: f,
    "log": lambda u, f: over(ONE, u),
    "log10": lambda u, f: over(Number(1 / math.log(10)), u),
    "sqrt": lambda u, f: over(Number(0.5), f),
    "abs": lambda u, f: apply("sign", u),
    "floor": lambda u, f: ZERO,
    "ceil": lambda u, f: ZERO,
    "sign": lambda u, f: ZERO,
    "step": lambda u, f: ZERO,
}


def _chained(outer: Tree, inner: Tree) -> Tree:
    """Return the product of two slopes, 0 where the inner one is, though the outer one may be infinite there.

    So it is at the tip of hypot(X, Y), and where max(X, 0)**0.5 is flat.
    """
    if isinstance(inner, Number):
        return times(outer, inner)
    return Apply("if", (Apply("==", (inner, ZERO)), ZERO, times(outer, inner)))


def derivative(tree: Tree, name: str) -> Tree:
    """Return the partial derivative of an expression's tree by a name."""
    if isinstance(tree, Number):
        return ZERO
    if isinstance(tree, Name):
        return ONE if tree.name == name else ZERO
    function, arguments = tree.function, tree.arguments
    if function == "if":
        first, second = (derivative(argument, name) for argument in arguments[1:])
        return first if first == second else Apply("if", (arguments[0], first, second))
    slopes = tuple(derivative(argument, name) for argument in arguments)
    if all(slope == ZERO for slope in slopes):
        return ZERO
    if function in _SLOPES:
        return _chained(_SLOPES[function](arguments[0], tree), slopes[0])
    if function in ("min", "max"):
        return _extreme("<=" if function == "min" else ">=", arguments, slopes)[1]
    if function == "clamp":
        x, low, high = arguments
        inner = Apply("max", (x, low))
        return _extreme("<=", (inner, high), (_extreme(">=", (x, low), slopes[:2])[1], slopes[2]))[1]
    return _of_two(tree, *slopes)


def _of_two(tree: Apply, da: Tree, db: Tree) -> Tree:
    """Return the derivative of a function of a and b, from theirs."""
    a, b = tree.arguments
    match tree.function:
        case "+":
            return plus(da, db)
        case "-":
            return minus(da, db)
        case "*":
            return plus(times(da, b), times(a, db))
        case "/":
            return minus(over(da, b), over(times(tree, db), b))
        case "%":
            return minus(da, times(apply("floor", apply("/", a, b)), db))
        case "**" | "pow":
            # b a^(b-1) a' + a^b log(a) b', each left out where it is 0, as it may not exist there.
            return plus(
                _chained(times(b, apply("**", a, minus(b, ONE))), da),
                _chained(times(tree, apply("log", a)), db),
            )
        case "atan2":
            return over(minus(times(b, da), times(a, db)), plus(squared(a), squared(b)))
        case "hypot":
            return _chained(over(ONE, tree), plus(times(a, da), times(b, db)))
    raise AssertionError(f"{tree.function} has no rule")


def _extreme(sign: str, values: tuple[Tree, ...], slopes: tuple[Tree, ...]) -> tuple[Tree, Tree]:
    """Return the extreme of some values and its slope: that of the value that is chosen."""
    value, slope = values[0], slopes[0]
    for other, own in zip(values[1:], slopes[1:], strict=True):
        chosen = Apply(sign, (value, other))
        slope = slope if slope == own else Apply("if", (chosen, slope, own))
        value = Apply("if", (chosen, value, other))
    return value, slope
