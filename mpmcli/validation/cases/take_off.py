"""A block that leaves a corner of separating walls: a parabola, and no stress."""

from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

EDGE, DENSITY, YOUNG, POISSON = 1.0, 1000.0, 1e6, 0.3
VELOCITY, GRAVITY = (1.5, 4.0), 9.81
# Before the block comes down again, s.
END, FRAMES = 0.5, 10


class TakeOff(Case):
    """x = X + v t - g t^2/2 from the first step on: walls that let go do not pull."""

    name = "take_off"
    title = "Block that takes off from separating walls"
    group = "invariants"
    source = "Galileo 1638 (Discorsi): the parabola of a throw"
    resolution = "cells along the block"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    varies = ("precision", "transfer")
    measures = (
        Measure("path error", "", "Largest distance of a particle from its parabola, over the edge.", lambda n: 1e-12),
        Measure("stress", "E", "Largest stress in the block.", lambda n: 1e-12),
    )
    note = "The steps are those of leapfrog, which has the parabola exactly: what is left is round-off."

    def tables(self, n: int) -> dict[str, Any]:
        return {
            "domain": {
                "size": [3 * EDGE, 3 * EDGE],
                "cells": [3 * n, 3 * n],
                "gravity": [0.0, -GRAVITY],
                "walls": "separate",
            },
            "time": {"end": END, "frames": FRAMES},
            "output": {"fields": ["stress", "initial_position"]},
            "bodies": [
                {
                    "name": "block",
                    "material": elastic("neo_hookean", DENSITY, YOUNG, POISSON),
                    "shape": {"box": {"min": [0.0, 0.0], "max": [EDGE, EDGE]}},
                    "velocity": list(VELOCITY),
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        path = stress = 0.0
        for frame, _ in frames:
            t = frame.time
            flown = np.array(VELOCITY) * t - np.array([0.0, GRAVITY]) * t**2 / 2
            off = frame.position.astype(np.float64) - frame.fields["initial_position"] - flown
            path = max(path, float(np.linalg.norm(off, axis=1).max()))
            stress = max(stress, float(np.abs(frame.fields["stress"]).max()))
        return {"path error": path / EDGE, "stress": stress / YOUNG}


CASES = (TakeOff(),)
