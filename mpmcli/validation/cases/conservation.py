"""Free bodies that rotate and vibrate: momenta and energy over thousands of steps (docs/theory.md, 10)."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, Tables, case_text
from mpmcli.validation.shared import ball, body, box, elastic, field, problem

FRAMES = 200
DENSITY, YOUNG, POISSON = 1000.0, 1e4, 0.3
EDGE, RADIUS = 0.5, 0.3
# Initial spin and strain rate, 1/s: the strain reaches a few per cent, and bodies make several turns.
SPIN, RATE = 1.5, 0.5
DRIFT = (0.004, -0.003, 0.002)


def started(turn: float, rate: float, dimension: int) -> list[list[float]]:
    """Return an initial velocity gradient, 1/s: rotation about every axis and stretching along x."""
    L = [[0.0] * dimension for _ in range(dimension)]
    for i in range(dimension):
        for j in range(i):
            # Different about each axis, so that no symmetry hides an error.
            L[i][j] = turn * (1 - 0.3 * j)
            L[j][i] = -L[i][j]
    L[0][0], L[1][1] = rate, -rate
    return L


class Conservation(Case):
    """A neo-Hookean block and a fixed corotated ball, far from each other and from walls."""

    text = case_text("conservation")
    group = "invariants"
    varies = ("precision", "kernel", "transfer")

    def __init__(self, name: str, title: str, dimension: int, levels: Levels) -> None:
        """Set measures with their bounds, the end, s, and the exact mass, kg, for a dimension."""
        self.name, self.title, self.dimension, self.levels = name, title, dimension, levels
        # Shorter waves in the bodies are damped first.
        loss = (lambda n: 0.2 * (8 / n) ** 0.45) if dimension == 2 else 0.11
        self.measures = (
            self.text.measure("angular momentum drift", 2e-14),
            self.text.measure("linear momentum drift", 2e-14),
            self.text.measure("mass error", 1e-12),
            self.text.measure("energy gain", 5e-4),
            self.text.measure("energy loss", loss),
        )
        # Several thousand steps.
        self.end = 20.0 if dimension == 2 else 10.0
        volume = math.pi * RADIUS**2 if dimension == 2 else 4 / 3 * math.pi * RADIUS**3
        self.mass = DENSITY * (EDGE**dimension + volume)

    def tables(self, n: int) -> Tables:
        """Return the block, of n cells per edge, and the ball; they drift, spin and stretch in opposite senses."""
        d = self.dimension
        across = [1.5 * EDGE] * (d - 1)
        centre = [1.5 * EDGE, *across]
        cube = box([c - EDGE / 2 for c in centre], [c + EDGE / 2 for c in centre])
        first = {"velocity": [*DRIFT[:d]], "velocity_gradient": started(SPIN, RATE, d)}
        second = {"velocity": [-v for v in DRIFT[:d]], "velocity_gradient": started(-0.5 * SPIN, -RATE, d)}
        neo_hookean, corotated = (elastic(law, DENSITY, YOUNG, POISSON) for law in ("neo_hookean", "fixed_corotated"))
        bodies = [
            body("block", neo_hookean, cube, **first),
            body("ball", corotated, ball([4.5 * EDGE, *across], RADIUS), **second),
        ]
        domain = {"size": [6 * EDGE] + [3 * EDGE] * (d - 1), "cells": [6 * n] + [3 * n] * (d - 1)}
        return problem(domain, (self.end, FRAMES), "velocity mass", bodies)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the largest changes of momenta, over sums of magnitudes, and of mass, and energy gained and lost."""
        origin = np.array(scene.domain.origin)
        rows = []
        momentum = moment = 0.0
        for frame, row in frames:
            if frame.index == 0:
                m = field(frame, "mass")
                speed = np.linalg.norm(frame.velocity, axis=1)
                momentum = float(m @ speed)
                moment = float(m @ (np.linalg.norm(frame.position - origin, axis=1) * speed))
            rows.append(row)

        def change(values: list[tuple[float, ...]]) -> float:
            return float(np.abs(np.array(values) - values[0]).max())

        energy = np.array([row.energy for row in rows])
        return {
            "angular momentum drift": change([row.angular_momentum for row in rows]) / moment,
            "linear momentum drift": change([row.linear_momentum for row in rows]) / momentum,
            "mass error": max(abs(row.mass / self.mass - 1) for row in rows),
            "energy gain": float(energy.max() / energy[0] - 1),
            "energy loss": float(1 - energy[-1] / energy[0]),
        }


class Meeting(Conservation):
    """Off-centre collision of a rotating soft ball and one a hundred times stiffer, with different stable steps."""

    text = case_text("conservation_contact")
    varies = ("precision", "transfer", "safety")

    def __init__(self) -> None:
        levels: Levels = {"coarse": (8, 16), "default": (8, 16, 32), "fine": (8, 16, 32)}
        super().__init__("conservation_contact", "A soft and a stiff ball that meet", 2, levels)
        self.measures = (
            self.text.measure("angular momentum drift", 5e-14),
            self.text.measure("linear momentum drift", 5e-14),
            *self.measures[2:4],
            self.text.measure("energy loss", lambda n: 4 / n, order=0.9, expected=1.0),
        )
        self.end, self.mass = 1.6, DENSITY * 2 * math.pi * RADIUS**2

    def tables(self, n: int) -> Tables:
        balls = [
            body(name, elastic("neo_hookean", DENSITY, young, POISSON), ball(centre, RADIUS), **start)
            for name, young, centre, start in (
                ("soft", YOUNG, [0.6, 1.0], {"velocity": [0.5, 0.0], "velocity_gradient": started(SPIN, 0.0, 2)}),
                ("stiff", 100 * YOUNG, [1.6, 1.2], {"velocity": [-0.5, 0.0]}),
            )
        ]
        domain = {"size": [6 * EDGE, 4 * EDGE], "cells": [6 * n, 4 * n]}
        return problem(domain, (self.end, FRAMES), "velocity mass", balls)


PLANE: Levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}
SPACE: Levels = {"coarse": (6,), "default": (6, 9), "fine": (6, 9, 12)}
CASES = (
    Conservation("conservation", "Momenta and energy of free bodies", 2, PLANE),
    Conservation("conservation_3d", "Momenta and energy of free bodies in 3D", 3, SPACE),
    Meeting(),
)
