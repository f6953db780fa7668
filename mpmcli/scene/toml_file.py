"""The TOML of a scene: reading, line numbers of keys, overrides by `--set`, and writing."""

import re
import tomllib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path as File
from typing import Any, get_origin

import tomli_w

from mpmcli.errors import InputError
from mpmcli.scene.examples import examples
from mpmcli.scene.problem import Path, hint_at, listed, nearest_entry, path_text, written
from mpmcli.scene.quantity import dimension_of
from mpmcli.scene.schema import Scene

# Largest nesting depth of lists and tables. No scene needs a fifth of it; Python's stack ends at some hundreds.
MOST_NESTED = 60


def copied(tree: Any) -> Any:
    """Return a copy of tables and lists without shared tables, which callers in Python may pass."""
    if isinstance(tree, dict):
        return {key: copied(value) for key, value in tree.items()}
    return [copied(value) for value in tree] if isinstance(tree, list) else tree


def too_deep(tree: Any) -> bool:
    """Return whether tables and lists are nested deeper than MOST_NESTED."""
    level = [tree]
    for _ in range(MOST_NESTED):
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return False
    return True


_POSITION = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_HEADER = re.compile(r"^[ \t]*\[\[?[ \t]*([\w.-]+)[ \t]*\]", re.MULTILINE)
# Messages of tomllib, and the plainer sentences that replace them.
_SYNTAX = {
    "Cannot overwrite a value": "this key is given twice",
    "Invalid value": "this is not a TOML value; text needs quotes, numbers and lists none",
    "Expected '=' after a key in a key/value pair": "expected key = value",
    "Invalid initial character for a key part": "expected a key; a table in { } stands on one line",
    "Unclosed array": "a list is not closed with ]",
    "Invalid statement": "expected key = value or a [table]",
}


def read_toml(path: str | PathLike[str], kind: str = "scene") -> tuple[str, dict[str, Any]]:
    """Return the text of a TOML file, and its parsed data.

    Args:
        path: the file.
        kind: subject of the file, one word, for errors.

    Raises:
        InputError: the file cannot be read, or is not valid TOML.
    """
    file = File(path)
    try:
        # utf-8-sig: some editors begin a file with a byte order mark.
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        known = list(examples()) if kind == "scene" and not file.suffix else []
        hint = hint_at(file.name, known, f"give the path of a {kind} in TOML")
        raise InputError(f"{file}: there is no such file; {hint}") from None
    except IsADirectoryError:
        inside = file / f"{kind}.toml"
        hint = f"did you mean {inside}?" if inside.is_file() else f"give the path of a {kind} in TOML"
        raise InputError(f"{file}: this is a directory; {hint}") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"{file}: this is not text in UTF-8 (byte {error.start} is {error.object[error.start]:#04x}); "
            f"give a {kind} in TOML"
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{file}: the file cannot be read: {reason}") from None
    return text, _parse(text, str(path))


def _parse(text: str, source: str) -> dict[str, Any]:
    """Return the tables of a text. Raises InputError, with line and column, if it is not valid TOML."""
    try:
        found = tomllib.loads(text)
        if not too_deep(found):
            return found
    except tomllib.TOMLDecodeError as error:
        said, place = str(error), source
        if position := _POSITION.search(said):
            said = said[: position.start()]
            line, column = position.groups() if position[1] else (max(1, len(text.splitlines())), None)
            place += f":{line}" + (f":{column}" if column else "")
            if said.startswith("Cannot") and (header := _HEADER.match(text.splitlines()[int(line) - 1])):
                said = _given_twice(header[1], text)
        raise InputError(f"{place}: not valid TOML: {_SYNTAX.get(said, said[:1].lower() + said[1:])}") from None
    except (ValueError, RecursionError):
        pass
    raise InputError(f"{source}: not valid TOML: a number is too long or lists are too deep")


def _given_twice(name: str, text: str) -> str:
    """Return the fault of a header [name] or [[name]] that stands in a text before."""
    if len({match[0].count("[") for match in _HEADER.finditer(text) if match[1] == name}) == 1:
        return f"{name} is given twice"
    field = Scene.model_fields.get(name)
    right = f"[{name}] for a table, [[{name}]] for each entry of a list"
    if field:
        right = f"[[{name}]] for each entry" if get_origin(field.annotation) is tuple else f"[{name}] once"
    return f"[{name}] and [[{name}]] are both given; write {right}"


_BLANK = re.compile(r"[ \t]*")
_BLANK_LINES = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_COMMA = re.compile(rf"{_BLANK_LINES.pattern}(?:,{_BLANK_LINES.pattern})?")
_KEY = re.compile(r"""[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'""")
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}(?!")' r"|'''.*?'{3,5}(?!')" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'", re.DOTALL
)
# Numbers, dates, true and false; a date may hold a space.
_BARE = re.compile(r"[^,\]}#\n]+")


def key_lines(text: str) -> dict[Path, int]:
    """Return the line, counted from 1, of every table, key and array element of a valid TOML text."""
    return _Scanner(text).lines


def line_of(path: Path, lines: dict[Path, int]) -> int | None:
    """Return the line of a path or of the nearest table around it, or None if neither is in the text."""
    found = nearest_entry(path, lines)
    return None if found is None else found[0]


class _Scanner:
    """Scans the structure of a text that `tomllib` has already checked."""

    def __init__(self, text: str) -> None:
        """Scan the text, and record the lines of its keys, tables and list entries."""
        self.text = text.replace("\r\n", "\n")
        self.at = 0
        self.breaks = [match.start() for match in re.finditer("\n", self.text)]
        self.lines: dict[Path, int] = {}
        self.elements: dict[Path, int] = {}
        table: Path = ()
        self._skip(_BLANK_LINES)
        while self.at < len(self.text):
            start = self.at
            if self.text[self.at] == "[":
                brackets = 2 if self.text.startswith("[[", self.at) else 1
                self.at += brackets
                table = self._header(self._dotted_key(), double=brackets == 2)
                self.at += brackets
                self._record(table, start)
            else:
                self._pair(table)
            self._skip(_BLANK_LINES)

    def _header(self, keys: list[str], double: bool) -> Path:
        """Return the path of a header: a name of an array of tables means its latest element."""
        path: Path = ()
        for key in keys[:-1]:
            path += (key,)
            if path in self.elements:
                path += (self.elements[path] - 1,)
        path += (keys[-1],)
        if double:
            self._record(path, self.at)
            self.elements[path] = self.elements.get(path, 0) + 1
            path += (self.elements[path] - 1,)
        return path

    def _pair(self, table: Path) -> None:
        start = self.at
        path = table
        for key in self._dotted_key():
            path += (key,)
            self._record(path, start)
        self.at += 1  # the equals sign
        self._skip(_BLANK)
        self._value(path)

    def _value(self, path: Path) -> None:
        """Skip a value, and record the lines of what lists and inline tables in it hold."""
        first = self.text[self.at]
        if first not in "[{":
            self._skip(_STRING if first in "\"'" else _BARE)
            return
        self.at += 1
        self._skip(_BLANK_LINES)
        index = 0
        while self.text[self.at] not in "]}":
            if first == "[":
                self._record((*path, index), self.at)
                self._value((*path, index))
            else:
                self._pair(path)
            self._skip(_COMMA)
            index += 1
        self.at += 1

    def _dotted_key(self) -> list[str]:
        keys = []
        while True:
            self._skip(_BLANK)
            key = self._skip(_KEY)
            keys.append(next(iter(tomllib.loads(f"{key} = 0"))))
            self._skip(_BLANK)
            if self.text[self.at] != ".":
                return keys
            self.at += 1

    def _skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        assert match, f"line {bisect_right(self.breaks, self.at) + 1} is not the TOML that tomllib read"
        self.at = match.end()
        return match[0]

    def _record(self, path: Path, at: int) -> None:
        # The parent tables in a dotted header may have no line of their own.
        for end in range(1, len(path) + 1):
            self.lines.setdefault(path[:end], bisect_right(self.breaks, at) + 1)


_PATH = re.compile(r"[^.\[\]]+(?:\[\d+\])*(?:\.[^.\[\]]+(?:\[\d+\])*)*")
_PART = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_BARE_WORD = re.compile(r"[^\W\d][\w ./+-]*")
# Keys whose default is zero along each axis: one entry can be set alone.
_ZEROS = ("velocity", "gravity", "origin")


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], dict[Path, str]]:
    """Return a copy of parsed TOML with every override in it, and the text of each by its path.

    An override is `KEY=VALUE`. KEY is a path, `time.end`, in which an entry of a list is named by its index,
    `bodies[0].velocity` or `bodies.0.velocity`, and a body also by its name, `bodies.column.velocity`. VALUE is a TOML
    value; a bare word is taken as text. Validation checks whether the scene has the key. An InputError has a line for
    every override that cannot be read or placed.
    """
    if too_deep(data):
        raise InputError("lists or tables of the scene are too deep")
    data = copied(data)
    placed: dict[Path, str] = {}
    faults = []
    for override in overrides:
        try:
            key, equals, text = override.partition("=")
            if not equals:
                raise InputError("an override is KEY=VALUE, for example time.end=0.5; the = is missing")
            placed[set_value(data, key_parts(key.strip()), _value_of(text.strip()))] = f"--set {override}"
        except InputError as fault:
            faults.append(f"--set {override}: {fault}")
    if not faults and too_deep(data):
        faults = [f"--set {override}: nests lists and tables too deeply" for override in overrides]
    if faults:
        raise InputError("\n".join(faults))
    return data, placed


def key_parts(key: str) -> list[str]:
    """Return the parts of a key as `apply_overrides` takes it, indices as text, or raise an InputError."""
    if not _PATH.fullmatch(key):
        raise InputError(f'"{key}" is not a key; a key is a path such as time.end or bodies[0].velocity')
    parts = [index or name.strip() for index, name in _PART.findall(key)]
    if len(parts) > MOST_NESTED:
        raise InputError(f'"{key[:40]}..." has {len(parts)} parts, and no value of a scene lies so deep')
    return parts


def _value_of(text: str) -> object:
    try:
        read = tomllib.loads(f"value = {text}")
        if list(read) == ["value"] and "\n" not in text:
            return read["value"]
    except (ValueError, RecursionError):
        if _BARE_WORD.fullmatch(text):
            return text
    raise InputError(f"{text or 'nothing'} is not a TOML value; write a number, a list or a word, or text in quotes")


def set_value(data: dict[str, Any], parts: list[str], value: object) -> Path:
    """Set one value of parsed TOML in place, with the tables on the way to it, and return its path.

    `parts` is what `key_parts` returns. A vector of _ZEROS that is not there begins as zeros. Raises InputError, a
    sentence without a place, where they lead nowhere.
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
        elif path[0] in ("bodies", "emitters") and path[2:] == ("material",) and isinstance(at.get(key), str):
            # A preset written as one word becomes a table, so that keys can be added.
            at[key] = {"preset": at[key]}
            at = at[key]
        elif isinstance(at, dict) and part in _ZEROS and parts[position + 1].isdecimal():
            at = at.setdefault(part, [0.0] * (dimension_of(data) or 2))
        elif isinstance(at, dict):
            at = at.setdefault(part, {})
        else:
            at = at[key]
    return path


def _index(entries: list[Any], part: str, path: Path) -> int:
    """Return the index of a list entry from its number or name. Raises InputError if there is no such entry."""
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
    hint = hint_at(part, known, f"the names are {listed(known, 'and')}")
    raise InputError(f'no entry of {path_text(path)} has the name "{part}"; {hint}')


_WIDTH = 100
# Keys of an entry of a list that are tables of their own, not inline.
_OWN_TABLE = ("material",)


def scene_to_toml(scene: Scene) -> str:
    """Write a scene as TOML; loading the text again gives an equal scene.

    Only `domain.spacing` is written, which determines `domain.cells`. Presets and knobs are written as laws with
    physical parameters.
    """
    data = scene.model_dump(exclude_none=True, exclude={"domain": {"cells"}})
    return "\n\n".join(block for name, value in data.items() for block in _blocks(name, value)) + "\n"


def _blocks(name: str, value: object) -> Iterator[str]:
    """Lay out one key of the scene: a value, a table, or a list of tables; a material has a table of its own."""
    match value:
        case dict():
            yield _table(f"[{name}]", value)
        case list() | tuple():
            for entry in value:
                inner = {key: entry.pop(key) for key in _OWN_TABLE if key in entry}
                yield _table(f"[[{name}]]", entry)
                for key, table in inner.items():
                    yield _table(f"[{name}.{key}]", table)
        case _:
            yield f"{name} = {value_text(value)}"


def _table(header: str, table: dict[str, Any]) -> str:
    return "\n".join([header, *(f"{key} = {value_text(value)}" for key, value in table.items())])


def value_text(value: object) -> str:
    """Return a value as TOML; TypeError: it is none."""
    match value:
        case dict():
            return "{ " + ", ".join(f"{key} = {value_text(inner)}" for key, inner in value.items()) + " }"
        case list() | tuple():
            inner = [value_text(entry) for entry in value]
            if inner and len(inner) * len(inner[0]) > _WIDTH:
                return "[\n    " + ",\n    ".join(inner) + ",\n]"
            return f"[{', '.join(inner)}]"
        case _:
            # tomli_w escapes text and formats numbers.
            return tomli_w.dumps({"k": value}).removeprefix("k = ").rstrip("\n")
