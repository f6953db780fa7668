"""Thickness of a shape, which the grid has to resolve, and the distance between two shapes."""

import math
from collections.abc import Collection, Iterator, Sequence
from itertools import product

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.colliders import Plane
from mpmcli.scene.domain import STICKING
from mpmcli.scene.primitives import TurnedBox, edge_distances
from mpmcli.scene.shapes import Ball, Box, Capsule, Composite, Cylinder, Form, Mesh, Points, Polygon, distance_grid

# Accuracy of the largest ball in a form, relative to the extent of the form, in 2D and 3D.
RESOLUTION = {2: 1e-3, 3: 2e-2}
# Cells along the longest axis of a mesh, whose nodes are tried as the centre of its largest ball.
CELLS = 48
# Distance from a wall, in cells, below which a body touches it.
TOUCHING = 1e-3
# Alternating projections end when an iteration changes the distance by less than this fraction of it.
SETTLED = 1e-6
ROUNDS = 500
# Search: points per axis at the first level, number of halvings of the best cells, and number of those cells.
TRIED, HALVINGS, KEPT = 16, 7, 500


def spanned_axes(scene: Scene, form: Form) -> set[int]:
    """Return the axes along which a box spans the domain between walls that do not stick, like unbounded matter."""
    if not isinstance(form, Box):
        return set()
    return {a for a, faces in enumerate(touched_walls(scene, form)) if all(faces) and STICKING.isdisjoint(faces)}


def touched_walls(scene: Scene, form: Box) -> list[tuple[str, str]]:
    """Return for each axis the conditions of the lower and upper wall that a box touches, "" if it touches none."""
    domain, reach = scene.domain, TOUCHING * scene.domain.spacing
    return [
        (
            below if form.min[a] - domain.origin[a] < reach else "",
            above if domain.upper[a] - form.max[a] < reach else "",
        )
        for a, (below, above) in enumerate(domain.walls.faces(scene.dimension))
    ]


def thickness(form: Form, endless: Collection[int] = ()) -> float:
    """Return the diameter of the largest ball that fits into a shape, m.

    For a mesh the error is up to a few cells of a grid with 48 cells along its longest axis. Of overlapping parts of a
    union the thickest one counts. Points have the smallest extent of their bounding box plus the edge of a particle.
    For a box the axes in `endless` are ignored; if these are all axes, its longest edge is returned.
    """
    if isinstance(form, Ball | Capsule):
        return 2 * form.radius
    if isinstance(form, Cylinder):
        return min(2 * form.radius, form.height)
    if isinstance(form, TurnedBox):
        return 2 * min(form.half)
    if isinstance(form, Box):
        edges = [hi - lo for lo, hi in zip(form.min, form.max, strict=True)]
        return min((edge for a, edge in enumerate(edges) if a not in endless), default=max(edges))
    if isinstance(form, Points):
        return float(np.ptp(form.bounds(), axis=0).min()) + form.edge
    if isinstance(form, Mesh):
        spacing = float(np.ptp(form.bounds(), axis=0).max()) / CELLS
        return -2 * float(distance_grid(form, spacing, 0.0)[0].min())
    return 2 * _inradius(form)


def thin_colliders(scene: Scene, width: float) -> list[str]:
    """Return the names of obstacles that are thinner than a width, m; rigid bodies and meshes are not looked at."""
    solids = [one for one in scene.colliders if not (one.holds or one.free or one.side == "inside")]
    return [one.name for one in solids if not isinstance(one.form, Plane | Mesh) and thickness(one.form) < width]


def _inradius(form: Form) -> float:
    """Return the radius of the largest ball in a form, or a bound; cells that may hold a better centre are halved."""
    lower, upper = form.bounds()
    d, size = len(lower), float(np.max(upper - lower))
    half = float(np.min(upper - lower)) / 2
    counts = np.ceil((upper - lower) / (2 * half)).astype(int)
    centres = lower + (np.stack(np.meshgrid(*map(np.arange, counts)), axis=-1).reshape(-1, d) * 2 + 1) * half
    offsets = np.array(list(product((-1, 1), repeat=d)))
    best = 0.0
    while len(centres):
        distance = -form.signed_distance(centres)
        best = max(best, float(distance.max()))
        promising = centres[distance + math.sqrt(d) * half > best + RESOLUTION[d] * size]
        half /= 2
        centres = (promising[:, None, :] + half * offsets).reshape(-1, d)
    return best


def close_pairs(scene: Scene, forms: Sequence[Form], reach: float) -> Iterator[tuple[int, int, float]]:
    """Yield (i, j, distance in m) of forms up to `reach` apart; across a periodic face that of bounding boxes."""
    bounds = [form.bounds() for form in forms]
    lowers, uppers = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    for j in range(1, len(bounds)):
        apart = np.maximum(lowers[:j] - uppers[j], lowers[j] - uppers[:j])
        for i in np.flatnonzero(np.all(apart <= reach, axis=1)):
            distance = distance_between(forms[i], forms[j])
            if distance <= reach:
                yield int(i), j, distance
        for shift in image_shifts(scene)[1:]:
            apart = np.maximum(lowers[:j] - uppers[j] - shift, lowers[j] + shift - uppers[:j])
            distances = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
            yield from ((int(i), j, float(distances[i])) for i in np.flatnonzero(distances <= reach))


def image_shifts(scene: Scene) -> np.ndarray:
    """Return the displacements of the nearest images of a body, (k, d), m, beginning with zero."""
    pairs = zip(scene.domain.size, scene.domain.periodic, strict=True)
    return np.array(list(product(*((0.0, -size, size) if repeats else (0.0,) for size, repeats in pairs))))


def distance_between(first: Form, second: Form) -> float:
    """Return the distance of two shapes, m, 0 if they overlap; iterative for two cylinders, or box and cylinder."""
    if any(isinstance(form, Composite | Mesh | Points | TurnedBox) for form in (first, second)):
        return _distance_by_search(first, second)
    pairs = ((first, second), (second, first))
    for ball, other in pairs:
        if isinstance(ball, Ball):
            return max(0.0, _distance_from(np.array(ball.center), other) - ball.radius)
    if isinstance(first, Box) and isinstance(second, Box):
        (a, b), (c, d) = first.bounds(), second.bounds()
        return float(np.linalg.norm(np.maximum(0.0, np.maximum(c - b, a - d))))
    if isinstance(first, Polygon) or isinstance(second, Polygon):
        v, w = _outline(first), _outline(second)
        if first.contains(w[:1])[0] or second.contains(v[:1])[0] or _cross(v, w):
            return 0.0
        rounding = sum(form.radius for form in (first, second) if isinstance(form, Capsule))
        return max(0.0, float(min(edge_distances(v, w).min(), edge_distances(w, v).min())) - rounding)
    for capsule, other in pairs:
        if isinstance(capsule, Capsule):
            middle = _distance_of_segment(np.array(capsule.start), np.array(capsule.end), other)
            return max(0.0, middle - capsule.radius)
    return _distance_of_convex(first, second)


def _distance_from(point: np.ndarray, form: Form) -> float:
    """Return the distance of a point, (d,), from a shape, m; 0 inside."""
    return max(0.0, float(form.signed_distance(point[None])[0]))


def _outline(form: Form) -> np.ndarray:
    """Return the vertices of a polygon or rectangle in order, or the ends of the axis of a capsule, (k, 2), m."""
    if isinstance(form, Polygon):
        return np.array(form.vertices)
    if isinstance(form, Capsule):
        return np.array([form.start, form.end])
    (x0, y0), (x1, y1) = form.bounds()
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _cross(v: np.ndarray, w: np.ndarray) -> bool:
    """Return whether two outlines cross, (k, 2) each: the ends of an edge lie on both sides of one of the other."""

    def sides(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return for edge i of outline a and corner j of b whether the corner is to the left of the edge."""
        (x, y), along = np.moveaxis(b[None] - a[:, None], -1, 0), np.roll(a, -1, axis=0) - a
        return along[:, :1] * y > along[:, 1:] * x

    first, second = sides(v, w), sides(w, v).T
    return bool(((first != np.roll(first, -1, axis=1)) & (second != np.roll(second, -1, axis=0))).any())


def _nearest_in(point: np.ndarray, form: Form) -> np.ndarray:
    """Return the nearest point of a box or a cylinder, (d,)."""
    if isinstance(form, Box):
        return np.clip(point, *form.bounds())
    assert isinstance(form, Cylinder)
    axis = form.direction
    offset = point - np.array(form.base)
    along = float(offset @ axis)
    across = offset - along * axis
    reach = float(np.linalg.norm(across))
    across *= min(1.0, form.radius / reach) if reach > 0 else 1.0
    return np.array(form.base) + np.clip(along, 0.0, form.height) * axis + across


def _distance_of_segment(a: np.ndarray, b: np.ndarray, form: Form) -> float:
    """Return the distance of the segment between a and b, (d,) each, from a convex shape, m."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda t: _distance_from(a + t * (b - a), form), bounds=(0, 1), method="bounded", options={"xatol": 1e-8}
    )
    return float(found.fun)


def _distance_of_convex(first: Form, second: Form) -> float:
    """Return the distance of boxes or cylinders, m, by alternating projections (Cheney and Goldstein 1959)."""
    b = np.mean(second.bounds(), axis=0)
    before = np.inf
    for _ in range(ROUNDS):
        a = _nearest_in(b, first)
        b = _nearest_in(a, second)
        distance = float(np.linalg.norm(a - b))
        if before - distance <= SETTLED * distance:
            break
        before = distance
    return distance


def _distance_by_search(first: Form, second: Form) -> float:
    """Return the distance of two forms that do not overlap, m, to 1e-3 of the extent of the smaller one.

    It is the smallest sum of a point's distances from both, for points within half of it of both bounding boxes. Cells
    are halved; a cell is dropped if its sum, which changes by at most twice the displacement, cannot become the
    smallest.
    """
    bounds = [form.bounds() for form in (first, second)]
    small = min(bounds, key=lambda pair: float(np.ptp(pair, axis=0).max()))
    d = len(small[0])
    corners = np.array(list(product((0, 1), repeat=d)))

    def total(points: np.ndarray) -> np.ndarray:
        return np.maximum(first.signed_distance(points), 0.0) + np.maximum(second.signed_distance(points), 0.0)

    best = float(total(small[0] + (corners + 0.5) / 2 * np.ptp(small, axis=0)).min())
    lower = np.max([low for low, _ in bounds], axis=0) - best / 2
    upper = np.min([high for _, high in bounds], axis=0) + best / 2
    size = np.maximum(upper - lower, 0.0) / TRIED
    steps = np.stack(np.meshgrid(*[np.arange(TRIED)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    centers = lower + (steps + 0.5) * size
    for _ in range(HALVINGS):
        sums = total(centers)
        best = min(best, float(sums.min()))
        promising = sums - np.linalg.norm(size) < best
        order = np.argsort(sums[promising], kind="stable")[:KEPT]
        size = size / 2
        centers = (centers[promising][order][:, None] + (corners - 0.5) * size).reshape(-1, d)
        if not len(centers) or math.isclose(best, 0.0, abs_tol=1e-12):
            break
    return best
