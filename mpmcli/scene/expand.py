"""Expands the material of a scene to the table of a law: presets are filled in, and knobs become parameters.

A material is written `"honey"`, `{ preset = "honey", thickness = 0.7, density = 1400 }`, or
`{ law = "fluid", ... }`. What the scene says itself always wins over what its preset holds.
"""

import copy
from dataclasses import dataclass, field
from typing import Any

from mpmcli.scene.material import Knob, Laws, MaterialParameters, knobs_of, unit_of
from mpmcli.scene.presets import PRESETS
from mpmcli.scene.problem import Path, Problem, Renames, listed, nearest, quoted, written


@dataclass
class Expansion:
    """Parsed TOML whose materials are tables of laws; a material that is too faulty to go on with is None."""

    data: dict[str, Any]
    problems: list[Problem] = field(default_factory=list)  # of presets and knobs
    renames: Renames = field(default_factory=dict)  # path of each parameter that a knob set -> path of the knob
    faulty: set[Path] = field(default_factory=set)  # paths of the materials that are None
    notes: dict[tuple[str, int], list[str]] = field(default_factory=dict)  # what each knob did, by table and index

    def hides(self, path: Path) -> bool:
        """Say whether a path lies in a material that has its problem already."""
        return any(path[: len(material)] == material for material in self.faulty)


def expand_materials(data: dict[str, Any], laws: Laws) -> Expansion:
    """Return parsed TOML, copied, with every material as its law's table; what is no material at all stays as it is."""
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
        """Return the table of the law, or None after a problem without which it cannot be made."""
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
        """Say whether a word names a law or a preset, as `kind` says; report a problem where it does not."""
        laws, presets = sorted(self.laws), self.presets
        known, others = (laws, presets) if kind == "law" else (presets, laws)
        if word in known:
            return True
        if word not in others:
            hint = f'did you mean "{guess}"? The' if (guess := nearest(word, known)) else "the"
            sentence = f"unknown {kind} {written(word)}; {hint} {kind}s are {listed(quoted(known), 'and')}"
        elif kind == "law":
            sentence = f'"{word}" is a preset: write preset = "{word}"'
        else:
            sentence = f'"{word}" is a law, and needs its parameters: {{ law = "{word}", density = ... }}'
        self._fault(path, sentence)
        return False

    def _table(self, kind: str, word: str, said: dict[str, Any]) -> dict[str, Any]:
        """Return the table of a law, or of that of a preset with its values, and what the scene says itself."""
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
            if sentence := _beside(knob, parameter, own):
                self._fault((*self.path, key), sentence)
                continue
            result[parameter] = self._turned(knob, said[key], parameter, model, word if preset else "")
        return result

    def _foreign(self, key: str, law: str) -> str | None:
        """Return what is wrong with a key that only other laws know, or None."""
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
        """Return the parameter that a knob sets; that of the middle after a problem, to find what else is wrong."""
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


def _beside(knob: Knob, parameter: str, said: dict[str, Any]) -> str | None:
    """Return what is wrong with a knob beside the parameters that the scene gives, or None."""
    if parameter in said:
        return f"sets {parameter}, which is given as well; leave one of them out"
    overrules = (f"{other} = {written(said[other])}" for other in knob.excludes if said.get(other, "auto") != "auto")
    first = next(overrules, None)
    return f"sets {parameter}, which {first} overrules; leave one of them out" if first else None


def _law_name(law: type[MaterialParameters]) -> str:
    return str(law.model_fields["law"].default)
