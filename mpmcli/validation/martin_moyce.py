"""The dam breaks that Martin and Moyce measured in 1952, and how far a computed one is from them."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np

# Where they are compared: before, the column hardly moves; after, the tongue is a film that friction holds back.
FIRST, LAST = 1.0, 4.0
# Height over width of the columns.
N_SQUARED = 2.0
# The time shifts that are tried, in T.
SHIFTS = np.linspace(0.0, 0.6, 121)


@dataclass(frozen=True)
class Series:
    """One measured curve.

    Attributes:
        name: "i", "ii" or "iii"; quantity: "front" or "height".
        width: a, of the column, m.
        source: where the numbers were read.
        T: (n,) times n t sqrt(g / a); value: (n,) the front over a, or the height over n^2 a.
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
    """Return the mean of |value - measured| / measured, for a gate that lets go `shift` late.

    Args:
        T, value: (m,) the computed curve, up to T = LAST at least.
    """
    times, known = series.compared()
    return float(np.mean(np.abs(np.interp(times - shift, T, value) - known) / known))


def best_shift(curves: Sequence[Series], T: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Return the one time shift with which the curves agree best on average, in T, and the mean error left."""
    errors = [np.mean([mean_error(series, T, value, shift) for series in curves]) for shift in SHIFTS]
    best = int(np.argmin(errors))
    return float(SHIFTS[best]), float(errors[best])
