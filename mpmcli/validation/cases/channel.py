"""Flow between two walls that stick, started by a pull: a viscous fluid and a Bingham fluid, in closed form."""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure

# Distance of the walls, m; density, kg/m^3; kinematic viscosity, m^2/s; and the pull, m/s^2.
WIDTH, DENSITY, VISCOSITY, PULL = 1.0, 1000.0, 1.0, 0.5
# Length of the middle that is looked at, in widths.
MIDDLE = 1
# Terms of the series; the first one left out has 1e-6 of the first.
TERMS = 50


def started(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity of a viscous fluid at y, m/s, a time after it was at rest, s.

    u = g/(2 nu) y (W - y) - sum 4 g W^2/(nu (k pi)^3) sin(k pi y/W) exp(-nu (k pi/W)^2 t) over odd k.
    """
    k = math.pi * (2 * np.arange(TERMS) + 1)
    waves = 4 * PULL * WIDTH**2 / (VISCOSITY * k**3) * np.exp(-VISCOSITY * (k / WIDTH) ** 2 * time)
    return PULL / (2 * VISCOSITY) * y * (WIDTH - y) - np.sin(y[:, None] * k / WIDTH) @ waves


def plugged(y: np.ndarray, plug: float) -> np.ndarray:
    """Return the steady velocity of a Bingham fluid at y, m/s, whose plug has a width in that of the channel.

    u = g/(2 nu) ((W/2 - b)^2 - max(|y - W/2| - b, 0)^2) with the half width b of the plug, yield stress = density g b.
    """
    half, b = WIDTH / 2, plug * WIDTH / 2
    return PULL / (2 * VISCOSITY) * ((half - b) ** 2 - np.maximum(np.abs(y - half) - b, 0) ** 2)


class Channel(Case):
    """A strip of fluid, its ends free and far away, that is pulled along the channel from rest."""

    resolution = "cells across the channel"
    # End of the run, s, and length of the strip in widths: what its ends do has not come to the middle by then.
    end: float
    length: int

    @abstractmethod
    def material(self) -> dict[str, Any]:
        """Return the table of the material."""

    @abstractmethod
    def known(self, y: np.ndarray, time: float) -> np.ndarray:
        """Return the velocity along the channel at y, m/s."""

    def tables(self, n: int) -> dict[str, Any]:
        h = WIDTH / n
        return {
            "domain": {
                "size": [(self.length + 1) * WIDTH, WIDTH],
                "cells": [(self.length + 1) * n, n],
                "gravity": [PULL, 0.0],
                "walls": {"default": "slip", "y_min": "stick", "y_max": "stick"},
            },
            "time": {"end": self.end, "frames": 1},
            "output": {"fields": ["velocity", "initial_position"]},
            "bodies": [
                {
                    "name": "fluid",
                    "material": self.material(),
                    "shape": {"box": {"min": [4 * h, 0.0], "max": [4 * h + self.length * WIDTH, WIDTH]}},
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for entry in frames:
            last, row = entry
        X = last.fields["initial_position"].astype(np.float64)
        start, end = (bound[0] for bound in scene.bodies[0].shape.form.bounds())
        middle = np.abs(X[:, 0] - (start + end) / 2) < MIDDLE * WIDTH / 2
        # Velocities are half a step old.
        exact = self.known(X[middle, 1], last.time - row.step_max / 2)
        u, v = last.velocity[middle].astype(np.float64).T
        return {
            "velocity error": float(np.sqrt(((u - exact) ** 2).mean() / (exact**2).mean())),
            "flow error": float(u.sum() / exact.sum() - 1),
            "cross flow": float(np.abs(v).max() / exact.max()),
        }


def channel_measures(bound: Callable[[int], float], order: float | None = None) -> tuple[Measure, ...]:
    """Return the measures with bounds of that of the velocity; the flow is a mean of it."""
    text = "L2 error of the velocity in the middle, over the velocity."
    return (
        Measure("velocity error", "", text, bound=bound, order=order, expected=2.0),
        Measure("flow error", "", "Flow through the middle over the exact one, less 1.", bound=bound, expected=2.0),
        Measure("cross flow", "", "Largest velocity across the channel, over the largest along it.", lambda n: 1e-4),
    )


class Poiseuille(Channel):
    """The plane flow of Poiseuille, a fifth of the time after its start in which viscosity crosses the channel."""

    name = "poiseuille"
    title = "Start of a viscous flow between walls that stick"
    group = "fluids"
    source = "Batchelor 1967 (An Introduction to Fluid Dynamics), 4.3"
    levels = {"coarse": (8, 16), "default": (8, 16, 32), "fine": (8, 16, 32, 64)}  # noqa: RUF012
    end, length = 0.15 * WIDTH**2 / VISCOSITY, 6
    varies = ("precision", "transfer", "walls")
    measures = channel_measures(lambda n: 1.5 * 1.6 / n**2, 1.9)
    note = (
        "Most of the error is that particles have the mean of the flow over a kernel, h^2/8 u'' less than the flow: "
        "1/n^2 of the largest velocity."
    )

    def material(self) -> dict[str, Any]:
        # Sound crosses ten channels in the time in which viscosity crosses one.
        modulus = DENSITY * (10 * VISCOSITY / WIDTH) ** 2
        return {
            "law": "fluid",
            "density": DENSITY,
            "bulk_modulus": modulus,
            "viscosity": DENSITY * VISCOSITY,
            "tension_cutoff": False,
        }

    def known(self, y: np.ndarray, time: float) -> np.ndarray:
        return started(y, time)


class Bingham(Channel):
    """The steady flow of a Bingham fluid: a plug, and a parabola on either side."""

    name = "bingham"
    title = "Bingham fluid between walls that stick"
    group = "plastic"
    source = "Bird, Stewart and Lightfoot 1960 (Transport Phenomena), the plug flow of a Bingham fluid, between plates"
    levels = {"coarse": (16,), "default": (16, 32), "fine": (16, 32, 64)}  # noqa: RUF012
    end, length = 0.55 * WIDTH**2 / VISCOSITY, 20
    varies = ("precision",)
    plug = 0.4
    measures = channel_measures(lambda n: 1.5 * (1.5 / n**2 + 3e-4))
    note = (
        "The material gives way elastically before it yields, and what its free ends do runs along the plug at the "
        "speed of sound: the strip is so long that this has not arrived, and the flow is steady to 1e-3."
    )

    def material(self) -> dict[str, Any]:
        # Shear waves cross twelve channels in the time in which viscosity crosses one.
        modulus = DENSITY * (12 * VISCOSITY / WIDTH) ** 2
        return {
            "law": "viscoplastic",
            "density": DENSITY,
            "yield_stress": DENSITY * PULL * self.plug * WIDTH / 2,
            "consistency": DENSITY * VISCOSITY,
            "shear_modulus": modulus,
            "bulk_modulus": modulus,
        }

    def known(self, y: np.ndarray, time: float) -> np.ndarray:
        return plugged(y, self.plug)


CASES = (Poiseuille(), Bingham())
