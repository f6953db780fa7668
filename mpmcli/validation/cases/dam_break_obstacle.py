"""A dam break on a box that stands on the floor, beside measured heights of the water (Kleefsman et al. 2005)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure
from mpmcli.validation.kleefsman import FILM, IMPACT, SPEED, arrival, impact, measured, water_height

GRAVITY, DENSITY = 9.81, 1000.0
# Of the tank and of the water, m.
LENGTH, WIDTH, HEIGHT = 3.22, 1.0, 1.0
DAM, DEPTH = 1.992, 0.55
# Two corners of the box, m, which stands on the floor.
LOWER, UPPER = (0.6635, 0.2955), (0.8245, 0.6985, 0.161)
# Later water that the walls threw back comes down.
END = 0.8
GAUGES = ("H2", "H3", "H4")


class DamBreakObstacle(Case):
    """Water at rest at one end of a tank, its pressure hydrostatic, whose gate is gone at t = 0; no friction."""

    name = "dam_break_obstacle"
    title = "Dam break on an obstacle, SPHERIC test 2"
    group = "fluids"
    source = "Kleefsman et al. 2005 (JCP 206:363); Issa and Violeau 2006, SPHERIC test case 2"
    resolution = "cells across the tank"
    levels = {"coarse": (16,), "default": (16, 24, 32), "fine": (16, 24, 32, 40)}  # noqa: RUF012
    measures = (
        Measure(
            "height error",
            "",
            "Mean of the three that follow.",
            bound=lambda n: 0.2,
        ),
        Measure(
            "height error H2",
            "",
            "Mean of |height - measured| at x = 0.992 m, from the arrival to 0.8 s, over the mean measured.",
            bound=lambda n: 0.2,
        ),
        Measure("height error H3", "", "That at x = 1.488 m.", bound=lambda n: 0.25 + 2 / n),
        Measure("height error H4", "", "That in the column, at x = 2.638 m.", bound=lambda n: 0.02),
        Measure("arrival H3", "s", "When the height at H3 is 1 cm, less when it was.", bound=lambda n: 0.06),
        Measure("arrival H2", "s", "When the height at H2 is 1 cm, less when it was.", bound=lambda n: 0.02),
        Measure(
            "impact",
            "s",
            "When the front of 99.9 % of the water is at the box, less when it was, by its times at the gauges.",
            bound=lambda n: 0.02,
        ),
        Measure(
            "first force",
            "s",
            "When the force on the box is a tenth of its largest, less when the front met it.",
            bound=lambda n: 0.03,
        ),
        Measure(
            "peak",
            "s",
            "When the force on the box is largest, less when the front met it.",
            bound=lambda n: 0.12,
        ),
        Measure(
            "largest force",
            "",
            "Over density speed^2 / 2 times the face of the box, with the measured speed of the front. A stream as "
            "high as the box that is turned aside makes 2.",
            bound=lambda n: 2.0,
        ),
        Measure(
            "depth in the box",
            "h",
            "How far inside of the box any water comes, in cells.",
            bound=lambda n: 0.5,
            # Rounding decides which drop gets deepest.
            single=lambda n: 0.5,
        ),
    )
    varies = ("precision",)
    note = (
        "Validation, not verification: the experiment has a gate, a floor with friction and an uncertain origin of "
        "time. The measured front is at H3 0.04 s before the computed one, and takes 0.164 s from there to H2 (3.0 "
        "m/s), where the computed one takes 0.131 s (3.8 m/s); the water of the column sinks sooner, too: as if all "
        "had begun some 0.03 s before t = 0, and been slowed down by the floor. Heights at H3 are 28 % off with 32 "
        "cells and 27 % with 40: what is left is no error of the grid. Shallow water without friction (Ritter 1892) "
        "has 0.14 m there at 0.45 s, this 0.12 m, the experiment 0.10 m. At H2 comes back what the box throws up, "
        "which depends on how the box lies between the nodes: it acts on those up to 0.76 cells outside. For that "
        "reason, and as nodes act on what is 1.5 cells farther, the force begins early, and is larger on a coarse "
        "grid. The flow leaves the sides of the box dry at first. A height is the volume of the water in a column "
        "over its area (docs/theory.md, 10)."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = WIDTH / n
        along, up = math.ceil(LENGTH / h - 1e-9), math.ceil(HEIGHT / h - 1e-9)
        return {
            "domain": {
                # What is too long lies behind the box.
                "origin": [LENGTH - along * h, 0.0, 0.0],
                "size": [along * h, WIDTH, up * h],
                "cells": [along, n, up],
                "gravity": [0.0, 0.0, -GRAVITY],
                "walls": "separate",
            },
            "time": {"end": END, "frames": 80},
            "output": {"fields": ["velocity"]},
            "bodies": [
                {
                    "name": "water",
                    "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": "auto"},
                    "shape": {"box": {"min": [DAM, 0.0, 0.0], "max": [LENGTH, WIDTH, DEPTH]}},
                    "initial_pressure": "hydrostatic",
                }
            ],
            # It reaches below the floor, so that no node of the floor under it is free.
            "colliders": [{"name": "obstacle", "shape": {"box": {"min": [*LOWER, -2 * h], "max": [*UPPER]}}}],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        gauges = {name: measured()[name] for name in GAUGES}
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
        # Forces are means since the frame before.
        middle = time - END / (2 * (len(time) - 1))
        face = (UPPER[1] - LOWER[1]) * UPPER[2]
        return {
            "height error": float(np.mean(errors)),
            **{f"height error {name}": error for name, error in zip(gauges, errors, strict=True)},
            **{f"arrival {name}": arrival(time, curves[name]) - gauges[name].arrival for name in ("H3", "H2")},
            "impact": impact(time, np.array(fronts)) - IMPACT,
            "first force": arrival(middle, force, force.max() / 10) - IMPACT,
            "peak": float(middle[np.argmax(force)]) - IMPACT,
            "largest force": float(force.max()) / (DENSITY * SPEED**2 / 2 * face),
            "depth in the box": deepest * n / WIDTH,
        }


CASES = (DamBreakObstacle(),)
