"""Shapes: forms with volume, bounds, inside test and signed distance, and composites of forms."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, combinations, islice, product
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from mpmcli.scene.mesh import Mesh, Rotation
from mpmcli.scene.points import Points, ResultState
from mpmcli.scene.primitives import (
    Ball,
    Box,
    Capsule,
    Cylinder,
    Polygon,
    Solid,
    TurnedBox,
    box_corners,
    grid_points,
    rotation,
)
from mpmcli.scene.quantity import Number, Table, Vector, flaw, scene_dimension

# Cells of the coarsest lattice along the longest axis of the bounding box, and number of halvings of surface cells, in
# 2D and 3D.
_CELLS, _HALVINGS = 8, {2: 8, 3: 4}
_POINTS_AT_ONCE = 200_000


def enclosed_volume(solid: Solid, fewer: int = 0) -> float:
    """Return the volume of the region of negative signed distance, m^3 (m^2 in 2D).

    Cells that lie inside by their distance count as a whole. Cells on the surface are halved, and at the last level cut
    by the plane with the distance and the gradient at their centre. The error falls as the square of their size, and is
    extrapolated from cells of 1/1024 and 1/2048 (2D), 1/64 and 1/128 (3D) of the extent: below 5e-7 (2D) and 1e-5 (3D)
    of the volume in the tests. Each of the `fewer` omitted halvings makes it about four times as large.
    """
    lower, upper = solid.bounds()
    d = len(lower)
    size = float((upper - lower).max()) / _CELLS
    counts = np.ceil((upper - lower) / size - 1e-9).astype(int)
    corners = grid_points(*map(np.arange, counts))
    centers = lower + (corners + 0.5) * size
    offsets = np.array(list(product((-0.25, 0.25), repeat=d)))
    whole, found, halvings = 0.0, [], _HALVINGS[d] - fewer
    for halving in range(halvings + 1):
        distance = _distances(solid, centers)
        reach = math.sqrt(d) / 2 * size
        whole += float(np.count_nonzero(distance <= -reach)) * size**d
        surface = np.abs(distance) < reach
        centers, distance = centers[surface], distance[surface]
        if halving >= halvings - 1:
            ahead, behind = (
                [_distances(solid, centers + way * step) for step in np.eye(d) * size / 4] for way in (1, -1)
            )
            rise = 2 * np.abs(np.array(ahead) - np.array(behind)).T
            found.append(whole + float(_shares(distance, rise).sum()) * size**d)
        centers = (centers[:, None] + offsets * size).reshape(-1, d)
        size /= 2
    return (4 * found[1] - found[0]) / 3


def _distances(solid: Solid, points: np.ndarray) -> np.ndarray:
    parts = [solid.signed_distance(points[i : i + _POINTS_AT_ONCE]) for i in range(0, len(points), _POINTS_AT_ONCE)]
    return np.concatenate(parts) if parts else np.zeros(0)


def _shares(distance: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return the share of cells (n,) below the plane that is `distance` at their centre and rises by (n, d) across.

    It is the volume of the simplex that the plane cuts off at a corner, by inclusion and exclusion over the corners.
    """
    d = rise.shape[1]
    # A plane along an axis is replaced by one of slight slope, which cuts off the same volume.
    rise = np.maximum(rise, 1e-3 * rise.max(axis=1, keepdims=True, initial=1e-300))
    level = rise.sum(axis=1) / 2 - distance
    found = sum(
        (-1) ** sum(corner) * np.maximum(0.0, level - rise @ np.array(corner)) ** d
        for corner in product((0, 1), repeat=d)
    )
    return np.clip(found / (math.factorial(d) * rise.prod(axis=1)), 0.0, 1.0)


@dataclass(frozen=True)
class Composite(Solid):
    """The union of the forms `added`, at least one, without the forms `removed`."""

    added: tuple[Solid, ...]
    removed: tuple[Solid, ...] = ()

    @property
    def volume(self) -> float:
        """Volume, m^3: exact if no two forms intersect, else by quadrature with the error of `enclosed_volume`."""
        return _volume(self)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lowers, uppers = zip(*(form.bounds() for form in self.added), strict=True)
        return np.min(lowers, axis=0), np.max(uppers, axis=0)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Return whether points lie inside; with an inset, whether they lie at least that deep."""
        if inset > 0:
            return self.signed_distance(points) <= -inset
        inside = np.any([form.contains(points) for form in self.added], axis=0)
        for form in self.removed:
            inside[inside] = ~form.contains(points[inside])
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the maximum of the smallest distance from `added` and the negative distances from `removed`, (n,), m.

        It is a lower bound on the true distance; where forms intersect, some points are farther from the surface.
        """
        distance = np.min([form.signed_distance(points) for form in self.added], axis=0)
        for form in self.removed:
            distance = np.maximum(distance, -form.signed_distance(points))
        return distance


# Simple forms up to which a composite is taken apart.
MOST_PARTS = 64
Signed = tuple[Solid, int]


def clauses_of(form: Solid, sign: int = 1) -> list[tuple[Signed, ...]]:
    """Return simple forms with signs: the distance is the maximum over clauses of their least sign * distance.

    With sign = -1 it is the distance from the complement. There is a clause for the added forms and one for each
    removed form, and products of clauses where a composite is added. The list ends after MOST_PARTS + 1 clauses.
    """
    if not isinstance(form, Composite):
        return [((form, sign),)]

    def least(groups: list[list[tuple[Signed, ...]]]) -> list[tuple[Signed, ...]]:
        return [sum(chosen, ()) for chosen in islice(product(*groups), MOST_PARTS + 1)]

    added, removed = [clauses_of(one, sign) for one in form.added], [clauses_of(one, -sign) for one in form.removed]
    if sign > 0:
        return [*least(added), *chain(*removed)]
    return least([[*chain(*added)], *removed])


@lru_cache(maxsize=256)
def _volume(form: Composite) -> float:
    if all(any(_holds(other, one) for other in form.removed) for one in form.added):
        return 0.0
    # A removed form that meets no bounding box of an added one removes nothing.
    removed = [one for one in form.removed if any(_boxes_meet(one, other) for other in form.added)]
    lone = not any(_boxes_meet(*pair) for forms in (form.added, removed) for pair in combinations(forms, 2))
    if lone and all(any(_holds(other, one) for other in form.added) for one in removed):
        return sum(one.volume for one in form.added) - sum(one.volume for one in removed)
    return enclosed_volume(form, fewer=1 if any(isinstance(one, Mesh) for one in (*form.added, *removed)) else 0)


def _boxes_meet(first: Solid, second: Solid) -> bool:
    (a, b), (c, d) = first.bounds(), second.bounds()
    return bool(np.all((b > c) & (d > a)))


def _holds(outer: Solid, inner: Solid) -> bool:
    """Return whether a convex form contains another one; False if unknown."""
    if not isinstance(outer, Box | Ball | Capsule | Cylinder):
        return False
    match inner:
        case Ball():
            return bool(outer.contains(np.array([inner.center]), inset=inner.radius).all())
        case Capsule():
            return bool(outer.contains(np.array([inner.start, inner.end]), inset=inner.radius).all())
        case Box():
            return bool(outer.contains(box_corners(*inner.bounds())).all())
        case Polygon():
            return bool(outer.contains(np.array(inner.vertices)).all())
    return False


Form = Box | Ball | Capsule | Composite | Cylinder | Mesh | Points | Polygon | TurnedBox


def turned(form: Solid, turn: np.ndarray, center: np.ndarray) -> Solid:
    """Return a form rotated about a point, (d,), m, by a rotation (d, d)."""

    def moved(*points: Sequence[float]) -> list[tuple[float, ...]]:
        return [tuple(point) for point in (center + (np.array(points) - center) @ turn.T).tolist()]

    match form:
        case Composite():
            return Composite(*(tuple(turned(one, turn, center) for one in of) for of in (form.added, form.removed)))
        case Ball():
            return form.model_copy(update={"center": moved(form.center)[0]})
        case Capsule():
            start, end = moved(form.start, form.end)
            return form.model_copy(update={"start": start, "end": end})
        case Cylinder():
            return form.model_copy(update={"base": moved(form.base)[0], "axis": tuple((turn @ form.axis).tolist())})
        case Polygon():
            return form.model_copy(update={"vertices": tuple(moved(*form.vertices))})
        case Mesh():
            return form.turned(turn, center)
        case TurnedBox():
            edges = turn @ np.array(form.turn)
            return TurnedBox(moved(form.middle)[0], form.half, tuple(map(tuple, edges.tolist())))
    lower, upper = form.bounds()
    if len(lower) == 2:
        (x0, y0), (x1, y1) = lower, upper
        return Polygon.model_construct(vertices=tuple(moved((x0, y0), (x1, y0), (x1, y1), (x0, y1))))
    (middle,) = moved((lower + upper) / 2)
    return TurnedBox(middle, tuple(((upper - lower) / 2).tolist()), tuple(map(tuple, turn.tolist())))


def _only_in(dimension: int, instead: str) -> Any:
    def check(value: object, info: ValidationInfo) -> object:
        found = scene_dimension(info)
        if value is not None and found not in (None, dimension):
            raise flaw(f"is a shape of {dimension}D scenes and this one is {found}D; use {instead}")
        return value

    return BeforeValidator(check)


def _fits_dimension(rotated: object, info: ValidationInfo) -> object:
    d = scene_dimension(info)
    if rotated is not None and d is not None and (d == 3) != isinstance(rotated, dict | Rotation):
        right = "{ axis = [x, y, z], angle = degrees }" if d == 3 else "an angle, degrees,"
        raise flaw(f"must be {right} in {d}D")
    return rotated


COMBINED = ("add", "subtract", "rotation", "center")


def exactly_one_form(shape: "Shape") -> "Shape":
    """Refuse a shape of no form or of several; a validator."""
    known = [name for name in type(shape).model_fields if name not in COMBINED]
    given = [name for name in known if getattr(shape, name) is not None]
    if len(given) != 1:
        raise flaw(f"needs exactly one of {', '.join(known)}; found {' and '.join(given) or 'none'}")
    return shape


Others = tuple[Annotated["Shape", AfterValidator(exactly_one_form)], ...] | None


class Shape(Table):
    """A shape: exactly one of the forms below, with shapes added and subtracted."""

    box: Box | None = Field(None, description="A box with faces along the axes.")
    ball: Ball | None = Field(None, description="A ball; a disc in 2D.")
    capsule: Capsule | None = Field(
        None, description="A cylinder with round ends: all points within a radius of a segment."
    )
    cylinder: Annotated[Cylinder | None, _only_in(3, "box, ball, capsule or polygon")] = Field(
        None, description="A round cylinder; 3D only."
    )
    mesh: Annotated[Mesh | None, _only_in(3, "box, ball, capsule or polygon")] = Field(
        None, description="The interior of a closed surface from a file; 3D only."
    )
    polygon: Annotated[Polygon | None, _only_in(2, "box, ball, capsule, cylinder or mesh")] = Field(
        None, description="A polygon; 2D only."
    )
    add: Others = Field(None, description="Shapes added to the form. Default: none.")
    subtract: Others = Field(None, description="Shapes subtracted from the form and the added shapes. Default: none.")
    rotation: Annotated[Number | Rotation | None, BeforeValidator(_fits_dimension)] = Field(
        None, description="Rotation of the whole: an angle, degrees, in 2D; a table of axis and angle in 3D."
    )
    center: Vector | None = Field(
        None, description="Point about which it rotates, m. Default: the middle of the bounding box."
    )
    _whole: Any = PrivateAttr(None)

    @model_validator(mode="after")
    def _center_is_of_a_rotation(self) -> "Shape":
        if self.rotation is None and self.center is not None:
            raise flaw("is the centre of a rotation; give rotation as well", "center")
        return self

    @property
    def form(self) -> Form:
        """The given form, or its composite with other shapes, rotated."""
        if self.rotation is None:
            return self._upright
        if self._whole is None:
            form, rotated = self._upright, self.rotation
            center = np.mean(form.bounds(), axis=0) if self.center is None else np.array(self.center)
            if isinstance(rotated, Rotation):
                turn = rotation(rotated.axis, math.radians(rotated.angle))
            else:
                s, c = math.sin(math.radians(rotated)), math.cos(math.radians(rotated))
                turn = np.array([[c, -s], [s, c]])
            self._whole = turned(form, turn, center)
        return self._whole

    @property
    def _upright(self) -> Form:
        """The form before it is rotated."""
        single = next(form for name, form in self if form is not None and name not in COMBINED)
        if not (self.add or self.subtract):
            return single
        added, removed = (tuple(shape.form for shape in shapes or ()) for shapes in (self.add, self.subtract))
        return Composite((single, *added), removed)

    @property
    def files(self) -> list[str]:
        others = [file for shape in (*(self.add or ()), *(self.subtract or ())) for file in shape.files]
        return [self.mesh.file, *others] if self.mesh else others

    @property
    def notes(self) -> tuple[str, ...]:
        """What was changed in the surfaces of meshes."""
        own = self.mesh.surface.notes if self.mesh else ()
        return (*own, *(note for one in (*(self.add or ()), *(self.subtract or ())) for note in one.notes))


class BodyShape(Shape):
    """The shape of a body: a form, or points from a file."""

    points: Points | None = Field(None, description="Points from a file, each of which is a particle of the body.")

    @model_validator(mode="after")
    def _points_are_alone(self) -> "BodyShape":
        if self.points and (self.add or self.subtract or self.rotation is not None):
            raise flaw("are particles as they are; leave add, subtract and rotation out", "points")
        return self

    @property
    def files(self) -> list[str]:
        return [self.points.file] if self.points else super().files

    @property
    def at_rest(self) -> "tuple[Form, np.ndarray] | None":
        """The form from which the body of a result began, and its particles there, (n, d), m; None if unknown."""
        state = self.points and self.points.state
        return _at_rest(state, self.points.position.shape[1]) if state else None

    @property
    def notes(self) -> tuple[str, ...]:
        return self.points.notes if self.points else super().notes


@lru_cache(maxsize=32)
def _at_rest(state: ResultState, d: int) -> tuple[Form, np.ndarray] | None:
    """Return `BodyShape.at_rest`, unknown for several bodies and for one that began deformed or as points."""
    if "initial_position" not in state.fields or "deformation" in state.body:
        return None
    try:
        began = BodyShape.model_validate(state.body.get("shape", {}), context={"dimension": d}).form
    except (ValidationError, StopIteration):
        # The file of a shape is gone.
        return None
    return None if isinstance(began, Points) else (began, state.fields["initial_position"][:, :d])


OneShape = Annotated[BodyShape, AfterValidator(exactly_one_form), Field(json_schema_extra={"minProperties": 1})]


_NODES_AT_ONCE = 500_000


def distance_grid(
    form: Form, spacing: float, margin: float, box: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the signed distance from a form on a grid that covers a box and a margin around it.

    Args:
        form: any form of a shape.
        spacing: of the nodes, m.
        margin: m; the grid reaches at least as far beyond the box.
        box: lower and upper corner, m; by default the bounding box of the form.

    Returns:
        values: float32, (n1, ..., nd), m, negative inside; for a mesh see `ClosedSurface.signed_distance`.
        origin: place of the first node, (d,), m.
        spacing: as given; node i lies at origin + i spacing.
    """
    lower, upper = box if len(box) else form.bounds()
    cells = np.ceil((upper - lower + 2 * margin) / spacing - 1e-9).astype(int)
    shape = tuple(int(n) for n in np.maximum(cells, 1) + 1)
    origin = (lower + upper - (np.array(shape) - 1) * spacing) / 2
    total = int(np.prod(shape))
    values = np.empty(total, dtype=np.float32)
    for first in range(0, total, _NODES_AT_ONCE):
        some = np.arange(first, min(first + _NODES_AT_ONCE, total))
        values[some] = form.signed_distance(origin + spacing * np.stack(np.unravel_index(some, shape), axis=1))
    return values.reshape(shape), origin, spacing
