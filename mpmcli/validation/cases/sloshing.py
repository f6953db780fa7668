"""A standing wave in a tank: gravity and a free surface against the period of potential flow."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure
from mpmcli.validation.oscillation import fit_oscillation


def standing_wave_frequency(gravity: float, wave_number: float, depth: float, amplitude: float = 0.0) -> float:
    """Return the angular frequency of a standing wave in water of finite depth, rad/s, to third order in its steepness.

    For small waves w^2 = g k tanh(k d). In general w / sqrt(g k) = w0 + (a k)^2/2 w2, with w0^2 = tanh(k d) and
    w2 = (9 w0^-7 - 12 w0^-3 - 3 w0 - 2 w0^5)/32 (Tadjbakhsh and Keller 1960, JFM 8:442).

    Args:
        gravity: m/s^2.
        wave_number: 1/m.
        depth: m.
        amplitude: m.
    """
    w = math.sqrt(math.tanh(wave_number * depth))
    curvature = (9 * w**-7 - 12 * w**-3 - 3 * w - 2 * w**5) / 32
    return math.sqrt(gravity * wave_number) * (w + (amplitude * wave_number) ** 2 / 2 * curvature)


LENGTH, DEPTH, AMPLITUDE, GRAVITY, DENSITY = 1.0, 0.5, 0.02, 9.81, 1000.0
# Sound ten times as fast as what falls from the surface to the floor.
MODULUS = 100 * 2 * DENSITY * GRAVITY * DEPTH
WAVE_NUMBER = math.pi / LENGTH
LINEAR = standing_wave_frequency(GRAVITY, WAVE_NUMBER, DEPTH)
EXACT = standing_wave_frequency(GRAVITY, WAVE_NUMBER, DEPTH, AMPLITUDE)
PERIODS = 5
FRAMES_PER_PERIOD = 24


class Sloshing(Case):
    """From flat, with v = a w (-sin kX cosh kY, cos kX sinh kY)/sinh kd: the centre of mass swings at w."""

    name = "sloshing"
    varies = ("precision", "kernel", "transfer", "walls", "safety")
    title = "Sloshing in a tank"
    group = "fluids"
    source = "w^2 = g k tanh(k d); its change by amplitude: Tadjbakhsh and Keller 1960 (JFM 8:442)"
    resolution = "cells along the tank"
    levels = {"coarse": (24, 32), "default": (24, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        Measure(
            "period error",
            "",
            "Period of the centre of mass, over five periods, over the exact one, less 1.",
            bound=lambda n: 5e-3 * (32 / n) ** 1.5,
        ),
        Measure(
            "amplitude loss",
            "",
            "Amplitude that the wave loses in a period.",
            bound=lambda n: 0.018 * (32 / n) ** 2,
        ),
        Measure(
            "amplitude error",
            "",
            "Amplitude of the centre of mass at the start over the exact one, 2 a L/(pi^2 d), less 1.",
            bound=lambda n: 0.018 * 32 / n,
        ),
    )
    note = (
        "Compressibility lengthens the period by 0.01 to 0.02 %. What presses at the surface depends on where its "
        "rows of particles lie between the nodes: a spring to waves that move them little, which averages out over a "
        "cell. At L/32 a wave of a = 0.002 m, h/16, has a period 2.4 % short. So the error has no clean order, as a/h "
        "grows when h falls, and three particles per axis make it smaller (0.07 % at L/32)."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = LENGTH / n
        k, speed = WAVE_NUMBER, AMPLITUDE * LINEAR / math.sinh(WAVE_NUMBER * DEPTH)
        return {
            "domain": {
                "size": [LENGTH, n * 5 // 8 * h],
                "cells": [n, n * 5 // 8],
                "gravity": [0.0, -GRAVITY],
                "walls": "slip",
            },
            "time": {
                "end": PERIODS * 2 * math.pi / LINEAR,
                "frames": PERIODS * FRAMES_PER_PERIOD,
            },
            "output": {"fields": ["velocity"]},
            "bodies": [
                {
                    "name": "water",
                    "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": MODULUS},
                    "shape": {"box": {"min": [0.0, 0.0], "max": [LENGTH, DEPTH]}},
                    "velocity": [
                        f"{-speed!r} * sin({k!r} * X) * cosh({k!r} * Y)",
                        f"{speed!r} * cos({k!r} * X) * sinh({k!r} * Y)",
                    ],
                    "initial_pressure": "hydrostatic",
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        signal = [(frame.time, frame.position[:, 0].astype(np.float64).mean() - LENGTH / 2) for frame, _ in frames]
        found = fit_oscillation(*np.array(signal).T, EXACT)
        swing = 2 * AMPLITUDE * LENGTH / (math.pi**2 * DEPTH)
        return {
            "period error": EXACT / found.frequency - 1,
            "amplitude loss": 1 - math.exp(-found.decay * 2 * math.pi / found.frequency),
            "amplitude error": found.amplitude / swing - 1,
        }


CASES = (Sloshing(),)
