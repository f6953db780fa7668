"""The JSON Schema of scenes, with which editors complete and check a scene as it is typed."""

from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.schema import scene_model


class _WithoutTitles(GenerateJsonSchema):
    def field_title_should_be_set(self, schema: Any) -> bool:
        """Leave out titles that only repeat the key."""
        return False


def json_schema(laws: tuple[type[MaterialParameters], ...]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a scene whose materials are of the given laws."""
    schema = _without_null(scene_model(laws).model_json_schema(schema_generator=_WithoutTitles))
    for law in laws:
        # `law` has a default in Python; in a scene it is what tells the laws apart.
        table = schema["$defs"][law.__name__]
        table["required"] = ["law", *table.get("required", [])]
    schema["$defs"]["Domain"]["oneOf"] = [{"required": ["spacing"]}, {"required": ["cells"]}]
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def _without_null(schema: Any) -> Any:
    """Drop null from a schema: TOML cannot write it, so it is only our word for "not given"."""
    if isinstance(schema, list):
        return [_without_null(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: _without_null(value) for key, value in schema.items() if not (key == "default" and value is None)}
    if {"type": "null"} in kept.get("anyOf", []):
        others = [entry for entry in kept.pop("anyOf") if entry != {"type": "null"}]
        kept |= others[0] if len(others) == 1 else {"anyOf": others}
    return kept
