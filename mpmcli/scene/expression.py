"""Expressions in a scene: arithmetic on named quantities, as `expression_reader` reads it from text."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mpmcli.scene.functions import FUNCTIONS, OPERATORS, Function, Kind

# Names whose value changes within a step, from particle to particle.
POSITION = ("x", "y", "z")
INITIAL = ("X", "Y", "Z")
QUANTITIES = ("t", *POSITION, *INITIAL)


class ExpressionError(ValueError):
    """What is wrong with an expression, and what would be right."""


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float


@dataclass(frozen=True)
class Name:
    """A quantity by its name."""

    name: str


@dataclass(frozen=True)
class Apply:
    """An operator or a function and what it is applied to."""

    function: str
    arguments: tuple["Tree", ...]


Tree = Number | Name | Apply


@dataclass(frozen=True)
class Expression:
    """An expression of at least one name.

    Attributes:
        text: with the constants of the scene put in.
        tree: what it means.
        source: as it was written.
    """

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
        return _evaluate(tree, values)


def _evaluate(tree: Tree, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
    if isinstance(tree, Number):
        return np.float64(tree.value)
    if isinstance(tree, Name):
        return np.asarray(values[tree.name], dtype=np.float64)
    return _function(tree.function).compute(*[_evaluate(argument, values) for argument in tree.arguments])


def names_in(tree: Tree) -> frozenset[str]:
    """Return the names in a tree."""
    if isinstance(tree, Name):
        return frozenset([tree.name])
    return frozenset().union(*(names_in(a) for a in tree.arguments)) if isinstance(tree, Apply) else frozenset()


def kind_of(tree: Tree) -> Kind:
    """Say whether a tree is a number or a truth value."""
    return _function(tree.function).result if isinstance(tree, Apply) else "number"


def apply(function: str, *arguments: Tree) -> Tree:
    """Return a function applied to trees; without names it is computed at once, if that gives a finite number."""
    made = Apply(function, arguments)
    if kind_of(made) == "number" and not names_in(made):
        value = float(evaluate(made, {}))
        if math.isfinite(value):
            return Number(value)
    return made


def _function(name: str) -> Function:
    return OPERATORS.get(name) or FUNCTIONS[name]
