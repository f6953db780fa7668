"""What a scene can reach, from its initial state alone: the highest speed, the deepest column, the densest body."""

from itertools import product

import numpy as np

from mpmcli.scene.entry import value_of, varies
from mpmcli.scene.expression import INITIAL, POSITION
from mpmcli.scene.initial import initial_motion, moves_unevenly
from mpmcli.scene.material import SceneBounds
from mpmcli.scene.schema import Body, Force, Scene

# Where expressions are looked at: instants of a run; points along each axis of a box, 2D and 3D, corners included;
# and for forces, which depend on both, fewer of either.
INSTANTS = 257
POINTS = {2: 65, 3: 17}
FORCE_INSTANTS = 33
FORCE_POINTS = {2: 17, 3: 9}


def scene_bounds(scene: Scene) -> SceneBounds:
    """Return bounds on the speed, the depth and the density of a scene.

    speed = sqrt(v0^2 + 2 g H), with v0 the highest initial speed of any body and H the height of the
    highest matter above the lowest point of the domain, both measured against gravity; v0 alone where
    there is no gravity. height = H, or the largest extent of the matter where there is no gravity.

    For gravity that depends on time, the strongest counts, and the largest H of any instant. Forces of magnitude a add
    min(2 a L, (a T)^2) to the square of the speed, L the largest extent of the domain and T the end of the run, and a
    to the gravity that presses. Both are found at sampled instants and places.
    """
    gravities, push = gravity_samples(scene), force_bound(scene)
    g = max(float(np.linalg.norm(gravity)) for gravity in gravities)
    initial = max(highest_speed(body) for body in scene.bodies)
    corners = np.concatenate([_corners(*body.shape.form.bounds()) for body in scene.bodies])
    if g > 0:
        height = max(_height(scene, corners, gravity) for gravity in gravities if gravity.any())
    else:
        height = float(np.max(np.ptp(corners, axis=0)))
    pushed = min(2 * push * max(scene.domain.size), (push * scene.time.end) ** 2)
    return SceneBounds(
        dimension=scene.dimension,
        spacing=scene.domain.spacing,
        gravity=g + push,
        speed=float(np.sqrt(initial**2 + 2 * g * height + pushed)),
        height=height,
        density=max(body.material.density for body in scene.bodies),
    )


def gravity_samples(scene: Scene) -> list[np.ndarray]:
    """Return gravity, (d,), m/s^2, at instants of the run; at one where it stays the same."""
    if scene.domain.steady:
        return [scene.domain.gravity_at(0.0)]
    times = np.linspace(0.0, scene.time.end, INSTANTS)
    return [np.nan_to_num(scene.domain.gravity_at(float(time))) for time in times]


def force_bound(scene: Scene) -> float:
    """Return the largest acceleration that forces add up to on one body, m/s^2, at sampled instants and places."""
    largest = max((_push(scene, body) for body in scene.bodies), default=0.0)
    return float(largest)


def _push(scene: Scene, body: Body) -> float:
    return sum(_magnitude(scene, body, force) for force in scene.forces if force.body in (None, body.name))


def _magnitude(scene: Scene, body: Body, force: Force) -> float:
    """Return the largest acceleration of one force: anywhere in the domain, of particles from anywhere in the body."""
    d = scene.dimension
    if not varies(*force.acceleration):
        return float(np.linalg.norm(force.acceleration))
    places = _lattice(np.array(scene.domain.origin), np.array(scene.domain.upper), FORCE_POINTS[d])
    starts = _lattice(*body.shape.form.bounds(), FORCE_POINTS[d])
    values = {name: column[:, None] for name, column in zip(POSITION, places.T, strict=False)}
    # A force of x and X is asked for all of both only where it depends on both.
    names = frozenset().union(*(entry.names for entry in force.acceleration if varies(entry)))
    both = names & set(POSITION) and names & set(INITIAL)
    values |= {
        name: column[None, :: len(starts) // 81 + 1] if both else column[:, None]
        for name, column in zip(INITIAL, starts.T, strict=False)
    }
    times = np.linspace(0.0, scene.time.end, FORCE_INSTANTS) if "t" in names else [0.0]
    largest = 0.0
    for time in times:
        squares = sum(np.square(value_of(entry, t=float(time), **values)) for entry in force.acceleration)
        # What is not finite somewhere is so for no particle, or stops the run.
        largest = max(largest, float(np.max(squares, initial=0.0, where=np.isfinite(squares))))
    return largest**0.5


def highest_speed(body: Body) -> float:
    """Return a bound on the initial speed of a body, m/s: that at the corners of its bounding box.

    For a velocity that is an expression, it is the largest over a lattice of points of the body.
    """
    if moves_unevenly(body):
        speeds = np.linalg.norm(initial_motion(body, body_points(body))[0], axis=1)
        return float(np.max(speeds, initial=0.0, where=np.isfinite(speeds)))
    velocity = np.array(body.velocity)
    if body.velocity_gradient is None:
        return float(np.linalg.norm(velocity))
    lower, upper = body.shape.form.bounds()
    offsets = _corners(lower, upper) - (lower + upper) / 2
    return float(np.max(np.linalg.norm(velocity + offsets @ np.array(body.velocity_gradient).T, axis=1)))


def body_points(body: Body) -> np.ndarray:
    """Return points of a body, (n, d), m: those of a lattice over its bounding box that lie inside."""
    form = body.shape.form
    points = _lattice(*form.bounds(), POINTS[len(body.velocity)])
    inside = form.contains(points)
    return points[inside] if inside.any() else points


def _height(scene: Scene, corners: np.ndarray, gravity: np.ndarray) -> float:
    down = gravity / float(np.linalg.norm(gravity))
    floor = np.max(_corners(np.array(scene.domain.origin), np.array(scene.domain.upper)) @ down)
    return max(0.0, float(floor - np.min(corners @ down)))


def _lattice(lower: np.ndarray, upper: np.ndarray, count: int) -> np.ndarray:
    axes = [np.linspace(a, b, count) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the 2^d corners of a box, (2^d, d)."""
    return np.array(list(product(*zip(lower, upper, strict=True))))
