"""Damage to the content of HDF5 files, archives of arrays and SQLite files, which stay what they are."""

import io
import json
import re
import sqlite3
import struct
import warnings
import zipfile
from contextlib import suppress
from random import Random

import h5py
import numpy as np

from fuzzing.mutation import NUMBERS, TEXTS, bytes_mutant, json_mutant, text_mutant, value_mutant


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
