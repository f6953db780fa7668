"""Free bodies that spin and ring: momenta and energy over thousands of steps (docs/theory.md, 10)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Level, Measure, elastic

FRAMES = 200
DENSITY, YOUNG, POISSON = 1000.0, 1e4, 0.3
EDGE, RADIUS = 0.5, 0.3
# Spin and strain rate at the start, 1/s: the strain reaches a few per cent, and bodies turn by some turns.
SPIN, RATE = 1.5, 0.5
DRIFT = (0.004, -0.003, 0.002)


def started(turn: float, rate: float, dimension: int) -> list[list[float]]:
    """Return the velocity gradient of a start that spins about every axis and stretches along x, 1/s."""
    L = [[0.0] * dimension for _ in range(dimension)]
    for i in range(dimension):
        for j in range(i):
            # Different about each axis, so that no symmetry hides an error.
            L[i][j] = turn * (1 - 0.3 * j)
            L[j][i] = -L[i][j]
    L[0][0], L[1][1] = rate, -rate
    return L


MEASURES = (
    Measure(
        "angular momentum drift",
        "",
        "Largest change of the angular momentum, affine part included, over the sum of m |x| |v|.",
        bound=lambda n: 2e-14,
    ),
    Measure(
        "linear momentum drift",
        "",
        "Largest change of the linear momentum over the sum of m |v|.",
        bound=lambda n: 2e-14,
    ),
    Measure("mass error", "", "Largest difference of the mass from density times volume.", bound=lambda n: 1e-12),
    Measure(
        "energy gain",
        "",
        "Largest energy of any frame over that of the start, less 1; 0 where it never grows.",
        bound=lambda n: 5e-4,
    ),
)


class Conservation(Case):
    """A neo-Hookean block and a fixed corotated ball, far from each other and from walls."""

    group = "invariants"
    source = "Jiang, Schroeder and Teran 2017 (JCP 338:137): APIC keeps both momenta in transfers"
    resolution = "cells along the block"
    note = (
        "No wall, no gravity: what the transfers and the stress do must leave both momenta alone, to round-off. "
        "In single precision 1e-5 is right. The energy that goes is that of waves in the bodies, which the grid damps; "
        "what a first frame may seem to gain is second order in the step, as the velocities of the others live half a "
        "step before the positions."
    )

    def __init__(self, name: str, title: str, dimension: int, levels: dict[Level, tuple[int, ...]]) -> None:
        self.name, self.title, self.dimension, self.levels = name, title, dimension, levels
        # Of the waves in the bodies, the shorter ones go first.
        loss = (lambda n: 0.2 * (8 / n) ** 0.45) if dimension == 2 else (lambda n: 0.11)
        text = "Part of the energy that has gone by the end."
        self.measures = (*MEASURES, Measure("energy loss", "", text, bound=loss))
        self.varies = ("precision", "kernel", "transfer")
        # Some thousand steps.
        self.end = 20.0 if dimension == 2 else 10.0

    def tables(self, n: int) -> dict[str, Any]:
        d = self.dimension
        across = [1.5 * EDGE] * (d - 1)
        block, ball = [1.5 * EDGE, *across], [4.5 * EDGE, *across]
        return {
            "domain": {"size": [6 * EDGE] + [3 * EDGE] * (d - 1), "cells": [6 * n] + [3 * n] * (d - 1)},
            "time": {"end": self.end, "frames": FRAMES},
            "output": {"fields": ["velocity", "mass"]},
            "bodies": [
                {
                    "name": "block",
                    "material": elastic("neo_hookean", DENSITY, YOUNG, POISSON),
                    "shape": {"box": {"min": [c - EDGE / 2 for c in block], "max": [c + EDGE / 2 for c in block]}},
                    "velocity": [*DRIFT[:d]],
                    "velocity_gradient": started(SPIN, RATE, d),
                },
                {
                    "name": "ball",
                    "material": elastic("fixed_corotated", DENSITY, YOUNG, POISSON),
                    "shape": {"ball": {"center": ball, "radius": RADIUS}},
                    "velocity": [-v for v in DRIFT[:d]],
                    "velocity_gradient": started(-0.5 * SPIN, -RATE, d),
                },
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        origin = np.array(scene.domain.origin)
        rows = []
        momentum = moment = 0.0
        for frame, row in frames:
            if frame.index == 0:
                m = frame.fields["mass"].astype(np.float64)
                speed = np.linalg.norm(frame.velocity, axis=1)
                momentum = float(m @ speed)
                moment = float(m @ (np.linalg.norm(frame.position - origin, axis=1) * speed))
            rows.append(row)

        def change(values: list[tuple[float, ...]]) -> float:
            return float(np.abs(np.array(values) - values[0]).max())

        ball = math.pi * RADIUS**2 if self.dimension == 2 else 4 / 3 * math.pi * RADIUS**3
        mass = DENSITY * (EDGE**self.dimension + ball)
        energy = np.array([row.energy for row in rows])
        return {
            "angular momentum drift": change([row.angular_momentum for row in rows]) / moment,
            "linear momentum drift": change([row.linear_momentum for row in rows]) / momentum,
            "mass error": max(abs(row.mass / mass - 1) for row in rows),
            "energy gain": float(energy.max() / energy[0] - 1),
            "energy loss": float(1 - energy[-1] / energy[0]),
        }


CASES = (
    Conservation(
        "conservation",
        "Momenta and energy of free bodies",
        2,
        {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)},
    ),
    Conservation(
        "conservation_3d",
        "Momenta and energy of free bodies in 3D",
        3,
        {"coarse": (6,), "default": (6, 9), "fine": (6, 9, 12)},
    ),
)
