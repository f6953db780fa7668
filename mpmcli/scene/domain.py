"""The domain of a scene: a box of whole grid cells, gravity, and what its walls do."""

from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from mpmcli.scene.cell_counts import MOST_CELLS, cells_of, spacing_of
from mpmcli.scene.entry import TimeVector, value_of, varies
from mpmcli.scene.quantity import (
    AXES,
    NUMBER_WORDS,
    Integer,
    NotNegative,
    Positive,
    Table,
    Vector,
    flaw,
    scene_dimension,
)
from mpmcli.scene.wall_rules import PERIODIC, WallVelocity, require_grip, require_pairs

Wall = Literal["slip", "stick", "separate", "periodic", "open"]
WALLS: tuple[str, ...] = get_args(Wall)
# Those on which nothing slips.
# Each wall acts on nodes up to two cells away from it, and no node may belong to both walls of an axis.
FEWEST_CELLS = 5
# Faces without friction: nothing slips along them, or they are no wall.
_NEVER_SLIP = ("stick", PERIODIC, "open")


class Walls(Table):
    """What each face of the domain does to the material that meets it.

    slip: no motion through the wall, free motion along it. stick: no motion at all.
    separate: as slip, but the material may leave the wall. periodic: what leaves here enters at the opposite face.
    open: no wall; what passes the face is gone.
    """

    default: Annotated[Wall, Field(description="For every face that is not named.")] = "separate"
    x_min: Annotated[Wall | None, Field(description="Lower face along x.")] = None
    x_max: Annotated[Wall | None, Field(description="Upper face along x.")] = None
    y_min: Annotated[Wall | None, Field(description="Lower face along y.")] = None
    y_max: Annotated[Wall | None, Field(description="Upper face along y.")] = None
    z_min: Annotated[Wall | None, Field(description="Lower face along z; 3D only.")] = None
    z_max: Annotated[Wall | None, Field(description="Upper face along z; 3D only.")] = None

    @field_validator("z_min", "z_max")
    @classmethod
    def _needs_a_third_axis(cls, wall: Wall | None, info: ValidationInfo) -> Wall | None:
        return _in_3d(wall, info)

    def faces(self, dimension: int) -> tuple[tuple[Wall, Wall], ...]:
        """Return what the lower and the upper face along each axis do."""
        return tuple(
            (getattr(self, f"{axis}_min") or self.default, getattr(self, f"{axis}_max") or self.default)
            for axis in AXES[:dimension]
        )

    def any_open(self, dimension: int) -> bool:
        """Return whether material can leave through a face."""
        return any("open" in pair for pair in self.faces(dimension))


class Friction(Table):
    """Coefficient of Coulomb friction of each face that slips or separates.

    The wall takes at most the coefficient times the normal force from the force along it that would make it stick.
    """

    default: Annotated[NotNegative, Field(description="For every face that is not named and does not stick.")] = 0.0
    x_min: Annotated[NotNegative | None, Field(description="Lower face along x.")] = None
    x_max: Annotated[NotNegative | None, Field(description="Upper face along x.")] = None
    y_min: Annotated[NotNegative | None, Field(description="Lower face along y.")] = None
    y_max: Annotated[NotNegative | None, Field(description="Upper face along y.")] = None
    z_min: Annotated[NotNegative | None, Field(description="Lower face along z; 3D only.")] = None
    z_max: Annotated[NotNegative | None, Field(description="Upper face along z; 3D only.")] = None

    @field_validator("z_min", "z_max")
    @classmethod
    def _needs_a_third_axis(cls, value: float | None, info: ValidationInfo) -> float | None:
        return _in_3d(value, info)

    def of(self, face: str) -> float | None:
        """Return the coefficient that is given for a face by its name, None where there is none."""
        return getattr(self, face)


def _in_3d(value: Any, info: ValidationInfo) -> Any:
    if value is not None and scene_dimension(info) == 2:
        raise flaw("is a face of a 3D scene and this one is 2D; leave it out")
    return value


def _one_number_for_all(value: object) -> object:
    if isinstance(value, Friction | dict):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise flaw(f'must be a number, or a table with one per face, such as {{ y_min = 0.5 }}; found "{value}"')
    return {"default": float(value)}


def _one_word_for_all(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value not in WALLS:
        words = [f'"{word}"' for word in WALLS]
        raise flaw(
            f'must be {", ".join(words[:-1])} or {words[-1]}, or a table with one of them per face; found "{value}"'
        )
    return {"default": value}


def _friction_schema(schema: dict[str, Any]) -> None:
    table = {key: schema.pop(key) for key in ("$ref", "allOf") if key in schema}
    schema["anyOf"] = [{"type": "number", "minimum": 0}, table]
    schema["default"] = 0


def _walls_schema(schema: dict[str, Any]) -> None:
    table = {key: schema.pop(key) for key in ("$ref", "allOf") if key in schema}
    schema["anyOf"] = [{"enum": list(WALLS)}, table]
    schema["default"] = "separate"


class Domain(Table):
    """A box of square (2D) or cubic (3D) grid cells."""

    size: Annotated[
        tuple[Positive, ...],
        Field(
            description="Edge lengths, m; two numbers make a 2D scene, three a 3D one.",
            json_schema_extra={"minItems": 2, "maxItems": 3},
        ),
    ]
    origin: Annotated[
        Vector,
        Field(validate_default=True, description="Coordinates of the lower corner, m. Default: zeros."),
    ] = None  # type: ignore[assignment]
    spacing: Annotated[
        Positive,
        Field(description="Grid spacing h, m, of which the size is a whole multiple; or give cells."),
    ] = None  # type: ignore[assignment]
    cells: Annotated[
        tuple[Annotated[Integer, Field(ge=1, le=MOST_CELLS)], ...],
        Field(
            description="Number of cells along each axis; or give spacing.",
            json_schema_extra={"minItems": 2, "maxItems": 3},
        ),
    ] = None  # type: ignore[assignment]
    gravity: Annotated[
        TimeVector,
        Field(
            validate_default=True,
            description="Gravity, m/s^2; numbers, or expressions of the time t (s). Default: none.",
        ),
    ] = None  # type: ignore[assignment]
    walls: Annotated[
        Walls,
        BeforeValidator(_one_word_for_all),
        Field(
            description="slip, stick, separate, periodic or open: one word for all faces, or a table.",
            json_schema_extra=_walls_schema,
        ),
    ] = Walls()
    friction: Annotated[
        Friction,
        BeforeValidator(_one_number_for_all),
        Field(
            description="Coefficient of friction of walls that slip or separate: one number for all, or a table.",
            json_schema_extra=_friction_schema,
        ),
    ] = Friction()
    wall_velocity: Annotated[
        WallVelocity | None, Field(description="Velocity along themselves of walls that stick or have friction, m/s.")
    ] = None

    @field_validator("size")
    @classmethod
    def _two_or_three(cls, size: tuple[float, ...]) -> tuple[float, ...]:
        if len(size) not in NUMBER_WORDS:
            raise flaw(f"needs two numbers (2D) or three (3D); found {len(size)}")
        return size

    @model_validator(mode="after")
    def _both_spacing_and_cells(self) -> "Domain":
        """Give the domain its cells from its spacing, or its spacing from its cells."""
        if self.spacing is None and self.cells is None:
            raise flaw('missing key "spacing" (m), or "cells" (a number per axis) in its place')
        if self.spacing is not None and self.cells is not None:
            raise flaw('"spacing" is given as well; leave one of them out', "cells")
        key = "cells" if self.spacing is None else "spacing"
        spacing = self.spacing or spacing_of(self.size, self.cells)
        cells = self.cells or cells_of(self.size, self.spacing)
        if min(cells) < FEWEST_CELLS:
            axis = cells.index(min(cells))
            raise flaw(
                f"makes {cells[axis]} cells along {AXES[axis]}, and opposite walls need at least {FEWEST_CELLS} "
                f"between them; a spacing of {self.size[axis] / FEWEST_CELLS:.6g} m or less would do",
                key,
            )
        return self.model_copy(update={"spacing": spacing, "cells": cells})

    @model_validator(mode="after")
    def _friction_of_walls_that_slip(self) -> "Domain":
        words = self._words()
        for face, word in words.items():
            if word in _NEVER_SLIP and self.friction.of(face) is not None:
                raise flaw(
                    f'is for a wall that can slip, and domain.walls has "{word}" for {face}; leave it out, or give '
                    f'"slip" or "separate" there',
                    f"friction.{face}",
                )
        if self.friction.default > 0 and set(words.values()) <= {*_NEVER_SLIP}:
            found = " or ".join(f'"{word}"' for word in sorted({*words.values()}, reverse=True))
            raise flaw(f"is for walls that can slip, and domain.walls has {found} for all; leave it out", "friction")
        return self

    @model_validator(mode="after")
    def _walls_that_belong_together(self) -> "Domain":
        words = self._words()
        require_pairs(words, self.cells)
        if self.wall_velocity is not None:
            require_grip(self.wall_velocity, words, dict(zip(words, sum(self.frictions, ()), strict=True)))
        return self

    def _words(self) -> dict[str, Wall]:
        pairs = self.walls.faces(len(self.size))
        return {
            f"{axis}_{side}": word
            for axis, pair in zip(AXES, pairs, strict=False)
            for side, word in zip(("min", "max"), pair, strict=True)
        }

    @property
    def frictions(self) -> tuple[tuple[float, float], ...]:
        """Coefficients of friction of the lower and the upper face along each axis, 0 for one that never slips."""
        found = []
        for face, word in self._words().items():
            own = self.friction.of(face)
            found.append(0.0 if word in _NEVER_SLIP else self.friction.default if own is None else own)
        return tuple(zip(found[::2], found[1::2], strict=True))

    @property
    def wall_velocities(self) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
        """Velocities of the lower and the upper face along each axis, m/s."""
        still, given = (0.0,) * len(self.size), self.wall_velocity or WallVelocity()
        found = [given.of(face) or still for face in self._words()]
        return tuple(zip(found[::2], found[1::2], strict=True))

    @property
    def wall_speed(self) -> float:
        """Speed of the fastest wall, m/s."""
        return max(float(np.linalg.norm(velocity)) for pair in self.wall_velocities for velocity in pair)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether the faces along each axis are periodic."""
        return tuple(PERIODIC in pair for pair in self.walls.faces(len(self.size)))

    @property
    def upper(self) -> tuple[float, ...]:
        """Coordinates of the upper corner, m."""
        return tuple(o + s for o, s in zip(self.origin, self.size, strict=True))

    @property
    def steady(self) -> bool:
        """Whether gravity is the same at all times."""
        return not varies(*self.gravity)

    def gravity_at(self, time: float) -> np.ndarray:
        """Return gravity at a time (s), (d,), m/s^2."""
        return np.array([float(value_of(entry, t=time)) for entry in self.gravity])
