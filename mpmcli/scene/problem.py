"""Problems of a scene: one sentence per faulty value, with its path and a correction."""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime, time
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from mpmcli.scene.material import MaterialParameters, knobs_of

Path = tuple[str | int, ...]
# Path in repaired data -> path in the scene as written.
Renames = dict[Path, Path]


@dataclass(frozen=True)
class Problem:
    """A fault of one value of a scene: its path, whose last key may be missing, and a sentence with a correction."""

    path: Path
    sentence: str


def path_text(path: Path) -> str:
    """Write a path as users do, for example `bodies[0].material.density`."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def nearest_entry(path: Path, entries: Mapping[Path, Any]) -> tuple[Any, Path] | None:
    """Return the entry of a path, or of the nearest table around it, and the rest of the path; None without any."""
    for end in range(len(path), 0, -1):
        if path[:end] in entries:
            return entries[path[:end]], path[end:]
    return None


def value_at(data: object, path: Path) -> object:
    """Return the value at a path in parsed TOML, or raise a LookupError."""
    for part in path:
        if (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
        else:
            raise LookupError(path_text(path))
    return data


_KINDS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text in quotes",
    "tuple_type": "a list in brackets",
    "list_type": "a list in brackets",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
}
_RANGES = {
    "greater_than": ("greater than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
}


def problems_of(error: ValidationError, data: dict[str, Any], model: type[BaseModel]) -> list[Problem]:
    """Return one problem per value that `model` found faulty in parsed TOML, in pydantic's order."""
    by_path: dict[Path, list[Any]] = {}
    for one in error.errors(include_url=False):
        if one["type"] == "too_short" and len(one["input"]) >= one["ctx"]["min_length"]:
            continue  # pydantic counts only valid entries, and the others have errors of their own
        by_path.setdefault(path_in(data, one["loc"], one["type"] == "missing"), []).append(one)
    return [_problem(path, errors, model) for path, errors in by_path.items()]


# Words of other programs, and ours.
SYNONYMS = {
    **dict.fromkeys(("sphere", "circle", "disc", "disk"), "ball"),
    **dict.fromkeys(("cuboid", "cube", "rectangle", "rect", "square", "block"), "box"),
    **dict.fromkeys(("liquid", "oil"), "water"),
    **dict.fromkeys(("elastic", "gel", "foam", "soft"), "jelly"),
    **dict.fromkeys(("steel", "iron", "copper"), "metal"),
    **dict.fromkeys(("soil", "gravel", "granular"), "sand"),
}
RIGID = ("wood", "stone", "rock", "rigid", "concrete", "brick", "glass", "ice", "plastic")


def nearest(word: str, known: list[str]) -> str | None:
    """Return the known word that a misspelled or foreign one most likely means, or None."""
    if (ours := SYNONYMS.get(word.lower())) in known:
        return ours
    return next(iter(difflib.get_close_matches(word.lower(), known, n=1)), None)


def rigid_hint(word: str) -> str:
    """Return an advice for the name of a material that is stiffer than a body can be, else ""."""
    return "a collider with a density is a rigid body; " if word.lower() in RIGID else ""


def hint_at(word: str, known: list[str], otherwise: str) -> str:
    """Return a question with the likely meaning of a misspelled word, or `otherwise` if there is none."""
    return f'did you mean "{guess}"?' if (guess := nearest(word, known)) else otherwise


def listed(words: list[str], last: str = "or") -> str:
    """Write ["a", "b", "c"] as `a, b or c`."""
    return f" {last} ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def several(words: list[str], most: int = 5) -> str:
    """Write the first words, and how many more there are: `a, b and 3 more`."""
    return listed([*words[:most], f"{len(words) - most} more"] if len(words) > most else words, "and")


def quoted(words: list[str]) -> list[str]:
    """Write each word as text in TOML."""
    return [f'"{word}"' for word in words]


def known_keys(model: type[BaseModel], loc: Path) -> list[str]:
    """Return the keys of the table that pydantic's location leads to, union tags, knobs and presets included."""
    tables = list(_tables_at(model, loc))
    keys = {name for table in tables for name in (*table.model_fields, *knobs_of(table))}
    return sorted(keys | {"preset" for table in tables if issubclass(table, MaterialParameters)})


def written(value: object) -> str:
    """Write a value as in a scene, cut after 60 characters."""
    match value:
        case bool():
            text = str(value).lower()
        case str():
            text = f'"{value}"'
        case dict():
            text = f"a table with {listed(sorted(map(str, value)), 'and')}" if value else "an empty table"
        case list() | tuple():
            text = f"[{', '.join(written(v) for v in value[:9])}{', ...' if len(value) > 9 else ''}]"
        case datetime() | date() | time():
            text = value.isoformat()
        case int() if abs(value) >= 10**20:
            text = "a number of more than 20 digits"
        case _:
            text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def path_in(data: object, loc: Path, missing: bool = False) -> Path:
    """Return pydantic's location without the names of union members; `missing` if its last key is absent."""
    path: Path = ()
    for position, part in enumerate(loc):
        try:
            value_at(data, (*path, part))
        except LookupError:
            if not (missing and position == len(loc) - 1):
                continue
        path += (part,)
    return path


def _problem(path: Path, errors: list[Any], model: type[BaseModel]) -> Problem:
    """Return the problem that the errors of Pydantic at one key mean, in the terms of TOML."""
    first = errors[0]
    kind, ctx, value = first["type"], first.get("ctx", {}), first["input"]
    match kind:
        case "flaw":
            return Problem((*path, ctx["key"]) if ctx["key"] else path, ctx["sentence"])
        case "extra_forbidden":
            return Problem(path, _unknown_key(first["loc"], model))
        case "missing":
            return Problem(path, _missing_key(first["loc"], model))
        case "string_pattern_mismatch":
            right = "must begin with a letter and hold only letters, digits, spaces, - and _"
            return Problem(path, f"{right}; found {written(value)}")
        case "too_short" | "too_long":
            words, bound = ("at least", ctx["min_length"]) if kind == "too_short" else ("at most", ctx["max_length"])
            entries = "entry" if bound == 1 else "entries"
            return Problem(path, f"needs {words} {bound} {entries}; found {ctx['actual_length']}")
        case "union_tag_not_found":
            key = ctx["discriminator"].strip("'")
            tags = [tag for table in _tables_at(model, path) for tag in get_args(table.model_fields[key].annotation)]
            return Problem(path, f"missing key: {key}, {listed(quoted(tags))}")
        case "union_tag_invalid":
            known = ctx["expected_tags"].replace("'", '"').replace(", ", " or ")
            return Problem((*path, ctx["discriminator"].strip("'")), f"must be {known}; found {written(ctx['tag'])}")
        case "tuple_type" | "list_type" if isinstance(value, dict) and any(_tables_at(model, first["loc"])):
            right = f"[[{path[0]}]] for each entry" if len(path) == 1 else f"{path[-1]} = [{{ ... }}]"
            return Problem(path, f"must be a list of tables: write {right}; found {written(value)}")
        case "model_type" | "model_attributes_type" if isinstance(value, list):
            name = path_text(tuple(part for part in path if isinstance(part, str)))
            return Problem(path, f"must be one table: write [{name}] or {path[-1]} = {{ ... }}; found a list")
    return Problem(path, _wrong_value(errors, value))


def _unknown_key(loc: Path, model: type[BaseModel]) -> str:
    key, known = str(loc[-1]), known_keys(model, loc[:-1])
    if guess := nearest(key, known):
        return f'unknown key; did you mean "{guess}"?'
    tables = [("domain",), ("time",), ("output",), ("solver",), ()]
    home = next((t for t in tables if t != loc[:-1] and key in known_keys(model, t)), None)
    if home is not None:
        return f"unknown key here; it belongs to [{home[0]}]" if home else "unknown key here; it belongs at the top"
    return f"unknown key; the keys here are {listed(known, 'and')}"


def _missing_key(loc: Path, model: type[BaseModel]) -> str:
    for table in _tables_at(model, loc[:-1]):
        field = table.model_fields.get(str(loc[-1]))
        if field and field.description:
            knobs = [name for name, (parameter, _) in knobs_of(table).items() if parameter == loc[-1]]
            instead = "".join(f"; or its knob {name}, 0 to 1" for name in knobs)
            description = field.description.rstrip(".")
            # Young's and Poisson's keep their capitals.
            first = description[:1] if "'s" in description.split(maxsplit=1)[0] else description[:1].lower()
            return f"missing key: {first}{description[1:]}{instead}"
    return "missing key"


def _wrong_value(errors: list[Any], value: object) -> str:
    """Join the values that the members of a union accept, for example `a number or "auto"`."""
    right: list[str] = []
    choices: list[str] = []
    for one in errors:
        kind, ctx = one["type"], one.get("ctx", {})
        if kind == "literal_error":
            choices += ctx["expected"].replace(" or ", ", ").replace("'", "").split(", ")
            continue
        if kind in _RANGES:
            words, key = _RANGES[kind]
            phrase = f"{words} {ctx[key] if isinstance(ctx[key], int) else format(ctx[key], 'g')}"
        else:
            phrase = _KINDS.get(kind, one["msg"][:1].lower() + one["msg"][1:])
        if phrase not in right:
            right.append(phrase)
    guess = nearest(value, choices) if isinstance(value, str) else None
    hint = f'; did you mean "{guess}"?' if guess else ""
    return f"must be {listed(right + quoted(choices))}; found {written(value)}{hint}"


def _tables_at(model: type[BaseModel], loc: Path) -> list[type[BaseModel]]:
    """Return the models that a value at pydantic's location may be validated against."""
    tables = [model]
    for part in loc:
        if isinstance(part, int):
            continue
        deeper = [
            inner
            for table in tables
            if part in table.model_fields
            for inner in _models_in(table.model_fields[part].annotation)
        ]
        # A part that is not a key is the tag of a union and selects one of its members.
        tagged = [t for t in tables if any(get_args(one.annotation) == (part,) for one in t.model_fields.values())]
        tables = deeper or tagged
    return tables


def _models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
