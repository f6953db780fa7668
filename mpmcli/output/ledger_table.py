"""The run-time ledger as columns, for HDF5, and as CSV text, for the VTK series."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields

import h5py
import numpy as np

from mpmcli.frames.ledger import LOADS, RIGID, LedgerRow

COLUMNS = tuple(f.name for f in fields(LedgerRow))
# A row for each collider, pair or body.
PER_PART = (*LOADS, *RIGID)
VECTORS = ("linear_momentum", "angular_momentum")
# Of scenes in which particles come and go, or bodies separate; elsewhere they are None, and not stored.
OPTIONAL = ("emitted", "emitted_mass", "retired", "retired_mass", "blocked", "contact_overlap", "contact_gap")
INTEGERS = ("steps", "emitted", "retired", "blocked")
TEXT = "limit"
# What is read where a file has no such column.
MISSING = {**dict.fromkeys(PER_PART, ()), **dict.fromkeys(OPTIONAL)}
# Columns of each frame in the CSV: its number, time steps since the start, particles.
FRAME_COLUMNS = ("frame", "step", "particles")


def ledger_columns(rows: Sequence[LedgerRow]) -> dict[str, np.ndarray]:
    """Return columns of T rows; momenta are (T, components), loads (T, count, components), `limit` is UTF-8."""
    columns = {}
    for name in _stored(rows):
        values = [getattr(row, name) for row in rows]
        if name in PER_PART and not any(values):
            continue
        if name == TEXT:
            texts = [text.encode("utf-8") for text in values]
            columns[name] = np.array(texts, dtype=h5py.string_dtype("utf-8", max([1, *map(len, texts)])))
        else:
            columns[name] = np.array(values, dtype=np.int64 if name in INTEGERS else np.float64)
    return columns


def _stored(rows: Sequence[LedgerRow]) -> tuple[str, ...]:
    """Return the names of the columns of some rows of one run."""
    return tuple(name for name in COLUMNS if name not in OPTIONAL or (rows and getattr(rows[0], name) is not None))


def read_ledger(group: h5py.Group, read: Callable[[str], np.ndarray]) -> list[LedgerRow]:
    """Read the ledger in a group, each column by `read`."""
    return ledger_rows({name: read(name) for name in COLUMNS if name in group})


def ledger_rows(columns: Mapping[str, np.ndarray]) -> list[LedgerRow]:
    """Undo `ledger_columns`; a column of `MISSING` may be absent."""
    lists = []
    for name in COLUMNS:
        if name in MISSING and name not in columns:
            lists.append([MISSING[name]] * len(columns["time"]))
            continue
        values = np.asarray(columns[name]).tolist()
        if name == TEXT:
            values = [text.decode("utf-8") for text in values]
        elif name in VECTORS:
            values = [tuple(value) for value in values]
        elif name in PER_PART:
            values = [tuple(map(tuple, value)) for value in values]
        lists.append(values)
    return [LedgerRow(*values) for values in zip(*lists, strict=True)]


def ledger_csv(rows: Sequence[LedgerRow], frames: Sequence[tuple[int, ...]]) -> str:
    """Write T rows as CSV with a header line, after `FRAME_COLUMNS`; numbers have the digits that read back exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, row in enumerate(rows):
        record: dict[str, object] = dict(zip(FRAME_COLUMNS, frames[i], strict=True))
        for name in _stored(rows):
            value = getattr(row, name)
            if name in VECTORS:
                record |= {f"{name}_{axis}": repr(float(v)) for axis, v in enumerate(value)}
            elif name in PER_PART:
                entries = [(k, axis, v) for k, vector in enumerate(value) for axis, v in enumerate(vector)]
                record |= {f"{name}_{k}_{axis}": repr(float(v)) for k, axis, v in entries}
            else:
                record[name] = value if name == TEXT or name in INTEGERS else repr(float(value))
        if i == 0:
            writer.writerow(record)
        writer.writerow(record.values())
    return text.getvalue()
