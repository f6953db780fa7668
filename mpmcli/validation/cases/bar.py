"""An axially vibrating bar: what the grid does to the frequency and the energy of a wave (Bardenhagen 2002)."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic
from mpmcli.validation.linear_wave import discrete_wave
from mpmcli.validation.oscillation import fit_oscillation

LENGTH, YOUNG, DENSITY, SPEED = 25.0, 100.0, 1.0, 0.01
WAVE_SPEED = math.sqrt(YOUNG / DENSITY)
# The grid has at least five cells per axis; the strip fills them, between slip walls, so that it stays one-dimensional.
STRIP = 5
PERIODS = 5
# With this many, just under two steps of 0.8 of the limit fit between two frames of the coarsest bar, just under four
# of the next: steps are at most slightly smaller than those of the setting.
FRAMES_PER_PERIOD = 17
# Loss at a free end, over that of the wave: 5.8 / n, from 13, 26 and 52 cells.
END_LOSS = 5.8


class Bar(Case):
    """v = v0 sin(b x) at t = 0; then u = v0/w sin(w t) sin(b x), w = b c."""

    group = "solids"
    source = "Bardenhagen 2002 (JCP 180:383), plane strain with nu = 0; errors predicted by von Neumann's analysis"
    resolution = "cells along the bar"
    levels = {"coarse": (13, 26), "default": (13, 26, 52), "fine": (13, 26, 52, 104)}  # noqa: RUF012

    def __init__(self, name: str, title: str, quarters: int, room: int) -> None:
        """`quarters`: quarter waves in the bar; `room`: empty cells beyond a free end."""
        self.name, self.title, self.room = name, title, room
        self.b = quarters * math.pi / (2 * LENGTH)
        self.frequency = self.b * WAVE_SPEED
        b = self.b
        free = room > 0
        # What the other knobs do shows in the bar between two walls.
        self.varies = ("precision", "walls") if free else Case.varies
        self.measures = (
            Measure(
                "period error",
                "",
                "Period of the first mode over the exact one, less 1.",
                bound=lambda n: 1.3 * 0.105 * (b * LENGTH / n) ** 2,
                order=1.9,
                expected=2.0,
            ),
            Measure(
                "period error against theory",
                "",
                "Period error over the one that linear analysis of the scheme predicts for this step, less 1.",
                # Between walls: what a fit to a signal of finite amplitude cannot tell.
                bound=(lambda n: 0.3 / n) if free else (lambda n: 2.8e-6 * (n / 13) ** 1.4),
                single=lambda n: 0.008,
            ),
            Measure(
                "dissipation against theory",
                "",
                "Energy that the mode loses in a step over the predicted loss, 0.024 (kh)^4 at every step, less 1.",
                # Where the loss itself, which falls as n^-3 in a period, is above what a finite amplitude does to it.
                bound=(lambda n: 1.3 * END_LOSS / n if n <= 26 else math.inf)
                if free
                else (lambda n: 0.004 * (n / 13) ** 1.3 if n <= 52 else 0.13),
                # Of a loss of 1e-5 and less.
                single=lambda n: 0.9 if free else 0.15,
            ),
            Measure(
                "amplitude error",
                "",
                "Amplitude of the displacement at the start over v0/w, less 1.",
                bound=lambda n: 0.3 * (b * LENGTH / n) ** 2,
                expected=2.0,
            ),
            Measure("energy loss", "", "Energy that the mode loses in a period.", expected=3.0),
        )
        self.note = (
            "The loss is per step and not per second: halving the step doubles it. "
            + (
                f"In steps of 0.8 of the limit a free end takes {END_LOSS:g} / n more of it than the wave does in the "
                "bulk, and makes the period error 0.2 / n larger; from 52 cells on the loss is too small to be fitted "
                "at this amplitude, and carries no bound."
                if free
                else "Linear analysis gives 0.0235 to 0.0242 (kh)^4 with 2 to 4 particles per cell and axis, at every "
                "Courant number, and the period error to four digits."
            )
            + " The solid is fixed corotated, whose stress is linear in the strain of a bar: that of a neo-Hookean "
            "solid passes energy on to the second mode, some 5e-6 of it in a period at this amplitude."
        )

    def tables(self, n: int) -> dict[str, Any]:
        h = LENGTH / n
        period = 2 * math.pi / self.frequency
        return {
            "domain": {
                "size": [LENGTH + self.room * h, STRIP * h],
                "cells": [n + self.room, STRIP],
                "walls": "slip",
            },
            "time": {"end": PERIODS * period, "frames": PERIODS * FRAMES_PER_PERIOD},
            "output": {"fields": ["velocity", "initial_position"]},
            "bodies": [
                {
                    "name": "bar",
                    "material": elastic("fixed_corotated", DENSITY, YOUNG, 0.0),
                    "shape": {"box": {"min": [0.0, 0.0], "max": [LENGTH, STRIP * h]}},
                    "velocity": [f"{SPEED} * sin({self.b!r} * X)", 0.0],
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, signal, steps = [], [], 0
        for frame, row in frames:
            X = frame.fields["initial_position"][:, 0].astype(np.float64)
            shape = np.sin(self.b * X)
            times.append(frame.time)
            signal.append(float((frame.position[:, 0] - X) @ shape / (shape @ shape)))
            steps += row.steps
        found = fit_oscillation(np.array(times), np.array(signal), self.frequency)
        error = self.frequency / found.frequency - 1
        dt = times[-1] / steps
        h = scene.domain.spacing
        theory = discrete_wave(self.b * h, WAVE_SPEED * dt / h, math.isqrt(scene.bodies[0].particles_per_cell))
        loss = 0.024 * (self.b * h) ** 4
        return {
            "period error": error,
            "period error against theory": error / theory.period_error - 1,
            "dissipation against theory": -math.expm1(-2 * found.decay * dt) / loss - 1,
            "amplitude error": found.amplitude * self.frequency / SPEED - 1,
            "energy loss": -math.expm1(-2 * found.decay * 2 * math.pi / found.frequency),
        }


CASES = (
    Bar("bar_fixed_fixed", "Vibrating bar between two walls", 2, 0),
    Bar("bar_fixed_free", "Vibrating bar with a free end", 1, 4),
)
