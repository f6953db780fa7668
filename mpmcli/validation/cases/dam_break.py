"""Dam breaks against experiments: columns (Martin and Moyce 1952), and an obstacle (Kleefsman et al. 2005)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, box, fluid, problem, reference_data

# Compared range of T. Earlier the column is nearly at rest; later friction slows the thin front.
FIRST, LAST = 1.0, 4.0
# Height over width of the columns.
N_SQUARED = 2.0
# Candidate time shifts, in units of T.
SHIFTS = np.linspace(0.0, 0.6, 121)
# a of the larger column, m.
COLUMN = 0.05715
GRAVITY, DENSITY = 9.81, 1000.0
# Fraction of the water ahead of the front, which consists of drops and a film.
FILM = 0.001
# The height at the back is that of the highest water within this fraction of the width.
BACK = 1 / 8


@dataclass(frozen=True)
class Series:
    """One measured curve: front position over the width a of the column, or height over n^2 a, at n t sqrt(g / a)."""

    name: str
    quantity: Literal["front", "height"]
    T: np.ndarray
    value: np.ndarray


@lru_cache
def measured(quantity: Literal["front", "height"]) -> tuple[Series, ...]:
    """Return the measured curves of the front or of the height."""
    found = []
    for row in reference_data("martin_moyce")["series"]:
        T = np.array(row["T"]) if "T" in row else math.sqrt(N_SQUARED) * np.array(row["tau"])
        found.append(Series(row["name"], row["quantity"], T, np.array(row["value"])))
    return tuple(series for series in found if series.quantity == quantity)


def mean_error(series: Series, T: np.ndarray, value: np.ndarray, shift: float = 0.0) -> float:
    """Return the mean of |value - measured| / measured from T = FIRST to LAST, for a gate that opens `shift` late."""
    here = (series.T >= FIRST) & (series.T <= LAST)
    known = series.value[here]
    return float(np.mean(np.abs(np.interp(series.T[here] - shift, T, value) - known) / known))


def best_shift(curves: Sequence[Series], T: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Return the time shift, in units of T, that minimizes the mean error over the curves, and that error."""
    errors = [np.mean([mean_error(series, T, value, shift) for series in curves]) for shift in SHIFTS]
    best = int(np.argmin(errors))
    return float(SHIFTS[best]), float(errors[best])


class DamBreak(Case):
    """A column of width a and height 2 a at rest with hydrostatic pressure, released at t = 0 without friction."""

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
        h = COLUMN / n
        across, up = 13 * n // 2, 5 * n // 2
        column = box([0.0, 0.0], [COLUMN, N_SQUARED * COLUMN])
        return problem(
            {"size": [across * h, up * h], "cells": [across, up], "gravity": [0.0, -GRAVITY], "walls": "separate"},
            (LAST / math.sqrt(N_SQUARED * GRAVITY / COLUMN), 80),
            "velocity",
            [body("water", fluid(DENSITY, "auto"), column, initial_pressure="hydrostatic")],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of front and height against the measured curves, in units of the column and its time."""
        times, fronts, heights = [], [], []
        for frame, _ in frames:
            x, y = frame.position.astype(np.float64).T
            # Half the edge of a particle.
            reach = COLUMN * math.sqrt(N_SQUARED / len(x)) / 2
            times.append(frame.time)
            fronts.append((np.quantile(x, 1 - FILM) + reach) / COLUMN)
            heights.append((y[x < BACK * COLUMN].max() + reach) / (N_SQUARED * COLUMN))
        T = np.array(times) * math.sqrt(N_SQUARED * GRAVITY / COLUMN)
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


# Dimensions of the tank, m; start and depth of the water, m.
LENGTH, WIDTH, HEIGHT = 3.22, 1.0, 1.0
DAM, DEPTH = 1.992, 0.55
# Two corners of the obstacle, a box on the floor, m.
LOWER, UPPER = (0.6635, 0.2955), (0.8245, 0.6985, 0.161)
# End of the run, s; later, water reflected by the walls falls back.
END = 0.8
# Compared gauges, in the middle of the width, m.
GAUGES = ("H2", "H3", "H4")
MIDDLE = 0.5
# Height at which the water has arrived at a gauge, m. A dry gauge reads up to 1.5 mm.
WET = 0.01
# Half the width of the columns in which the water of a simulation is measured, m.
HALF_WIDTH = 1 / 16
# Face of the obstacle that the front hits, m; speed of the front, m/s, from its times at x = 1.488 and 0.992 m; time of
# impact, s.
FACE = 0.8245
SPEED = (1.488 - 0.992) / (0.358 - 0.194)
IMPACT = 0.358 + (0.992 - FACE) / SPEED


@dataclass(frozen=True)
class Gauge:
    """Position of a gauge, m, first time with a height above WET, s, and heights, m, at times, s, (n,) each."""

    x: float
    arrival: float
    time: np.ndarray
    height: np.ndarray

    def mean_error(self, time: np.ndarray, height: np.ndarray, last: float) -> float:
        """Return the mean of |height - measured| from the arrival to time `last`, over the mean measured height."""
        here = (self.time > self.arrival) & (self.time <= last * (1 + 1e-9))
        known = self.height[here]
        return float(np.mean(np.abs(np.interp(self.time[here], time, height) - known)) / np.mean(known))


@lru_cache
def measured_gauges() -> dict[str, Gauge]:
    """Return the gauges by name, H1 to H4."""
    tables = reference_data("kleefsman")
    time = np.array(tables["time"])
    return {row["name"]: Gauge(row["x"], row["arrival"], time, np.array(row["height"])) for row in tables["gauge"]}


def water_height(position: np.ndarray, x: float, volume: float, reach: float = HALF_WIDTH) -> float:
    """Return the height of the water in a column, m: volume over area, so that a single drop contributes little.

    The weight of a particle is a hat function along both axes, 1 at the gauge and 0 at the distance `reach`, m, so that
    the height is continuous. All particles have the same volume, m^3.
    """
    off = np.abs(position[:, :2] - [x, MIDDLE]) / reach
    return volume * float(np.prod(np.maximum(1 - off, 0.0), axis=1).sum()) / reach**2


def impact(time: np.ndarray, front: np.ndarray) -> float:
    """Return the time at which the front, which comes from larger x, reaches the obstacle, s."""
    return float(np.interp(-FACE, -front, time))


def arrival(time: np.ndarray, value: np.ndarray, level: float = WET) -> float:
    """Return the time at which a curve, such as the height at a gauge, first exceeds a level, s; nan if never."""
    above = value > level
    if not above.any():
        return math.nan
    k = int(np.argmax(above))
    return float(np.interp(level, value[k - 1 : k + 1], time[k - 1 : k + 1])) if k else float(time[0])


class DamBreakObstacle(Case):
    """Water at rest at one end of a tank with hydrostatic pressure, released at t = 0 without friction."""

    text = case_text("dam_break_obstacle")
    name, title, group = "dam_break_obstacle", "Dam break on an obstacle, SPHERIC test 2", "fluids"
    levels = {"coarse": (16,), "default": (16, 24, 32), "fine": (16, 24, 32, 40)}  # noqa: RUF012
    measures = (
        text.measure("height error", 0.2),
        text.measure("height error H2", 0.2),
        text.measure("height error H3", lambda n: 0.25 + 2 / n),
        text.measure("height error H4", 0.02),
        text.measure("arrival H3 (s)", 0.06),
        text.measure("arrival H2 (s)", 0.02),
        text.measure("impact (s)", 0.02),
        text.measure("first force (s)", 0.03),
        text.measure("peak (s)", 0.12),
        text.measure("largest force", 2.0),
        # Rounding affects which drop penetrates deepest.
        text.measure("depth in the box (h)", 0.5, rounding=0.5),
    )
    varies = ("precision",)

    def tables(self, n: int) -> Tables:
        """Return the tank, n cells wide, with the water behind the gate and the obstacle."""
        h = WIDTH / n
        along, up = math.ceil(LENGTH / h - 1e-9), math.ceil(HEIGHT / h - 1e-9)
        column = box([DAM, 0.0, 0.0], [LENGTH, WIDTH, DEPTH])
        return problem(
            {
                # The excess length of whole cells lies behind the obstacle.
                "origin": [LENGTH - along * h, 0.0, 0.0],
                "size": [along * h, WIDTH, up * h],
                "cells": [along, n, up],
                "gravity": [0.0, 0.0, -GRAVITY],
                "walls": "separate",
            },
            (END, 80),
            "velocity",
            [body("water", fluid(DENSITY, "auto"), column, initial_pressure="hydrostatic")],
            # The obstacle extends below the floor, so that it covers the nodes of the floor below it.
            colliders=[{"name": "obstacle", "shape": box([*LOWER, -2 * h], UPPER)}],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of heights, arrivals, s, and impact, s, the force, and how deep water enters the obstacle."""
        gauges = {name: measured_gauges()[name] for name in GAUGES}
        times, fronts, forces, heights, deepest = [], [], [], [], 0.0
        for frame, row in frames:
            place = frame.position.astype(np.float64)
            volume = (LENGTH - DAM) * WIDTH * DEPTH / len(place)
            times.append(frame.time)
            fronts.append(np.quantile(place[:, 0], FILM))
            forces.append(-row.collider_force[0][0])
            heights.append([water_height(place, gauge.x, volume) for gauge in gauges.values()])
            deepest = max(deepest, float(np.minimum(place - [*LOWER, -math.inf], UPPER - place).min(axis=1).max()))
        time, force = np.array(times), np.array(forces)
        curves = dict(zip(gauges, np.array(heights).T, strict=True))
        errors = [gauge.mean_error(time, curves[name], END) for name, gauge in gauges.items()]
        # Forces are means since the previous frame.
        middle = time - END / (2 * (len(time) - 1))
        face = (UPPER[1] - LOWER[1]) * UPPER[2]
        # The force stays near its peak for 0.1 s, where frames differ by a fifth: a mean of three has a definite peak.
        smooth = np.convolve(force, np.ones(3) / 3, "same")
        return {
            "height error": float(np.mean(errors)),
            **{f"height error {name}": error for name, error in zip(gauges, errors, strict=True)},
            **{f"arrival {name}": arrival(time, curves[name]) - gauges[name].arrival for name in ("H3", "H2")},
            "impact": impact(time, np.array(fronts)) - IMPACT,
            "first force": arrival(middle, force, force.max() / 10) - IMPACT,
            "peak": float(middle[np.argmax(smooth)]) - IMPACT,
            "largest force": float(smooth.max()) / (DENSITY * SPEED**2 / 2 * face),
            "depth in the box": deepest * n / WIDTH,
        }
