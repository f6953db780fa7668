"""The run-time ledger as columns, for HDF5, and as CSV text, for the VTK series."""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields

import h5py
import numpy as np

from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.guarded_read import read_whole

COLUMNS = tuple(f.name for f in fields(LedgerRow))
VECTORS = ("linear_momentum", "angular_momentum")
# Of each collider.
LOADS = ("collider_force", "collider_torque")
# Of scenes in which particles come and go; elsewhere they are None, and not stored.
COMINGS = ("emitted", "emitted_mass", "retired", "retired_mass", "blocked")
INTEGERS = ("steps", "emitted", "retired", "blocked")
TEXT = "limit"
# Columns that files written before them lack; they are read as nan.
LATER = ("volume_error", *LOADS)
# Columns of each frame in the CSV: its number, time steps since the start, particles.
FRAME_COLUMNS = ("frame", "step", "particles")


def ledger_columns(rows: Sequence[LedgerRow]) -> dict[str, np.ndarray]:
    """Turn T rows into one array per column.

    Returns:
        (T,) float64, int64 for `steps`, UTF-8 of fixed length for `limit`; momenta (T, components).
    """
    columns = {}
    for name in _stored(rows):
        values = [getattr(row, name) for row in rows]
        if name in LOADS and not any(values):
            continue
        if name == TEXT:
            texts = [text.encode("utf-8") for text in values]
            length = max(1, *(len(text) for text in texts), 1)
            columns[name] = np.array(texts, dtype=h5py.string_dtype("utf-8", length))
        else:
            columns[name] = np.array(values, dtype=np.int64 if name in INTEGERS else np.float64)
    return columns


def _stored(rows: Sequence[LedgerRow]) -> tuple[str, ...]:
    """Return the names of the columns of some rows of one run."""
    comes_and_goes = bool(rows) and rows[0].emitted is not None
    return tuple(name for name in COLUMNS if comes_and_goes or name not in COMINGS)


def read_ledger(group: h5py.Group, read: Callable[[str, str], np.ndarray] | None = None) -> list[LedgerRow]:
    """Read the ledger in a group of a file.

    Args:
        read: (name, kinds of types) -> column, which compares its checksum; `read_whole` by default.

    Raises:
        KeyError, ValueError: a column is missing, or is none.
    """
    found = {}
    for name in COLUMNS:
        if name in group:
            kinds = "S" if name == TEXT else "iu" if name in INTEGERS else "f"
            found[name] = read(name, kinds) if read else read_whole(group, name, kinds)
            if found[name].ndim != 1 + (name in VECTORS) + 2 * (name in LOADS):
                raise ValueError(f"the column {name} of the ledger is {found[name].shape}")
    return ledger_rows(found)


def ledger_rows(columns: Mapping[str, np.ndarray]) -> list[LedgerRow]:
    """Undo `ledger_columns`; a column of LATER or COMINGS may be absent."""
    lists = []
    for name in COLUMNS:
        if name in COMINGS and name not in columns:
            lists.append([None] * len(columns["time"]))
            continue
        if name in LATER and name not in columns:
            lists.append([() if name in LOADS else math.nan] * len(columns["time"]))
            continue
        values = np.asarray(columns[name]).tolist()
        if name == TEXT:
            values = [text.decode("utf-8") for text in values]
        elif name in VECTORS:
            values = [tuple(value) for value in values]
        elif name in LOADS:
            values = [tuple(map(tuple, value)) for value in values]
        lists.append(values)
    return [LedgerRow(*values) for values in zip(*lists, strict=True)]


def ledger_csv(rows: Sequence[LedgerRow], frames: Mapping[str, Sequence[int]]) -> str:
    """Write T rows as CSV with a header line; numbers have the digits that read back exactly.

    Args:
        rows: the ledger.
        frames: the first columns, whole numbers by name (`FRAME_COLUMNS`), one per row.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, row in enumerate(rows):
        record: dict[str, object] = {name: frames[name][i] for name in FRAME_COLUMNS}
        for name in _stored(rows):
            value = getattr(row, name)
            if name in VECTORS:
                record |= {f"{name}_{axis}": repr(float(v)) for axis, v in enumerate(value)}
            elif name in LOADS:
                entries = [(k, axis, v) for k, vector in enumerate(value) for axis, v in enumerate(vector)]
                record |= {f"{name}_{k}_{axis}": repr(float(v)) for k, axis, v in entries}
            else:
                record[name] = value if name == TEXT or name in INTEGERS else repr(float(value))
        if i == 0:
            writer.writerow(record)
        writer.writerow(record.values())
    return text.getvalue()


def parse_ledger_csv(text: str) -> tuple[list[LedgerRow], dict[str, list[int]]]:
    """Undo `ledger_csv`: the rows, and the first columns by name."""
    rows, frames = [], {name: [] for name in FRAME_COLUMNS}
    for record in csv.DictReader(io.StringIO(text)):
        for name in FRAME_COLUMNS:
            frames[name].append(int(record[name]))
        values: dict[str, object] = {}
        for name in COLUMNS:
            if name in VECTORS:
                keys = [key for key in record if key.startswith(f"{name}_")]
                values[name] = tuple(float(record[key]) for key in keys)
            elif name == TEXT:
                values[name] = record[name]
            elif name in LOADS:
                values[name] = _vectors(record, name)
            elif name in LATER and name not in record:
                values[name] = math.nan
            elif name in COMINGS and name not in record:
                values[name] = None
            else:
                values[name] = int(record[name]) if name in INTEGERS else float(record[name])
        rows.append(LedgerRow(**values))
    return rows, frames


def _vectors(record: Mapping[str, str], name: str) -> tuple[tuple[float, ...], ...]:
    """Return the vectors of each collider from their columns, such as collider_force_0_1."""
    found: dict[int, list[float]] = {}
    for key, text in record.items():
        if key.startswith(f"{name}_"):
            found.setdefault(int(key.rsplit("_", 2)[1]), []).append(float(text))
    return tuple(tuple(found[k]) for k in sorted(found))
