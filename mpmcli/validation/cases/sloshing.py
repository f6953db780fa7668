"""A standing wave in a tank: gravity and a free surface against the period of potential flow."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.measuring import fit_oscillation
from mpmcli.validation.tables import Tables, body, box, fluid, problem


def standing_wave_frequency(gravity: float, wave_number: float, depth: float, amplitude: float = 0.0) -> float:
    """Return the angular frequency of a standing wave in water of finite depth, rad/s, to third order in its steepness.

    For small waves w^2 = g k tanh(k d). In general w / sqrt(g k) = w0 + (a k)^2/2 w2, with w0^2 = tanh(k d) and
    w2 = (9 w0^-7 - 12 w0^-3 - 3 w0 - 2 w0^5)/32 (Tadjbakhsh and Keller 1960, JFM 8:442).
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

    text = case_text("sloshing")
    name, title, group = "sloshing", "Sloshing in a tank", "fluids"
    varies = ("precision", "kernel", "transfer", "safety")
    levels = {"coarse": (24, 32), "default": (24, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("period error", lambda n: 5e-3 * (32 / n) ** 1.5),
        text.measure("amplitude loss", lambda n: 0.018 * (32 / n) ** 2),
        text.measure("amplitude error", lambda n: 0.018 * 32 / n),
    )

    def tables(self, n: int) -> Tables:
        h, k = LENGTH / n, WAVE_NUMBER
        speed = AMPLITUDE * LINEAR / math.sinh(k * DEPTH)
        size, cells = [LENGTH, n * 5 // 8 * h], [n, n * 5 // 8]
        velocity = [f"{-speed!r} * sin({k!r} * X) * cosh({k!r} * Y)", f"{speed!r} * cos({k!r} * X) * sinh({k!r} * Y)"]
        start = {"velocity": velocity, "initial_pressure": "hydrostatic"}
        water = body("water", fluid(DENSITY, MODULUS), box([0.0, 0.0], [LENGTH, DEPTH]), **start)
        domain = {"size": size, "cells": cells, "gravity": [0.0, -GRAVITY], "walls": "slip"}
        time = PERIODS * 2 * math.pi / LINEAR, PERIODS * FRAMES_PER_PERIOD
        return problem(domain, time, "velocity", [water])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        signal = [(frame.time, frame.position[:, 0].astype(np.float64).mean() - LENGTH / 2) for frame, _ in frames]
        wave = fit_oscillation(*np.array(signal).T, EXACT)
        swing = 2 * AMPLITUDE * LENGTH / (math.pi**2 * DEPTH)
        return {
            "period error": EXACT / wave.frequency - 1,
            "amplitude loss": 1 - math.exp(-wave.decay * 2 * math.pi / wave.frequency),
            "amplitude error": wave.amplitude / swing - 1,
        }


CASES = (Sloshing(),)
