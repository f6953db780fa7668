"""Expands the material of a scene to the table of a law: presets are filled in, and knobs become parameters.

A material is written `"honey"`, `{ preset = "honey", thickness = 0.7, density = 1400 }`, or
`{ law = "fluid", ... }`. What the scene says itself always wins over what its preset holds.
"""

import copy
from dataclasses import dataclass, field
from typing import Any

from mpmcli.scene.knobs import Knob, knobs_of
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.presets import PRESETS
from mpmcli.scene.problem import Path, Problem
from mpmcli.scene.repair import Renames
from mpmcli.scene.sentences import listed, nearest, quoted, written
from mpmcli.scene.units import unit_of

Laws = tuple[type[MaterialParameters], ...]


@dataclass
class Expansion:
    """Parsed TOML whose materials are tables of laws.

    Attributes:
        data: the scene; a material that is too faulty to go on with is None.
        problems: what is wrong with presets and knobs.
        renames: path of each parameter that a knob set -> path of the knob.
        faulty: paths of the materials that are None.
        notes: by table and index of the body or emitter, what each knob did.
    """

    data: dict[str, Any]
    problems: list[Problem] = field(default_factory=list)
    renames: Renames = field(default_factory=dict)
    faulty: set[Path] = field(default_factory=set)
    notes: dict[tuple[str, int], list[str]] = field(default_factory=dict)

    def hides(self, path: Path) -> bool:
        """Say whether a path lies in a material that has its problem already."""
        return any(path[: len(material)] == material for material in self.faulty)


def expand_materials(data: dict[str, Any], laws: Laws) -> Expansion:
    """Return parsed TOML with every material as its law's table; what is no material at all stays as it is.

    Args:
        data: parsed TOML, which is not changed.
        laws: parameter models of the constitutive laws that a material may follow.
    """
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
    """One material of a scene on its way to a law's table."""

    def __init__(self, expansion: Expansion, body: tuple[str, int], laws: Laws) -> None:
        self.expansion = expansion
        self.body = body
        self.path: Path = (*body, "material")
        self.laws = {_law_name(law): law for law in laws}
        self.presets = available_presets(laws)

    def expanded(self, written_so: object) -> dict[str, Any] | None:
        """Return the table of the law, or None after a problem without which it cannot be made."""
        if isinstance(written_so, str):
            preset = self._preset(written_so, self.path)
            return self._table(preset, {}) if preset else None
        if isinstance(written_so, dict):
            return self._from_table(dict(written_so))
        sentence = f"must be a preset in quotes, or a table with a law or a preset; found {written(written_so)}"
        return self._fault(self.path, sentence)

    def _from_table(self, table: dict[str, Any]) -> dict[str, Any] | None:
        found = self._kind(table)
        if found is None:
            return None
        key, kind = found
        path, word = (*self.path, key), table.pop(key)
        if not isinstance(word, str):
            return self._fault(path, f"must be text in quotes; found {written(word)}")
        if kind == "law":
            return self._table("", {"law": word, **table}) if self._is_law(word, path) else None
        preset = self._preset(word, path)
        return self._table(preset, table) if preset else None

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

    def _preset(self, name: str, path: Path) -> str | None:
        if name in self.presets:
            return name
        if name in self.laws:
            sentence = f'"{name}" is a law, and needs its parameters: {{ law = "{name}", density = ... }}'
        else:
            sentence = _unknown("preset", name, self.presets)
        return self._fault(path, sentence)

    def _is_law(self, name: str, path: Path) -> bool:
        if name in self.laws:
            return True
        if name in self.presets:
            self._fault(path, f'"{name}" is a preset: write preset = "{name}"')
        else:
            self._fault(path, _unknown("law", name, sorted(self.laws)))
        return False

    def _table(self, preset: str, said: dict[str, Any]) -> dict[str, Any]:
        """Return the law's table from a preset, or "" for none, and what the scene says itself."""
        values = dict(PRESETS[preset].parameters) if preset else {}
        law = PRESETS[preset].law if preset else said["law"]
        model = self.laws[law]
        knobs = knobs_of(model)
        own = {key: value for key, value in said.items() if key not in knobs}
        for key in list(own):
            if sentence := self._foreign(key, law):
                self._fault((*self.path, key), sentence)
                del own[key]
        result = {"law": law, **values, **own}
        for key in [key for key in said if key in knobs]:
            parameter, knob = knobs[key]
            if sentence := _beside(knob, parameter, own):
                self._fault((*self.path, key), sentence)
                continue
            result[parameter] = self._turned(knob, said[key], parameter, model, preset)
        return result

    def _foreign(self, key: str, law: str) -> str | None:
        """Return what is wrong with a key that only other laws know, or None."""
        fields, knobs = self.laws[law].model_fields, knobs_of(self.laws[law])
        if key in fields:
            return None
        for kind, own, other in (("knob", list(knobs), knobs_of), ("parameter", list(fields), _parameters)):
            if any(key in other(model) for model in self.laws.values()):
                names = [name for name in sorted(own) if name != "law"]
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
    for other in knob.excludes:
        if other in said and said[other] != "auto":
            return f"sets {parameter}, which {other} = {written(said[other])} overrules; leave one of them out"
    return None


def _unknown(kind: str, name: str, known: list[str]) -> str:
    guess = nearest(name, known)
    hint = f'did you mean "{guess}"? ' if guess else ""
    return f"unknown {kind} {written(name)}; {hint}The {kind}s are {listed(quoted(known), 'and')}"


def _parameters(law: type[MaterialParameters]) -> list[str]:
    return list(law.model_fields)


def _law_name(law: type[MaterialParameters]) -> str:
    return str(law.model_fields["law"].default)
