"""Shapes: forms, each with its volume, its bounds, an inside test and a signed distance, and composites of them."""

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from mpmcli.scene.composite import Composite
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.points import Points
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder
from mpmcli.scene.quantity import Table, flaw, scene_dimension

Form = Box | Ball | Capsule | Composite | Cylinder | Mesh | Points | Polygon


def _only_in(dimension: int, instead: str) -> Any:
    def check(value: object, info: ValidationInfo) -> object:
        found = scene_dimension(info)
        if value is not None and found not in (None, dimension):
            raise flaw(f"is a shape of {dimension}D scenes and this one is {found}D; use {instead}")
        return value

    return BeforeValidator(check)


COMBINED = ("add", "subtract")


def exactly_one_form(shape: "Shape") -> "Shape":
    """Refuse a shape of no form or of several; a validator."""
    known = [name for name in type(shape).model_fields if name not in COMBINED]
    given = [name for name in known if getattr(shape, name) is not None]
    if len(given) != 1:
        raise flaw(f"needs exactly one of {', '.join(known)}; found {' and '.join(given) or 'none'}")
    return shape


class Shape(Table):
    """A form: exactly one of those below, with others added to it and taken from it."""

    box: Annotated[Box | None, Field(description="A box with faces along the axes.")] = None
    ball: Annotated[Ball | None, Field(description="A ball; a disc in 2D.")] = None
    capsule: Annotated[
        Capsule | None, Field(description="A cylinder with round ends: all points within a radius of a segment.")
    ] = None
    cylinder: Annotated[
        Cylinder | None, _only_in(3, "box, ball, capsule or polygon"), Field(description="A round cylinder; 3D only.")
    ] = None
    mesh: Annotated[
        Mesh | None,
        _only_in(3, "box, ball, capsule or polygon"),
        Field(description="What a closed surface encloses, from a file; 3D only."),
    ] = None
    polygon: Annotated[
        Polygon | None, _only_in(2, "box, ball, capsule, cylinder or mesh"), Field(description="A polygon; 2D only.")
    ] = None
    add: Annotated[
        tuple[Annotated["Shape", AfterValidator(exactly_one_form)], ...] | None,
        Field(description="Shapes that belong to it as well. Default: none."),
    ] = None
    subtract: Annotated[
        tuple[Annotated["Shape", AfterValidator(exactly_one_form)], ...] | None,
        Field(description="Shapes that are taken from the form and from what is added. Default: none."),
    ] = None

    @property
    def form(self) -> Form:
        """The form that is given, or the composite of it and others."""
        single = next(form for name, form in self if form is not None and name not in COMBINED)
        if not (self.add or self.subtract):
            return single
        added, removed = (tuple(shape.form for shape in shapes or ()) for shapes in (self.add, self.subtract))
        return Composite((single, *added), removed)

    @property
    def files(self) -> list[str]:
        """The files that the shape is read from."""
        others = [file for shape in (*(self.add or ()), *(self.subtract or ())) for file in shape.files]
        return [self.mesh.file, *others] if self.mesh else others


class BodyShape(Shape):
    """The shape of a body: a form as other shapes, or points from a file."""

    points: Annotated[
        Points | None, Field(description="Points from a file, each of which is a particle of the body.")
    ] = None

    @model_validator(mode="after")
    def _points_are_alone(self) -> "BodyShape":
        if self.points and (self.add or self.subtract):
            raise flaw("are particles as they are; leave add and subtract out", "points")
        return self

    @property
    def files(self) -> list[str]:
        """The files that the shape is read from."""
        return [self.points.file] if self.points else super().files


OneShape = Annotated[
    BodyShape,
    AfterValidator(exactly_one_form),
    Field(json_schema_extra={"minProperties": 1}),
]
