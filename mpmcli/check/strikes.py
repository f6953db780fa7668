"""The speed at which a body and colliders or rigid bodies meet, by the paths of their bounding boxes."""

import math

import numpy as np

from mpmcli.scene import Body, Scene
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.primitives import box_corners

# Fewest and most instants of a run at which paths are evaluated, a cell apart; most of a prescribed motion.
INSTANTS, MOST_INSTANTS, MOST_POSES = 65, 2000, 65


def strike_speed(scene: Scene, body: Body, landing: float) -> tuple[float, str]:
    """Return the largest closing speed, m/s, of a body and a collider that meet in the run, and the collider's name.

    Of each collider the first contact counts. The body flies freely until `landing`, s, or until it meets one of them;
    rigid bodies fly freely to the walls of the domain.
    """
    colliders = [one for one in scene.colliders if not one.holds and one.side == "outside"]
    if not colliders or not scene.domain.steady:
        return 0.0, ""
    end, bounds = scene.time.end, body.shape.form.bounds()
    fastest = float(np.linalg.norm(body.velocity)) + max(one.fastest(scene.domain, end) for one in colliders)
    count = min(max(INSTANTS, int(fastest * end / scene.domain.spacing) + 2), MOST_INSTANTS)
    times = np.linspace(0.0, end, count)
    ways = [_way(scene, one, times) for one in colliders]
    for _ in range(2):
        # First contacts end the flight; then they are those of the path that ends there.
        path = _flight(scene, bounds, body.velocity, times, landing)
        met = [_meeting(scene, bounds, path - way, one, times) for one, way in zip(colliders, ways, strict=True)]
        landing = min(landing, *(time for time, _ in met))
    return max((speed, one.name) for (_, speed), one in zip(met, colliders, strict=True))


def _flight(
    scene: Scene, bounds: tuple[np.ndarray, np.ndarray], velocity: tuple, times: np.ndarray, landing: float
) -> np.ndarray:
    """Return the displacement, (n, d), m, of a box in free flight until `landing`, s, within the domain."""
    lasts = np.minimum(times, landing)[:, None]
    # What is in contact from the start slides.
    way = (
        np.array(velocity) * (lasts if landing > 0 else times[:, None]) + np.array(scene.domain.gravity) * lasts**2 / 2
    )
    below, above = np.array(scene.domain.origin) - bounds[0], np.array(scene.domain.upper) - bounds[1]
    return np.clip(way, np.minimum(below, 0.0), np.maximum(above, 0.0))


def _way(scene: Scene, one: Collider, times: np.ndarray) -> np.ndarray:
    """Return the displacement of a collider, (n, d), m."""
    if one.free:
        return _flight(scene, one.form.bounds(), one.velocity, times, math.inf)
    if not one.driven:
        return np.zeros((len(times), scene.dimension))
    motion, instants = one.motion, np.linspace(0.0, scene.time.end, MOST_POSES)
    places = np.array([motion.pose(time)[0] for time in instants]) - one.center
    return np.stack([np.interp(times, instants, each) for each in places.T], axis=1)


def _meeting(
    scene: Scene, bounds: tuple[np.ndarray, np.ndarray], relative: np.ndarray, one: Collider, times: np.ndarray
) -> tuple[float, float]:
    """Return when a box that is displaced by `relative`, (n, d), first meets a collider, s, and their speed, m/s."""
    turns = not one.free and one.driven and one.motion.turns
    if isinstance(one.form, Plane):
        relative = relative @ one.form.direction[:, None]
        gaps = one.form.signed_distance(box_corners(*bounds)).min() + relative
    else:
        lower, upper = one.form.bounds()
        if turns:
            lower, upper = np.array(one.center) - one.radius, np.array(one.center) + one.radius
        gaps = np.maximum(bounds[0] + relative - upper, lower - bounds[1] - relative)
    met = (gaps < scene.domain.spacing).all(axis=1)
    first = int(met.argmax())
    if not met[first]:
        return math.inf, 0.0
    axis, before = int(gaps[first].argmax()), max(first - 1, 0)
    speed = abs(float(np.gradient(relative[:, axis], times)[before]))
    return float(times[first]), one.fastest(scene.domain, scene.time.end) if turns and first else speed
