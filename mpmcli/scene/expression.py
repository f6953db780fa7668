"""Expressions in a scene: arithmetic on named quantities, read from text and never run as Python.

Python's parser splits the text, and of what it returns only what stands in the tables of `functions` is taken. A
comparison is true or false and no number: it may stand where a condition is needed, in `a if c else b`, `and`, `or` and
`not`, and nowhere else.
"""

import ast
import difflib
import math
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from mpmcli.scene.functions import CONSTANTS, FUNCTIONS, OPERATORS, Function, Kind

# An expression of a scene is a formula that a person has written; kernels hold all of it.
MOST_CHARACTERS = 2000
MOST_NESTED = 60
# Names whose value changes within a step, from particle to particle.
POSITION = ("x", "y", "z")
INITIAL = ("X", "Y", "Z")

_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%", ast.Pow: "**"}
_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_INSTEAD = {
    ast.BitXor: "a power is written **",
    ast.FloorDiv: "write floor(a / b)",
    ast.BitAnd: "write and",
    ast.BitOr: "write or",
    ast.Invert: "write not",
}


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
        text: as it was written.
        tree: what it means.
    """

    text: str
    tree: Tree = field(compare=False, repr=False)

    @property
    def names(self) -> frozenset[str]:
        """The quantities that it depends on."""
        return names_in(self.tree)

    def __call__(self, **values: np.ndarray | float) -> np.ndarray:
        """Return its value in float64; arrays are broadcast, and values out of range become inf or nan, silently."""
        return evaluate(self.tree, values)


def parse(text: str, names: Collection[str]) -> Expression | float:
    """Read an expression.

    Args:
        text: what stands in the scene.
        names: the quantities that may occur in it.

    Returns:
        The expression, or its value where it depends on nothing.

    Raises:
        ExpressionError: one sentence, which goes on after the place of the value.
    """
    if len(text) > MOST_CHARACTERS:
        raise ExpressionError(f"is too long for an expression: {len(text)} characters, {MOST_CHARACTERS} at most")
    source = " ".join(text.split())
    if not source:
        raise ExpressionError("is empty; write a number or an expression")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parsed = ast.parse(source, mode="eval")
    except SyntaxError as error:
        near = source[max(0, (error.offset or 1) - 1) :][:12].strip()
        place = f' near "{near}"' if near else " at its end"
        raise ExpressionError(f'is no expression: "{_cut(source)}" cannot be read{place}') from None
    except (ValueError, RecursionError, MemoryError):
        raise ExpressionError("is no expression: it cannot be read") from None
    tree = _Reader(source, tuple(names)).read(parsed.body)
    return tree.value if isinstance(tree, Number) else Expression(text, tree)


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


def _cut(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:37]}..."


class _Reader:
    """Turns what Python's parser returns into a tree, or into a sentence on what has no place in an expression."""

    def __init__(self, source: str, names: tuple[str, ...]) -> None:
        self.source = source
        self.names = names

    def read(self, node: ast.expr) -> Tree:
        tree = self._number(node, 0)
        if isinstance(tree, Apply) and not names_in(tree):
            raise ExpressionError(f'is not finite: "{_cut(self.source)}" divides by zero or is out of range')
        return tree

    def _number(self, node: ast.expr, depth: int) -> Tree:
        tree = self._tree(node, depth)
        if kind_of(tree) == "truth":
            raise ExpressionError(
                f'needs a number where "{self._said(node)}" is true or false; write 1 if {self._said(node)} else 0'
            )
        return tree

    def _truth(self, node: ast.expr, depth: int) -> Tree:
        tree = self._tree(node, depth)
        if kind_of(tree) == "number":
            said = self._said(node)
            raise ExpressionError(f'needs a comparison where "{said}" is a number; compare it, with > 0 say')
        return tree

    def _tree(self, node: ast.expr, depth: int) -> Tree:
        if depth > MOST_NESTED:
            raise ExpressionError(
                f"is nested more than {MOST_NESTED} deep, each term of a sum counted; write it shorter"
            )
        depth += 1
        match node:
            case ast.Constant(value=bool()):
                raise ExpressionError(f'needs a comparison instead of "{node.value}"')
            case ast.Constant(value=int() | float()):
                return self._constant(node)
            case ast.Name():
                return self._name(node.id)
            case ast.UnaryOp(op=ast.USub()):
                return apply("negative", self._number(node.operand, depth))
            case ast.UnaryOp(op=ast.UAdd()):
                return self._number(node.operand, depth)
            case ast.UnaryOp(op=ast.Not()):
                return Apply("not", (self._truth(node.operand, depth),))
            case ast.BinOp() if type(node.op) in _BINARY:
                left, right = self._number(node.left, depth), self._number(node.right, depth)
                return apply(_BINARY[type(node.op)], left, right)
            case ast.BoolOp():
                word = "and" if isinstance(node.op, ast.And) else "or"
                return self._joined(word, [self._truth(value, depth) for value in node.values])
            case ast.Compare() if all(type(op) in _COMPARED for op in node.ops):
                sides = [self._number(side, depth) for side in (node.left, *node.comparators)]
                signs = [_COMPARED[type(op)] for op in node.ops]
                pairs = zip(signs, sides[:-1], sides[1:], strict=True)
                return self._joined("and", [Apply(sign, (left, right)) for sign, left, right in pairs])
            case ast.IfExp():
                condition = self._truth(node.test, depth)
                return apply("if", condition, self._number(node.body, depth), self._number(node.orelse, depth))
            case ast.Call():
                return self._call(node, depth)
        operator = getattr(node, "op", None)
        instead = f"; {_INSTEAD[type(operator)]}" if type(operator) in _INSTEAD else ""
        raise ExpressionError(
            f'cannot hold "{self._said(node)}"{instead or "; it takes numbers, names, + - * / ** %, comparisons, "}'
            f"{'' if instead else '`a if c else b` and functions'}"
        )

    @staticmethod
    def _joined(word: str, truths: list[Tree]) -> Tree:
        tree = truths[0]
        for other in truths[1:]:
            tree = Apply(word, (tree, other))
        return tree

    def _said(self, node: ast.expr) -> str:
        return _cut(ast.get_source_segment(self.source, node) or ast.unparse(node))

    def _constant(self, node: ast.Constant) -> Number:
        try:
            value = float(node.value)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise ExpressionError(f'holds "{self._said(node)}", which is beyond what can be computed with')
        return Number(value)

    def _name(self, name: str) -> Tree:
        if name in CONSTANTS:
            return Number(CONSTANTS[name])
        if name in self.names:
            return Name(name)
        if name in FUNCTIONS:
            raise ExpressionError(f'needs what "{name}" is to be taken of: {name}(...)')
        if {"z": "y", "Z": "Y"}.get(name) in self.names:
            raise ExpressionError(f'has no "{name}" in a 2D scene; the names here are {_listed(self.names)}')
        raise ExpressionError(_unknown("name", name, self.names, (*self.names, *CONSTANTS)))

    def _call(self, node: ast.Call, depth: int) -> Tree:
        if not isinstance(node.func, ast.Name):
            raise ExpressionError(f'cannot hold "{self._said(node)}"; a function is called by its name')
        name = node.func.id
        if name not in FUNCTIONS:
            if name in CONSTANTS or name in self.names:
                raise ExpressionError(f'takes "{name}" for a function, and it is none; a product is written with *')
            raise ExpressionError(_unknown("function", name, FUNCTIONS, tuple(FUNCTIONS)))
        function = FUNCTIONS[name]
        if node.keywords or any(isinstance(a, ast.Starred) for a in node.args):
            raise ExpressionError(f'cannot hold "{self._said(node)}"; arguments are numbers in their order')
        count = len(node.args)
        if not function.least <= count <= function.most:
            need = f"{function.least}" if function.least == function.most else f"at least {function.least}"
            plural = "" if need == "1" else "s"
            raise ExpressionError(f'needs {need} argument{plural} in "{self._said(node)}"; found {count}')
        return apply(name, *[self._number(argument, depth) for argument in node.args])


def _listed(words: Collection[str]) -> str:
    words = list(words)
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _unknown(kind: str, word: str, shown: Collection[str], known: tuple[str, ...]) -> str:
    # A name that differs in its case alone is nearest.
    cased = [one for one in known if one.lower() == word.lower()]
    guess = next(iter(cased or difflib.get_close_matches(word, known, n=1)), None)
    hint = f'did you mean "{guess}"? ' if guess else ""
    here = " here" if kind == "name" else ""
    are = f"s{here} are" if len(shown) > 1 else f"{here} is"
    return f'has an unknown {kind} "{_cut(word)}"; {hint}{"The" if guess else "the"} {kind}{are} {_listed(shown)}'
