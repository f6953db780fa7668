"""A column of water that is let go, beside three measured ones (Martin and Moyce 1952): validation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.tables import Tables, body, box, fluid, problem, reference_data

# Range of T that is compared. Earlier the column is nearly at rest; later friction slows the thin front.
FIRST, LAST = 1.0, 4.0
# Height over width of the columns.
N_SQUARED = 2.0
# Candidate time shifts, in units of T.
SHIFTS = np.linspace(0.0, 0.6, 121)
# a of the larger column, m.
WIDTH = 0.05715
GRAVITY, DENSITY = 9.81, 1000.0
# The front is where all but this share of the water is behind: what is left is a film thinner than a particle.
FILM = 0.001
# The height at the back is that of the highest water within this part of the width.
BACK = 1 / 8


@dataclass(frozen=True)
class Series:
    """One measured curve: front position over the width a of the column, or height over n^2 a, at n t sqrt(g / a)."""

    name: str
    quantity: Literal["front", "height"]
    width: float
    source: str
    T: np.ndarray
    value: np.ndarray


@lru_cache
def measured(quantity: Literal["front", "height"]) -> tuple[Series, ...]:
    """Return the measured curves of the front or of the height."""
    found = []
    for row in reference_data("martin_moyce")["series"]:
        T = np.array(row["T"]) if "T" in row else math.sqrt(N_SQUARED) * np.array(row["tau"])
        found.append(Series(row["name"], row["quantity"], row["width"], row["source"], T, np.array(row["value"])))
    return tuple(series for series in found if series.quantity == quantity)


def mean_error(series: Series, T: np.ndarray, value: np.ndarray, shift: float = 0.0) -> float:
    """Return the mean of |value - measured| / measured of a curve to T = LAST, for a gate that opens `shift` late."""
    here = (series.T >= FIRST) & (series.T <= LAST)
    known = series.value[here]
    return float(np.mean(np.abs(np.interp(series.T[here] - shift, T, value) - known) / known))


def best_shift(curves: Sequence[Series], T: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Return the time shift, in units of T, that minimizes the mean error over the curves, and that error."""
    errors = [np.mean([mean_error(series, T, value, shift) for series in curves]) for shift in SHIFTS]
    best = int(np.argmin(errors))
    return float(SHIFTS[best]), float(errors[best])


class DamBreak(Case):
    """A column a wide and 2 a high at rest, its pressure hydrostatic, whose gate is gone at t = 0; no friction."""

    text = case_text("dam_break")
    name, title, group = "dam_break", "Dam break against the columns of Martin and Moyce", "fluids"
    levels = {"coarse": (16,), "default": (16, 32, 64), "fine": (16, 32, 64, 96)}  # noqa: RUF012
    measures = (
        text.measure("shifted front error", 0.02),
        text.measure("time shift (T)", 0.3),
        text.measure("front error", 0.15),
        text.measure("series i", 0.15),
        text.measure("series ii", 0.15),
        text.measure("series iii", 0.15),
        text.measure("height error", 0.021),
    )

    def tables(self, n: int) -> Tables:
        h = WIDTH / n
        across, up = 13 * n // 2, 5 * n // 2
        column = box([0.0, 0.0], [WIDTH, N_SQUARED * WIDTH])
        return problem(
            {"size": [across * h, up * h], "cells": [across, up], "gravity": [0.0, -GRAVITY], "walls": "separate"},
            (LAST / math.sqrt(N_SQUARED * GRAVITY / WIDTH), 80),
            "velocity",
            [body("water", fluid(DENSITY, "auto"), column, initial_pressure="hydrostatic")],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, fronts, heights = [], [], []
        for frame, _ in frames:
            x, y = frame.position.astype(np.float64).T
            # Half the edge of a particle.
            reach = WIDTH * math.sqrt(N_SQUARED / len(x)) / 2
            times.append(frame.time)
            fronts.append((np.quantile(x, 1 - FILM) + reach) / WIDTH)
            heights.append((y[x < BACK * WIDTH].max() + reach) / (N_SQUARED * WIDTH))
        T = np.array(times) * math.sqrt(N_SQUARED * GRAVITY / WIDTH)
        front = np.array(fronts)
        curves = measured("front")
        errors = {f"series {series.name}": mean_error(series, T, front) for series in curves}
        shift, left = best_shift(curves, T, front)
        (height,) = measured("height")
        return {
            "shifted front error": left,
            "time shift": shift,
            "front error": float(np.mean(list(errors.values()))),
            **errors,
            "height error": mean_error(height, T, np.array(heights)),
        }


CASES = (DamBreak(),)
