"""Distance between two shapes."""

from collections.abc import Iterator

import numpy as np

from mpmcli.check.extent import edge_distances
from mpmcli.scene import Scene
from mpmcli.scene.shapes import Ball, Box, Cylinder, Form, Polygon

# Alternating projections end when an iteration changes the distance by less than this fraction of it.
SETTLED = 1e-6
ROUNDS = 500


def close_pairs(scene: Scene, reach: float) -> Iterator[tuple[int, int, float]]:
    """Yield (i, j, distance in m) for every two bodies no farther apart than `reach`, m."""
    bounds = [body.shape.form.bounds() for body in scene.bodies]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    for j in range(1, len(bounds)):
        apart = np.maximum(lowers[:j] - uppers[j], lowers[j] - uppers[:j])
        for i in np.flatnonzero(np.all(apart <= reach, axis=1)):
            found = distance_between(scene.bodies[i].shape.form, scene.bodies[j].shape.form)
            if found <= reach:
                yield int(i), j, found


def distance_between(first: Form, second: Form) -> float:
    """Return the distance of two shapes that do not overlap, m; iterative for two cylinders or box and cylinder."""
    if isinstance(first, Ball):
        return max(0.0, distance_from(np.array(first.center), second) - first.radius)
    if isinstance(second, Ball):
        return max(0.0, distance_from(np.array(second.center), first) - second.radius)
    if isinstance(first, Box) and isinstance(second, Box):
        (a, b), (c, d) = first.bounds(), second.bounds()
        return float(np.linalg.norm(np.maximum(0.0, np.maximum(c - b, a - d))))
    if isinstance(first, Polygon) or isinstance(second, Polygon):
        v, w = _outline(first), _outline(second)
        return float(min(edge_distances(v, w).min(), edge_distances(w, v).min()))
    return _distance_of_convex(first, second)


def distance_from(point: np.ndarray, form: Form) -> float:
    """Return the distance of a point, (d,), from a shape, m; 0 inside."""
    if isinstance(form, Polygon):
        inside = bool(form.contains(point[None])[0])
        return 0.0 if inside else float(edge_distances(point[None], np.array(form.vertices))[0])
    return float(np.linalg.norm(point - _nearest_in(point, form)))


def _outline(form: Form) -> np.ndarray:
    """Return the vertices of a polygon or rectangle in order, (k, 2), m."""
    if isinstance(form, Polygon):
        return np.array(form.vertices)
    (x0, y0), (x1, y1) = form.bounds()
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _nearest_in(point: np.ndarray, form: Form) -> np.ndarray:
    """Return the nearest point of a convex shape, (d,)."""
    if isinstance(form, Box):
        return np.clip(point, *form.bounds())
    if isinstance(form, Ball):
        offset = point - np.array(form.center)
        reach = float(np.linalg.norm(offset))
        return point if reach <= form.radius else np.array(form.center) + offset * (form.radius / reach)
    assert isinstance(form, Cylinder)
    axis = form.direction
    offset = point - np.array(form.base)
    along = float(offset @ axis)
    across = offset - along * axis
    reach = float(np.linalg.norm(across))
    across *= min(1.0, form.radius / reach) if reach > 0 else 1.0
    return np.array(form.base) + np.clip(along, 0.0, form.height) * axis + across


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
