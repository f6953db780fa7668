"""Snow pressed together in a shaft: the closed form of its confined compression (Stomakhin et al. 2013)."""

from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

DENSITY, DEPTH = 400.0, 1.0
YOUNG, NU, COMPRESSION, HARDENING = 1.4e5, 0.2, 0.025, 10.0
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
# Gravity grows to this, m/s^2, within so long, s, many times as long as a wave takes there and back: the lowest snow
# ends at 0.8 of its height, the last row of the table.
PULL, DURATION = 70.0, 3.0
STRIP = 5


def confined_stress(stretch: np.ndarray) -> np.ndarray:
    """Return the Cauchy stress along the axis at a stretch below 1, Pa (docs/theory.md, 5.6).

    sigma = exp(xi (1 - J_P)) (2 mu (s - 1) s + lambda (J_E - 1) J_E) / J with the elastic stretch s = J_E, which is
    the stretch up to the critical compression, and J_P what is left of J.
    """
    s = np.maximum(stretch, 1 - COMPRESSION)
    return np.exp(HARDENING * (1 - stretch / s)) * (2 * MU + LAMBDA) * (s - 1) * s / stretch


class SnowOedometer(Case):
    """A shaft of snow between slip walls, in which gravity grows slowly: every height is at another compression."""

    name = "snow_oedometer"
    varies = ("precision", "kernel", "transfer")
    title = "Snow pressed together in a shaft"
    group = "plastic"
    source = "Stomakhin et al. 2013 (ACM TOG 32:102), in confined compression"
    resolution = "cells along the shaft"
    levels = {"coarse": (12,), "default": (12, 24), "fine": (12, 24, 48)}  # noqa: RUF012
    measures = (
        Measure(
            "stress error",
            "",
            "Stress along the axis over the closed form at the stretch of the row, less 1: the largest of all rows.",
            bound=lambda n: 0.0065,
        ),
        Measure(
            "weight error",
            "",
            "Stress along the axis less the weight of the snow above, L2 over the rows, over that of the weight.",
            bound=lambda n: min(0.02, 0.32 / n),
        ),
        Measure(
            "height error",
            "",
            "Height of the shaft over that of the closed form under its own weight, less 1.",
            bound=lambda n: 9e-4,
        ),
        Measure(
            "shear stress",
            "",
            "Largest shear stress of a row over the weight of all the snow: confinement alone makes none.",
            bound=lambda n: 1e-12,
        ),
        Measure("stretch at the base", "", "Height over that at the start, of the lowest row."),
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = DEPTH / n
        return {
            "domain": {
                "size": [STRIP * h, (n + 3) * h],
                "cells": [STRIP, n + 3],
                "gravity": [0.0, f"-{PULL!r} * t / {DURATION!r}"],
                "walls": "slip",
            },
            "time": {"end": DURATION, "frames": 1},
            "output": {"fields": ["velocity", "stress", "volume_ratio", "initial_position"]},
            "bodies": [
                {
                    "name": "snow",
                    "material": elastic(
                        "snow", DENSITY, YOUNG, NU, critical_compression=COMPRESSION, hardening=HARDENING
                    ),
                    "shape": {"box": {"min": [0.0, 0.0], "max": [STRIP * h, DEPTH]}},
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for frame, _ in frames:
            last = frame
        everything = last.fields["stress"].astype(np.float64)
        Y = last.fields["initial_position"][:, 1].astype(np.float64)
        rows, row = np.unique(np.round(Y, 9), return_inverse=True)
        stress = np.bincount(row, everything[:, 4]) / np.bincount(row)
        shear = np.bincount(row, everything[:, 1]) / np.bincount(row)
        stretch = np.bincount(row, last.fields["volume_ratio"]) / np.bincount(row)
        top = np.bincount(row, last.position[:, 1]) / np.bincount(row)
        weight = -DENSITY * PULL * (DEPTH - rows)
        known = confined_height(rows[-1])
        return {
            "stress error": float(np.abs(stress / confined_stress(stretch) - 1).max()),
            "weight error": float(np.linalg.norm(stress - weight) / np.linalg.norm(weight)),
            "height error": float(top[-1] / known - 1),
            "shear stress": float(np.abs(shear).max() / (DENSITY * PULL * DEPTH)),
            "stretch at the base": float(stretch[0]),
        }


def confined_height(Y: float, points: int = 2000) -> float:
    """Return the height of the snow that began at Y, m, under the weight of what is above.

    The stretch at each height is where the closed form, which grows with compression, reaches the weight.
    """
    stretch = np.linspace(1.0, 0.7, 20001)
    heights = (np.arange(points) + 0.5) * Y / points
    found = np.interp(DENSITY * PULL * (DEPTH - heights), -confined_stress(stretch), stretch)
    return float(found.mean() * Y)


CASES = (SnowOedometer(),)
