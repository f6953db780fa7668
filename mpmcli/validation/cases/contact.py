"""Bodies on walls and on each other: lift-off, and sliding and rolling with Coulomb friction."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, Tables, case_text
from mpmcli.validation.shared import ball, body, box, elastic, problem, smooth_ramp

GRAVITY, DENSITY, YOUNG = 9.81, 1000.0, 1e6
# The sliding block: length and height, m, coefficient of friction, and initial speed, m/s.
LENGTH, HEIGHT, FRICTION, SPEED = 1.0, 0.25, 0.3, 2.0
DECELERATION = FRICTION * GRAVITY
STOP = SPEED / DECELERATION


class SlidingBlock(Case):
    """v = v0 - mu g t along the floor, and rest after v0^2 / (2 mu g)."""

    text = case_text("sliding_block")
    name, title, group = "sliding_block", "Block that slides along a rough floor and stops", "solids"
    levels = {"coarse": (4,), "default": (4, 8), "fine": (4, 8, 16)}  # noqa: RUF012
    varies = ("precision", "kernel", "transfer")
    measures = (
        Measure("distance error: Error of the sliding distance, relative to v0^2 / (2 mu g).", 7e-3),
        Measure("deceleration error: Error of the deceleration while sliding, relative to mu g.", 7e-3),
        Measure("drift (L/s): Speed after the block has stopped, in lengths per second.", 8e-5),
    )

    def tables(self, n: int) -> Tables:
        """Return a block of n cells of height, compressed by its weight, that slides on a floor with friction."""
        block = body(
            "block",
            # With nu = 0 the weight causes one-dimensional compression, which is the initial state.
            elastic("neo_hookean", DENSITY, YOUNG, 0.0),
            box([2 * HEIGHT, 0.0], [2 * HEIGHT + LENGTH, HEIGHT]),
            velocity=[SPEED, 0.0],
            deformation=[[1.0, 0.0], [0.0, f"1 - {DENSITY * GRAVITY / YOUNG} * ({HEIGHT} - Y)"]],
        )
        domain = {"size": [16 * HEIGHT, 2 * HEIGHT], "spacing": HEIGHT / n, "gravity": [0.0, -GRAVITY]}
        walls = {"walls": "separate", "friction": {"y_min": FRICTION}}
        return problem(domain | walls, (2.5 * STOP, 250), "velocity", [block])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        path = np.array([(frame.time, frame.position[:, 0].mean(dtype=np.float64)) for frame, _ in frames]).T
        time, place = path
        sliding, resting = (time > 0.1 * STOP) & (time < 0.9 * STOP), time > 1.1 * STOP
        slowing = -2 * np.polyfit(time[sliding], place[sliding], 2)[0]
        return {
            "distance error": abs(float(place[resting].mean() - place[0]) / (SPEED**2 / (2 * DECELERATION)) - 1),
            "deceleration error": abs(float(slowing) / DECELERATION - 1),
            "drift": abs(float(np.polyfit(time[resting], place[resting], 1)[0])) / LENGTH,
        }


# Material of the bodies with separate velocity fields.
SOLID = elastic("neo_hookean", DENSITY, 4e6, 0.3)
# End of the ramp of the normal load and start of the load along the slope, start of the measurement, and end, s.
LOADED, MEASURED, END = 0.2, 0.25, 0.6
FRAMES = 60


def pull(degrees: float, along: np.ndarray, up: np.ndarray) -> list[str]:
    """Return the gravity of a slope, given unit vectors along and normal to it; its normal part is applied first."""
    slope, step = math.radians(degrees), f"clamp((t - {LOADED}) * 1e6, 0, 1)"
    parts = GRAVITY * math.sin(slope) * along, -GRAVITY * math.cos(slope) * up
    return [f"{one!r} * {step} + {other!r} * ({smooth_ramp(LOADED)})" for one, other in np.array(parts).T.tolist()]


def rate(times: list[float], values: list[float]) -> float:
    """Return the rate of change of values after MEASURED."""
    late = np.array(times) > MEASURED
    return float(np.polyfit(np.array(times)[late], np.array(values)[late], 1)[0])


class SlopeContact(Case):
    """A block on an elastic base with a slope of 30 degrees, 0.3 cells off the grid."""

    text = case_text("slope_contact")
    name, title, group = "slope_contact", "Block that slides on an elastic base", "solids"
    levels = {"coarse": (5,), "default": (5, 10), "fine": (5, 10, 20)}  # noqa: RUF012
    varies = ("precision", "transfer", "per_axis")
    measures = (text.measure("friction error", 3e-3), text.measure("spin (1/s)"))
    degrees, friction, height = 30.0, 0.3, 0.25

    def tables(self, n: int) -> Tables:
        """Return a block on a base, n cells high, both off nodes, in gravity tilted by `degrees`."""
        h = self.height / n
        off, edge = 0.3 * h, self.height
        top = edge + off
        bodies = [
            body("base", SOLID, box([edge + off, 0.0], [9 * edge + off, top])),
            body("block", SOLID, box([2 * edge + off, top], [4 * edge + off, top + edge])),
        ]
        domain = {"size": [10 * edge, 3 * edge], "spacing": h, "walls": {"default": "separate", "y_min": "stick"}}
        gravity = pull(self.degrees, np.array([1.0, 0.0]), np.array([0.0, 1.0]))
        contact = {"default": "separate", "friction": self.friction}
        return problem(domain | {"gravity": gravity}, (END, FRAMES), "velocity", bodies, contact=contact)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, speeds, turns = [], [], []
        for frame, _ in frames:
            block = frame.body == len(scene.bodies) - 1
            x, v = (one[block].astype(np.float64) for one in (frame.position, frame.velocity))
            times.append(frame.time)
            speeds.append(v.mean(axis=0))
            x, v = x - x.mean(axis=0), v - v.mean(axis=0)
            turns.append(float((x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() / (x**2).sum()))
        return self.found(times, np.array(speeds), turns)

    def found(self, times: list[float], speeds: np.ndarray, turns: list[float]) -> dict[str, float]:
        """Return the measures from the mean velocity of the body, m/s, and its spin, 1/s."""
        slope = math.radians(self.degrees)
        friction = (math.sin(slope) - rate(times, speeds[:, 0]) / GRAVITY) / math.cos(slope)
        return {"friction error": friction / self.friction - 1, "spin": turns[-1]}


class RollingContact(SlopeContact):
    """A disk on a rough plane at 17 degrees to the grid, with a slope of 20 degrees."""

    text = case_text("rolling_contact")
    name, title = "rolling_contact", "Disk that rolls on a rough plane"
    levels = {"coarse": (5,), "default": (5, 10), "fine": (5, 10, 20)}  # noqa: RUF012
    measures = (
        text.measure("acceleration error", lambda n: 0.3 / n, expected=1.0),
        text.measure("spin error", lambda n: 0.5 / n),
    )
    degrees, friction, radius = 20.0, 0.5, 0.1
    turned = math.radians(17.0)

    def tables(self, n: int) -> Tables:
        along, up = self.axes()
        start = np.array([0.3, 0.5])
        disk = body("disk", SOLID, ball(start + self.radius * up, self.radius))
        plane = {"plane": {"point": start.tolist(), "normal": up.tolist()}}
        domain = {"size": [1.0, 1.0], "spacing": self.radius / n, "gravity": pull(self.degrees, along, up)}
        more = {
            "colliders": [{"name": "plane", "shape": plane, "friction": self.friction}],
            "contact": {"default": "separate"},
        }
        return problem(domain, (END, FRAMES), "velocity", [disk], **more)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors down the plane and normal to it."""
        c, s = math.cos(self.turned), math.sin(self.turned)
        return np.array([c, -s]), np.array([s, c])

    def found(self, times: list[float], speeds: np.ndarray, turns: list[float]) -> dict[str, float]:
        exact = 2 / 3 * GRAVITY * math.sin(math.radians(self.degrees))
        along, _ = self.axes()
        return {
            "acceleration error": rate(times, speeds @ along) / exact - 1,
            "spin error": -rate(times, turns) * self.radius / exact - 1,
        }


# The block that lifts off: its edge, m, and velocity, m/s.
EDGE, VELOCITY = 1.0, (1.5, 4.0)


class TakeOff(Case):
    """x = X + v t - g t^2/2 from the first step on: separating walls do not pull."""

    text = case_text("take_off")
    name, title, group = "take_off", "Block that takes off from separating walls", "invariants"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    varies = ("precision", "transfer")
    measures = (
        Measure("path error: Largest distance of a particle from its parabola, over the edge.", 1e-12),
        Measure("stress (E): Largest stress in the block.", 1e-12),
    )

    def tables(self, n: int) -> Tables:
        material = elastic("neo_hookean", DENSITY, YOUNG, 0.3)
        block = body("block", material, box([0.0, 0.0], [EDGE, EDGE]), velocity=[*VELOCITY])
        domain = {"size": [3 * EDGE] * 2, "cells": [3 * n] * 2, "gravity": [0.0, -GRAVITY], "walls": "separate"}
        # The block is still in the air at the end.
        return problem(domain, (0.5, 10), "stress initial_position", [block])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        path = stress = 0.0
        for frame, _ in frames:
            t = frame.time
            flown = np.array(VELOCITY) * t - np.array([0.0, GRAVITY]) * t**2 / 2
            off = frame.position.astype(np.float64) - frame.fields["initial_position"] - flown
            path = max(path, float(np.linalg.norm(off, axis=1).max()))
            stress = max(stress, float(np.abs(frame.fields["stress"]).max()))
        return {"path error": path / EDGE, "stress": stress / YOUNG}
