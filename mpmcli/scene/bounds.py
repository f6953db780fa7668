"""What a scene can reach, from its initial state alone: the highest speed, the deepest column, the densest body."""

from itertools import product

import numpy as np

from mpmcli.scene.drive import Drive, force_drive, gravity_drive
from mpmcli.scene.emitters import Emitter
from mpmcli.scene.initial import initial_motion, moves_unevenly
from mpmcli.scene.material import SceneBounds
from mpmcli.scene.points import Points
from mpmcli.scene.sampling import estimate_body, particle_places
from mpmcli.scene.schema import Body, Scene

# Points along each axis of a box at which the velocity of a body is looked at, 2D and 3D, corners included.
POINTS = {2: 65, 3: 17}
# Particles up to which a body is looked at where its particles are; a larger one on a lattice.
MOST_LOOKED_AT = 500_000

# Numbers whose squares, and sums of a few, are numbers.
SQUARED = (1e-150, 1e150)


def scene_bounds(scene: Scene) -> SceneBounds:
    """Return bounds on the speed, the depth and the density of a scene.

    speed = sqrt(v0^2 + 2 g H), with v0 the highest initial speed of any body and H the height of the
    highest matter above the lowest point of the domain, both measured against gravity; v0 alone where
    there is no gravity. height = H, or the largest extent of the matter where there is no gravity.

    The speed is that of the fastest wall, and of the fastest point of a collider, at least. Along a periodic axis there
    is no lowest point: gravity along it adds its impulse over the run, and no height.

    For gravity that depends on time, the strongest counts, and the largest H of any instant; its impulse bounds the
    speed too. Forces of magnitude a add min(2 a L, I^2) to the square of the speed, L the largest extent of the domain
    and I their impulse over the run, and a to the gravity that presses. See `drive` for where they are looked at.
    Impulses add their strength to the speed.
    """
    pull, gravities = gravity_drive(scene)
    push = Drive()
    if scene.forces:
        drives = [
            force_drive(scene, body, body_places(body, index, scene.domain.spacing), highest_speed(body), pull)
            for index, body in enumerate(scene.bodies)
        ]
        push = Drive(max(one.largest for one in drives), max(one.impulse for one in drives))
    g = pull.largest
    pushed_by = [collider.fastest(scene.domain, scene.time.end) for collider in scene.colliders]
    initial = max(scene.domain.wall_speed, *pushed_by, *(highest_speed(body) for body in scene.sources))
    closed = ~np.array(scene.domain.periodic)
    corners = np.concatenate([_corners(*body.shape.form.bounds()) for body in scene.sources])
    if any((gravity * closed).any() for gravity in gravities):
        height = max(_height(scene, corners, gravity * closed) for gravity in gravities if (gravity * closed).any())
    else:
        height = float(np.max(np.ptp(corners, axis=0)))
    # What presses on no face pulls as long as the run.
    weight = g if closed.all() else max(float(np.linalg.norm(gravity * closed)) for gravity in gravities)
    fallen = 2 * weight * height if scene.domain.steady else min(2 * weight * height, pull.impulse * pull.impulse)
    if not closed.all():
        initial += max(float(np.linalg.norm(gravity[~closed])) for gravity in gravities) * scene.time.end
    pushed = min(2 * push.largest * max(scene.domain.size), push.impulse * push.impulse)
    return SceneBounds(
        dimension=scene.dimension,
        spacing=scene.domain.spacing,
        gravity=g + push.largest,
        speed=float(np.sqrt(initial * initial + fallen + pushed)) + sum(abs(one.strength) for one in scene.impulses),
        height=height,
        density=max(body.material.density for body in scene.sources),
    )


def highest_speed(body: Body | Emitter) -> float:
    """Return a bound on the initial speed of a body, m/s: that at the corners of its bounding box.

    For a velocity that is an expression, it is the largest over a lattice of points of the body. The largest of the
    velocities that stand beside points in a file is added.
    """
    if isinstance(body, Emitter):
        return float(np.linalg.norm(body.velocity))
    own = _speed_of_table(body)
    if isinstance(form := body.shape.form, Points) and form.file_velocity is not None:
        return own + float(np.linalg.norm(form.file_velocity, axis=1).max())
    return own


def _speed_of_table(body: Body) -> float:
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
    if isinstance(form, Points):
        return form.position
    points = _lattice(*form.bounds(), POINTS[len(body.velocity)])
    inside = form.contains(points)
    return points[inside] if inside.any() else points


def body_places(body: Body, index: int, h: float) -> np.ndarray:
    """Return where the particles of a body start, (n, d), m; points of a lattice in it where there are too many."""
    if estimate_body(body, h) > MOST_LOOKED_AT:
        return body_points(body)
    found = particle_places(body, index, h)
    return found if len(found) else body_points(body)


def _height(scene: Scene, corners: np.ndarray, gravity: np.ndarray) -> float:
    largest = float(np.max(np.abs(gravity)))
    if not SQUARED[0] < largest < SQUARED[1]:
        # Only its direction counts, and its squares would leave the range of numbers.
        gravity = gravity / largest
    down = gravity / float(np.linalg.norm(gravity))
    floor = np.max(_corners(np.array(scene.domain.origin), np.array(scene.domain.upper)) @ down)
    return max(0.0, float(floor - np.min(corners @ down)))


def _lattice(lower: np.ndarray, upper: np.ndarray, count: int) -> np.ndarray:
    axes = [np.linspace(a, b, count) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the 2^d corners of a box, (2^d, d)."""
    return np.array(list(product(*zip(lower, upper, strict=True))))
