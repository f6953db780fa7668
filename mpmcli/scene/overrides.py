"""Overrides such as `--set time.end=0.5`: one value of the parsed scene replaced, or added."""

import re
import tomllib
from collections.abc import Sequence
from typing import Any

from mpmcli.errors import InputError
from mpmcli.scene.problem import Path, path_text
from mpmcli.scene.sentences import listed, nearest, written
from mpmcli.scene.tables import MOST_NESTED, copied, too_deep

_PATH = re.compile(r"[^.\[\]]+(?:\[\d+\])*(?:\.[^.\[\]]+(?:\[\d+\])*)*")
_PART = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_BARE_WORD = re.compile(r"[^\W\d][\w ./+-]*")


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], dict[Path, str]]:
    """Return a copy of parsed TOML with every override in it, and the text of each by its path.

    An override is `KEY=VALUE`. KEY is a path, `time.end`, in which an entry of a list is named by its
    index, `bodies[0].velocity` or `bodies.0.velocity`, and a body also by its name,
    `bodies.column.velocity`. VALUE is a TOML value; a bare word is taken as text. Whether the scene
    has the key is left to validation.

    Raises:
        InputError: one line for every override that cannot be read or placed.
    """
    if too_deep(data):
        raise InputError("lists or tables of the scene are too deep")
    data = copied(data)
    placed: dict[Path, str] = {}
    faults = []
    for override in overrides:
        try:
            path, value = _split(override)
            placed[set_value(data, path, value)] = f"--set {override}"
        except InputError as fault:
            faults.append(f"--set {override}: {fault}")
    if not faults and too_deep(data):
        faults = [f"--set {override}: nests lists and tables too deeply" for override in overrides]
    if faults:
        raise InputError("\n".join(faults))
    return data, placed


def _split(override: str) -> tuple[list[str], object]:
    key, equals, text = override.partition("=")
    key, text = key.strip(), text.strip()
    if not equals:
        raise InputError("an override is KEY=VALUE, for example time.end=0.5; the = is missing")
    return key_parts(key), _value(text)


def key_parts(key: str) -> list[str]:
    """Return the parts of a key as `apply_overrides` takes it; indices stay text.

    Raises:
        InputError: this is no path of keys; a sentence without a place.
    """
    if not _PATH.fullmatch(key):
        raise InputError(f'"{key}" is no key; a key is a path such as time.end or bodies[0].velocity')
    parts = [index or name.strip() for index, name in _PART.findall(key)]
    if len(parts) > MOST_NESTED:
        raise InputError(f'"{key[:40]}..." has {len(parts)} parts, and no value of a scene lies so deep')
    return parts


def _value(text: str) -> object:
    try:
        read = tomllib.loads(f"value = {text}")
        if list(read) == ["value"] and "\n" not in text:
            return read["value"]
    except (ValueError, RecursionError):
        if _BARE_WORD.fullmatch(text):
            return text
    raise InputError(f"{text or 'nothing'} is no TOML value; write a number, a list or a word, or text in quotes")


def set_value(data: dict[str, Any], parts: list[str], value: object) -> Path:
    """Set one value of parsed TOML in place, with the tables on the way to it, and return its path.

    Args:
        data: parsed TOML, which is changed.
        parts: what `key_parts` returns.
        value: the new value.

    Raises:
        InputError: the parts lead nowhere; a sentence without a place.
    """
    at: Any = data
    path: Path = ()
    for position, part in enumerate(parts):
        if isinstance(at, list):
            key: str | int = _index(at, part, path)
        elif isinstance(at, dict):
            key = part
        else:
            raise InputError(
                f"{path_text(path)} is {written(at)} and holds no {part}; replace it as a whole, "
                f"{path_text(path)}={{{part} = ...}}"
            )
        path += (key,)
        if position == len(parts) - 1:
            at[key] = value
        elif _is_material(path) and isinstance(at.get(key), str):
            # A preset that was written as one word becomes a table, so that something can be added to it.
            at[key] = {"preset": at[key]}
            at = at[key]
        elif isinstance(at, dict):
            at = at.setdefault(part, {})
        else:
            at = at[key]
    return path


def _is_material(path: Path) -> bool:
    return len(path) == 3 and path[0] in ("bodies", "emitters") and path[2] == "material"


def _index(entries: list[Any], part: str, path: Path) -> int:
    if part.isdecimal():
        if int(part) < len(entries):
            return int(part)
        raise InputError(
            f"{path_text(path)} has {len(entries)} {'entry' if len(entries) == 1 else 'entries'}, "
            f"counted from 0; there is no {path_text((*path, int(part)))}"
        )
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    if part in names:
        return names.index(part)
    known = [name for name in names if isinstance(name, str)]
    if not known:
        raise InputError(f'{path_text(path)} is a list: give an index, {path_text((*path, 0))}, for "{part}"')
    guess = nearest(part, known)
    hint = f'did you mean "{guess}"?' if guess else f"the names are {listed(known, 'and')}"
    raise InputError(f'no entry of {path_text(path)} has the name "{part}"; {hint}')
