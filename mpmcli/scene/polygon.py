"""The polygon: which points lie inside, how far it reaches, its exact area and distance; simple outlines only."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from mpmcli.scene.primitives import distance_to_segment
from mpmcli.scene.quantity import Number, Table, flaw


def edge_distances(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distance of each point, (n, 2), from the outline of a polygon, (k, 2): (n,), m."""
    nearest = np.full(len(points), np.inf)
    for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        nearest = np.minimum(nearest, distance_to_segment(points, a, b))
    return nearest


class Polygon(Table):
    """A polygon given by its vertices in order, either way round; 2D only. Edges may not cross or touch."""

    vertices: Annotated[
        tuple[Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)], ...],
        Field(min_length=3, description="Vertices in order, m; the last is joined to the first."),
    ]

    @model_validator(mode="after")
    def _is_simple(self) -> "Polygon":
        sentence = _fault_of_polygon(np.array(self.vertices))
        if sentence:
            raise flaw(sentence, "vertices")
        return self

    @property
    def volume(self) -> float:
        """Area by the shoelace formula, about the first vertex so that a far origin costs no digits."""
        x, y = (np.array(self.vertices) - np.array(self.vertices[0])).T
        return float(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (2,) each, m."""
        vertices = np.array(self.vertices)
        return vertices.min(axis=0), vertices.max(axis=0)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, 2) whether it lies inside, at least `inset` metres from the edges.

        A point is inside when a ray from it along x crosses the edges an odd number of times.
        """
        x, y = points[:, 0], points[:, 1]
        inside = np.zeros(len(points), dtype=bool)
        near = np.zeros(len(points), dtype=bool)
        vertices = np.array(self.vertices)
        for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
            crossing = (a[1] > y) != (b[1] > y)
            if a[1] != b[1]:
                inside ^= crossing & (x < a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
            if inset > 0:
                t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
                near |= np.sum((points - a - t[:, None] * (b - a)) ** 2, axis=1) < inset**2
        return inside & ~near

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 2) from the surface, (n,), m; negative inside."""
        distance = edge_distances(points, np.array(self.vertices))
        return np.where(self.contains(points), -distance, distance)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _fault_of_polygon(vertices: np.ndarray) -> str:
    """Return what keeps vertices (n, 2) from making a simple polygon, or "" when nothing does."""
    n = len(vertices)
    vertices = vertices / max(1.0, np.max(np.abs(vertices)))  # so that no product overflows
    ahead = np.roll(vertices, -1, axis=0)
    edges = ahead - vertices
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    if lengths[-1] == 0:
        return "the last vertex repeats the first: leave it out, the polygon closes by itself"
    if np.any(lengths == 0):
        return f"vertex {int(np.argmin(lengths)) + 1} repeats the one before it: leave it out"
    following = np.roll(edges, -1, axis=0)
    back = (_cross(edges, following) == 0) & (np.sum(edges * following, axis=1) < 0)
    if np.any(back):
        return f"the outline runs back on itself at vertex {(int(np.argmax(back)) + 1) % n}"
    for i in range(n - 2):
        # Edges that share no vertex with edge i; the last edge is a neighbour of the first.
        others = np.arange(i + 2, n if i else n - 1)
        if others.size and np.any(hit := _meet(vertices[i], ahead[i], vertices[others], ahead[others])):
            j = int(others[np.argmax(hit)])
            return f"the edges after vertices {i} and {j} cross or touch: list the vertices in order round the outline"
    return ""


def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Say which of the segments c-d, (n, 2) each, share a point with the segment a-b."""
    side_c, side_d = _cross(b - a, c - a), _cross(b - a, d - a)
    side_a, side_b = _cross(d - c, a - c), _cross(d - c, b - c)
    # Collinear segments have four zero sides, so their bounding boxes must meet as well.
    boxes = np.all((np.minimum(c, d) <= np.maximum(a, b)) & (np.maximum(c, d) >= np.minimum(a, b)), axis=1)
    return boxes & (np.sign(side_c) * np.sign(side_d) <= 0) & (np.sign(side_a) * np.sign(side_b) <= 0)
