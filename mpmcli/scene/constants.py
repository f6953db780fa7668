"""Named constants and shared subexpressions of a scene: the table [constants].

A name stands for a number, or for an expression of time, place and the names above it, in every expression of the
scene.
"""

import ast
import re
from collections.abc import Mapping
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from mpmcli.scene.expression import INITIAL, POSITION, QUANTITIES, Expression, ExpressionError
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.functions import CONSTANTS, FUNCTIONS
from mpmcli.scene.quantity import LARGEST, flaw, scene_dimension
from mpmcli.scene.sentences import written

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Constants(dict[str, "float | str"]):
    """The constants as they were written: a number, or the text of an expression, by name."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema that reads the table, and writes it back."""
        return core_schema.with_info_plain_validator_function(
            cls._read, serialization=core_schema.plain_serializer_function_ser_schema(dict)
        )

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return a table of numbers and strings."""
        entry = {"anyOf": [{"type": "number"}, {"type": "string", "description": "An expression."}]}
        return {"type": "object", "additionalProperties": entry}

    @classmethod
    def _read(cls, value: object, info: core_schema.ValidationInfo) -> "Constants":
        if not isinstance(value, dict):
            raise flaw(f"must be a table of names, such as {{ depth = 0.3 }}; found {written(value)}")
        _, faults = definitions(value, scene_dimension(info))
        for name, sentence in faults.items():
            raise flaw(sentence, name)
        return cls(value)


def definitions(table: object, dimension: int | None) -> tuple[dict[str, ast.expr], dict[str, str]]:
    """Return what each constant stands for, and what is wrong with others, by name.

    Args:
        table: the table [constants] of a scene, None where there is none.
        dimension: of the scene, None where it is not readable.
    """
    found: dict[str, ast.expr] = {}
    faults: dict[str, str] = {}
    quantities = [name for name in QUANTITIES if dimension != 2 or name not in (POSITION[2], INITIAL[2])]
    for name, value in table.items() if isinstance(table, Mapping) else ():
        if not _NAME.fullmatch(name):
            faults[name] = "is no name for an expression; use letters, digits and _, and begin with a letter"
        elif name in QUANTITIES or name in CONSTANTS or name in FUNCTIONS:
            faults[name] = "has a meaning in every expression already; take another name"
        else:
            # What uses a constant that is wrong has no fault of its own.
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
