"""Expressions: every function against Python's own, derivatives against differences, and a sentence for every fault."""

import ast
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mpmcli.scene.expression import (
    FUNCTIONS,
    OPERATORS,
    Apply,
    Expression,
    ExpressionError,
    bounds_of,
    derivative,
    evaluate,
)
from mpmcli.scene.expression_reader import MOST_CHARACTERS, MOST_NESTED, MOST_NODES, parse

NAMES = ("t", "x", "y", "X", "Y")
# What Python itself makes of the same text.
PYTHON = {
    **{name: getattr(math, name) for name in FUNCTIONS if hasattr(math, name)},
    "abs": abs,
    "min": min,
    "max": max,
    "sign": lambda x: float(x > 0) - float(x < 0),
    "step": lambda x: float(x >= 0),
    "clamp": lambda x, low, high: min(max(x, low), high),
    "pi": math.pi,
    "e": math.e,
}

numbers = st.sampled_from(["0.5", "2", "3.25", "1e-2", "pi", "e", "7"])
leaves = st.one_of(numbers, st.sampled_from(NAMES))


def grown(children):
    pairs = st.tuples(children, children)
    signs = st.sampled_from(["+", "-", "*", "/", "%", "**"])
    compared = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
    truth = st.tuples(children, compared, children).map(lambda p: f"{p[0]} {p[1]} {p[2]}")
    chained = st.tuples(children, children, children).map(lambda p: f"{p[0]} < {p[1]} <= {p[2]}")
    truths = st.one_of(truth, chained)
    truths = st.one_of(
        truths,
        truths.map(lambda c: f"not ({c})"),
        st.tuples(truths, st.sampled_from(["and", "or"]), truths).map(" ".join),
    )
    return st.one_of(
        st.tuples(pairs, signs).map(lambda p: f"({p[0][0]} {p[1]} {p[0][1]})"),
        children.map(lambda a: f"(-{a})"),
        st.tuples(children, truths, children).map(lambda p: f"({p[0]} if {p[1]} else {p[2]})"),
        *[
            st.tuples(*[children] * max(function.least, 1)).map(lambda p, name=name: f"{name}({', '.join(p)})")
            for name, function in FUNCTIONS.items()
        ],
    )


texts = st.recursive(leaves, grown, max_leaves=12)
values = st.fixed_dictionaries({name: st.floats(-3, 3).map(lambda v: round(v, 4)) for name in NAMES})


@given(texts, values)
def test_it_is_what_python_makes_of_it(text, at):
    """Where Python has a real number, ours is the same to rounding."""
    try:
        expected = eval(text, {"__builtins__": {}}, {**PYTHON, **at})
    except (ArithmeticError, ValueError):
        assume(False)
    assume(isinstance(expected, int | float) and abs(expected) < 1e6)
    try:
        read = parse(text, NAMES)
    except ExpressionError as error:
        # A part without names, such as 2 / (pi - pi), that is not finite though the whole may be.
        assume("is not finite" in str(error))
        raise
    found = float(read(**at)) if isinstance(read, Expression) else read
    # Rounding inside sin of a large number, or beside a jump, shows: both are as right as the other.
    nudged = [float(_at(read, {n: v * (1 + s * 1e-13) + s * 1e-15 for n, v in at.items()})) for s in (-1, 1)]
    assume(max(abs(n - found) for n in nudged) < 1e-6 * (1 + abs(found)))
    assert found == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


def _at(read, at):
    return read(**at) if isinstance(read, Expression) else read


FUNCTION_CASES = {
    "sin": "sin(x)", "cos": "cos(x)", "tan": "tan(x)", "asin": "asin(x / 3)", "acos": "acos(x / 3)", "atan": "atan(x)",
    "atan2": "atan2(y, x)", "sinh": "sinh(x)", "cosh": "cosh(x)", "tanh": "tanh(x)", "exp": "exp(x)",
    "log": "log(2 + x)", "log10": "log10(2 + x)", "sqrt": "sqrt(2 + x)", "abs": "abs(x * y)",
    "floor": "floor(3 * x) * y", "ceil": "ceil(3 * x) * y", "sign": "sign(x) * y", "step": "step(x - 0.1) * y",
    "min": "min(x, y**2, 0.3 * x + y)", "max": "max(x, y**2, 0.3 * x + y)", "clamp": "clamp(x * y, -0.5, y)",
    "hypot": "hypot(x, 2 * y)", "pow": "pow(2 + x, y)", "+": "x + y", "-": "x - y", "*": "x * y", "/": "x / (y + 3)",
    "%": "(x + 4) % (y + 3)", "**": "x**3 + (x + 2)**y + x**-2", "negative": "-x * y", "<": "x if x < y else y",
    "<=": "x if x <= y else y", ">": "x if x > y else y", ">=": "x if x >= y else y", "==": "x if x == y else y",
    "!=": "x if x != y else y", "and": "x if x > 0 and y > 0 else y**2", "or": "x if x > 0 or y > 0 else y**2",
    "not": "x if not x > 0 else y**2", "if": "x * y if -0.5 < x <= 0.5 else y**2",
}  # fmt: skip


def test_every_function_has_a_case():
    assert set(FUNCTION_CASES) == set(FUNCTIONS) | set(OPERATORS)


@pytest.mark.parametrize("text", FUNCTION_CASES.values(), ids=FUNCTION_CASES)
def test_the_derivative_is_the_limit_of_differences(text):
    """Central differences over 2d err by d^2 f'''/6 and by rounding, 1e-16 / d: some 1e-8 at d = 1e-5 or 1e-6."""
    rng = np.random.default_rng(1)
    at = {"x": rng.uniform(-1.5, 1.5, 400), "y": rng.uniform(-1.5, 1.5, 400)}
    tree = parse(text, ("x", "y")).tree
    for name in at:
        exact = np.broadcast_to(evaluate(derivative(tree, name), at), 400)
        d = 1e-6
        up, down = ({**at, name: at[name] + sign * d} for sign in (1, -1))
        difference = (evaluate(tree, up) - evaluate(tree, down)) / (2 * d)
        # Beside a jump, or a kink, a difference says nothing.
        smooth = np.abs(difference) < 1e4
        right = np.abs(exact - difference) < 1e-6 * (1 + np.abs(exact))
        assert (right | ~smooth).mean() >= 0.99 and np.isfinite(exact).all()


SHARED = {
    "max": "max(" + ", ".join(f"{k}*x" for k in range(1, 31)) + ")",
    "nested max": "max(x, 1 - x, sin(" * 20 + "x" + "))" * 20,
    "sin": "sin(" * 50 + "x" + ")" * 50,
    "clamp": "clamp(" * 25 + "x" + ", x - 9, 9 + x)" * 25,
    "hypot": "hypot(x, " * 50 + "1" + ")" * 50,
    "power": "(x + 1)**(" * 20 + "x" + ")" * 20,
    "product": "*".join(f"(x + {k})" for k in range(50)),
    "quotient": "/".join(f"(x + {k})" for k in range(50)),
}


@pytest.mark.parametrize("text", SHARED.values(), ids=SHARED)
def test_a_derivative_shares_the_parts_of_its_expression(text):
    """It has some nodes for each node of the expression, and walks of it visit each once: 2^20 and more by paths."""
    tree = parse(text, ("x",)).tree
    slope = derivative(tree, "x")
    nodes = len(slope.order) if isinstance(slope, Apply) else 1
    assert nodes <= 8 * len(tree.order)
    at, d = 0.3, 1e-7
    difference = (evaluate(tree, {"x": at + d}) - evaluate(tree, {"x": at - d})) / (2 * d)
    assert evaluate(slope, {"x": at}) == pytest.approx(difference, rel=1e-5)
    low, high = bounds_of(slope, {"x": (np.float64(at), np.float64(at))})
    slack = 1e-9 * abs(difference)
    assert low - slack <= evaluate(slope, {"x": at}) <= high + slack


def test_derivatives_exist_at_tips():
    for text in ("hypot(x, y)", "sqrt(x**2 + y**2)", "abs(x)", "max(x - 1, 0)**0.5", "asin(clamp(x + 2, 0, 1))"):
        assert evaluate(derivative(parse(text, ("x", "y")).tree, "x"), {"x": 0.0, "y": 0.0}) == 0


def test_constants_are_numbers():
    assert parse("-9.81 * cos(pi / 3)", NAMES) == pytest.approx(-9.81 / 2, rel=1e-15)
    assert parse(" 2\n + 3", NAMES) == 5 and parse("+x", NAMES)(x=2.0) == 2
    assert parse("1 if 2 > 1 else x", NAMES).names == {"x"}


def test_arrays_are_broadcast_in_silence(recwarn):
    found = parse("log(x) / y", NAMES)(x=np.array([[1.0], [-1.0]]), y=np.array([0.0, 2.0]))
    assert found.shape == (2, 2) and np.isnan(found[0, 0]) and found[0, 1] == 0 and np.isnan(found[1]).all()
    assert not recwarn.list


FAULTS = {
    "sine(x)": 'has an unknown function "sine"; did you mean "sin"? The functions are sin, ',
    "q": 'has an unknown name "q"; the names here are t, x, y, X and Y',
    "T": 'has an unknown name "T"; did you mean "t"? The names here are t, x, y, X and Y',
    "z": 'has no "z" in a 2D scene; the names here are t, x, y, X and Y',
    "x <": 'is not an expression: "x <" cannot be read near "',
    "x ^ 2": 'cannot contain "x ^ 2"; a power is written **',
    "x // 2": 'cannot contain "x // 2"; write floor(a / b)',
    "1 / 0": 'is not finite: "1 / 0" divides by zero or is out of range',
    "x > 1": 'needs a number where "x > 1" is true or false; write 1 if x > 1 else 0',
    "2 * (x > 1)": 'needs a number where "x > 1" is true or false; write 1 if x > 1 else 0',
    "1 if x else 2": 'needs a comparison where "x" is a number; compare it, with > 0 say',
    "x and y": 'needs a comparison where "x" is a number; compare it, with > 0 say',
    "sin": 'needs the argument of "sin": sin(...)',
    "sin(x, y)": 'needs 1 argument in "sin(x, y)"; found 2',
    "min(x)": 'needs at least 2 arguments in "min(x)"; found 1',
    "2 pi": 'is not an expression: "2 pi" cannot be read near ',
    "pi(2)": 'takes "pi" for a function, which it is not; a product is written with *',
    "sin(x=2)": 'cannot contain "sin(x=2)"; arguments are numbers in their order',
    "x.real": 'cannot contain "x.real"; it takes numbers, names, + - * / ** %, comparisons, `a if c else b` and '
    "functions",
    "__import__('os')": 'has an unknown function "__import__"; the functions are sin, ',
    "[x for x in (1, 2)]": 'cannot contain "[x for x in (1, 2)]"; it takes numbers, ',
    "(lambda: 1)()": 'cannot contain "(lambda: 1)()"; a function is called by its name',
    "'a'": "cannot contain \"'a'\"; it takes numbers, ",
    "1j": 'cannot contain "1j"; it takes numbers, ',
    "1e999": 'holds "1e999", which is beyond what can be computed with',
    "True": 'needs a comparison instead of "True"',
    "": "is empty; write a number or an expression",
    "1) + (2": 'is not an expression: "1) + (2" cannot be read near ',
    "+".join(["x"] * 80): f"is nested more than {MOST_NESTED} deep, each term of a sum counted; write it shorter",
    "x" * (MOST_CHARACTERS + 1): f"is too long for an expression: {MOST_CHARACTERS + 1} characters, ",
    "+".join(["max(" + ",".join(["x"] * 60) + ")"] * 9): "is too large: 557 numbers, names, operators and functions, "
    f"{MOST_NODES} at most",
    "(" * 900 + "x" + ")" * 900: "is not an expression: ",
    "x\0": "is not an expression: ",
}


@pytest.mark.parametrize("text", FAULTS, ids=lambda text: text[:20])
def test_every_fault_has_its_sentence(text):
    with pytest.raises(ExpressionError) as error:
        parse(text, NAMES)
    assert str(error.value).startswith(FAULTS[text]), str(error.value)


@given(st.text(max_size=30))
def test_any_text_is_an_expression_or_a_sentence(text):
    try:
        parse(text, NAMES)
    except ExpressionError as error:
        assert str(error)


def test_nesting_has_a_limit_where_constants_are_put_in():
    """The depth of what Python's parser takes is that of nearly all characters of the longest expression."""
    depth = ast.parse("2", mode="eval").body
    for count in (MOST_NESTED + 1, 900, 1900):
        with pytest.raises(ExpressionError, match=f"is nested more than {MOST_NESTED} deep"):
            parse("-" * count + "depth", ["t"], {"depth": depth})
