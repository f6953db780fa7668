"""The effective scene as TOML: every default filled in, laid out to be read."""

from collections.abc import Iterator
from typing import Any

import tomli_w

from mpmcli.scene.schema import Scene

_WIDTH = 100
# Keys of an entry of a list that are tables of their own, not inline.
_OWN_TABLE = ("material",)


def scene_to_toml(scene: Scene) -> str:
    """Write a scene as TOML; loading the text again gives an equal scene.

    Only `domain.spacing` is written, which determines `domain.cells`. Materials are laws with physical
    parameters, whatever presets and knobs they came from.
    """
    data = scene.model_dump(exclude_none=True, exclude={"domain": {"cells"}})
    return "\n\n".join(block for name, value in data.items() for block in _blocks(name, value)) + "\n"


def _blocks(name: str, value: object) -> Iterator[str]:
    """Lay out one key of the scene: a value, a table, or a list of tables; a material has a table of its own."""
    match value:
        case dict():
            yield _table(f"[{name}]", value)
        case list() | tuple():
            for entry in value:
                inner = {key: entry.pop(key) for key in _OWN_TABLE if key in entry}
                yield _table(f"[[{name}]]", entry)
                for key, table in inner.items():
                    yield _table(f"[{name}.{key}]", table)
        case _:
            yield f"{name} = {_value(value)}"


def _table(header: str, table: dict[str, Any]) -> str:
    return "\n".join([header, *(f"{key} = {_value(value)}" for key, value in table.items())])


def _value(value: object) -> str:
    match value:
        case dict():
            return "{ " + ", ".join(f"{key} = {_value(inner)}" for key, inner in value.items()) + " }"
        case list() | tuple():
            inner = [_value(entry) for entry in value]
            if inner and len(inner) * len(inner[0]) > _WIDTH:
                return "[\n    " + ",\n    ".join(inner) + ",\n]"
            return f"[{', '.join(inner)}]"
        case _:
            # tomli_w escapes text and formats numbers.
            return tomli_w.dumps({"k": value}).removeprefix("k = ").rstrip("\n")
