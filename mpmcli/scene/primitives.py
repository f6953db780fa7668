"""Forms given by numbers: inside test, bounding box, exact volume and signed distance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from mpmcli.scene.quantity import AXES, Axis, Number, Positive, Table, Vector, flaw


def unit(vector: Sequence[float]) -> np.ndarray:
    """Return the unit vector of a nonzero vector of any length, however large or small, (d,)."""
    scaled = np.array(vector) / np.max(np.abs(vector))
    return scaled / np.linalg.norm(scaled)


def grid_points(*axes: np.ndarray) -> np.ndarray:
    """Return all points with coordinates from the given axes, (n, d), the last axis fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def box_corners(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the corners of a box, (2^d, d); bit i of a corner's number is its side along axis i."""
    d = len(lower)
    return np.array([[upper[a] if k >> a & 1 else lower[a] for a in range(d)] for k in range(2**d)])


def distance_to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of each point, (n, d), from the segment between a and b, (d,) each: (n,), m."""
    t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1)


def _distance_to_edges(beyond: np.ndarray) -> np.ndarray:
    """Return the signed distance from a box, (n,), of points that are `beyond` its faces, (n, k), by axis; m."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


class Solid:
    """The interface of every form. In 2D a volume is an area, m^2: that of a slice one metre deep."""

    @property
    def volume(self) -> float:
        """Volume, m^3."""
        raise NotImplementedError

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (d,) each, m."""
        raise NotImplementedError

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Return whether each point (n, d) lies inside, at least `inset` metres from the surface, (n,)."""
        return self.signed_distance(points) <= -inset

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the surface, (n,), m; negative inside."""
        raise NotImplementedError


class Box(Table, Solid):
    """A box with faces along the axes; a rectangle in 2D."""

    min: Vector = Field(description="Lower corner, m.")
    max: Vector = Field(description="Upper corner, m.")

    @model_validator(mode="after")
    def _upper_corner_above_lower(self) -> "Box":
        flat = [a for a, lo, hi in zip(AXES, self.min, self.max, strict=False) if not lo < hi]
        if flat:
            raise flaw(f"must be above min along {' and '.join(flat)}, so that the box holds matter", "max")
        return self

    @property
    def volume(self) -> float:
        return math.prod(hi - lo for lo, hi in zip(self.min, self.max, strict=True))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.min), np.array(self.max)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        lo, hi = self.bounds()
        return np.all((points >= lo + inset) & (points <= hi - inset), axis=1)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        lo, hi = self.bounds()
        return _distance_to_edges(np.maximum(lo - points, points - hi))


@dataclass(frozen=True)
class TurnedBox(Solid):
    """A box in 3D whose edges are not along the axes: its middle, half its edges, m, and its rotation by rows."""

    middle: tuple[float, ...]
    half: tuple[float, ...]
    turn: tuple[tuple[float, ...], ...]

    @property
    def volume(self) -> float:
        return math.prod(2 * edge for edge in self.half)

    @property
    def corners(self) -> np.ndarray:
        """The corners, (8, 3), m, numbered as by `box_corners`."""
        half = np.array(self.half)
        return np.array(self.middle) + box_corners(-half, half) @ np.array(self.turn).T

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.corners.min(axis=0), self.corners.max(axis=0)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        own = (points - np.array(self.middle)) @ np.array(self.turn)
        return _distance_to_edges(np.abs(own) - np.array(self.half))


class Ball(Table, Solid):
    """A ball; a disc in 2D."""

    center: Vector = Field(description="Centre, m.")
    radius: Positive = Field(description="Radius, m.")

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 if len(self.center) == 2 else 4 / 3 * math.pi * self.radius**3

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        center = np.array(self.center)
        return center - self.radius, center + self.radius

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        radius = self.radius - inset
        return (radius >= 0) & (np.sum((points - np.array(self.center)) ** 2, axis=1) <= radius**2)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.array(self.center), axis=1) - self.radius


class Cylinder(Table, Solid):
    """A round cylinder with flat ends, in any direction; 3D only."""

    base: Vector = Field(description="Centre of the first end, m.")
    axis: Axis = Field(description="Direction from the first end to the other, of any length.")
    radius: Positive = Field(description="Radius, m.")
    height: Positive = Field(description="Distance between the two ends, m.")

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * self.height

    @property
    def direction(self) -> np.ndarray:
        """The axis as a unit vector, (3,)."""
        return unit(self.axis)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        # A disc of normal a and radius r reaches r sqrt(1 - a_k^2) along axis k.
        a, base = self.direction, np.array(self.base)
        top = base + self.height * a
        reach = self.radius * np.sqrt(np.maximum(0.0, 1.0 - a**2))
        return np.minimum(base, top) - reach, np.maximum(base, top) + reach

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        along, across = self._places(points)
        return (along >= inset) & (along <= self.height - inset) & (across <= self.radius - inset)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        along, across = self._places(points)
        return _distance_to_edges(np.stack([np.maximum(-along, along - self.height), across - self.radius], axis=1))

    def _places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of points (n, 3) along the axis, from the base, and from the axis, (n,) each, m."""
        offset = points - np.array(self.base)
        along = offset @ self.direction
        return along, np.linalg.norm(offset - along[:, None] * self.direction, axis=1)


class Capsule(Table, Solid):
    """All points within a radius of a segment: a cylinder with round ends, in any direction; in 2D a stadium."""

    start: Vector = Field(description="Centre of the first round end, m.")
    end: Vector = Field(description="Centre of the other round end, m.")
    radius: Positive = Field(description="Radius, m.")

    @model_validator(mode="after")
    def _ends_are_apart(self) -> "Capsule":
        if self.start == self.end:
            raise flaw("must not be where the start is; use ball", "end")
        return self

    @property
    def length(self) -> float:
        """Distance between the centres of the ends, m."""
        return math.dist(self.start, self.end)

    @property
    def volume(self) -> float:
        r = self.radius
        if len(self.start) == 2:
            return 2 * r * self.length + math.pi * r**2
        return math.pi * r**2 * self.length + 4 / 3 * math.pi * r**3

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.minimum(self.start, self.end) - self.radius, np.maximum(self.start, self.end) + self.radius

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        return distance_to_segment(points, np.array(self.start), np.array(self.end)) - self.radius


def rotation(axis: Sequence[float], angle: float) -> np.ndarray:
    """Return the rotation by an angle (rad) about an axis (3,) of any length, (3, 3). Formula of Rodrigues."""
    x, y, z = unit(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)


# Edges of a polygon up to which the distance to each of them is computed.
_FEW_EDGES = 100


def edge_distances(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distance of each point, (n, 2), from the outline of a polygon, (k, 2): (n,), m."""
    return np.sqrt(_edge_squares(points, vertices))


def _edge_squares(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the squares of the distances of points from an outline, m^2."""
    ahead = np.roll(vertices, -1, axis=0)
    if len(vertices) > _FEW_EDGES:
        return _located_squares(points, vertices, ahead)
    nearest = np.full(len(points), np.inf)
    for a, b in zip(vertices, ahead, strict=True):
        t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
        nearest = np.minimum(nearest, np.sum((points - a - t[:, None] * (b - a)) ** 2, axis=1))
    return nearest


def _located_squares(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the squared distance of each point from the nearest segment, m^2, found by a locator of VTK."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import reference
    from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

    corners = np.pad(np.stack([starts, ends], axis=1).reshape(-1, 2), ((0, 0), (0, 1)))
    lines = pv.line_segments_from_points(corners)
    locator = vtkStaticCellLocator()
    locator.SetDataSet(lines)
    locator.BuildLocator()
    found = np.empty(len(points))
    nearest, cell, part, square = [0.0, 0.0, 0.0], reference(0), reference(0), reference(0.0)
    for k, (x, y) in enumerate(points.tolist()):
        locator.FindClosestPoint((x, y, 0.0), nearest, cell, part, square)
        found[k] = square.get()
    return found


class Polygon(Table, Solid):
    """A polygon given by its vertices in order, either way round; 2D only. Edges may not cross or touch."""

    vertices: tuple[Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)], ...] = Field(
        min_length=3, description="Vertices in order, m; the last is joined to the first."
    )

    @model_validator(mode="after")
    def _is_simple(self) -> "Polygon":
        sentence = _fault_of_polygon(np.array(self.vertices))
        if sentence:
            raise flaw(sentence, "vertices")
        return self

    @property
    def volume(self) -> float:
        # The shoelace formula, about the first vertex so that a far origin costs no digits.
        x, y = (np.array(self.vertices) - np.array(self.vertices[0])).T
        return float(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        vertices = np.array(self.vertices)
        return vertices.min(axis=0), vertices.max(axis=0)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Return which points are inside by at least `inset`, m, (n,) bool."""
        # A point is inside when a ray from it along x crosses the edges an odd number of times.
        order = np.argsort(points[:, 1], kind="stable")
        x, y = points[order].T
        crossed = np.zeros(len(points), dtype=bool)
        vertices = np.array(self.vertices)
        ahead = np.roll(vertices, -1, axis=0)
        # Those at heights of each edge, without its upper end.
        first, last = (np.searchsorted(y, side(vertices[:, 1], ahead[:, 1])) for side in (np.minimum, np.maximum))
        for k in np.flatnonzero(first < last):
            some, a, b = slice(first[k], last[k]), vertices[k], ahead[k]
            crossed[some] ^= x[some] < a[0] + (y[some] - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside = np.empty(len(points), dtype=bool)
        inside[order] = crossed
        if inset > 0:
            inside[inside] = _edge_squares(points[inside], vertices) >= inset**2
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        distance = edge_distances(points, np.array(self.vertices))
        return np.where(self.contains(points), -distance, distance)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _fault_of_polygon(vertices: np.ndarray) -> str:
    """Return why vertices (n, 2) do not form a simple polygon, or "" if they do."""
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
    crossing = _crossing(vertices, ahead)
    if crossing is None:
        return ""
    i, j = crossing
    return f"the edges after vertices {i} and {j} cross or touch: list the vertices in order round the outline"


# Pairs of parts of an outline that are compared at once.
_PAIRS = 100_000


def _crossing(a: np.ndarray, b: np.ndarray) -> tuple[int, int] | None:
    """Return two edges of an outline that meet although they share no vertex; edge i is from a[i] to b[i], (n, 2).

    Two parts of 2^k edges each are halved if their bounding boxes meet. For an outline that does not come near itself
    the effort is O(n log n).
    """
    n = len(a)
    boxes = [(np.minimum(a, b), np.maximum(a, b))]
    while len(boxes[-1][0]) > 1:
        firsts = np.arange(0, len(boxes[-1][0]), 2)
        low, high = boxes[-1]
        boxes.append((np.minimum.reduceat(low, firsts), np.maximum.reduceat(high, firsts)))
    waiting = [(len(boxes) - 1, np.zeros(1, np.int64), np.zeros(1, np.int64))]
    while waiting:
        level, i, j = waiting.pop()
        if level == 0:
            # The last edge is a neighbour of the first.
            apart = (j - i > 1) & ((i > 0) | (j < n - 1))
            i, j = i[apart], j[apart]
            u, v = b[i] - a[i], b[j] - a[j]
            # Collinear segments have four zero sides; the boxes of these meet.
            sides = np.sign(_cross(u, a[j] - a[i])) * np.sign(_cross(u, b[j] - a[i]))
            others = np.sign(_cross(v, a[i] - a[j])) * np.sign(_cross(v, b[i] - a[j]))
            hit = np.flatnonzero((sides <= 0) & (others <= 0))
            if len(hit):
                return min(zip(i[hit].tolist(), j[hit].tolist(), strict=True))
            continue
        low, high = boxes[level - 1]
        i, j = (np.concatenate([2 * i, 2 * i, 2 * i + 1, 2 * i + 1]), np.concatenate([2 * j, 2 * j + 1] * 2))
        real = (i <= j) & (j < len(low))
        i, j = i[real], j[real]
        meet = np.all((low[i] <= high[j]) & (low[j] <= high[i]), axis=1)
        i, j = i[meet], j[meet]
        parts = len(i) // _PAIRS + 1
        waiting += [(level - 1, *pair) for pair in zip(np.array_split(i, parts), np.array_split(j, parts), strict=True)]
    return None
