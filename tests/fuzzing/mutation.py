"""Damage to bytes, text, trees of values, HDF5 and SQLite files; all from one generator of random numbers."""

import copy
import io
import json
import re
import sqlite3
import struct
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from random import Random
from typing import Any

import h5py
import numpy as np

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
_WIDTHS = ("<b", "<H", "<i", "<q", ">i", "<f", "<d", ">q")


def bytes_mutant(data: bytes, rng: Random) -> bytes:
    """Damage bytes in one to four places."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_DAMAGES)(data, rng)
    return data


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


def _number(data: bytes, rng: Random) -> bytes:
    kind = rng.choice(_WIDTHS)
    value = rng.choice(NUMBERS)
    size = struct.calcsize(kind)
    try:
        made = struct.pack(kind, value if kind[1] in "fd" else int(value))
    except (struct.error, OverflowError, ValueError):
        made = rng.choice((b"\xff", b"\x7f", b"\x00")) * size
    at = rng.randrange(len(data) + 1)
    return data[:at] + made + data[at + size :]


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.choice((1, 2, 8, 64, 512)) :]


def _repeat(data: bytes, rng: Random) -> bytes:
    at, size = rng.randrange(len(data) + 1), rng.choice((1, 4, 16, 128, 1024))
    return data[:at] + data[at : at + size] * rng.choice((2, 2, 2, 3, 50)) + data[at + size :]


def _insert(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 2, 8, 64))) + data[at:]


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


_DAMAGES = (_flip, _flip, _byte, _number, _number, _cut, _remove, _repeat, _insert, _move)
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


def json_mutant(data: bytes, rng: Random) -> bytes:
    """Damage the values of a JSON text."""
    with suppress(ValueError, RecursionError):
        return json.dumps(tree_mutant(json.loads(data), rng)).encode("utf-8", "replace")
    return text_mutant(data, rng)


def hdf5_mutant(data: bytes, rng: Random) -> bytes:
    """Damage the content of an HDF5 file, which stays one: values, attributes, types, shapes, links."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(rng.choice((1, 1, 2, 3))):
            name = rng.choice(names)
            # What one of these refuses leaves the file as it was.
            with suppress(Exception):
                rng.choice((_h5_values, _h5_values, _h5_attribute, _h5_attribute, _h5_replace, _h5_link))(
                    file, name, rng
                )
    return buffer.getvalue()


def _h5_values(file: h5py.File, name: str, rng: Random) -> None:
    data = file[name]
    if not isinstance(data, h5py.Dataset):
        return _h5_attribute(file, name, rng)
    if data.size and data.dtype.kind in "iuf":
        flat = data[...].reshape(-1)
        value = rng.choice(NUMBERS)
        if data.dtype.kind != "f":
            low, high = np.iinfo(data.dtype).min, np.iinfo(data.dtype).max
            value = low if value != value else int(min(max(value, low), high))
        flat[rng.randrange(len(flat))] = value
        if rng.random() < 0.2:
            flat[:] = value
        data[...] = flat.reshape(data.shape)
    elif data.size:
        data[...] = rng.choice((b"", b"\xff\xfe", b"wave", b"x"))
    return None


def _h5_attribute(file: h5py.File, name: str, rng: Random) -> None:
    holders = [file, *(file[n] for n in ("mpmcli", "VTKHDF", "VTKHDF/Steps", name) if n in file)]
    holder = rng.choice([one for one in holders if len(one.attrs)] or [file])
    key = rng.choice([*holder.attrs] or ["format"])
    value = holder.attrs.get(key)
    if isinstance(value, str) and rng.random() < 0.8:
        raw = value.encode()
        made = json_mutant(raw, rng) if raw[:1] in b"{[" else text_mutant(raw, rng)
        holder.attrs[key] = made.decode("utf-8", "replace").replace("\0", "0")[:60_000]
    elif rng.random() < 0.2:
        del holder.attrs[key]
    else:
        made = rng.choice((*NUMBERS, *TEXTS[:9], b"\xff\xfe", np.arange(3), np.zeros((0,)), h5py.Empty("f8"), True))
        holder.attrs[key] = made


def _h5_replace(file: h5py.File, name: str, rng: Random) -> None:
    old = file[name]
    shape, dtype = (old.shape, old.dtype) if isinstance(old, h5py.Dataset) else ((3,), np.dtype("f8"))
    attributes = dict(old.attrs)
    del file[name]
    match rng.randrange(8):
        case 0:
            return
        case 1:
            file.create_group(name)
        case 2:
            file[name] = rng.choice((1.0, "text", b"\xff", np.zeros((0, 3)), np.zeros((2, 2, 2, 2)), h5py.Empty("f4")))
        case 3:
            # Of no size in the file, and of any in memory.
            big = rng.choice((2**27, 2**31, 2**36, 2**45, 2**61))
            file.create_dataset(name, (big, *shape[1:]), dtype, chunks=(1024, *shape[1:]), maxshape=(None, *shape[1:]))
        case 4:
            size = rng.choice((0, 1, 2, 5, 7, 100))
            file.create_dataset(name, (size, *shape[1:]), dtype)
        case 5:
            file.create_dataset(name, (*shape, 2) if rng.random() < 0.5 else shape[:-1], dtype)
        case 6:
            other = rng.choice(("i1", "u8", "f2", "c16", "S3", "?", [("a", "f8"), ("b", "i4")], h5py.string_dtype()))
            file.create_dataset(name, shape, other)
        case _:
            file.create_dataset(name, shape, dtype, compression="gzip", fillvalue=rng.choice(NUMBERS[:8]))
    file[name].attrs.update(attributes)


def _h5_link(file: h5py.File, name: str, rng: Random) -> None:
    del file[name]
    file[name] = rng.choice(
        (
            *(h5py.SoftLink(f"/{name}"), h5py.SoftLink("/"), h5py.SoftLink("/mpmcli"), h5py.SoftLink("/VTKHDF/Points")),
            *(h5py.ExternalLink("/etc/passwd", "/"), h5py.ExternalLink("../other.h5", "/VTKHDF/Points")),
        )
    )


def npz_mutant(data: bytes, rng: Random) -> bytes:
    """Damage members of an archive of arrays, which stays one: their headers, their values, their number."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(name, file.read(name)) for name in file.namelist()]
    for _ in range(rng.choice((1, 1, 2))):
        k = rng.randrange(len(members))
        name, held = members[k]
        head, facts = held[:128], held[128:]
        match rng.randrange(8):
            case 0:
                members[k] = text_mutant(name.encode(), rng).decode("utf-8", "replace"), held
            case 1:
                members.append(members[k])
            case 2:
                members[k] = name, b"\x93NUMPY\x01\x00v\x00" + text_mutant(held[10:128], rng) + facts
            case 3:
                shape = f"'shape': ({rng.choice((0, -1, 7, 2**31, 2**40, 2**62))}, {rng.choice((0, 1, 3, -2))})"
                text = re.sub(rb"'shape': \([^)]*\)", shape.encode(), held[10:128]).ljust(118)[:118]
                members[k] = name, held[:10] + text + facts
            case 4 | 5 | 6 if facts[:1] == b"{":
                made = json_mutant(facts, rng)
                stated = re.sub(rb"\(\d+,\)", b"(%d,)" % len(made), head[10:])[:118].ljust(118)
                members[k] = name, head[:10] + stated + made
            case _:
                members[k] = name, bytes_mutant(held, rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED,) * 4 + (zipfile.ZIP_DEFLATED,))) as file:
        for name, held in members:
            with suppress(ValueError, struct.error, UnicodeError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                file.writestr(zipfile.ZipInfo(name), held)
    return buffer.getvalue()


def sqlite_mutant(data: bytes, rng: Random) -> bytes:
    """Damage the content of a SQLite file, which stays one."""
    connection = sqlite3.connect(":memory:")
    connection.deserialize(data)
    tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    for _ in range(rng.choice((1, 1, 2))):
        with suppress(sqlite3.Error, OverflowError, UnicodeError):
            _sqlite_damage(connection, rng.choice(tables), rng)
    connection.commit()
    return connection.serialize()


def _sqlite_damage(connection: sqlite3.Connection, table: str, rng: Random) -> None:
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    if not columns:
        return
    column = rng.choice(columns)
    match rng.randrange(10):
        case 0:
            connection.execute(f"DROP TABLE {table}")
        case 1:
            connection.execute(f"DELETE FROM {table} WHERE rowid % 2 = {rng.randrange(2)}")
        case 2:
            connection.execute(f"ALTER TABLE {table} RENAME COLUMN {column} TO other")
        case 3:
            connection.execute(f"ALTER TABLE {table} RENAME TO other")
        case 4:
            connection.execute(f"UPDATE {table} SET {column} = ?", (rng.randbytes(5),))
        case 5 | 6 if "value" in columns:
            rows = connection.execute(f"SELECT rowid, value FROM {table}").fetchall()
            row, value = rng.choice(rows)
            text = json_mutant(str(value).encode(), rng).decode()
            text = json.dumps(value_mutant(rng)) if rng.random() < 0.5 else text
            connection.execute(f"UPDATE {table} SET value = ? WHERE rowid = ?", (text, row))
        case _:
            value = rng.choice((*NUMBERS, *TEXTS, "../../../etc/passwd", "/etc/passwd", "../result"))
            where = (
                ""
                if rng.random() < 0.3
                else " WHERE rowid = (SELECT rowid FROM " + table + " ORDER BY random() LIMIT 1)"
            )
            connection.execute(f"UPDATE {table} SET {column} = ?{where}", (value,))
