"""Dam breaks measured by Martin and Moyce (1952), and the deviation of computed ones."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np

# Range of T that is compared. Earlier the column is nearly at rest; later friction slows the thin front.
FIRST, LAST = 1.0, 4.0
# Height over width of the columns.
N_SQUARED = 2.0
# Candidate time shifts, in units of T.
SHIFTS = np.linspace(0.0, 0.6, 121)


@dataclass(frozen=True)
class Series:
    """One measured curve.

    Attributes:
        name: "i", "ii" or "iii".
        quantity: "front" or "height".
        width: width a of the column, m.
        source: reference of the data.
        T: (n,), dimensionless times n t sqrt(g / a).
        value: (n,), front position over a, or height over n^2 a.
    """

    name: str
    quantity: Literal["front", "height"]
    width: float
    source: str
    T: np.ndarray
    value: np.ndarray

    def compared(self) -> tuple[np.ndarray, np.ndarray]:
        """Return T and value of the points with T from FIRST to LAST."""
        here = (self.T >= FIRST) & (self.T <= LAST)
        return self.T[here], self.value[here]


@lru_cache
def measured(quantity: Literal["front", "height"]) -> tuple[Series, ...]:
    """Return the measured curves of the front or of the height."""
    tables = tomllib.loads(files("mpmcli.validation").joinpath("data/martin_moyce.toml").read_text(encoding="utf-8"))
    return tuple(
        Series(
            row["name"],
            row["quantity"],
            row["width"],
            row["source"],
            np.array(row["T"]) if "T" in row else math.sqrt(N_SQUARED) * np.array(row["tau"]),
            np.array(row["value"]),
        )
        for row in tables["series"]
        if row["quantity"] == quantity
    )


def mean_error(series: Series, T: np.ndarray, value: np.ndarray, shift: float = 0.0) -> float:
    """Return the mean of |value - measured| / measured, for a gate that opens `shift` late.

    Args:
        T, value: (m,), computed curve; must extend to T = LAST.
    """
    times, known = series.compared()
    return float(np.mean(np.abs(np.interp(times - shift, T, value) - known) / known))


def best_shift(curves: Sequence[Series], T: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Return the time shift, in units of T, that minimizes the mean error over the curves, and that error."""
    errors = [np.mean([mean_error(series, T, value, shift) for series in curves]) for shift in SHIFTS]
    best = int(np.argmin(errors))
    return float(SHIFTS[best]), float(errors[best])
