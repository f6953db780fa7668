"""The laws and presets as plain data, and the JSON Schema of scenes with which editors complete them."""

from itertools import combinations
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from mpmcli.scene.expand import available_presets
from mpmcli.scene.material import Laws, MaterialParameters, knobs_of, unit_of
from mpmcli.scene.presets import PRESETS
from mpmcli.scene.problem import listed, written
from mpmcli.scene.schema import scene_model


class _WithoutTitles(GenerateJsonSchema):
    def field_title_should_be_set(self, schema: Any) -> bool:
        """Leave out titles that only repeat the key."""
        return False


def json_schema(laws: Laws) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a scene whose materials are of the given laws."""
    schema = _without_null(scene_model(laws).model_json_schema(schema_generator=_WithoutTitles))
    definitions = schema["$defs"]
    presets = available_presets(laws)
    forms: list[dict[str, Any]] = [_one_of(presets, "A preset as it is.")] if presets else []
    for law in laws:
        key = _definition_of(law, definitions)
        table = definitions[key]
        forms.append({"$ref": f"#/$defs/{key}"})
        if own := [name for name in presets if PRESETS[name].law == law.model_fields["law"].default]:
            name = key.removesuffix("Parameters") + "Presets"
            definitions[name] = _preset_table(table, law, own, name)
            forms.append({"$ref": f"#/$defs/{name}"})
        _add_knobs(table, law)
        # `law` has a default in Python; in a scene it selects the law.
        table["required"] = ["law", *table.get("required", [])]
    material = definitions["Body"]["properties"]["material"]
    definitions["Body"]["properties"]["material"] = {"description": material["description"], "oneOf": forms}
    definitions["Domain"]["oneOf"] = [{"required": ["spacing"]}, {"required": ["cells"]}]
    schema["$defs"] = dict(sorted(definitions.items()))
    # Not in the model of a scene: they are gone once it is read.
    text = {"type": "string"}
    base = {**text, "description": "Path of a scene that this one begins with; tables here are merged into its tables."}
    remove = {"type": "array", "items": text, "description": "Names of what the base has and this scene has not."}
    schema["properties"] |= {"base": base, "remove": remove}
    schema["anyOf"] = [{"required": ["base"]}, {"required": schema.pop("required")}]
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def _definition_of(law: type[MaterialParameters], definitions: dict[str, Any]) -> str:
    """Return the name that pydantic gave a law's table: that of its class, or longer where two classes share it."""
    word = law.model_fields["law"].default
    tables = {name: table.get("properties", {}).get("law", {}) for name, table in definitions.items()}
    return next(name for name, inner in tables.items() if inner.get("const") == word)


def _one_of(presets: list[str], description: str) -> dict[str, Any]:
    return {
        "description": description,
        "oneOf": [{"const": name, "description": PRESETS[name].shows} for name in presets],
    }


def _preset_table(
    table: dict[str, Any], law: type[MaterialParameters], presets: list[str], name: str
) -> dict[str, Any]:
    """Return the table of a preset: nothing but its name is needed, and its values are the defaults."""
    others = {
        key: {word: value for word, value in inner.items() if word != "default"}
        for key, inner in table["properties"].items()
        if key != "law"
    }
    made = {
        **table,
        "title": name,
        "description": f"A preset that follows the law {law.model_fields['law'].default}, with changes.",
        "properties": {"preset": _one_of(presets, "Name of the preset."), **others},
    }
    made.pop("required", None)
    _add_knobs(made, law)
    made["required"] = ["preset"]
    return made


def _add_knobs(table: dict[str, Any], law: type[MaterialParameters]) -> None:
    """Add the knobs of a law to the table of its parameters: either the knob or the parameter that it sets."""
    required = table.get("required", [])
    rules: list[dict[str, Any]] = []
    for name, (parameter, knob) in knobs_of(law).items():
        reach = knob.reach(unit_of(law.model_fields[parameter].description))
        text = f"Knob, 0 to 1, that sets {parameter}: {reach}; {knob.meaning}."
        entry = {"description": text, "type": "number", "minimum": 0, "maximum": 1}
        table["properties"] = {**table["properties"], name: entry}
        ways = [parameter, name, *(key for key, other in law.sets.items() if other == parameter)]
        either = {"oneOf": [{"required": [way]} for way in ways]}
        pairs = [{"not": {"required": list(pair)}} for pair in combinations(ways, 2)]
        rules += [either] if parameter in required else pairs
    table["required"] = [key for key in required if key not in {parameter for parameter, _ in knobs_of(law).values()}]
    if rules:
        table["allOf"] = rules


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
    """Return a preset's law, its values with their sources, and where its knobs stand; `model` is that of its law."""
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
        scale = {key: getattr(knob, key) for key in ("low", "high", "scale", "meaning")}
        unit = unit_of(field.description)
        facts.append({"name": name, "sets": parameter, "unit": unit, **scale, "position": position})
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
