"""Places for bodies and colliders: at random, inside a region, and apart from everything else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.scene.shapes import Ball, Form

# Signed distance of points (n, d), (n,), m.
Distance = Callable[[np.ndarray], np.ndarray]
# Candidates that are drawn for one body before the placement starts anew, and how often it does.
TRIES = 256
STARTS = 20


@dataclass(frozen=True, eq=False)
class RoundedBox:
    """All points no farther than `radius` from a box: a box (radius 0), a ball (half 0).

    Attributes:
        center: (d,), m.
        half: half the edge lengths, (d,), m.
        radius: m.
    """

    center: np.ndarray
    half: np.ndarray
    radius: float


@dataclass(frozen=True, eq=False)
class Wanted:
    """A body that needs a place.

    Attributes:
        half, radius: as of a RoundedBox; the body fits into its region.
        volume: m^3 (m^2 in 2D); large bodies are placed first.
        lower, upper: corners of the region, (d,), m.
        min_distance: smallest distance to other bodies, m.
        generator: its random numbers.
    """

    half: np.ndarray
    radius: float
    volume: float
    lower: np.ndarray
    upper: np.ndarray
    min_distance: float
    generator: np.random.Generator


class NoPlace(Exception):  # noqa: N818
    """No arrangement was found.

    Attributes:
        index: of the body without a place, in the arrangement that came farthest.
        placed: number of bodies that had one.
    """

    def __init__(self, index: int, placed: int) -> None:
        super().__init__(index, placed)
        self.index = index
        self.placed = placed


def room_before(centers: np.ndarray, half: np.ndarray, radius: float, wall: Distance) -> np.ndarray:
    """Return how far a rounded box at each of m centres (m, d) is from a wall, (m,), m: exact for convex room."""
    d = len(half)
    corners = np.array([[half[a] if k >> a & 1 else -half[a] for a in range(d)] for k in range(2**d)])
    return np.min([wall(centers + corner) for corner in np.unique(corners, axis=0)], axis=0) - radius


def rounded_box(form: Form) -> RoundedBox:
    """Return a box or a ball itself, and of any other shape its bounding box."""
    if isinstance(form, Ball):
        center = np.array(form.center)
        return RoundedBox(center, np.zeros(len(center)), form.radius)
    lower, upper = form.bounds()
    return RoundedBox((lower + upper) / 2, (upper - lower) / 2, 0.0)


def find_places(
    wanted: Sequence[Wanted], obstacles: Sequence[RoundedBox], walls: Sequence[Distance] = ()
) -> list[np.ndarray]:
    """Return the centre of every body, (d,) each, m, by rejection.

    Each body takes the first of its candidates, uniform in its region, that keeps its distance from the obstacles
    and from the bodies before it; the largest body is the first. Where none of TRIES candidates does, all bodies
    start anew, up to STARTS times.

    Args:
        wanted: what is placed.
        obstacles: boxes and balls in the way; walls: planes and containers, by their signed distances.

    Raises:
        NoPlace: no start ended well.
    """
    order = sorted(range(len(wanted)), key=lambda i: -wanted[i].volume)
    farthest = NoPlace(0, -1)
    for _ in range(STARTS):
        centers: dict[int, np.ndarray] = {}
        for i in order:
            found = [(RoundedBox(center, wanted[k].half, wanted[k].radius), k) for k, center in centers.items()]
            others = [*obstacles, *(body for body, _ in found)]
            apart = [wanted[i].min_distance] * len(obstacles)
            apart += [max(wanted[i].min_distance, wanted[k].min_distance) for _, k in found]
            center = _free_center(wanted[i], others, np.array(apart), walls)
            if center is None:
                if len(centers) > farthest.placed:
                    farthest = NoPlace(i, len(centers))
                break
            centers[i] = center
        else:
            return [centers[i] for i in range(len(wanted))]
    raise farthest


def _free_center(
    body: Wanted, others: Sequence[RoundedBox], apart: np.ndarray, walls: Sequence[Distance]
) -> np.ndarray | None:
    """Return the first free one of TRIES candidates, (d,), or None.

    Args:
        body: what is placed.
        others: n bodies in the way.
        apart: distance to keep from each, (n,), m.
        walls: signed distances, positive where there is room.
    """
    reach = body.half + body.radius
    slack = np.maximum(0.0, body.upper - body.lower - 2 * reach)
    centers = body.lower + reach + body.generator.random((TRIES, len(body.lower))) * slack
    free = np.ones(TRIES, dtype=bool)
    if others:
        distance = distances(centers, body.half, body.radius, others)
        # Bodies that overlap have the distance 0, too.
        free = np.all((distance >= apart) & (distance > 0), axis=1)
    for wall in walls:
        room = room_before(centers, body.half, body.radius, wall)
        free &= (room >= body.min_distance) & (room > 0)
    return centers[np.argmax(free)] if free.any() else None


def distances(centers: np.ndarray, half: np.ndarray, radius: float, others: Sequence[RoundedBox]) -> np.ndarray:
    """Return the distance of a rounded box at each of m centres (m, d) to n others, (m, n), m; 0 where they overlap.

    Two boxes are apart by what their centres are apart along each axis beyond their half edges, and rounding takes
    the radii off that distance.
    """
    other_centers = np.array([other.center for other in others])
    other_halves = np.array([other.half for other in others])
    other_radii = np.array([other.radius for other in others])
    beyond = np.abs(centers[:, None] - other_centers) - (half + other_halves)
    return np.maximum(0.0, np.linalg.norm(np.maximum(0.0, beyond), axis=2) - (radius + other_radii))
