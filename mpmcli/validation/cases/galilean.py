"""A vibrating rod that flies through the grid, and one at rest: what motion adds to the error (docs/theory.md, 10)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic
from mpmcli.validation.oscillation import Oscillation, fit_oscillation

LENGTH, YOUNG, DENSITY, SPEED = 25.0, 100.0, 1.0, 0.1
WAVE_SPEED = math.sqrt(YOUNG / DENSITY)
B = math.pi / LENGTH
FREQUENCY = B * WAVE_SPEED
# Ten times the largest speed of the vibration along the rod: by the end it has flown its own length.
FLIGHT = (10 * SPEED, 3 * SPEED)
PERIODS, FRAMES_PER_PERIOD = 5, 17
# Height of a rod, room around it and between the two, cells; and where in a cell the flying one starts.
HEIGHT, ROOM, OFFSET = 4, 4, (0.37, 0.23)


class Galilean(Case):
    """u = v0/w sin(w t) cos(b X) in two free rods, of which one flies with ten times the speed of the vibration."""

    name = "galilean"
    title = "Vibrating rod in flight and at rest"
    group = "invariants"
    source = "Free rod of linear elasticity, plane strain with nu = 0; Galilean invariance"
    resolution = "cells along the rod"
    levels = {"coarse": (13, 26), "default": (13, 26, 52), "fine": (13, 26, 52, 104)}  # noqa: RUF012
    varies = ("precision", "kernel", "transfer")
    measures = (
        Measure(
            "period error",
            "",
            "Period of the rod in flight over the exact one, less 1.",
            bound=lambda n: 1.3 * 0.105 * (math.pi / n) ** 2,
            order=1.9,
            expected=2.0,
        ),
        Measure(
            "change by flight",
            "",
            "Period error in flight less that at rest, over the one at rest.",
            bound=lambda n: 0.012,
            single=lambda n: 0.01,
        ),
        Measure("energy loss", "", "Energy that the mode in flight loses in a period.", expected=3.0),
        Measure("energy loss at rest", "", "The same of the rod at rest.", expected=3.0),
    )
    note = (
        "The rod in flight starts off the grid's lines and crosses as many cells as it is long. What flight changes is "
        "below a hundredth of the error itself. It loses less energy than the rod at rest, whose ends stay on nodes."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = LENGTH / n
        end = PERIODS * 2 * math.pi / FREQUENCY
        low = (ROOM * h, ROOM * h)
        start = ((ROOM + OFFSET[0]) * h, (2 * ROOM + HEIGHT + OFFSET[1]) * h)
        cells = [math.ceil((start[a] + FLIGHT[a] * end) / h) + extent + ROOM for a, extent in enumerate((n, HEIGHT))]
        return {
            "domain": {"size": [c * h for c in cells], "cells": cells},
            "time": {"end": end, "frames": PERIODS * FRAMES_PER_PERIOD},
            "output": {"fields": ["velocity", "initial_position"]},
            "bodies": [
                self._rod("rod at rest", low, (0.0, 0.0), h),
                self._rod("rod in flight", start, FLIGHT, h),
            ],
        }

    def _rod(self, name: str, low: tuple[float, float], flight: tuple[float, float], h: float) -> dict[str, Any]:
        vibration = f"{SPEED} * cos({B!r} * (X - {low[0]!r}))"
        return {
            "name": name,
            "material": elastic("fixed_corotated", DENSITY, YOUNG, 0.0),
            "shape": {"box": {"min": [*low], "max": [low[0] + LENGTH, low[1] + HEIGHT * h]}},
            "velocity": [f"{flight[0]} + {vibration}" if flight[0] else vibration, flight[1]],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times: list[float] = []
        signals: tuple[list[float], list[float]] = ([], [])
        for frame, _ in frames:
            times.append(frame.time)
            for body, signal in enumerate(signals):
                mine = frame.body == body
                X = frame.fields["initial_position"][mine, 0].astype(np.float64)
                shape = np.cos(B * (X - scene.bodies[body].shape.form.bounds()[0][0]))
                # A uniform motion has no part in this sum: the shape is odd about the middle of the rod.
                signal.append(float((frame.position[mine, 0] - X) @ (shape - shape.mean())))
        rest, flying = (fit_oscillation(np.array(times), np.array(signal), FREQUENCY) for signal in signals)
        at_rest, in_flight = (FREQUENCY / found.frequency - 1 for found in (rest, flying))
        return {
            "period error": in_flight,
            "change by flight": (in_flight - at_rest) / abs(at_rest),
            "energy loss": _loss(flying),
            "energy loss at rest": _loss(rest),
        }


def _loss(found: Oscillation) -> float:
    return -math.expm1(-4 * math.pi * found.decay / found.frequency)


CASES = (Galilean(),)
