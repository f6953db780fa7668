"""Water at rest on a slope and in a bowl, and water that swings in a U tube."""

import math
from typing import ClassVar

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import ball, body, box, fit_oscillation, fluid, problem

GRAVITY, DENSITY = 9.81, 1000.0
# Size of the domain, m, and modulus of the water, Pa: the speed of sound is ten times that of a fall from 0.5 m.
SIZE, MODULUS = 1.0, 1e6


def tank(n: int, time: tuple[float, int], shape: Tables, collider: Tables, **start: str) -> Tables:
    """Return the tables of water in a domain of n cells along both axes, with one collider."""
    domain = {"size": [SIZE, SIZE], "cells": [n, n], "gravity": [0.0, -GRAVITY]}
    water = body("water", fluid(DENSITY, MODULUS), shape, **start)
    return problem(domain, time, "velocity", [water], colliders=[{"name": "vessel", **collider}])


def energy_rise(energy: np.ndarray) -> float:
    """Return the largest rise over an earlier value, in units of the energies, (n,)."""
    return float((energy - np.minimum.accumulate(energy)).max())


class StillWater(Case):
    """Water that starts at rest under its hydrostatic pressure on a collider, which carries its weight.

    `height` is that of its level above its lowest point.
    """

    text = case_text("still_water")
    group = "fluids"
    levels = {"coarse": (25, 50), "default": (25, 50, 100), "fine": (50, 100, 200)}  # noqa: RUF012
    varies = ("precision", "transfer", "per_axis", "safety")
    measures = (
        text.measure("kinetic energy (M g H)", 5e-5),
        text.measure("drift (h)", 6.0),
        text.measure("force error", 5e-3),
        text.measure("energy rise (M g H)", 1e-6),
    )
    water: ClassVar[Tables]
    vessel: ClassVar[Tables]
    height: ClassVar[float]

    def tables(self, n: int) -> Tables:
        return tank(n, (3.0, 60), self.water, self.vessel, initial_pressure="hydrostatic")

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return kinetic energy and rise of energy over M g H, drift, cells, and error of the force on the vessel."""
        energies, forces, first = [], [], None
        for frame, row in frames:
            first = frame.position.astype(np.float64) if first is None else first
            energies.append(row.energy)
            forces.append(-row.collider_force[0][1])
        weight = row.mass * GRAVITY
        scale = weight * self.height
        return {
            "kinetic energy": row.kinetic / scale,
            "drift": float(np.linalg.norm(frame.position - first, axis=1).max()) * n / SIZE,
            "force error": float(np.mean(forces[len(forces) // 2 :])) / weight - 1,
            "energy rise": energy_rise(np.array(energies)) / scale,
        }


# The slope rises from RISE[0] at the left wall to RISE[1] at the right one, 20 degrees, and the water to LEVEL, m.
RISE, LEVEL = (0.11, 0.11 + SIZE * math.tan(math.radians(20))), 0.6


class StillSlope(StillWater):
    """A slope of 20 degrees from wall to wall, all under water."""

    name, title = "still_slope", "Still water on a slope"
    water: ClassVar[Tables] = {"polygon": {"vertices": [[0.0, RISE[0]], [SIZE, RISE[1]], [SIZE, LEVEL], [0.0, LEVEL]]}}
    vessel: ClassVar[Tables] = {"shape": {"plane": {"point": [0.0, RISE[0]], "normal": [RISE[0] - RISE[1], SIZE]}}}
    height = LEVEL - RISE[0]


# Corners of the bowl.
TURNS = 2 * np.pi * (np.arange(24) + 0.2) / 24
CORNERS = [0.51, 0.49] + 0.43 * np.stack([np.cos(TURNS), np.sin(TURNS)], axis=1)


class StillBowl(StillWater):
    """A bowl of 24 sides, of radius 0.43 m, filled to 0.07 m above its middle."""

    name, title = "still_bowl", "Still water in a bowl"
    bowl: ClassVar[Tables] = {"polygon": {"vertices": CORNERS.tolist()}}
    water: ClassVar[Tables] = bowl | {"subtract": [box([0.0, 0.56], [SIZE, SIZE])]}
    vessel: ClassVar[Tables] = {"shape": bowl, "side": "inside"}
    height = 0.5


# The tube: half a ring of radii INNER and OUTER about (0.5, 0.5) below two legs, in which water stands LEG above the
# middle, and rises and falls by SWING, m.
INNER, OUTER, LEG, SWING = 0.2, 0.4, 0.2, 0.04
WIDTH, MIDDLE = OUTER - INNER, SIZE / 2
# Between arcs the flow is that of a vortex: its energy is that of a straight tube of length pi WIDTH / ln(OUTER/INNER).
VORTEX = WIDTH / math.log(OUTER / INNER)
LENGTH = 2 * LEG + math.pi * VORTEX
FREQUENCY = math.sqrt(2 * GRAVITY / LENGTH)
PERIODS, FRAMES_PER_PERIOD = 3, 24


def tube(level: float) -> Tables:
    """Return the shape of the tube up to a height above its middle, m."""
    ring = ball([MIDDLE, MIDDLE], OUTER)
    bend = ring | {"subtract": [ball([MIDDLE, MIDDLE], INNER), box([0.0, MIDDLE], [SIZE, SIZE])]}
    left, right = (box([x, MIDDLE], [x + WIDTH, MIDDLE + level]) for x in (MIDDLE - OUTER, MIDDLE + INNER))
    return left | {"add": [right, bend]}


class UTube(Case):
    """Water without friction, at its level with the velocity of potential flow: w^2 = 2 g / L."""

    text = case_text("u_tube")
    name, title, group = "u_tube", "Water that swings in a U tube", "fluids"
    levels = {"coarse": (40, 80), "default": (40, 80), "fine": (40, 80, 160)}  # noqa: RUF012
    varies = ("precision", "transfer", "per_axis", "safety")
    measures = (
        text.measure("period error", 0.015),
        text.measure("amplitude loss", lambda n: 0.1 * 40 / n),
        text.measure("energy rise (M g H)", 2e-4),
    )

    def tables(self, n: int) -> Tables:
        speed, x, y = SWING * FREQUENCY, f"(X - {MIDDLE!r})", f"(Y - {MIDDLE!r})"
        turn = f"{speed * VORTEX!r} / ({x}**2 + {y}**2)"
        velocity = [f"0 if {y} > 0 else -{turn} * {y}", f"{speed!r} * sign({x}) if {y} > 0 else {turn} * {x}"]
        start = {"velocity": velocity, "initial_pressure": "hydrostatic"}
        time = PERIODS * 2 * math.pi / FREQUENCY, PERIODS * FRAMES_PER_PERIOD
        return tank(n, time, tube(LEG), {"shape": tube(MIDDLE), "side": "inside"}, **start)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        found = []
        for frame, row in frames:
            found.append((frame.time, frame.position[:, 0].astype(np.float64).mean(), row.energy))
        time, place, energy = np.array(found).T
        swing = fit_oscillation(time, place - MIDDLE, FREQUENCY)
        return {
            "period error": FREQUENCY / swing.frequency - 1,
            "amplitude loss": 1 - math.exp(-swing.decay * 2 * math.pi / swing.frequency),
            "energy rise": energy_rise(energy) / (row.mass * GRAVITY * (OUTER + LEG)),
        }
