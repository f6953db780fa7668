"""Expands presets and knobs of a scene to tables of laws, as plain data, and makes the JSON Schema of scenes.

A preset is a named material: a law and its parameters in SI units, each with its source, from presets.toml. A material
is written `"honey"`, `{ preset = "honey", thickness = 0.7, density = 1400 }`, or `{ law = "fluid", ... }`. Presets are
filled in, and knobs become parameters. Values in the scene take precedence over those of the preset. Editors use the
JSON Schema to complete scenes.
"""

import copy
import tomllib
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import combinations
from typing import Any, Literal, NamedTuple

from pydantic.json_schema import GenerateJsonSchema

from mpmcli.scene.material import Knob, Laws, MaterialParameters, knobs_of, unit_of
from mpmcli.scene.problem import Path, Problem, Renames, listed, nearest, quoted, rigid_hint, written
from mpmcli.scene.schema import scene_model


class Value(NamedTuple):
    """A parameter of a preset, and where its value comes from."""

    value: float | bool | Literal["auto"]
    source: str


@dataclass(frozen=True)
class Preset:
    """One material: its law, its look in motion, and its parameters; others have the law's default."""

    law: str
    shows: str
    values: dict[str, Value]

    @property
    def parameters(self) -> dict[str, float | bool | Literal["auto"]]:
        return {name: value for name, (value, _) in self.values.items()}


_TABLES = tomllib.loads(files("mpmcli.scene").joinpath("presets.toml").read_text(encoding="utf-8"))
PRESETS = {
    name: Preset(table.pop("law"), table.pop("shows"), {key: Value(*value) for key, value in table.items()})
    for name, table in _TABLES.items()
}


@dataclass
class Expansion:
    """Parsed TOML whose materials are tables of laws; a material that cannot be expanded is None."""

    data: dict[str, Any]
    problems: list[Problem] = field(default_factory=list)  # of presets and knobs
    renames: Renames = field(default_factory=dict)  # path of each parameter that a knob set -> path of the knob
    faulty: set[Path] = field(default_factory=set)  # paths of the materials that are None
    notes: dict[tuple[str, int], list[str]] = field(default_factory=dict)  # effect of each knob, by table and index


def expand_materials(data: dict[str, Any], laws: Laws) -> Expansion:
    """Return a copy of parsed TOML with every material as its law's table; other values stay as they are."""
    expansion = Expansion(copy.deepcopy(data))
    for table in ("bodies", "emitters"):
        bodies = expansion.data.get(table)
        for i, body in enumerate(bodies if isinstance(bodies, list) else []):
            if isinstance(body, dict) and "material" in body:
                one = _Material(expansion, (table, i), laws)
                body["material"] = one.expanded(body["material"])
                if body["material"] is None:
                    expansion.faulty.add(one.path)
    return expansion


def available_presets(laws: Laws) -> list[str]:
    """Return the names of the presets whose law is among the given ones."""
    known = {_law_name(law) for law in laws}
    return [name for name, preset in PRESETS.items() if preset.law in known]


class _Material:
    def __init__(self, expansion: Expansion, body: tuple[str, int], laws: Laws) -> None:
        self.expansion = expansion
        self.body = body
        self.path: Path = (*body, "material")
        self.laws = {_law_name(law): law for law in laws}
        self.presets = available_presets(laws)

    def expanded(self, material: object) -> dict[str, Any] | None:
        """Return the table of the law, or None after a problem that prevents it."""
        if isinstance(material, str):
            return self._table("preset", material, {}) if self._names("preset", material, self.path) else None
        if not isinstance(material, dict):
            sentence = f"must be a preset in quotes, or a table with a law or a preset; found {written(material)}"
            return self._fault(self.path, sentence)
        if (found := self._kind(material)) is None:
            return None
        key, kind = found
        path, word = (*self.path, key), material[key]
        if not isinstance(word, str):
            return self._fault(path, f"must be text in quotes; found {written(word)}")
        others = {name: value for name, value in material.items() if name != key}
        return self._table(kind, word, others) if self._names(kind, word, path) else None

    def _kind(self, table: dict[str, Any]) -> tuple[str, str] | None:
        """Return the key that names the material, `law` or `preset`, perhaps misspelled, and its meaning."""
        if "law" in table and "preset" in table:
            sentence = "the preset has a law of its own; leave either the law or the preset out"
            return self._fault((*self.path, "law"), sentence)
        for key in ("law", "preset"):
            if key in table:
                return key, key
        for key in table:
            if guess := nearest(str(key), ["law", "preset"]):
                self._fault((*self.path, key), f'unknown key; did you mean "{guess}"?')
                return key, guess
        laws, presets = listed(quoted(sorted(self.laws))), listed(quoted(self.presets))
        return self._fault((*self.path, "law"), f"missing key: the constitutive law, {laws}; or a preset, {presets}")

    def _names(self, kind: str, word: str, path: Path) -> bool:
        """Return whether a word names a law or a preset, according to `kind`; report a problem if not."""
        laws, presets = sorted(self.laws), self.presets
        known, others = (laws, presets) if kind == "law" else (presets, laws)
        if word in known:
            return True
        if word not in others:
            hint = f'did you mean "{guess}"? The' if (guess := nearest(word, known)) else f"{rigid_hint(word)}the"
            sentence = f"unknown {kind} {written(word)}; {hint} {kind}s are {listed(quoted(known), 'and')}"
        elif kind == "law":
            sentence = f'"{word}" is a preset: write preset = "{word}"'
        else:
            sentence = f'"{word}" is a law, and needs its parameters: {{ law = "{word}", density = ... }}'
        self._fault(path, sentence)
        return False

    def _table(self, kind: str, word: str, said: dict[str, Any]) -> dict[str, Any]:
        """Return the table of a law, or of a preset's law with its values, updated by the keys of the scene."""
        preset = PRESETS[word] if kind == "preset" else None
        law = preset.law if preset else word
        model = self.laws[law]
        knobs = knobs_of(model)
        own = {key: value for key, value in said.items() if key not in knobs}
        for key in list(own):
            if sentence := self._foreign(key, law):
                self._fault((*self.path, key), sentence)
                del own[key]
        replaced = [other for key, other in model.sets.items() if key in own]
        held = {key: value for key, value in (preset.parameters if preset else {}).items() if key not in replaced}
        result = {"law": law, **held, **own}
        for key in [key for key in said if key in knobs]:
            parameter, knob = knobs[key]
            stronger = [
                f"{other} = {written(own[other])}" for other in knob.excludes if own.get(other, "auto") != "auto"
            ]
            if parameter in own or stronger:
                why = "is given as well" if parameter in own else f"{stronger[0]} overrules"
                self._fault((*self.path, key), f"sets {parameter}, which {why}; leave one of them out")
                continue
            result[parameter] = self._turned(knob, said[key], parameter, model, word if preset else "")
        return result

    def _foreign(self, key: str, law: str) -> str | None:
        """Return the fault of a key that only other laws have, or None."""
        fields, knobs = self.laws[law].model_fields, knobs_of(self.laws[law])
        if key in fields:
            return None
        models = self.laws.values()
        for kind, known, elsewhere in (
            ("knob", knobs, any(key in knobs_of(model) for model in models)),
            ("parameter", fields, any(key in model.model_fields for model in models)),
        ):
            if elsewhere:
                names = [name for name in sorted(known) if name != "law"]
                its = f"its {kind}{'s are' if len(names) > 1 else ' is'} {listed(quoted(names), 'and')}"
                return f'the law {law} has no {kind} "{key}"; {its if names else "it has none"}'
        return None

    def _turned(
        self, knob: Knob, position: object, parameter: str, model: type[MaterialParameters], preset: str
    ) -> float:
        """Return the parameter that a knob sets; that of position 0.5 after a problem, to find further problems."""
        path = (*self.path, knob.name)
        self.expansion.renames[(*self.path, parameter)] = path
        if isinstance(position, bool) or not isinstance(position, int | float) or not 0 <= position <= 1:
            self._fault(path, f"must be a number from 0 to 1; found {written(position)}")
            return knob.value(0.5)
        value = knob.value(position)
        unit = unit_of(model.model_fields[parameter].description)
        note = f"{knob.name} = {position:g} sets {parameter} = {value:.3g} {unit}".rstrip()
        note += f" (preset {preset})" if preset else ""
        self.expansion.notes.setdefault(self.body, []).append(note)
        return value

    def _fault(self, path: Path, sentence: str) -> None:
        self.expansion.problems.append(Problem(path, sentence))


def _law_name(law: type[MaterialParameters]) -> str:
    return str(law.model_fields["law"].default)


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
        word = law.model_fields["law"].default
        # The name that pydantic gave its table: the class name, or a longer one if two classes share it.
        own_law = {name: table.get("properties", {}).get("law", {}) for name, table in definitions.items()}
        key = next(name for name, inner in own_law.items() if inner.get("const") == word)
        table = definitions[key]
        forms.append({"$ref": f"#/$defs/{key}"})
        if own := [name for name in presets if PRESETS[name].law == word]:
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
    # Not in the model of a scene: reading removes them.
    text = {"type": "string"}
    base = {**text, "description": "Path of the base scene; tables here are merged into its tables."}
    remove = {"type": "array", "items": text, "description": "Names of entries of the base to leave out."}
    schema["properties"] |= {"base": base, "remove": remove}
    schema["anyOf"] = [{"required": ["base"]}, {"required": schema.pop("required")}]
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def _one_of(presets: list[str], description: str) -> dict[str, Any]:
    return {
        "description": description,
        "oneOf": [{"const": name, "description": PRESETS[name].shows} for name in presets],
    }


def _preset_table(
    table: dict[str, Any], law: type[MaterialParameters], presets: list[str], name: str
) -> dict[str, Any]:
    """Return the table of a preset: only its name is required, and its values are the defaults."""
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
    """Drop null from a schema: TOML has no null; here it means "not given"."""
    if isinstance(schema, list):
        return [_without_null(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: _without_null(value) for key, value in schema.items() if not (key == "default" and value is None)}
    if {"type": "null"} in kept.get("anyOf", []):
        others = [entry for entry in kept.pop("anyOf") if entry != {"type": "null"}]
        kept |= others[0] if len(others) == 1 else {"anyOf": others}
    return kept


# JSON Schema keywords for the ends of a range, and their notation.
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
    """Return a preset's law, its values with their sources, and its knob positions; `model` is that of its law."""
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
    """Return the knobs of a law: the parameter and scale of each, and its position for `values` or the defaults."""
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
    """Write the accepted values of a JSON Schema: `> 0 or "auto"`, `> -1, < 0.5`, `true or false`."""
    if "anyOf" in schema:
        return listed([_range(one) for one in schema["anyOf"]])
    if "const" in schema:
        return written(schema["const"])
    if "enum" in schema:
        return listed([written(one) for one in schema["enum"]])
    if schema.get("type") == "boolean":
        return "true or false"
    return ", ".join(f"{sign} {schema[word]:g}" for word, sign in _ENDS.items() if word in schema) or "any"
