"""Thickness of a shape, which the grid has to resolve."""

import math
from collections.abc import Collection

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.shapes import Ball, Box, Cylinder, Form, Polygon

# Accuracy of the inscribed circle of a polygon, relative to the extent of the polygon.
RESOLUTION = 1e-3
# Distance from a wall, in cells, below which a body touches it.
TOUCHING = 1e-3


def spanned_axes(scene: Scene, form: Form) -> set[int]:
    """Return the axes along which a box spans the domain between walls without "stick", as unbounded matter does."""
    if not isinstance(form, Box):
        return set()
    domain = scene.domain
    touching = TOUCHING * domain.spacing
    return {
        a
        for a, walls in enumerate(domain.walls.faces(scene.dimension))
        if "stick" not in walls
        and form.min[a] - domain.origin[a] < touching
        and domain.upper[a] - form.max[a] < touching
    }


def thickness(form: Form, endless: Collection[int] = ()) -> float:
    """Return the diameter of the largest ball that fits into a shape, m: its thinnest extent where it is convex.

    The axes in `endless` are ignored for a box, unless all axes are in it.
    """
    if isinstance(form, Ball):
        return 2 * form.radius
    if isinstance(form, Cylinder):
        return min(2 * form.radius, form.height)
    if isinstance(form, Box):
        edges = [hi - lo for lo, hi in zip(form.min, form.max, strict=True)]
        return min((edge for a, edge in enumerate(edges) if a not in endless), default=max(edges))
    return 2 * _inradius(form)


def height_along(form: Form, direction: np.ndarray) -> float:
    """Return the extent of the bounding box of a shape along a unit vector, (d,); m."""
    lower, upper = form.bounds()
    return float((upper - lower) @ np.abs(direction))


def edge_distances(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distance of each point, (n, 2), from the outline of a polygon, (k, 2): (n,), m."""
    nearest = np.full(len(points), np.inf)
    for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - t[:, None] * (b - a), axis=1))
    return nearest


def _inradius(form: Polygon) -> float:
    """Return the radius of the largest circle inside a polygon.

    Squares that may contain a better centre are halved until none can improve the result by RESOLUTION. No point of
    a square is farther from the outline than the centre of the square plus half a diagonal.
    """
    vertices = np.array(form.vertices)
    lower, upper = form.bounds()
    size = float(np.max(upper - lower))
    half = float(np.min(upper - lower)) / 2
    counts = np.ceil((upper - lower) / (2 * half)).astype(int)
    centres = lower + (np.stack(np.meshgrid(*map(np.arange, counts)), axis=-1).reshape(-1, 2) * 2 + 1) * half
    best = 0.0
    while len(centres):
        inside = form.contains(centres)
        distance = edge_distances(centres, vertices) * np.where(inside, 1, -1)
        best = max(best, float(distance.max()))
        promising = centres[distance + math.sqrt(2) * half > best + RESOLUTION * size]
        half /= 2
        corners = half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        centres = (promising[:, None, :] + corners).reshape(-1, 2)
    return best
