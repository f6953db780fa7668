"""What depends on time in the runs of a batch: integrals by the parts of a run, from which kernels take their means.

The host fills the table of a run with the windows that come next (`scene.quadrature.Mean`); the kernel stops where a
kick would end beyond them.
"""

import math
from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.scene.quadrature import BOUND, COEFFICIENTS, COLUMNS, HALF, LOW, MIDDLE, WINDOWS, Mean

# Rows for each number of a run, and windows that are filled at once.
ROOM, AHEAD = 4096, 8


@ti.data_oriented
class TimeTables:
    """Tables of the numbers of some runs that depend on time.

    Attributes:
        rows: of each table, (runs * numbers, ROOM) Vector(COLUMNS), float64; used: number of its rows.
    """

    def __init__(self, runs: int, numbers: int) -> None:
        self._numbers = numbers
        self.rows = ti.Vector.field(COLUMNS, ti.f64, shape=(runs * numbers, ROOM))
        self.used = ti.field(int, shape=runs * numbers)

    def fill(self, run: int, means: Sequence[Mean], since: float, *, coarse: bool) -> float:
        """Fill the tables of a run with the windows from the time `since`, s, on, as far as they find room.

        Args:
            coarse: whether room must be found for as many windows as a run has, with fewer rows for each.

        Returns:
            The time up to which kernels may take means, s.
        """
        ahead = 2 * WINDOWS if coarse else AHEAD
        horizon = math.inf
        for i, mean in enumerate(means):
            first = k = mean.window_at(since)
            rows: list[np.ndarray] = []
            count, before = 0, 0.0
            while k < first + ahead:
                own = thinned(mean.rows(k), ROOM // (ahead if coarse else 2))
                count += len(own)
                if count > ROOM:
                    break
                rows.append(own.copy())
                rows[-1][:, -1] += before
                before += _integral(own[-1])
                k += 1
            self._write(run * self._numbers + i, np.concatenate(rows))
            horizon = min(horizon, mean.start_of(k))
        return horizon

    @ti.kernel
    def _write(self, table: int, rows: ti.types.ndarray(ti.f64, 2)):
        self.used[table] = rows.shape[0]
        for q in range(rows.shape[0]):
            for k in ti.static(range(COLUMNS)):
                self.rows[table, q][k] = rows[q, k]

    @ti.func
    def part(self, table: int, time: ti.f64):
        """Return the row in which a time, s, lies."""
        low = 0
        high = self.used[table] - 1
        while low < high:
            middle = (low + high + 1) // 2
            if self.rows[table, middle][LOW] <= time:
                low = middle
            else:
                high = middle - 1
        return low

    @ti.func
    def integral(self, table: int, time: ti.f64):
        """Return the integral from the start of the table to a time, s."""
        q = self.part(table, time)
        place = (time - self.rows[table, q][MIDDLE]) / self.rows[table, q][HALF]
        result = self.rows[table, q][COEFFICIENTS]
        for k in ti.static(range(COEFFICIENTS + 1, COLUMNS)):
            result = result * place + self.rows[table, q][k]
        return result

    @ti.func
    def mean(self, table: int, start: ti.f64, end: ti.f64):
        """Return the mean between two times, s."""
        return (self.integral(table, end) - self.integral(table, start)) / (end - start)

    @ti.func
    def largest(self, table: int, start: ti.f64, end: ti.f64):
        """Return a bound on |value| between two times, s; what lies beyond the table does not count."""
        q = self.part(table, start)
        result = self.rows[table, q][BOUND]
        for k in range(q + 1, self.part(table, end) + 1):
            result = ti.max(result, self.rows[table, k][BOUND])
        return result


def _integral(row: np.ndarray) -> float:
    """Return the integral to the end of a row, from the start of its window."""
    return float(row[COEFFICIENTS:].sum())


def thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many rows for those of a window: neighbours are joined, and the integral is linear in each."""
    if len(rows) <= most:
        return rows
    first = np.arange(0, len(rows), -(-len(rows) // most))
    end = rows[-1, MIDDLE] + rows[-1, HALF]
    low = rows[first, LOW]
    high = np.append(low[1:], end)
    # The integral at the start of each, by its polynomial at -1.
    signs = (-1.0) ** np.arange(COLUMNS - COEFFICIENTS)[::-1]
    before = rows[first, COEFFICIENTS:] @ signs
    after = np.append(before[1:], _integral(rows[-1]))
    joined = np.zeros((len(first), COLUMNS))
    joined[:, LOW], joined[:, MIDDLE], joined[:, HALF] = low, 0.5 * (low + high), 0.5 * (high - low)
    joined[:, BOUND] = np.maximum.reduceat(rows[:, BOUND], first)
    joined[:, -2], joined[:, -1] = 0.5 * (after - before), 0.5 * (after + before)
    return joined
