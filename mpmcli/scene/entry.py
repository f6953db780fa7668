"""Values of a scene that are numbers or expressions: which names each may hold, and how it is read and written."""

import math
from typing import Annotated, Any

import numpy as np
from pydantic import Discriminator, GetCoreSchemaHandler, GetJsonSchemaHandler, Tag
from pydantic_core import CoreSchema, core_schema

from mpmcli.scene.expression import INITIAL, POSITION, Expression, ExpressionError, Number, Tree
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.quantity import LARGEST, flaw, list_of_axes, scene_dimension
from mpmcli.scene.sentences import written

Entry = float | Expression


class EntryOf:
    """Marks a value as a number or an expression of some names."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema that reads an entry, and writes the text of an expression back."""
        return core_schema.with_info_plain_validator_function(
            self.read, serialization=core_schema.plain_serializer_function_ser_schema(plain)
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return number | string."""
        text = {"type": "string", "description": f"An expression of {', '.join(self.names)}."}
        return {"anyOf": [{"type": "number"}, text]}

    def read(self, value: object, info: core_schema.ValidationInfo) -> Entry:
        """Return the number, or the expression of a text; a text that depends on nothing is its number."""
        if isinstance(value, Expression):
            return value
        if isinstance(value, str):
            missing = () if scene_dimension(info) != 2 else (POSITION[2], INITIAL[2])
            try:
                names = [name for name in self.names if name not in missing]
                value = parse(value, names, info.context.get("constants", {}))
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


def plain(value: object) -> object:
    """Return an entry, or lists of entries, as TOML holds them."""
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value.source if isinstance(value, Expression) else value


def value_of(entry: Entry, **values: np.ndarray | float) -> np.ndarray:
    """Return the value of an entry in float64."""
    return entry(**values) if isinstance(entry, Expression) else np.float64(entry)


def tree_of(entry: Entry) -> Tree:
    """Return the tree of a number or an expression."""
    return entry.tree if isinstance(entry, Expression) else Number(float(entry))


def varies(*entries: Entry) -> bool:
    """Say whether any of the entries is an expression."""
    return any(isinstance(entry, Expression) for entry in entries)


def _is_list(value: object) -> str:
    return "F" if isinstance(value, list | tuple) else "J"


OfTime = Annotated[Entry, EntryOf("t")]
OfPlace = Annotated[Entry, EntryOf("t", *POSITION, *INITIAL)]
OfStart = Annotated[Entry, EntryOf(*INITIAL)]

TimeVector = list_of_axes(OfTime, zeros=True)
PlaceVector = list_of_axes(OfPlace)
StartVector = list_of_axes(OfStart, zeros=True)
StartMatrix = list_of_axes(list_of_axes(OfStart))
# J, or F as rows.
StartDeformation = Annotated[Annotated[OfStart, Tag("J")] | Annotated[StartMatrix, Tag("F")], Discriminator(_is_list)]
