"""Damage to text and trees of values; all from one generator of random numbers."""

import copy
import re
from collections.abc import Iterator
from random import Random
from typing import Any

NUMBERS = (
    *(0, -1, 1, 2, 3, 7, 255, 256, 65535, 2**31 - 1, 2**31, -(2**31), 2**32, 2**53, 2**63 - 1, 2**63, -(2**63), 10**30),
    *(0.0, -0.0, 0.5, -1.5, 1e-320, 5e-324, 1e-308, 1e-16, 1e-9, 1e9, 1e15, 1e16, 1e154, 1e300, 1e308, -1e308),
    *(float("inf"), float("-inf"), float("nan")),
)
TEXTS = (
    *(
        "",
        " ",
        "a",
        "nan",
        "true",
        "0",
        "1e999",
        "../../etc/passwd",
        "/etc/passwd",
        "/dev/zero",
        ".",
        "..",
        "a/b",
        "\0",
    ),
    *(
        "\x1b[31mred\x1b[0m",
        "\x07",
        "\u202e",
        "\ud7ff",
        "\U0001f600",
        "é" * 40,
        "x" * 5000,
        "[bold]",
        "%s",
        "{0}",
        "a\nb",
    ),
    *("t", "x", "X", "t**t", "1/0", "(" * 200, "-" * 3000 + "1", "sin(t)", "9" * 400, "t if t > 1 else x", "[" * 99),
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
_BLOCKS = (b"[", b"{", b"(", b"-", b"=", b'"', b"a.", b"[[", b"]]", b"'''", b"\n", b"#", b"\xff", b"\x00", b"9")


def text_mutant(data: bytes, rng: Random) -> bytes:
    """Damage a text: numbers, words and lines of it, and now and then bytes."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        data = rng.choice(_TEXT_DAMAGES)(data, rng)
    return data


def _flip(data: bytes, rng: Random) -> bytes:
    if not data:
        return b"\0"
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]


def _byte(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.choice((1, 2, 8, 64, 512)) :]


def _repeat(data: bytes, rng: Random) -> bytes:
    at, size = rng.randrange(len(data) + 1), rng.choice((1, 4, 16, 128, 1024))
    return data[:at] + data[at : at + size] * rng.choice((2, 2, 2, 3, 50)) + data[at + size :]


def _move(data: bytes, rng: Random) -> bytes:
    a, b = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
    size = rng.choice((1, 8, 64, 256))
    return data[:a] + data[b : b + size] + data[a + size :]


def _text_number(data: bytes, rng: Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return _byte(data, rng)
    one = rng.choice(found)
    return data[: one.start()] + str(rng.choice(NUMBERS)).encode() + data[one.end() :]


def _text_word(data: bytes, rng: Random) -> bytes:
    found = list(_WORD.finditer(data))
    if not found:
        return _byte(data, rng)
    one = rng.choice(found)
    new = rng.choice(found)[0] if rng.random() < 0.7 else rng.choice(TEXTS).encode("utf-8", "replace")
    return data[: one.start()] + new + data[one.end() :]


def _lines(data: bytes, rng: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) < 2:
        return _byte(data, rng)
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[a]
        case 1:
            lines.insert(b, lines[a])
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case _:
            lines[a : a + 1] = [lines[a]] * rng.choice((2, 30))
    return b"".join(lines)


def _block(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(_BLOCKS) * rng.choice((1, 1, 2, 40, 3000)) + data[at:]


_TEXT_DAMAGES = (*(_text_number, _text_word, _lines) * 3, _block, _block, _flip, _byte, _cut, _remove, _repeat, _move)


def value_mutant(rng: Random, depth: int = 2) -> Any:
    """Return a value out of place: a number, a text, or a list or table of such."""
    match rng.randrange(8):
        case 0 | 1 | 2:
            return rng.choice(NUMBERS)
        case 3 | 4:
            return rng.choice(TEXTS)
        case 5:
            return rng.choice((True, False))
        case 6 if depth:
            return [value_mutant(rng, depth - 1) for _ in range(rng.choice((0, 1, 2, 3, 4, 9)))]
        case 7 if depth:
            return {str(rng.choice(TEXTS)): value_mutant(rng, depth - 1) for _ in range(rng.randrange(3))}
    return rng.randrange(-5, 100)


def paths_of(tree: Any, path: tuple = ()) -> Iterator[tuple]:
    """Yield the path of every value in a tree of tables and lists."""
    if isinstance(tree, dict | list):
        for key, inner in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield (*path, key)
            yield from paths_of(inner, (*path, key))


def tree_mutant(tree: Any, rng: Random) -> Any:
    """Replace, remove, double or move values of a tree of tables and lists."""
    try:
        return _tree_mutant(copy.deepcopy(tree), rng)
    except RecursionError:
        # What is doubled was made too deep before.
        return value_mutant(rng)


def _tree_mutant(tree: Any, rng: Random) -> Any:
    for _ in range(rng.choice((1, 1, 2, 3))):
        paths = list(paths_of(tree))
        if not paths or rng.random() < 0.01:
            return value_mutant(rng)
        *way, key = rng.choice(paths)
        table = tree
        for part in way:
            table = table[part]
        match rng.randrange(8):
            case 0:
                del table[key]
            case 1:
                table[key] = copy.deepcopy(_at(tree, rng.choice(paths)))
            case 2 if isinstance(table, list):
                table.insert(key, copy.deepcopy(table[key]))
            case 2:
                table[str(rng.choice(TEXTS))] = table.pop(key)
            case 3:
                table[key] = [table[key]]
            case 4:
                deep = table[key]
                for _ in range(rng.choice((3, 30, 400))):
                    deep = [deep]
                table[key] = deep
            case _:
                table[key] = value_mutant(rng)
    return tree


def _at(tree: Any, path: tuple) -> Any:
    for part in path:
        tree = tree[part]
    return tree
