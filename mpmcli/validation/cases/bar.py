"""An axially vibrating bar: what the grid does to the frequency of a wave (Bardenhagen 2002)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure
from mpmcli.validation.oscillation import fit_oscillation
from mpmcli.validation.setting import Setting

LENGTH, YOUNG, DENSITY, SPEED = 25.0, 100.0, 1.0, 0.01
WAVE_SPEED = math.sqrt(YOUNG / DENSITY)
# The grid has at least five cells per axis; the strip fills them, between slip walls, so that it stays one-dimensional.
STRIP = 5
PERIODS = 5
FRAMES_PER_PERIOD = 24


class Bar(Case):
    """v = v0 sin(b x) at t = 0; then u = v0/w sin(w t) sin(b x), w = b c, while strains are small."""

    group = "solids"
    source = "Bardenhagen 2002 (JCP 180:383), plane strain with nu = 0"
    resolution = "cells along the bar"
    levels = {"coarse": (13, 26), "default": (13, 26, 52), "fine": (13, 26, 52, 104)}  # noqa: RUF012

    def __init__(self, name: str, title: str, quarters: int, room: int) -> None:
        """`quarters` of a wave fit into the bar; a free end has so many cells of `room` beyond it."""
        self.name, self.title, self.room = name, title, room
        self.b = quarters * math.pi / (2 * LENGTH)
        self.frequency = self.b * WAVE_SPEED
        b = self.b
        self.measures = (
            Measure(
                "period error",
                "",
                "Period of the first mode over the exact one, less 1.",
                bound=lambda n: 1.3 * 0.105 * (b * LENGTH / n) ** 2,
                order=1.9,
                expected=2.0,
            ),
            Measure("energy loss", "", "Energy that the mode loses in a period.", expected=3.0),
        )

    def tables(self, n: int, setting: Setting) -> dict[str, Any]:
        h = LENGTH / n
        period = 2 * math.pi / self.frequency
        return {
            "title": self.title,
            "domain": {
                "size": [LENGTH + self.room * h, STRIP * h],
                "cells": [n + self.room, STRIP],
                "gravity": [0.0, 0.0],
                "walls": "slip",
            },
            "time": {"end": PERIODS * period, "frames": PERIODS * FRAMES_PER_PERIOD, "safety": setting.safety},
            "solver": setting.solver_table(),
            "output": {"fields": ["velocity", "initial_position"]},
            "bodies": [
                {
                    "name": "bar",
                    "material": {
                        "law": "neo_hookean",
                        "density": DENSITY,
                        "youngs_modulus": YOUNG,
                        "poissons_ratio": 0.0,
                    },
                    "shape": {"box": {"min": [0.0, 0.0], "max": [LENGTH, STRIP * h]}},
                    "velocity": [f"{SPEED} * sin({self.b!r} * X)", 0.0],
                    "particles_per_cell": setting.particles_per_cell(2),
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, signal = [], []
        for frame, _ in frames:
            X = frame.fields["initial_position"][:, 0].astype(np.float64)
            times.append(frame.time)
            signal.append(float((frame.position[:, 0] - X) @ np.sin(self.b * X)))
        found = fit_oscillation(np.array(times), np.array(signal), self.frequency)
        return {
            "period error": self.frequency / found.frequency - 1,
            "energy loss": 1 - math.exp(-2 * found.decay * 2 * math.pi / found.frequency),
        }


CASES = (
    Bar("bar_fixed_fixed", "Vibrating bar between two walls", 2, 0),
    Bar("bar_fixed_free", "Vibrating bar with a free end", 1, 4),
)
