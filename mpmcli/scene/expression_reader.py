"""Reads expressions from text; the text is never run as Python.

Python's parser splits the text; only nodes in the tables of `expression` are accepted. A comparison is a truth value,
not a number: it is allowed only where a condition is needed, in `a if c else b`, `and`, `or` and `not`.
"""

import ast
import difflib
import math
import warnings
from collections import Counter
from collections.abc import Collection, Mapping
from functools import reduce
from itertools import pairwise
from types import MappingProxyType

from mpmcli.scene.expression import (
    CONSTANTS,
    FUNCTIONS,
    QUANTITIES,
    Apply,
    Expression,
    ExpressionError,
    Name,
    Number,
    Tree,
    apply,
    kind_of,
    names_in,
)
from mpmcli.scene.problem import listed

# Limits for formulas written by hand; kernels contain the whole expression.
MOST_CHARACTERS = 2000
MOST_NESTED = 60
TOO_DEEP = f"is nested more than {MOST_NESTED} deep, each term of a sum counted; write it shorter"
MOST_EXPANDED = 20_000
MOST_NODES = 500

_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%", ast.Pow: "**"}
_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_INSTEAD = {
    ast.BitXor: "a power is written **",
    ast.FloorDiv: "write floor(a / b)",
    ast.BitAnd: "write and",
    ast.BitOr: "write or",
    ast.Invert: "write not",
}


def parse(
    text: str, names: Collection[str], constants: Mapping[str, ast.expr] = MappingProxyType({})
) -> Expression | float:
    """Read an expression of the given names and constants; return its value if it depends on no name.

    The message of an ExpressionError continues a sentence that begins with the place of the value.
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
        raise ExpressionError(f'is not an expression: "{_cut(source)}" cannot be read{place}') from None
    except (ValueError, RecursionError, MemoryError):
        raise ExpressionError("is not an expression: it cannot be read") from None
    expanded = text
    used = Counter(node.id for node in ast.walk(parsed) if isinstance(node, ast.Name) and node.id in constants)
    for name in used:
        inner = {node.id for node in ast.walk(constants[name]) if isinstance(node, ast.Name)}
        for quantity in sorted(inner & set(QUANTITIES) - set(names)):
            raise ExpressionError(
                f'uses "{name}", which depends on "{quantity}"; the names here are {listed(list(names), "and")}'
            )
    if used:
        length = len(source) + sum(count * len(ast.unparse(constants[name])) for name, count in used.items())
        if length > MOST_EXPANDED:
            raise ExpressionError(
                f"is too long with its constants put in: {length} characters, {MOST_EXPANDED} at most"
            )
        try:
            expanded = source = ast.unparse(_PutIn(constants).visit(parsed))
        except RecursionError:
            raise ExpressionError(TOO_DEEP) from None
        parsed = ast.parse(source, mode="eval")
    tree = _Reader(source, (*names, *constants)).read(parsed.body)
    return tree.value if isinstance(tree, Number) else Expression(expanded, tree, text)


class _PutIn(ast.NodeTransformer):
    """Replaces constants by their expressions; names of called functions stay."""

    def __init__(self, constants: Mapping[str, ast.expr]) -> None:
        self.constants = constants

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self.constants.get(node.id, node)

    def visit_Call(self, node: ast.Call) -> ast.Call:
        node.args = [self.visit(argument) for argument in node.args]
        return node


def _cut(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:37]}..."


class _Reader:
    """Converts the nodes of Python's parser to a tree, or raises an ExpressionError for a node that is not allowed."""

    def __init__(self, source: str, names: tuple[str, ...]) -> None:
        self.source = source
        self.names = names

    def read(self, node: ast.expr) -> Tree:
        tree = self._number(node, 0)
        if isinstance(tree, Apply) and not names_in(tree):
            raise ExpressionError(f'is not finite: "{_cut(self.source)}" divides by zero or is out of range')
        if isinstance(tree, Apply) and len(tree.order) > MOST_NODES:
            raise ExpressionError(
                f"is too large: {len(tree.order)} numbers, names, operators and functions, {MOST_NODES} at most"
            )
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
        """Return the tree of a node of Python's syntax. Raises ExpressionError for what expressions cannot contain."""
        if depth > MOST_NESTED:
            raise ExpressionError(TOO_DEEP)
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
                truths = [self._truth(value, depth) for value in node.values]
                return reduce(lambda left, right: Apply(word, (left, right)), truths)
            case ast.Compare() if all(type(op) in _COMPARED for op in node.ops):
                sides = [self._number(side, depth) for side in (node.left, *node.comparators)]
                signs = [_COMPARED[type(op)] for op in node.ops]
                truths = [Apply(sign, pair) for sign, pair in zip(signs, pairwise(sides), strict=True)]
                return reduce(lambda left, right: Apply("and", (left, right)), truths)
            case ast.IfExp():
                condition = self._truth(node.test, depth)
                return apply("if", condition, self._number(node.body, depth), self._number(node.orelse, depth))
            case ast.Call():
                return self._call(node, depth)
        operator = getattr(node, "op", None)
        instead = f"; {_INSTEAD[type(operator)]}" if type(operator) in _INSTEAD else ""
        raise ExpressionError(
            f'cannot contain "{self._said(node)}"{instead or "; it takes numbers, names, + - * / ** %, comparisons, "}'
            f"{'' if instead else '`a if c else b` and functions'}"
        )

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
        """Return the tree of a constant or a variable. Raises ExpressionError, with a hint, for other names."""
        if name in CONSTANTS:
            return Number(CONSTANTS[name])
        if name in self.names:
            return Name(name)
        if name in FUNCTIONS:
            raise ExpressionError(f'needs the argument of "{name}": {name}(...)')
        if {"z": "y", "Z": "Y"}.get(name) in self.names:
            raise ExpressionError(
                f'has no "{name}" in a 2D scene; the names here are {listed(list(self.names), "and")}'
            )
        raise ExpressionError(_unknown("name", name, self.names, (*self.names, *CONSTANTS)))

    def _call(self, node: ast.Call, depth: int) -> Tree:
        """Return the tree of a function with its arguments. Raises ExpressionError if it is unknown or takes others."""
        if not isinstance(node.func, ast.Name):
            raise ExpressionError(f'cannot contain "{self._said(node)}"; a function is called by its name')
        name = node.func.id
        if name not in FUNCTIONS:
            if name in CONSTANTS or name in self.names:
                raise ExpressionError(f'takes "{name}" for a function, which it is not; a product is written with *')
            raise ExpressionError(_unknown("function", name, FUNCTIONS, tuple(FUNCTIONS)))
        function = FUNCTIONS[name]
        if node.keywords or any(isinstance(a, ast.Starred) for a in node.args):
            raise ExpressionError(f'cannot contain "{self._said(node)}"; arguments are numbers in their order')
        count = len(node.args)
        if not function.least <= count <= function.most:
            need = f"{function.least}" if function.least == function.most else f"at least {function.least}"
            plural = "" if need == "1" else "s"
            raise ExpressionError(f'needs {need} argument{plural} in "{self._said(node)}"; found {count}')
        return apply(name, *[self._number(argument, depth) for argument in node.args])


def _unknown(kind: str, word: str, shown: Collection[str], known: tuple[str, ...]) -> str:
    # A name that differs only in case is nearest.
    cased = [one for one in known if one.lower() == word.lower()]
    guess = next(iter(cased or difflib.get_close_matches(word, known, n=1)), None)
    hint = f'did you mean "{guess}"? ' if guess else ""
    here = " here" if kind == "name" else ""
    are = f"s{here} are" if len(shown) > 1 else f"{here} is"
    the = f"{'The' if guess else 'the'} {kind}{are} {listed(list(shown), 'and')}"
    return f'has an unknown {kind} "{_cut(word)}"; {hint}{the}'
