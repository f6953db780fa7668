"""Time and speed of the first contact of each body; until then it is in free flight and does not deform."""

import math
from dataclasses import dataclass

import numpy as np

from mpmcli.check.distance import image_shifts
from mpmcli.scene import Scene
from mpmcli.scene.initial import moves_unevenly

# Distance, in cells, below which two bodies, or a body and a wall, interact through the grid.
CONTACT = 1.0


@dataclass(frozen=True)
class Arrival:
    """End of the free flight of a body.

    Attributes:
        time: first contact, s; 0 if it is in contact at the start, infinite if there is no contact.
        speed: largest closing speed, m/s, over the walls and bodies that it meets.
        impact: velocity in the first contact after the start, (d,), m/s: relative to a wall, or half of that to a body;
            empty if there is none in the run.
    """

    time: float
    speed: float
    impact: tuple[float, ...] = ()


def arrivals(scene: Scene, fastest: float = 0.0, *, pressed: bool = False) -> list[Arrival]:
    """Return the arrival of the bounding box of each body, from velocities, gravity, walls and the other bodies.

    All bodies have the same acceleration, so that two approach each other at constant velocity. Rotation and
    deformation are ignored, and beyond a periodic face is the other side of the domain, with its bodies. If forces act,
    gravity or a velocity is an expression, or bodies start deformed, all bodies arrive at time 0.

    Args:
        scene: whose bodies.
        fastest: speed at which all arrive in those cases, m/s.
        pressed: whether any body starts deformed.
    """
    if pressed or scene.pushes or not scene.domain.steady or any(moves_unevenly(body) for body in scene.bodies):
        return [Arrival(0.0, fastest)] * len(scene.bodies)
    reach = CONTACT * scene.domain.spacing
    gravity = np.array(scene.domain.gravity)
    walls = [np.where(scene.domain.periodic, side * np.inf, at) for side, at in _ends(scene)]
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    velocities = np.array([body.velocity for body in scene.bodies])
    # Images of all bodies, those themselves first.
    shifts = image_shifts(scene)
    lowers, uppers = (np.concatenate([found + shift for shift in shifts]) for found in (lowers, uppers))
    velocities = np.tile(velocities, (len(shifts), 1))
    found = []
    for i, (lower, upper) in enumerate(bounds):
        falls = [
            _fall(float(gap), float(sign * velocities[i][a]), float(sign * gravity[a]), reach)
            for sign, gaps in ((-1, lower - walls[0]), (1, walls[1] - upper))
            for a, gap in enumerate(gaps)
        ]
        others = np.arange(len(lowers)) % len(bounds) != i
        relative = velocities[i] - velocities[others]
        times = _meetings(lowers[others] - upper - reach, uppers[others] - lower + reach, relative)
        met = np.isfinite(times)
        speeds = [speed for time, speed in falls if math.isfinite(time)]
        speeds += np.linalg.norm(relative[met], axis=1).tolist()
        ends = np.array([time for time, _ in falls] + times.tolist())
        # What touches it from the start, such as a wall along which it flies, is no impact.
        later = np.where(ends > 0, ends, np.inf)
        first = int(np.argmin(later))
        impact = np.zeros(0)
        if later[first] <= scene.time.end:
            # The axes of the lower walls, then those of the upper ones; then the bodies.
            axis, body = first % len(lower), first - len(falls)
            impact = relative[body] / 2 if body >= 0 else falls[first][1] * np.eye(len(lower))[axis]
        found.append(Arrival(float(ends.min()), max(speeds, default=0.0), tuple(impact.tolist())))
    return found


def _ends(scene: Scene) -> tuple[tuple[int, np.ndarray], ...]:
    return (-1, np.array(scene.domain.origin)), (1, np.array(scene.domain.upper))


def _fall(gap: float, speed: float, gravity: float, reach: float) -> tuple[float, float]:
    """Return the time, s, at which a gap that closes at `speed` and accelerates by `gravity` is `reach`, and the speed.

    If the gap is smaller than `reach` already, the speed is that at which it closes. An infinite one never closes.
    """
    if math.isinf(gap):
        return math.inf, 0.0
    left = gap - reach
    if left <= 0:
        # It accelerates over the remaining gap.
        return 0.0, math.sqrt(max(0.0, max(speed, 0.0) ** 2 + 2 * gravity * max(gap, 0.0)))
    square = speed**2 + 2 * gravity * left
    if square < 0 or (speed <= 0 and gravity <= 0):
        return math.inf, 0.0
    arrival = math.sqrt(square)
    # The root of speed t + gravity t^2/2 = left without cancellation.
    time = 2 * left / (speed + arrival) if speed > 0 else (arrival - speed) / gravity
    return time, math.sqrt(max(0.0, speed**2 + 2 * gravity * gap))


def _meetings(low: np.ndarray, high: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the time at which a box first overlaps each of n others, (n,), s; infinite if it does not.

    Args:
        low, high: displacement at which the overlap along each axis begins and ends, (n, d), m.
        velocity: velocity relative to each of the others, (n, d), m/s.
    """
    moving = velocity != 0
    safe = np.where(moving, velocity, 1.0)
    ends = np.sort(np.stack([low / safe, high / safe]), axis=0)
    # Along an axis without relative motion they overlap always or never.
    always = (low <= 0) & (high >= 0)
    enter = np.where(moving, ends[0], np.where(always, -np.inf, np.inf))
    leave = np.where(moving, ends[1], np.where(always, np.inf, -np.inf))
    first, last = np.maximum(0.0, enter.max(axis=1)), leave.min(axis=1)
    return np.where(first <= last, first, np.inf)
