"""Maxima that many threads of a GPU raise, stored as integers in the order of floats.

GPUs have an atomic maximum of integers. Taichi repeats one of floats in each thread until no other thread interferes:
on an H100 the update of nodes took three times as long.
"""

import numpy as np

from mpmcli.quick_taichi import ti


@ti.data_oriented
class Maxima:
    """Maxima in the precision of particles, in rows; NaN exceeds all numbers."""

    def __init__(self, rows: int, columns: int) -> None:
        double = ti.lang.impl.get_runtime().default_fp == ti.f64
        self.integer, self.dtype = (ti.i64, np.float64) if double else (ti.i32, np.float32)
        self.field = ti.field(self.integer, shape=(rows, columns))

    @ti.func
    def ordered(self, value: float):
        """Return a number as an integer: the bits of its absolute value, with its sign."""
        bits = ti.bit_cast(ti.abs(value), self.integer)
        return ti.select(value < 0.0, -bits, bits)

    @ti.func
    def reset(self, row: int, column: int, value: float):
        """Set a maximum, which no other thread may access."""
        self.field[row, column] = self.ordered(value)

    @ti.func
    def include(self, row: int, column: int, value: float):
        """Raise a maximum to a number if it is below."""
        bits = self.ordered(value)
        # The comparison may use an old value; it avoids most atomic operations.
        if bits > self.field[row, column]:
            ti.atomic_max(self.field[row, column], bits)

    @ti.func
    def value(self, row: int, column: int):
        """Return a maximum."""
        bits = self.field[row, column]
        number = ti.bit_cast(ti.abs(bits), float)
        return ti.select(bits < 0, -number, number)

    def to_numpy(self) -> np.ndarray:
        """Return all maxima."""
        bits = self.field.to_numpy()
        return np.copysign(np.abs(bits).view(self.dtype), bits)
