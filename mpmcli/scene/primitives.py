"""The convex forms: which points lie inside, how far they reach, their exact volume and distance.

In 2D a volume is an area, m^2: that of a slice one metre deep. Signed distances are negative inside.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from mpmcli.scene.quantity import AXES, Positive, Table, Vector, flaw


def unit(vector: Sequence[float]) -> np.ndarray:
    """Return a vector of length 1 in the direction of one of any length but 0, however large or small, (d,)."""
    scaled = np.array(vector) / np.max(np.abs(vector))
    return scaled / np.linalg.norm(scaled)


def distance_to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of each point, (n, d), from the segment between a and b, (d,) each: (n,), m."""
    t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1)


def _distance_to_edges(beyond: np.ndarray) -> np.ndarray:
    """Return the signed distance from a box, (n,), of points that are `beyond` its faces, (n, k), by axis; m."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


class Box(Table):
    """A box with faces along the axes; a rectangle in 2D."""

    min: Annotated[Vector, Field(description="Lower corner, m.")]
    max: Annotated[Vector, Field(description="Upper corner, m.")]

    @model_validator(mode="after")
    def _upper_corner_above_lower(self) -> "Box":
        flat = [a for a, lo, hi in zip(AXES, self.min, self.max, strict=False) if not lo < hi]
        if flat:
            raise flaw(f"must be above min along {' and '.join(flat)}, so that the box holds matter", "max")
        return self

    @property
    def volume(self) -> float:
        """Product of the edge lengths."""
        return math.prod(hi - lo for lo, hi in zip(self.min, self.max, strict=True))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (d,) each, m."""
        return np.array(self.min), np.array(self.max)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, d) whether it lies inside, at least `inset` metres from the surface."""
        lo, hi = self.bounds()
        return np.all((points >= lo + inset) & (points <= hi - inset), axis=1)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the surface, (n,), m; negative inside."""
        lo, hi = self.bounds()
        return _distance_to_edges(np.maximum(lo - points, points - hi))


class Ball(Table):
    """A ball; a disc in 2D."""

    center: Annotated[Vector, Field(description="Centre, m.")]
    radius: Annotated[Positive, Field(description="Radius, m.")]

    @property
    def volume(self) -> float:
        """pi r^2 in 2D, 4/3 pi r^3 in 3D."""
        return math.pi * self.radius**2 if len(self.center) == 2 else 4 / 3 * math.pi * self.radius**3

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (d,) each, m."""
        center = np.array(self.center)
        return center - self.radius, center + self.radius

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, d) whether it lies inside, at least `inset` metres from the surface."""
        radius = self.radius - inset
        return (radius >= 0) & (np.sum((points - np.array(self.center)) ** 2, axis=1) <= radius**2)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the surface, (n,), m; negative inside."""
        return np.linalg.norm(points - np.array(self.center), axis=1) - self.radius


class Cylinder(Table):
    """A round cylinder with flat ends, in any direction; 3D only."""

    base: Annotated[Vector, Field(description="Centre of the first end, m.")]
    axis: Annotated[Vector, Field(description="Direction from the first end to the other, of any length.")]
    radius: Annotated[Positive, Field(description="Radius, m.")]
    height: Annotated[Positive, Field(description="Distance between the two ends, m.")]

    @model_validator(mode="after")
    def _axis_has_a_direction(self) -> "Cylinder":
        if not any(self.axis):
            raise flaw("must have a direction, as [0, 0, 1] has; found zeros", "axis")
        return self

    @property
    def volume(self) -> float:
        """pi r^2 times the height."""
        return math.pi * self.radius**2 * self.height

    @property
    def direction(self) -> np.ndarray:
        """The axis as a unit vector, (3,)."""
        return unit(self.axis)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (3,) each, m.

        A disc of normal a and radius r reaches r sqrt(1 - a_k^2) along axis k.
        """
        a, base = self.direction, np.array(self.base)
        top = base + self.height * a
        reach = self.radius * np.sqrt(np.maximum(0.0, 1.0 - a**2))
        return np.minimum(base, top) - reach, np.maximum(base, top) + reach

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, 3) whether it lies inside, at least `inset` metres from the surface."""
        along, across = self._places(points)
        return (along >= inset) & (along <= self.height - inset) & (across <= self.radius - inset)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 3) from the surface, (n,), m; negative inside."""
        along, across = self._places(points)
        return _distance_to_edges(np.stack([np.maximum(-along, along - self.height), across - self.radius], axis=1))

    def _places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far points (n, 3) are along the axis, from the base, and away from it, (n,) each, m."""
        offset = points - np.array(self.base)
        along = offset @ self.direction
        return along, np.linalg.norm(offset - along[:, None] * self.direction, axis=1)


class Capsule(Table):
    """All points within a radius of a segment: a cylinder with round ends, in any direction; in 2D a stadium."""

    start: Annotated[Vector, Field(description="Centre of the first round end, m.")]
    end: Annotated[Vector, Field(description="Centre of the other round end, m.")]
    radius: Annotated[Positive, Field(description="Radius, m.")]

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
        """Sum of the straight part and of a ball."""
        r = self.radius
        if len(self.start) == 2:
            return 2 * r * self.length + math.pi * r**2
        return math.pi * r**2 * self.length + 4 / 3 * math.pi * r**3

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (d,) each, m."""
        return np.minimum(self.start, self.end) - self.radius, np.maximum(self.start, self.end) + self.radius

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, d) whether it lies inside, at least `inset` metres from the surface."""
        return self.signed_distance(points) <= -inset

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the surface, (n,), m; negative inside."""
        return distance_to_segment(points, np.array(self.start), np.array(self.end)) - self.radius
