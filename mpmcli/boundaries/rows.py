"""Rows of fields that the host writes.

Taichi compiles a kernel for each entry of a field that Python sets by its index, in every process: some 40 ms each.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mpmcli.quick_taichi import ti


@ti.data_oriented
class Rows:
    """Rows of fields with a common first index, written by one kernel; other axes of a field are entries of its row.

    Attributes:
        integers, reals: the fields of numbers, vectors or matrices, each with the column of its first entry.
    """

    def __init__(self, *fields: ti.Field) -> None:
        self._fields = fields
        self.integers, self.reals = (tuple(self._columns(whole)) for whole in (True, False))
        self._real = np.float64 if any(field.dtype == ti.f64 for field in fields) else np.float32

    def _columns(self, whole: bool) -> list[tuple[ti.Field, int]]:
        column, found = 0, []
        for field in (field for field in self._fields if _is_whole(field) == whole):
            found.append((field, column))
            column += math.prod(field.shape[1:]) * len(_entries(field))
        return found

    def write(self, first: int, *values: ArrayLike) -> None:
        """Set the rows from `first` on to values, (rows, ...) for each field."""
        found, tables = [np.asarray(one) for one in values], []
        for whole, dtype in ((True, np.int32), (False, self._real)):
            table = np.zeros((len(found[0]), 1), dtype)
            own = [one for one, field in zip(found, self._fields, strict=True) if _is_whole(field) == whole]
            tables.append(np.hstack([*(one.reshape(len(table), -1).astype(dtype) for one in own), table]))
        self._write(first, *tables)

    def write_all(self, first: int, rows: Sequence[Sequence[ArrayLike]]) -> None:
        """Set the rows from `first` on, each given by a value for each field."""
        if rows:
            self.write(first, *map(list, zip(*rows, strict=True)))

    @ti.kernel
    def _write(self, first: int, integers: ti.types.ndarray(ti.i32, 2), reals: ti.types.ndarray(ndim=2)):
        for line in range(integers.shape[0]):
            for field, column in ti.static(self.integers):
                self._set(field, first + line, integers, line, column)
            for field, column in ti.static(self.reals):
                self._set(field, first + line, reals, line, column)

    @ti.func
    def _set(self, field: ti.template(), row: int, table: ti.template(), line: int, column: ti.template()):
        """Set a row of a field to the numbers of a line of a table from `column` on, entry by entry."""
        d = ti.static(len(field.shape))
        place = ti.Vector.zero(int, d)
        for q in range(ti.static(math.prod(field.shape[1:]))):
            place[0], rest = row, q
            for b in ti.static(range(d - 1)):
                place[d - 1 - b] = rest % ti.static(field.shape[d - 1 - b])
                rest = rest // ti.static(field.shape[d - 1 - b])
            for e, entry in ti.static(enumerate(_entries(field))):
                value = ti.cast(table[line, column + q * ti.static(len(_entries(field))) + e], field.dtype)
                if ti.static(len(entry) == 0):
                    field[place] = value
                elif ti.static(len(entry) == 1):
                    field[place][entry[0]] = value
                else:
                    field[place][entry[0], entry[1]] = value


def _is_whole(field: ti.Field) -> bool:
    return field.dtype == ti.i32


def _entries(field: ti.Field) -> list[tuple[int, ...]]:
    """Return the indices of the entries of an element; () of a number."""
    return list(np.ndindex((field.n, field.m)[: field.ndim] if isinstance(field, ti.MatrixField) else ()))
