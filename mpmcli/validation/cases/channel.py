"""Flow of a viscous and a Bingham fluid between sticking walls, driven by a body force or by a moving wall."""

import math
from collections.abc import Callable

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, Tables, case_text
from mpmcli.validation.shared import body, box, field, fluid, problem

# Distance of the walls, m; density, kg/m^3; kinematic viscosity, m^2/s; acceleration by the body force, m/s^2; and
# speed of the moving wall, m/s.
WIDTH, DENSITY, VISCOSITY, PULL, SPEED = 1.0, 1000.0, 1.0, 0.5, 0.5
# Sound travels ten widths in the viscous time, WIDTH^2 / VISCOSITY.
VISCOUS = fluid(DENSITY, DENSITY * (10 * VISCOSITY / WIDTH) ** 2, viscosity=DENSITY * VISCOSITY, tension_cutoff=False)
# Length of the evaluated middle, in widths.
MIDDLE = 1
# Width of the plug of the Bingham fluid, relative to that of the channel.
PLUG = 0.4
# Terms of the series; the first omitted term is 1e-6 of the first.
TERMS = 50
# Cells along the channel with periodic ends: the flow does not depend on the position along it.
PERIODIC = 8


def started(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity of a viscous fluid at y, m/s, at a time after the body force starts, s.

    u = g/(2 nu) y (W - y) - sum 4 g W^2/(nu (k pi)^3) sin(k pi y/W) exp(-nu (k pi/W)^2 t) over odd k.
    """
    k = math.pi * (2 * np.arange(TERMS) + 1)
    waves = 4 * PULL * WIDTH**2 / (VISCOSITY * k**3) * np.exp(-VISCOSITY * (k / WIDTH) ** 2 * time)
    return PULL / (2 * VISCOSITY) * y * (WIDTH - y) - np.sin(y[:, None] * k / WIDTH) @ waves


def dragged(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity of a viscous fluid at y, m/s, at a time after the upper wall starts to move, s.

    u = U y/W + sum 2 U/(n pi) (-1)^n sin(n pi y/W) exp(-nu (n pi/W)^2 t).
    """
    n = np.arange(1, TERMS + 1)
    waves = 2 * SPEED / (n * math.pi) * (-1.0) ** n * np.exp(-VISCOSITY * (n * math.pi / WIDTH) ** 2 * time)
    return SPEED * y / WIDTH + np.sin(y[:, None] * n * math.pi / WIDTH) @ waves


def plugged(y: np.ndarray, plug: float) -> np.ndarray:
    """Return the steady velocity of a Bingham fluid at y, m/s; `plug` is the width of its plug over the channel's.

    u = g/(2 nu) ((W/2 - b)^2 - max(|y - W/2| - b, 0)^2) with the half width b of the plug, yield stress = density g b.
    """
    half, b = WIDTH / 2, plug * WIDTH / 2
    return PULL / (2 * VISCOSITY) * ((half - b) ** 2 - np.maximum(np.abs(y - half) - b, 0) ** 2)


class Channel(Case):
    """A strip of fluid with free, distant ends that is accelerated along the channel from rest."""

    resolution = "cells across the channel"
    # End of the run, s, and length of the strip in widths: its ends do not affect the middle until then.
    end: float
    length: int
    material: Tables

    # The exact velocity along the channel, m/s, at y, m, and a time, s.
    known: Callable[[np.ndarray, float], np.ndarray]

    def tables(self, n: int) -> Tables:
        """Return a channel of n cells of width, and a block of fluid in it that gravity pulls along the walls."""
        h = WIDTH / n
        return problem(
            {
                "size": [(self.length + 1) * WIDTH, WIDTH],
                "cells": [(self.length + 1) * n, n],
                "gravity": [PULL, 0.0],
                "walls": {"default": "slip", "y_min": "stick", "y_max": "stick"},
            },
            (self.end, 1),
            "velocity initial_position",
            # Particles stay in rows along the channel; any other sampling causes noise across it.
            [body("fluid", self.material, box([4 * h, 0.0], [4 * h + self.length * WIDTH, WIDTH]), sampling="lattice")],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of velocity and flow, and the flow across, in the middle of the block at the end."""
        *_, (last, row) = frames
        X = field(last, "initial_position")
        start, end = (bound[0] for bound in scene.bodies[0].shape.form.bounds())
        middle = np.abs(X[:, 0] - (start + end) / 2) < MIDDLE * WIDTH / 2
        # Velocities lag positions by half a step.
        exact = self.known(X[middle, 1], last.time - row.step_max / 2)
        u, v = last.velocity[middle].astype(np.float64).T
        return {
            "velocity error": float(np.sqrt(((u - exact) ** 2).mean() / (exact**2).mean())),
            "flow error": float(u.sum() / exact.sum() - 1),
            "cross flow": float(np.abs(v).max() / exact.max()),
        }


def channel_measures(bound: Callable[[int], float], order: float | None = None) -> tuple[Measure, ...]:
    """Return the measures; the flow, a mean of the velocity, has the bound of the velocity."""
    text = "L2 error of the velocity in the middle, over the velocity."
    return (
        Measure(f"velocity error: {text}", bound, order=order, expected=2.0),
        Measure("flow error: Flow through the middle over the exact one, minus 1.", bound, expected=2.0),
        Measure("cross flow: Largest velocity across the channel, over the largest along it.", 1e-4),
    )


class Poiseuille(Channel):
    """Plane Poiseuille flow at 0.15 WIDTH^2 / VISCOSITY after its start."""

    text = case_text("poiseuille")
    name, title, group = "poiseuille", "Start of a viscous flow between walls that stick", "fluids"
    levels = {"coarse": (8, 16), "default": (8, 16, 32), "fine": (8, 16, 32, 64)}  # noqa: RUF012
    end, length = 0.15 * WIDTH**2 / VISCOSITY, 6
    varies = ("precision", "transfer")
    material = VISCOUS
    measures = channel_measures(lambda n: 1.5 * 1.6 / n**2, 1.9)
    known = staticmethod(started)


class Bingham(Channel):
    """The steady flow of a Bingham fluid: a plug, and a parabola on either side."""

    text = case_text("bingham")
    name, title, group = "bingham", "Bingham fluid between walls that stick", "plastic"
    levels = {"coarse": (16,), "default": (16, 32), "fine": (16, 32, 64)}  # noqa: RUF012
    end, length = 0.55 * WIDTH**2 / VISCOSITY, 20
    varies = ("precision",)
    # Shear waves travel twelve widths in the viscous time.
    modulus = DENSITY * (12 * VISCOSITY / WIDTH) ** 2
    flow = {"yield_stress": DENSITY * PULL * PLUG * WIDTH / 2, "consistency": DENSITY * VISCOSITY}  # noqa: RUF012
    material = fluid(DENSITY, modulus, shear_modulus=modulus, law="viscoplastic", **flow)
    measures = channel_measures(lambda n: 1.5 * (1.5 / n**2 + 3e-4))
    known = staticmethod(lambda y, time: plugged(y, PLUG))


class Couette(Case):
    """Plane Couette flow at 0.1 WIDTH^2 / VISCOSITY after its start."""

    text = case_text("couette")
    name, title, group = "couette", "Start of a viscous flow by a wall that moves", "fluids"
    source = Poiseuille.source
    resolution = Channel.resolution
    levels = Poiseuille.levels
    varies = ("precision", "transfer")
    measures = (
        text.measure("velocity error", lambda n: 1.5 * 0.25 / n**2, order=1.9, expected=2.0),
        text.measure("cross flow", 1e-4),
        text.measure("unevenness", 1e-9),
    )

    def tables(self, n: int) -> Tables:
        """Return a periodic channel of n cells of width, whose upper wall moves along itself."""
        length = PERIODIC * WIDTH / n
        return problem(
            {
                "size": [length, WIDTH],
                "cells": [PERIODIC, n],
                "walls": {"x_min": "periodic", "x_max": "periodic", "y_min": "stick", "y_max": "stick"},
                "wall_velocity": {"y_max": [SPEED, 0.0]},
            },
            (0.1 * WIDTH**2 / VISCOSITY, 1),
            "velocity initial_position",
            [body("fluid", VISCOUS, box([0.0, 0.0], [length, WIDTH]))],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        *_, (last, row) = frames
        y = field(last, "initial_position")[:, 1]
        u, v = last.velocity.astype(np.float64).T
        # Velocities lag positions by half a step.
        exact = dragged(y, last.time - row.step_max / 2)
        return {
            "velocity error": float(np.sqrt(((u - exact) ** 2).mean())) / SPEED,
            "cross flow": float(np.abs(v).max()) / SPEED,
            "unevenness": max(float(np.ptp(u[y == height])) for height in np.unique(y)) / SPEED,
        }
