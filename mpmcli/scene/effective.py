"""The effective scene as TOML: every default filled in, laid out to be read."""

from typing import Any

import tomli_w

from mpmcli.scene.schema import Scene

_WIDTH = 100


def scene_to_toml(scene: Scene) -> str:
    """Write a scene as TOML; loading the text again gives an equal scene.

    Only `domain.spacing` is written, as `domain.cells` says the same. Materials are laws with physical
    parameters, whatever presets and knobs they came from.
    """
    data = scene.model_dump(exclude_none=True, exclude={"domain": {"cells"}})
    bodies = data.pop("bodies")
    title = data.pop("title")
    blocks = [f"title = {_value(title)}"]
    blocks += [_table(f"[{name}]", data.pop(name)) for name in ("domain", "time")]
    for body in bodies:
        material = body.pop("material")
        blocks += [_table("[[bodies]]", body), _table("[bodies.material]", material)]
    blocks += [_table("[[forces]]", force) for force in data.pop("forces")]
    blocks += [_table(f"[{name}]", table) for name, table in data.items()]
    return "\n\n".join(blocks) + "\n"


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
            # tomli_w knows how TOML escapes text and writes numbers.
            return tomli_w.dumps({"k": value}).removeprefix("k = ").rstrip("\n")
