"""A block that leaves a corner of separating walls: a parabola, and no stress."""

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, case_text
from mpmcli.validation.tables import Tables, body, box, elastic, problem

EDGE, DENSITY, YOUNG, POISSON = 1.0, 1000.0, 1e6, 0.3
VELOCITY, GRAVITY = (1.5, 4.0), 9.81
# Before the block comes down again, s.
END, FRAMES = 0.5, 10


class TakeOff(Case):
    """x = X + v t - g t^2/2 from the first step on: walls that let go do not pull."""

    text = case_text("take_off")
    name, title, group = "take_off", "Block that takes off from separating walls", "invariants"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    varies = ("precision", "transfer")
    measures = (
        Measure("path error: Largest distance of a particle from its parabola, over the edge.", 1e-12),
        Measure("stress (E): Largest stress in the block.", 1e-12),
    )

    def tables(self, n: int) -> Tables:
        material = elastic("neo_hookean", DENSITY, YOUNG, POISSON)
        block = body("block", material, box([0.0, 0.0], [EDGE, EDGE]), velocity=[*VELOCITY])
        domain = {"size": [3 * EDGE] * 2, "cells": [3 * n] * 2, "gravity": [0.0, -GRAVITY], "walls": "separate"}
        return problem(domain, (END, FRAMES), "stress initial_position", [block])

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
