"""What a scene can reach, from its initial state alone: the highest speed, the deepest column, the densest body."""

from itertools import product

import numpy as np

from mpmcli.scene.material import SceneBounds
from mpmcli.scene.schema import Body, Scene


def scene_bounds(scene: Scene) -> SceneBounds:
    """Return bounds on the speed, the depth and the density of a scene.

    speed = sqrt(v0^2 + 2 g H), with v0 the highest initial speed of any body and H the height of the
    highest matter above the lowest point of the domain, both measured against gravity; v0 alone where
    there is no gravity. height = H, or the largest extent of the matter where there is no gravity.
    """
    gravity = np.array(scene.domain.gravity)
    g = float(np.linalg.norm(gravity))
    initial = max(highest_speed(body) for body in scene.bodies)
    corners = np.concatenate([_corners(*body.shape.form.bounds()) for body in scene.bodies])
    if g > 0:
        down = gravity / g
        floor = np.max(_corners(np.array(scene.domain.origin), np.array(scene.domain.upper)) @ down)
        height = max(0.0, float(floor - np.min(corners @ down)))
    else:
        height = float(np.max(np.ptp(corners, axis=0)))
    return SceneBounds(
        dimension=scene.dimension,
        spacing=scene.domain.spacing,
        gravity=g,
        speed=float(np.sqrt(initial**2 + 2 * g * height)),
        height=height,
        density=max(body.material.density for body in scene.bodies),
    )


def highest_speed(body: Body) -> float:
    """Return a bound on the initial speed of a body, m/s: that at the corners of its bounding box."""
    velocity = np.array(body.velocity)
    if body.velocity_gradient is None:
        return float(np.linalg.norm(velocity))
    lower, upper = body.shape.form.bounds()
    offsets = _corners(lower, upper) - (lower + upper) / 2
    return float(np.max(np.linalg.norm(velocity + offsets @ np.array(body.velocity_gradient).T, axis=1)))


def _corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the 2^d corners of a box, (2^d, d)."""
    return np.array(list(product(*zip(lower, upper, strict=True))))
