"""When each body first meets a wall or another body, and how fast: until then it flies freely and stays as it is."""

import math
from dataclasses import dataclass

import numpy as np

from mpmcli.scene import Scene, scene_bounds
from mpmcli.scene.initial import moves_unevenly

# Cells between two things that meet through the grid already.
CONTACT = 1.0


@dataclass(frozen=True)
class Arrival:
    """Where the free flight of a body ends.

    Attributes:
        time: of its first contact, s; 0 where it is in contact from the start, infinite where it never is.
        speed: at which it closes in on whatever it first meets along each axis, the largest, m/s.
    """

    time: float
    speed: float


def arrivals(scene: Scene) -> list[Arrival]:
    """Return the arrival of each body, of its bounding box, from its velocity, gravity, walls and the other bodies.

    Bodies fall alike, so that two of them approach each other steadily. How they rotate and deform is left out. Where
    forces act, or gravity or a velocity is an expression, nothing is known of the flight: all bodies count as arrived.
    """
    if scene.forces or not scene.domain.steady or any(moves_unevenly(body) for body in scene.bodies):
        return [Arrival(0.0, scene_bounds(scene).speed)] * len(scene.bodies)
    reach = CONTACT * scene.domain.spacing
    gravity = np.array(scene.domain.gravity)
    walls = np.array(scene.domain.origin), np.array(scene.domain.upper)
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    velocities = np.array([body.velocity for body in scene.bodies])
    found = []
    for i, (lower, upper) in enumerate(bounds):
        falls = [
            _fall(float(gap), float(sign * velocities[i][a]), float(sign * gravity[a]), reach)
            for sign, gaps in ((-1, lower - walls[0]), (1, walls[1] - upper))
            for a, gap in enumerate(gaps)
        ]
        others = np.arange(len(bounds)) != i
        relative = velocities[i] - velocities[others]
        times = _meetings(lowers[others] - upper - reach, uppers[others] - lower + reach, relative)
        met = np.isfinite(times)
        speeds = [speed for time, speed in falls if math.isfinite(time)]
        speeds += np.linalg.norm(relative[met], axis=1).tolist()
        found.append(Arrival(min([time for time, _ in falls] + times.tolist()), max(speeds, default=0.0)))
    return found


def _fall(gap: float, speed: float, gravity: float, reach: float) -> tuple[float, float]:
    """Return when a gap that closes at `speed` and faster by `gravity` (m/s^2) is down to `reach`, and the speed then.

    A body that is there already has the speed at which it goes on closing.
    """
    left = gap - reach
    if left <= 0:
        # Through what is left of the gap it still gathers speed.
        return 0.0, math.sqrt(max(0.0, max(speed, 0.0) ** 2 + 2 * gravity * max(gap, 0.0)))
    square = speed**2 + 2 * gravity * left
    if square < 0 or (speed <= 0 and gravity <= 0):
        return math.inf, 0.0
    arrival = math.sqrt(square)
    # The root of speed t + gravity t^2/2 = left that does not cancel.
    time = 2 * left / (speed + arrival) if speed > 0 else (arrival - speed) / gravity
    return time, math.sqrt(max(0.0, speed**2 + 2 * gravity * gap))


def _meetings(low: np.ndarray, high: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return when a box first overlaps others, (n,), s; infinite where it never does.

    Args:
        low, high: (n, d), how far it has to go for the overlap to begin and to end along each axis, m.
        velocity: (n, d), its velocity relative to each of the others, m/s.
    """
    moving = velocity != 0
    safe = np.where(moving, velocity, 1.0)
    ends = np.sort(np.stack([low / safe, high / safe]), axis=0)
    # Along an axis without motion they overlap always, or never.
    always = (low <= 0) & (high >= 0)
    enter = np.where(moving, ends[0], np.where(always, -np.inf, np.inf))
    leave = np.where(moving, ends[1], np.where(always, np.inf, -np.inf))
    first, last = np.maximum(0.0, enter.max(axis=1)), leave.min(axis=1)
    return np.where(first <= last, first, np.inf)
