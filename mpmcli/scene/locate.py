"""Line numbers: where in a TOML text each key and each array element stands.

`tomllib` has checked the text already, so this only follows its structure and trusts that it is valid.
"""

import re
import tomllib
from bisect import bisect_right

from mpmcli.scene.problem import Path

_BLANK = re.compile(r"[ \t]*")
_BLANK_LINES = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
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
    """Return the line of a path or of the nearest table around it, or None when neither is in the text."""
    for end in range(len(path), 0, -1):
        if path[:end] in lines:
            return lines[path[:end]]
    return None


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text.replace("\r\n", "\n")
        self.at = 0
        self.breaks = [match.start() for match in re.finditer("\n", self.text)]
        self.lines: dict[Path, int] = {}
        self.elements: dict[Path, int] = {}
        self._document()

    def _document(self) -> None:
        table: Path = ()
        self._skip(_BLANK_LINES)
        while self.at < len(self.text):
            start = self.at
            if self.text[self.at] == "[":
                double = self.text.startswith("[[", self.at)
                self.at += 2 if double else 1
                table = self._header(self._dotted_key(), double)
                self.at += 2 if double else 1
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
        first = self.text[self.at]
        if first == "[":
            self.at += 1
            self._skip(_BLANK_LINES)
            index = 0
            while self.text[self.at] != "]":
                self._record((*path, index), self.at)
                self._value((*path, index))
                self._to_next()
                index += 1
            self.at += 1
        elif first == "{":
            self.at += 1
            self._skip(_BLANK_LINES)
            while self.text[self.at] != "}":
                self._pair(path)
                self._to_next()
            self.at += 1
        else:
            self._skip(_STRING if first in "\"'" else _BARE)

    def _to_next(self) -> None:
        self._skip(_BLANK_LINES)
        if self.text[self.at] == ",":
            self.at += 1
            self._skip(_BLANK_LINES)

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
        # A dotted header names tables on the way that may have no line of their own.
        for end in range(1, len(path) + 1):
            self.lines.setdefault(path[:end], bisect_right(self.breaks, at) + 1)
