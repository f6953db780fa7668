"""Distance between two shapes."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from mpmcli.check.search import distance_by_search
from mpmcli.scene import Scene
from mpmcli.scene.polygon import edge_distances
from mpmcli.scene.shapes import Ball, Box, Capsule, Composite, Cylinder, Form, Mesh, Points, Polygon

# Alternating projections end when an iteration changes the distance by less than this fraction of it.
SETTLED = 1e-6
ROUNDS = 500


def close_pairs(scene: Scene, reach: float) -> Iterator[tuple[int, int, float]]:
    """Yield (i, j, distance in m) for every two bodies no farther apart than `reach`, m.

    Across a periodic face it is the distance of their bounding boxes.
    """
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    for j in range(1, len(bounds)):
        apart = np.maximum(lowers[:j] - uppers[j], lowers[j] - uppers[:j])
        for i in np.flatnonzero(np.all(apart <= reach, axis=1)):
            found = distance_between(scene.bodies[i].shape.form, scene.bodies[j].shape.form)
            if found <= reach:
                yield int(i), j, found
        for shift in image_shifts(scene)[1:]:
            apart = np.maximum(lowers[:j] - uppers[j] - shift, lowers[j] + shift - uppers[:j])
            found = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
            yield from ((int(i), j, float(found[i])) for i in np.flatnonzero(found <= reach))


def image_shifts(scene: Scene) -> np.ndarray:
    """Return by how much the nearest images of a body lie beside it, (k, d), m, beginning with zero."""
    domain = scene.domain
    pairs = zip(domain.size, domain.periodic, strict=True)
    return np.array(list(product(*((0.0, -size, size) if repeats else (0.0,) for size, repeats in pairs))))


def distance_between(first: Form, second: Form) -> float:
    """Return the distance of two shapes that do not overlap, m; iterative for two cylinders, or box and cylinder."""
    if any(isinstance(form, Composite | Mesh | Points) for form in (first, second)):
        return distance_by_search(first, second)
    if isinstance(first, Ball):
        return max(0.0, distance_from(np.array(first.center), second) - first.radius)
    if isinstance(second, Ball):
        return max(0.0, distance_from(np.array(second.center), first) - second.radius)
    if isinstance(first, Box) and isinstance(second, Box):
        (a, b), (c, d) = first.bounds(), second.bounds()
        return float(np.linalg.norm(np.maximum(0.0, np.maximum(c - b, a - d))))
    if isinstance(first, Polygon) or isinstance(second, Polygon):
        v, w = _outline(first), _outline(second)
        rounding = sum(form.radius for form in (first, second) if isinstance(form, Capsule))
        return max(0.0, float(min(edge_distances(v, w).min(), edge_distances(w, v).min())) - rounding)
    for capsule, other in ((first, second), (second, first)):
        if isinstance(capsule, Capsule):
            return max(
                0.0, _distance_of_segment(np.array(capsule.start), np.array(capsule.end), other) - capsule.radius
            )
    return _distance_of_convex(first, second)


def distance_from(point: np.ndarray, form: Form) -> float:
    """Return the distance of a point, (d,), from a shape, m; 0 inside."""
    if isinstance(form, Polygon):
        inside = bool(form.contains(point[None])[0])
        return 0.0 if inside else float(edge_distances(point[None], np.array(form.vertices))[0])
    return float(np.linalg.norm(point - _nearest_in(point, form)))


def _outline(form: Form) -> np.ndarray:
    """Return the vertices of a polygon or rectangle in order, or the ends of the middle of a capsule, (k, 2), m."""
    if isinstance(form, Polygon):
        return np.array(form.vertices)
    if isinstance(form, Capsule):
        return np.array([form.start, form.end])
    (x0, y0), (x1, y1) = form.bounds()
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _nearest_in(point: np.ndarray, form: Form) -> np.ndarray:
    """Return the nearest point of a convex shape, (d,)."""
    if isinstance(form, Box):
        return np.clip(point, *form.bounds())
    if isinstance(form, Ball):
        return _nearest_in_ball(point, np.array(form.center), form.radius)
    if isinstance(form, Capsule):
        a, b = np.array(form.start), np.array(form.end)
        t = np.clip((point - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
        return _nearest_in_ball(point, a + t * (b - a), form.radius)
    assert isinstance(form, Cylinder)
    axis = form.direction
    offset = point - np.array(form.base)
    along = float(offset @ axis)
    across = offset - along * axis
    reach = float(np.linalg.norm(across))
    across *= min(1.0, form.radius / reach) if reach > 0 else 1.0
    return np.array(form.base) + np.clip(along, 0.0, form.height) * axis + across


def _distance_of_segment(a: np.ndarray, b: np.ndarray, form: Form) -> float:
    """Return the distance of the segment between a and b, (d,) each, from a convex shape, m.

    The distance from a convex shape is convex along the segment: a third that cannot hold its minimum is cut off, until
    what is left is shorter than half the digits of the segment.
    """
    low, high = 0.0, 1.0
    while high - low > 1e-8:
        one, two = (2 * low + high) / 3, (low + 2 * high) / 3
        # Where both are 0 the minimum is between them.
        if distance_from(a + one * (b - a), form) <= distance_from(a + two * (b - a), form):
            high = two
        else:
            low = one
    return distance_from(a + (low + high) / 2 * (b - a), form)


def _nearest_in_ball(point: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    offset = point - center
    reach = float(np.linalg.norm(offset))
    return point if reach <= radius else center + offset * (radius / reach)


def _distance_of_convex(first: Form, second: Form) -> float:
    """Return the distance of two convex shapes, m, by alternating projections (Cheney and Goldstein 1959)."""
    b = np.mean(second.bounds(), axis=0)
    before = np.inf
    for _ in range(ROUNDS):
        a = _nearest_in(b, first)
        b = _nearest_in(a, second)
        found = float(np.linalg.norm(a - b))
        if before - found <= SETTLED * found:
            break
        before = found
    return found
