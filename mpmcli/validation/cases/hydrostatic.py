"""A column of water in a shaft: at rest under its own pressure, and let go without any."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure

HEIGHT, DENSITY, GRAVITY = 1.0, 1000.0, 9.81
WEIGHT = DENSITY * GRAVITY * HEIGHT
SHAFT = 8
FRAMES_PER_PERIOD = 40
# Terms of the series of a triangle; the first one left out has 1e-6 of the first.
TERMS = 500


def column(n: int, modulus: float, end: float, frames: int, body: dict[str, Any]) -> dict[str, Any]:
    """Return the tables of a column of n cells in a shaft with slip walls."""
    h = HEIGHT / n
    return {
        "domain": {
            "size": [SHAFT * h, HEIGHT + 4 * h],
            "cells": [SHAFT, n + 4],
            "gravity": [0.0, -GRAVITY],
            "walls": "slip",
        },
        "time": {"end": end, "frames": frames},
        "output": {"fields": ["velocity", "pressure", "volume_ratio", "initial_position"]},
        "bodies": [
            {
                "name": "water",
                "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": modulus},
                "shape": {"box": {"min": [0.0, 0.0], "max": [SHAFT * h, HEIGHT]}},
                **body,
            }
        ],
    }


class Hydrostatic(Case):
    """p = density g (H - Y) from the start, and nothing moves."""

    name = "hydrostatic"
    title = "Hydrostatic column"
    group = "fluids"
    source = "docs/theory.md, 10, with c = 10 sqrt(2 g H)"
    resolution = "cells along the height"
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    modulus = 100 * 2 * WEIGHT
    end, frames = 2.0, 40
    measures = (
        Measure(
            "pressure error",
            "",
            "Relative L2 error of J p over all particles, the largest of all frames in 2 s.",
            bound=lambda n: 6e-4 * (32 / n) ** 1.5,
            order=1.4,
            expected=1.5,
        ),
        Measure(
            "resting speed",
            "sqrt(g H)",
            "Largest speed of a particle in any frame.",
            bound=lambda n: 6.5e-6 * (32 / n) ** 1.3,
        ),
        Measure(
            "row spread",
            "density g H",
            "Root mean square deviation of the pressure from the mean of its row of particles.",
            bound=lambda n: 1e-12,
        ),
    )
    note = (
        "Particles start evenly spaced, with the mass of their spacing, so that it is J p, their force per volume of "
        "that spacing, which carries the weight; the field `pressure` is p, larger by 1/J, 0.39 % in L2. The error is "
        "that of the topmost cell, where the kernel is not full: 5 % of density g h on a share h/H of the particles is "
        "order 3/2; in the cells below it is five times smaller and less."
    )

    def tables(self, n: int) -> dict[str, Any]:
        still = {"initial_pressure": "hydrostatic"}
        return column(n, self.modulus, self.end, self.frames, still)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        errors, speeds, spreads = [], [], []
        for frame, row in frames:
            Y = frame.fields["initial_position"][:, 1].astype(np.float64)
            pressure = frame.fields["pressure"].astype(np.float64)
            exact = WEIGHT * (1 - Y / HEIGHT)
            errors.append(np.linalg.norm(pressure * frame.fields["volume_ratio"] - exact) / np.linalg.norm(exact))
            speeds.append(row.speed_max)
            spreads.append(np.std(pressure - row_means(Y, pressure)))
        return {
            "pressure error": float(max(errors)),
            "resting speed": max(speeds) / math.sqrt(GRAVITY * HEIGHT),
            "row spread": float(max(spreads)) / WEIGHT,
        }


def row_means(Y: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return, for each particle, (n,), the mean of the values of all that began at its height."""
    _, rows = np.unique(np.round(Y, 6), return_inverse=True)
    return (np.bincount(rows, values) / np.bincount(rows))[rows]


class HydrostaticDrop(Case):
    """Gravity switched on at t = 0: the base feels a triangle between 0 and 2 density g H, of period 4 H/c."""

    name = "hydrostatic_drop"
    varies = ("precision", "transfer", "walls")
    title = "Column of water let go"
    group = "fluids"
    source = "d'Alembert's solution of the linear column"
    resolution = "cells along the height"
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    # Stiff, so that the column is nearly linear: its weight at rest compresses it by 0.1 % at the base. Sound runs as
    # much faster as it is compressed, by half of that along each characteristic, whenever that starts.
    modulus = 1000 * WEIGHT
    period = 4 * HEIGHT / math.sqrt(modulus / DENSITY) * (1 - WEIGHT / modulus / 2)
    periods = 3
    measures = (
        Measure(
            "pressure error",
            "",
            "Mean of |p - exact| over all particles and three periods, over density g H.",
            bound=lambda n: 0.02 * 16 / n,
            order=0.9,
            expected=1.0,
        ),
        Measure(
            "period error",
            "",
            "Period of the pressure at the base over 4 H/c (1 - density g H/2K), less 1.",
            bound=lambda n: 1.5e-4 + 2.3e-3 * (16 / n) ** 2,
        ),
        Measure(
            "peak error",
            "",
            "Largest pressure of the lowest particles over the exact one, less 1.",
            bound=lambda n: 0.04 * (16 / n) ** (2 / 3),
            expected=2 / 3,
        ),
    )
    note = (
        "The triangle has a corner, and a grid that lets short waves lag (by a third derivative) rounds it over a "
        "width of h^(2/3), so that the peak is reached at that order."
    )

    def tables(self, n: int) -> dict[str, Any]:
        end, frames = self.periods * self.period, FRAMES_PER_PERIOD * self.periods
        return column(n, self.modulus, end, frames, {})

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, base, exact_base, errors = [], [], [], []
        odd = 2 * np.arange(TERMS) + 1
        share = None
        for frame, _ in frames:
            if share is None:
                Y, row = np.unique(np.round(frame.fields["initial_position"][:, 1], 6), return_inverse=True)
                share = 8 / (np.pi * odd) ** 2 * np.cos(odd * np.pi * Y[:, None] / (2 * HEIGHT))
            exact = 1 - Y / HEIGHT - share @ np.cos(2 * np.pi * odd * frame.time / self.period)
            pressure = frame.fields["pressure"].astype(np.float64) / WEIGHT
            errors.append(np.abs(pressure - exact[row]).mean())
            times.append(frame.time)
            base.append(pressure[row == 0].mean())
            exact_base.append(exact[0])
        # The phase of the first harmonic, period by period: the others of a triangle are orthogonal to it there.
        turns = np.exp(-2j * math.pi / self.period * np.array(times[1:])) * base[1:]
        phases = turns.reshape(self.periods, -1).mean(1)
        lead = np.angle(phases[-1] / phases[0]) / (2 * math.pi * (self.periods - 1))
        return {
            "pressure error": float(np.mean(errors)),
            "period error": float(1 / (1 + lead) - 1),
            "peak error": max(base) / max(exact_base) - 1,
        }


CASES = (Hydrostatic(), HydrostaticDrop())
