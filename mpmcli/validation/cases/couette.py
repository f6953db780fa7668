"""Flow between a wall at rest and one that moves, from rest, in closed form."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure

# Distance of the walls, m; density, kg/m^3; kinematic viscosity, m^2/s; and the speed of the upper wall, m/s.
WIDTH, DENSITY, VISCOSITY, SPEED = 1.0, 1000.0, 1.0, 0.5
# Cells along the channel, whose faces are periodic: nothing depends on the place along it.
LENGTH = 8
# The end, s: a tenth of the time in which viscosity crosses the channel. Terms of the series.
END, TERMS = 0.1 * WIDTH**2 / VISCOSITY, 50


def started(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity of a viscous fluid at y, m/s, a time after the upper wall began to move, s.

    u = U y/W + sum 2 U/(n pi) (-1)^n sin(n pi y/W) exp(-nu (n pi/W)^2 t).
    """
    n = np.arange(1, TERMS + 1)
    waves = 2 * SPEED / (n * math.pi) * (-1.0) ** n * np.exp(-VISCOSITY * (n * math.pi / WIDTH) ** 2 * time)
    return SPEED * y / WIDTH + np.sin(y[:, None] * n * math.pi / WIDTH) @ waves


class Couette(Case):
    """The plane flow of Couette, a tenth of the time after its start in which viscosity crosses the channel."""

    name = "couette"
    title = "Start of a viscous flow by a wall that moves"
    group = "fluids"
    source = "Batchelor 1967 (An Introduction to Fluid Dynamics), 4.3"
    resolution = "cells across the channel"
    levels = {"coarse": (8, 16), "default": (8, 16, 32), "fine": (8, 16, 32, 64)}  # noqa: RUF012
    varies = ("precision", "transfer", "walls")
    measures = (
        Measure(
            "velocity error",
            "",
            "L2 error of the velocity, over that of the wall.",
            bound=lambda n: 1.5 * 0.25 / n**2,
            order=1.9,
            expected=2.0,
        ),
        Measure("cross flow", "", "Largest velocity across the channel, over that of the wall.", lambda n: 1e-4),
        Measure(
            "unevenness",
            "",
            "Largest difference of velocities at equal heights, over that of the wall.",
            lambda n: 1e-9,
        ),
    )
    note = "The channel is eight cells long, and its ends are periodic."

    def tables(self, n: int) -> dict[str, Any]:
        length = LENGTH * WIDTH / n
        return {
            "domain": {
                "size": [length, WIDTH],
                "cells": [LENGTH, n],
                "walls": {"x_min": "periodic", "x_max": "periodic", "y_min": "stick", "y_max": "stick"},
                "wall_velocity": {"y_max": [SPEED, 0.0]},
            },
            "time": {"end": END, "frames": 1},
            "output": {"fields": ["velocity", "initial_position"]},
            "bodies": [
                {
                    "name": "fluid",
                    "material": {
                        "law": "fluid",
                        "density": DENSITY,
                        # Sound crosses ten channels in the time in which viscosity crosses one.
                        "bulk_modulus": DENSITY * (10 * VISCOSITY / WIDTH) ** 2,
                        "viscosity": DENSITY * VISCOSITY,
                        "tension_cutoff": False,
                    },
                    "shape": {"box": {"min": [0.0, 0.0], "max": [length, WIDTH]}},
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for entry in frames:
            last, row = entry
        y = last.fields["initial_position"][:, 1].astype(np.float64)
        u, v = last.velocity.astype(np.float64).T
        # Velocities are half a step old.
        exact = started(y, last.time - row.step_max / 2)
        heights = [u[y == height] for height in np.unique(y)]
        return {
            "velocity error": float(np.sqrt(((u - exact) ** 2).mean())) / SPEED,
            "cross flow": float(np.abs(v).max()) / SPEED,
            "unevenness": max(float(np.ptp(row)) for row in heights) / SPEED,
        }


CASES = (Couette(),)
