"""Shapes of bodies: which points lie inside, how far they reach, and their exact volume.

In 2D a volume is an area, m^2: that of a slice one metre deep.
"""

import math
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from mpmcli.scene.quantity import AXES, Number, Positive, Table, Vector, flaw, scene_dimension


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
        axis = np.array(self.axis) / np.max(np.abs(self.axis))
        return axis / np.linalg.norm(axis)

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
        offset = points - np.array(self.base)
        along = offset @ self.direction
        across = np.linalg.norm(offset - along[:, None] * self.direction, axis=1)
        return (along >= inset) & (along <= self.height - inset) & (across <= self.radius - inset)


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


Form = Box | Ball | Cylinder | Polygon


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


def _only_in(dimension: int, instead: str) -> Any:
    def check(value: object, info: ValidationInfo) -> object:
        found = scene_dimension(info)
        if value is not None and found not in (None, dimension):
            raise flaw(f"is a shape of {dimension}D scenes and this one is {found}D; use {instead}")
        return value

    return BeforeValidator(check)


class Shape(Table):
    """The shape of a body: exactly one of the forms below."""

    box: Annotated[Box | None, Field(description="A box with faces along the axes.")] = None
    ball: Annotated[Ball | None, Field(description="A ball; a disc in 2D.")] = None
    cylinder: Annotated[
        Cylinder | None, _only_in(3, "box, ball or polygon"), Field(description="A round cylinder; 3D only.")
    ] = None
    polygon: Annotated[
        Polygon | None, _only_in(2, "box, ball or cylinder"), Field(description="A polygon; 2D only.")
    ] = None

    @property
    def form(self) -> Form:
        """The form that is given."""
        return next(form for _, form in self if form is not None)


def _exactly_one_form(shape: Shape) -> Shape:
    given = [name for name, form in shape if form is not None]
    if len(given) != 1:
        raise flaw(f"needs exactly one of box, ball, cylinder, polygon; found {' and '.join(given) or 'none'}")
    return shape


OneShape = Annotated[
    Shape,
    AfterValidator(_exactly_one_form),
    Field(json_schema_extra={"minProperties": 1, "maxProperties": 1}),
]
