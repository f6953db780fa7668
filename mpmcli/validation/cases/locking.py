"""Problems that lock where changes of volume are not averaged over cells: Cook's membrane, and Prandtl's punch."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic
from mpmcli.validation.plane_strain import deflection
from mpmcli.validation.quasi_static import smooth_ramp, window_weights

# Cook's membrane: corners, m, Young's modulus, Pa, and Poisson's ratio.
CORNERS = (0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0)
YOUNG, RATIO, DENSITY = 250.0, 0.499, 1e-3
SHEAR, LAME = YOUNG / (2 * (1 + RATIO)), YOUNG * RATIO / ((1 + RATIO) * (1 - 2 * RATIO))
# Width of the strip that is pulled, m, and the force on it over its area, N/m^2.
STRIP, PULL = 2.0, 0.2
# About the first period, s. In such periods: the ramp, and the window of the mean.
PERIOD = 7 * CORNERS[1][0] / math.sqrt(SHEAR / DENSITY)
RAMP, WINDOW, FRAMES_PER_PERIOD = 3, 2, 24
# Prandtl's punch: half of its width and the extent of the clay, m; undrained strength, stiffness, Pa, and density.
HALF, WIDE, DEEP = 1.0, 5.0, 3.0
STRENGTH, STIFFNESS, CLAY = 1e4, 1e7, 2000.0
# How far and how fast the punch goes, m and s, and the part of its way over which the load is averaged.
PUSH, TIME, LOOKED_AT = 0.04, 2.0, 0.5


class Membrane(Case):
    """A clamped trapezium of nearly incompressible material, pulled upwards along its right side."""

    name = "cook"
    title = "Cook's membrane, nearly incompressible"
    group = "solids"
    source = "Cook 1974; reference by biquadratic finite elements of our own (validation/plane_strain.py)"
    resolution = "cells along the right side"
    varies = ("precision",)
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    measures = (
        Measure(
            "deflection",
            "",
            "Deflection of the middle of the right side over that of the reference, less 1.",
            bound=lambda n: 1.3 * 0.24 / n,
            order=0.8,
        ),
    )
    note = (
        "nu = 0.499. The body has sloped sides, which a lattice of particles follows to half of a spacing. Without "
        "F-bar the deflection is 8.0 and 3.8 % too small at 8 and 16 cells, in place of 2.7 and 1.5 %."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h, periods = 16 / n, RAMP + WINDOW
        start = CORNERS[1][0] - STRIP
        pull = f"{PULL / DENSITY!r} * {smooth_ramp(RAMP * PERIOD)} if X > {start!r} else 0"
        return {
            "domain": {"size": [56.0, 64.0], "spacing": h, "walls": {"default": "slip", "x_min": "stick"}},
            "time": {"end": periods * PERIOD, "frames": periods * FRAMES_PER_PERIOD},
            "output": {"fields": ["initial_position"]},
            "bodies": [
                {
                    "name": "membrane",
                    "material": elastic("neo_hookean", DENSITY, YOUNG, RATIO),
                    "shape": {"polygon": {"vertices": [list(corner) for corner in CORNERS]}},
                }
            ],
            "forces": [{"name": "load", "acceleration": [0.0, pull]}],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        h = scene.domain.spacing
        weights = iter(window_weights(WINDOW * FRAMES_PER_PERIOD + 1))
        middle = (CORNERS[1][1] + CORNERS[2][1]) / 2
        moved = 0.0
        for frame, _ in frames:
            if frame.index < RAMP * FRAMES_PER_PERIOD:
                continue
            start = frame.fields["initial_position"].astype(np.float64)
            near = (start[:, 0] > CORNERS[1][0] - h / 2) & (np.abs(start[:, 1] - middle) < 1.01 * h)
            moved += next(weights) * float((frame.position[near, 1] - start[near, 1]).mean())
        return {"deflection": moved / deflection(CORNERS, (PULL, CORNERS[1][0] - STRIP), SHEAR, LAME) - 1}


class Punch(Case):
    """A strip of the surface of weightless clay is pushed in by springs; half of it, beside a plane of symmetry."""

    name = "prandtl"
    title = "Prandtl's punch: the bearing capacity of clay"
    group = "plastic"
    source = "Prandtl 1920: the load is (2 + pi) c, exact for rigid, perfectly plastic material"
    resolution = "cells in half of the width of the punch"
    varies = ("precision",)
    f_bar = True
    levels = {"coarse": (4, 8), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    measures = (
        Measure(
            "load",
            "",
            f"Load on the punch over its width and (2 + pi) c, less 1: mean over the last {LOOKED_AT:.0%} of its way.",
            bound=lambda n: 1.4 / n,
            order=0.6,
        ),
    )
    note = (
        "The grid spreads the discontinuity at the edge of the punch over a cell, so that the punch is about half a "
        "cell wider on each side: first order, 3.8 % at 32 cells. Without F-bar the load is 25 % too large at 8 cells, "
        "in place of 13 %."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = HALF / n
        push = f"{self.spring(h)!r} * (Y - y - {PUSH / TIME!r} * t) if X < {HALF!r} and Y > {DEEP - h!r} else 0"
        material = elastic("von_mises", CLAY, STIFFNESS, 0.49, yield_stress=math.sqrt(3) * STRENGTH)
        return {
            "domain": {"size": [WIDE, DEEP + 1.0], "spacing": h, "walls": {"default": "slip", "y_min": "stick"}},
            "time": {"end": TIME, "frames": 80},
            "output": {"fields": ["initial_position", "mass"]},
            "bodies": [
                {"name": "clay", "material": material, "shape": {"box": {"min": [0.0, 0.0], "max": [WIDE, DEEP]}}}
            ],
            "forces": [{"name": "punch", "acceleration": [0.0, push]}],
        }

    @staticmethod
    def spring(h: float) -> float:
        """Return the acceleration per displacement, 1/s^2, of the top layer of cells: c stretches it by PUSH / 400."""
        return 400 * STRENGTH / (CLAY * PUSH * h)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        h, loads = scene.domain.spacing, []
        for frame, _ in frames:
            if frame.time <= (1 - LOOKED_AT) * TIME:
                continue
            start = frame.fields["initial_position"].astype(np.float64)
            pushed = (start[:, 0] < HALF) & (start[:, 1] > DEEP - h)
            stretched = start[pushed, 1] - frame.position[pushed, 1] - PUSH / TIME * frame.time
            loads.append(-self.spring(h) * frame.fields["mass"][pushed] @ stretched)
        return {"load": float(np.mean(loads)) / (HALF * (2 + math.pi) * STRENGTH) - 1}


CASES = (Membrane(), Punch())
