"""Values of a scene that are numbers or expressions, and the constants that expressions may use."""

import ast
import math
import re
from collections.abc import Iterator, Mapping
from keyword import iskeyword
from typing import Annotated, Any

import numpy as np
from pydantic import Discriminator, PlainSerializer, PlainValidator, Tag, ValidationInfo, WithJsonSchema

from mpmcli.scene.expression import (
    CONSTANTS,
    FUNCTIONS,
    INITIAL,
    POSITION,
    QUANTITIES,
    VELOCITY,
    Expression,
    ExpressionError,
    Number,
    Tree,
)
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.problem import Path, written
from mpmcli.scene.quantity import LARGEST, flaw, list_of_axes, scene_dimension

Entry = float | Expression


def entry_of(*names: str) -> Any:
    """Return the type of a value that is a number or an expression of the given names."""

    def read(value: object, info: ValidationInfo) -> Entry:
        """Return a number or the expression of a text; a constant expression gives its number."""
        if isinstance(value, str):
            missing = () if scene_dimension(info) != 2 else (POSITION[2], INITIAL[2], VELOCITY[2])
            constants = info.context.get("constants", {})
            try:
                known = [name for name in names if name not in missing and not (name in VELOCITY and name in constants)]
                if set(VELOCITY) & set(names):
                    constants = {"speed": speed_of(scene_dimension(info) or 2)} | constants
                value = parse(value, known, constants)
            except ExpressionError as error:
                raise flaw(str(error)) from None
        if isinstance(value, Expression):
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise flaw(f"must be a number or an expression in quotes; found {written(value)}")
        if isinstance(value, float) and not math.isfinite(value):
            raise flaw(f"must be a finite number; found {written(value)}")
        if abs(value) > LARGEST:
            found = written(value) if isinstance(value, int) else f"{value:g}"
            raise flaw(f"is beyond what can be computed with, {LARGEST:g} at most; found {found}")
        return float(value)

    text = {"type": "string", "description": f"An expression of {', '.join(names)}."}
    schema = WithJsonSchema({"anyOf": [{"type": "number"}, text]})
    return Annotated[Entry, PlainValidator(read), PlainSerializer(plain), schema]


def plain(value: object) -> object:
    """Return an entry, or lists of entries, as TOML values."""
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value.source if isinstance(value, Expression) else value


def value_of(entry: Entry, **values: np.ndarray | float) -> np.ndarray:
    """Return the value of an entry in float64."""
    return entry(**values) if isinstance(entry, Expression) else np.float64(entry)


def tree_of(entry: Entry) -> Tree:
    """Return the tree of a number or an expression."""
    return entry.tree if isinstance(entry, Expression) else Number(float(entry))


def entries_in(value: Any, path: Path = ()) -> Iterator[tuple[Path, Entry]]:
    """Yield a scalar entry, or those of a vector or matrix, each with its path; nothing for None."""
    if isinstance(value, tuple):
        for k, inner in enumerate(value):
            yield from entries_in(inner, (*path, k))
    elif value is not None:
        yield path, value


def varies(*entries: Entry) -> bool:
    """Return whether any of the entries is an expression."""
    return any(isinstance(entry, Expression) for entry in entries)


def speed_of(dimension: int) -> ast.expr:
    """Return the magnitude of the velocity as a constant of expressions."""
    squares = " + ".join(f"{name}**2" for name in VELOCITY[:dimension])
    return ast.parse(f"sqrt({squares})", mode="eval").body


OfTime = entry_of("t")
OfMotion = entry_of("t", *POSITION, *INITIAL, *VELOCITY)
OfStart = entry_of(*INITIAL)

TimeVector = list_of_axes(OfTime, zeros=True)
MotionVector = list_of_axes(OfMotion)
StartVector = list_of_axes(OfStart, zeros=True)
StartMatrix = list_of_axes(list_of_axes(OfStart))
# J, or F as rows.
StartDeformation = Annotated[
    Annotated[OfStart, Tag("J")] | Annotated[StartMatrix, Tag("F")],
    Discriminator(lambda value: "F" if isinstance(value, list | tuple) else "J"),
]


_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Constants(dict[str, "float | str"]):
    """The constants as they were written: a number, or the text of an expression, by name."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))


def _read_constants(value: object, info: ValidationInfo) -> Constants:
    if not isinstance(value, dict):
        raise flaw(f"must be a table of names, such as {{ depth = 0.3 }}; found {written(value)}")
    _, faults = definitions(value, scene_dimension(info))
    for name, sentence in faults.items():
        raise flaw(sentence, name)
    return Constants(value)


_CONSTANT = {"anyOf": [{"type": "number"}, {"type": "string", "description": "An expression."}]}
ConstantTable = Annotated[
    Constants,
    PlainValidator(_read_constants),
    PlainSerializer(lambda table: dict(table)),
    WithJsonSchema({"type": "object", "additionalProperties": _CONSTANT}),
]


def definitions(table: object, dimension: int | None) -> tuple[dict[str, ast.expr], dict[str, str]]:
    """Return the expression of each constant of the table [constants], and the fault of each invalid one, by name."""
    found: dict[str, ast.expr] = {}
    faults: dict[str, str] = {}
    quantities = [name for name in QUANTITIES if dimension != 2 or name not in (POSITION[2], INITIAL[2])]
    for name, value in table.items() if isinstance(table, Mapping) else ():
        if not _NAME.fullmatch(name):
            faults[name] = "is not a valid name in an expression; use letters, digits and _, and begin with a letter"
        elif name in QUANTITIES or name in CONSTANTS or name in FUNCTIONS or iskeyword(name):
            faults[name] = "has a meaning in every expression already; take another name"
        else:
            # An expression that uses a faulty constant has no fault of its own.
            read: Expression | float = 1.0
            if isinstance(value, str):
                try:
                    read = parse(value, quantities, found)
                except ExpressionError as error:
                    faults[name] = str(error)
            elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
                faults[name] = f"must be a number up to {LARGEST:g}, or an expression in quotes; found {written(value)}"
            else:
                read = float(value)
            text = read.text if isinstance(read, Expression) else repr(read)
            found[name] = ast.parse(text, mode="eval").body
    return found, faults
