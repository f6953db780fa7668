"""The operators and functions of expressions: what they take, what they give, and how numpy computes them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import numpy as np

Kind = Literal["number", "truth"]
MANY = 64


@dataclass(frozen=True)
class Function:
    """An operator or a function.

    Attributes:
        compute: of numpy arrays or numbers, broadcast against each other.
        arguments: kind of each argument; of all, where there may be any number from `least` to `most`.
        result: kind of the result.
        least, most: number of arguments.
    """

    compute: Callable[..., np.ndarray]
    arguments: tuple[Kind, ...]
    result: Kind = "number"
    least: int = 1
    most: int = 1


def _of(compute: Callable[..., np.ndarray], count: int) -> Function:
    return Function(compute, ("number",) * count, "number", count, count)


def _compares(compute: Callable[..., np.ndarray]) -> Function:
    return Function(compute, ("number", "number"), "truth", 2, 2)


def _clamp(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.minimum(np.maximum(x, low), high)


def _step(x: np.ndarray) -> np.ndarray:
    """Heaviside's function, 1 at 0; not a number stays so."""
    return np.where(np.isnan(x), x, np.where(np.greater_equal(x, 0), 1.0, 0.0))


# Operators by their sign.
OPERATORS: dict[str, Function] = {
    "+": _of(np.add, 2),
    "-": _of(np.subtract, 2),
    "*": _of(np.multiply, 2),
    "/": _of(np.divide, 2),
    "%": _of(np.mod, 2),
    "**": _of(np.power, 2),
    "negative": _of(np.negative, 1),
    "<": _compares(np.less),
    "<=": _compares(np.less_equal),
    ">": _compares(np.greater),
    ">=": _compares(np.greater_equal),
    "==": _compares(np.equal),
    "!=": _compares(np.not_equal),
    "and": Function(np.logical_and, ("truth", "truth"), "truth", 2, 2),
    "or": Function(np.logical_or, ("truth", "truth"), "truth", 2, 2),
    "not": Function(np.logical_not, ("truth",), "truth"),
    "if": Function(np.where, ("truth", "number", "number"), "number", 3, 3),
}

# Functions by the name that an expression calls.
FUNCTIONS: dict[str, Function] = {
    "sin": _of(np.sin, 1),
    "cos": _of(np.cos, 1),
    "tan": _of(np.tan, 1),
    "asin": _of(np.arcsin, 1),
    "acos": _of(np.arccos, 1),
    "atan": _of(np.arctan, 1),
    "atan2": _of(np.arctan2, 2),
    "sinh": _of(np.sinh, 1),
    "cosh": _of(np.cosh, 1),
    "tanh": _of(np.tanh, 1),
    "exp": _of(np.exp, 1),
    "log": _of(np.log, 1),
    "log10": _of(np.log10, 1),
    "sqrt": _of(np.sqrt, 1),
    "abs": _of(np.abs, 1),
    "floor": _of(np.floor, 1),
    "ceil": _of(np.ceil, 1),
    "sign": _of(np.sign, 1),
    "step": _of(_step, 1),
    "min": Function(lambda *values: reduce(np.minimum, values), ("number",), "number", 2, MANY),
    "max": Function(lambda *values: reduce(np.maximum, values), ("number",), "number", 2, MANY),
    "clamp": _of(_clamp, 3),
    "hypot": _of(np.hypot, 2),
    "pow": _of(np.power, 2),
}

CONSTANTS = {"pi": math.pi, "e": math.e}
