"""The parameters of every law and the values of every preset, as plain data."""

from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from mpmcli.scene.knobs import knobs_of
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.presets import PRESETS
from mpmcli.scene.sentences import listed, written
from mpmcli.scene.units import unit_of

# JSON Schema's words for the ends of a range, and how they are written.
_ENDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def law_facts(model: type[MaterialParameters]) -> dict[str, Any]:
    """Return a law's name, its parameters with unit, range and default, its knobs, and its internal variables."""
    properties = model.model_json_schema(schema_generator=GenerateJsonSchema)["properties"]
    return {
        "name": model.model_fields["law"].default,
        "parameters": [
            {
                "name": name,
                "unit": unit_of(field.description),
                "range": _range(properties[name]),
                "default": None if field.is_required() else field.default,
                "description": field.description or "",
            }
            for name, field in model.model_fields.items()
            if name != "law"
        ],
        "knobs": knob_facts(model),
        "fields": [
            {"name": v.name, "description": v.description, "dimensions": list(v.dimensions)} for v in model.internal
        ],
    }


def preset_facts(name: str, model: type[MaterialParameters]) -> dict[str, Any]:
    """Return a preset's law, its values with their sources, and where its knobs stand.

    Args:
        name: of the preset.
        model: parameter model of its law.
    """
    preset = PRESETS[name]
    return {
        "name": name,
        "law": preset.law,
        "shows": preset.shows,
        "values": [
            {
                "name": parameter,
                "value": value,
                "unit": unit_of(model.model_fields[parameter].description) if value != "auto" else "",
                "source": source,
            }
            for parameter, (value, source) in preset.values.items()
        ],
        "knobs": knob_facts(model, preset.parameters),
    }


def knob_facts(model: type[MaterialParameters], values: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Return the knobs of a law: what each sets, on which scale, and where it stands for `values` or the defaults."""
    facts = []
    for name, (parameter, knob) in knobs_of(model).items():
        field = model.model_fields[parameter]
        value = (values or {}).get(parameter, field.default)
        position = knob.position(value) if isinstance(value, int | float) else None
        facts.append(
            {
                "name": name,
                "sets": parameter,
                "unit": unit_of(field.description),
                "low": knob.low,
                "high": knob.high,
                "scale": knob.scale,
                "meaning": knob.meaning,
                "position": position,
            }
        )
    return facts


def _range(schema: dict[str, Any]) -> str:
    """Write what JSON Schema accepts: `> 0 or "auto"`, `> -1, < 0.5`, `true or false`."""
    if "anyOf" in schema:
        return listed([_range(one) for one in schema["anyOf"]])
    if "const" in schema:
        return written(schema["const"])
    if "enum" in schema:
        return listed([written(one) for one in schema["enum"]])
    if schema.get("type") == "boolean":
        return "true or false"
    return ", ".join(f"{sign} {schema[word]:g}" for word, sign in _ENDS.items() if word in schema) or "any"
