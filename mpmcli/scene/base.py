"""Scenes that begin with another one: `base = "other.toml"`, and what of it is changed, added and removed."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError
from mpmcli.scene.problem import hint_at, quoted
from mpmcli.scene.toml_file import read_toml


def read_scene(path: str | PathLike[str], seen: Sequence[Path] = ()) -> tuple[str, dict[str, Any]]:
    """Return the text of a scene and what it holds, merged with its base; the text is empty where it has one.

    Raises:
        InputError: a file cannot be read or is no TOML, a base is its own, or what is to be removed is not there.
    """
    text, data = read_toml(path)
    name, remove = data.pop("base", None), data.pop("remove", [])
    if name is None and not remove:
        return text, data
    if name is None:
        raise InputError(f"{path}: base: missing key: the scene whose names `remove` leaves out")
    if not isinstance(name, str):
        raise InputError(f"{path}: base: must be the path of a scene in quotes; found {name!r}")
    if not isinstance(remove, list) or not all(isinstance(one, str) for one in remove):
        raise InputError(f"{path}: remove: must be a list of names in quotes; found {remove!r}")
    file, seen = Path(path).parent / name, (*seen, Path(path).resolve())
    if file.resolve() in seen:
        raise InputError(f"{path}: base: {name} has this scene as its base in turn; give another one")
    _, base = read_scene(file, seen)
    named = {one.get("name") for table in base.values() if isinstance(table, list) for one in _tables(table)}
    for one in remove:
        if one not in named:
            known = sorted(word for word in named if isinstance(word, str))
            hint = hint_at(one, known, f"those of {name} are {', '.join(quoted(known)) or 'none'}")
            raise InputError(f'{path}: remove: nothing has the name "{one}"; {hint}')
    kept = {
        key: [one for one in value if not isinstance(one, dict) or one.get("name") not in remove]
        if isinstance(value, list)
        else value
        for key, value in base.items()
    }
    return "", merged(_moved(kept, Path(name).parent), data)


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a table with changes: tables are merged, entries of lists by their names; all else is replaced.

    A shape, and a material with a preset or a law of its own, replace those of the base.
    """
    result = dict(base)
    for key, value in changes.items():
        before = base.get(key)
        if key == "material" and isinstance(before, str):
            before = {"preset": before}
        other = key == "material" and isinstance(value, dict) and value.keys() & {"preset", "law"}
        if isinstance(value, dict) and isinstance(before, dict) and key != "shape" and not other:
            result[key] = merged(before, value)
        elif isinstance(value, list) and isinstance(before, list) and all(isinstance(one, dict) for one in value):
            result[key] = _merged_entries(before, value)
        else:
            if key in ("cells", "spacing"):
                result = {name: one for name, one in result.items() if name not in ("cells", "spacing")}
            result[key] = value
    return result


def _merged_entries(base: list[Any], changes: list[dict[str, Any]]) -> list[Any]:
    result = list(base)
    places = {one.get("name"): k for k, one in enumerate(base) if isinstance(one, dict) and "name" in one}
    for one in changes:
        if one.get("name") in places:
            result[places[one["name"]]] = merged(result[places[one["name"]]], one)
        else:
            result.append(one)
    return result


def _tables(entries: list[Any]) -> list[dict[str, Any]]:
    return [one for one in entries if isinstance(one, dict)]


def _moved(tree: Any, directory: Path) -> Any:
    """Return tables whose files are relative to a directory, as seen from where that is."""
    if isinstance(tree, list):
        return [_moved(one, directory) for one in tree]
    if not isinstance(tree, dict):
        return tree
    return {
        key: str(directory / value) if key == "file" and isinstance(value, str) else _moved(value, directory)
        for key, value in tree.items()
    }
