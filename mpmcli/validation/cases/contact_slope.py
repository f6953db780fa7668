"""Bodies with velocity fields of their own on slopes: one slides on another with friction, a disk rolls on a plane."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.tables import Tables, ball, body, box, elastic, problem, smooth_ramp

GRAVITY, DENSITY, YOUNG, POISSON = 9.81, 1000.0, 4e6, 0.3
# The weight comes on, then what pulls along the slope, then rates are measured, s.
LOADED, MEASURED, END = 0.2, 0.25, 0.6
FRAMES = 60


def pull(degrees: float, along: np.ndarray, up: np.ndarray) -> list[str]:
    """Return gravity at an angle to a slope, with unit vectors along and normal to it: its normal part comes first."""
    slope, step = math.radians(degrees), f"clamp((t - {LOADED}) * 1e6, 0, 1)"
    parts = GRAVITY * math.sin(slope) * along, -GRAVITY * math.cos(slope) * up
    return [f"{one!r} * {step} + {other!r} * ({smooth_ramp(LOADED)})" for one, other in np.array(parts).T.tolist()]


def rate(times: list[float], values: list[float]) -> float:
    """Return the slope of values after MEASURED."""
    late = np.array(times) > MEASURED
    return float(np.polyfit(np.array(times)[late], np.array(values)[late], 1)[0])


class SlopeContact(Case):
    """A block on an elastic base, with gravity at 30 degrees, 0.3 cells off the grid."""

    text = case_text("slope_contact")
    name, title, group = "slope_contact", "Block that slides on an elastic base", "solids"
    levels = {"coarse": (5,), "default": (5, 10), "fine": (5, 10, 20)}  # noqa: RUF012
    varies = ("precision", "transfer", "per_axis")
    measures = (text.measure("friction error", 3e-3), text.measure("spin (1/s)"))
    degrees, friction, height = 30.0, 0.3, 0.25

    def tables(self, n: int) -> Tables:
        h, material = self.height / n, elastic("neo_hookean", DENSITY, YOUNG, POISSON)
        off, edge = 0.3 * h, self.height
        top = edge + off
        bodies = [
            body("base", material, box([edge + off, 0.0], [9 * edge + off, top])),
            body("block", material, box([2 * edge + off, top], [4 * edge + off, top + edge])),
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
    """A disk on a rough plane that is turned by 17 degrees on the grid, with gravity at 20 degrees to it."""

    text = case_text("rolling_contact")
    name, title = "rolling_contact", "Disk that rolls on a rough plane"
    levels = {"coarse": (5,), "default": (5, 10), "fine": (5, 10, 20)}  # noqa: RUF012
    measures = (
        text.measure("acceleration error", lambda n: 0.25 / n, expected=1.0),
        text.measure("spin error", lambda n: 0.5 / n),
    )
    degrees, friction, radius = 20.0, 0.5, 0.1
    turned = math.radians(17.0)

    def tables(self, n: int) -> Tables:
        along, up = self.axes()
        start = np.array([0.3, 0.5])
        disk = body(
            "disk", elastic("neo_hookean", DENSITY, YOUNG, POISSON), ball(start + self.radius * up, self.radius)
        )
        plane = {"plane": {"point": start.tolist(), "normal": up.tolist()}}
        domain = {"size": [1.0, 1.0], "spacing": self.radius / n, "gravity": pull(self.degrees, along, up)}
        more = {
            "colliders": [{"name": "plane", "shape": plane, "friction": self.friction}],
            "contact": {"default": "separate"},
        }
        return problem(domain, (END, FRAMES), "velocity", [disk], **more)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors down the plane and out of it."""
        c, s = math.cos(self.turned), math.sin(self.turned)
        return np.array([c, -s]), np.array([s, c])

    def found(self, times: list[float], speeds: np.ndarray, turns: list[float]) -> dict[str, float]:
        exact = 2 / 3 * GRAVITY * math.sin(math.radians(self.degrees))
        along, _ = self.axes()
        return {
            "acceleration error": rate(times, speeds @ along) / exact - 1,
            "spin error": -rate(times, turns) * self.radius / exact - 1,
        }


CASES = (SlopeContact(), RollingContact())
