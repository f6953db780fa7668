"""The domain of a scene: a box of whole grid cells, gravity, and wall conditions."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from mpmcli.scene.entry import TimeVector, value_of, varies
from mpmcli.scene.problem import listed, quoted
from mpmcli.scene.quantity import (
    AXES,
    NUMBER_WORDS,
    Integer,
    NotNegative,
    Number,
    Positive,
    Table,
    Vector,
    flaw,
    list_of_axes,
    scene_dimension,
)

MOST_CELLS = 2**31 - 1


def cells_of(size: tuple[float, ...], spacing: float) -> tuple[int, ...]:
    """Return the cells per axis; refuse a size (m) that is not a whole number of cells."""
    ratios = [s / spacing for s in size]
    if max(ratios) > MOST_CELLS:
        raise flaw(f"makes more than {MOST_CELLS} cells along an axis; make it coarser", "spacing")
    # A relative 1e-6 counts as round-off, but never more than a hundredth of a cell.
    broken = [k for k, r in enumerate(ratios) if round(r) < 1 or abs(r - round(r)) > min(1e-6 * r, 1e-2)]
    if not broken:
        return tuple(round(r) for r in ratios)
    said = []
    for k in broken:
        below = int(ratios[k])
        nearest = " or ".join(f"{n * spacing:.8g}" for n in (below, below + 1) if n)
        said.append(f"{size[k]:.8g} m is {ratios[k]:.6g} cells along {AXES[k]}, {nearest} m would fit")
    raise flaw(f"must be a whole number of cells of spacing {spacing:.8g} m: {'; '.join(said)}", "size")


def spacing_of(size: tuple[float, ...], cells: tuple[int, ...]) -> float:
    """Return the spacing, m; refuse cells that are not square or cubic."""
    if len(cells) != len(size):
        raise flaw(f"needs {NUMBER_WORDS[len(size)]} numbers, as domain.size has; found {len(cells)}", "cells")
    spacings = [s / n for s, n in zip(size, cells, strict=True)]
    if max(spacings) - min(spacings) > 1e-6 * max(spacings):
        found = ", ".join(f"{h:.6g} m along {axis}" for axis, h in zip(AXES, spacings, strict=False))
        fitting = ", ".join(str(max(1, round(s / spacings[0]))) for s in size)
        raise flaw(
            f"must make {'square' if len(size) == 2 else 'cubic'} cells; found {found}; "
            f"nearest to the size is [{fitting}]",
            "cells",
        )
    return spacings[0]


Wall = Literal["slip", "stick", "separate", "periodic", "open"]
WALLS: tuple[str, ...] = get_args(Wall)
PERIODIC, OPEN = "periodic", "open"
# What a word means is told here alone: faces that are no walls, walls along which nothing moves, and walls that
# material may leave.
PASSED, STICKING, SEPARATING = frozenset({PERIODIC, OPEN}), frozenset({"stick"}), frozenset({"separate"})
# Sorting moves particles back into the domain. Before it they reach up to three nodes beyond a face, and no node may
# have two images.
FEWEST_PERIODIC_CELLS = 7

Velocity = list_of_axes(Number)


class Faces(Table):
    """A table with a key for each face, None where nothing is given."""

    @field_validator("z_min", "z_max", check_fields=False)
    @classmethod
    def _needs_a_third_axis(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and scene_dimension(info) == 2:
            raise flaw("is a face of a 3D scene and this one is 2D; leave it out")
        return value


class WallVelocity(Faces):
    """Tangential velocity of each face that sticks or has friction."""

    x_min: Velocity | None = Field(None, description="Velocity of the lower face along x, m/s.")
    x_max: Velocity | None = Field(None, description="Velocity of the upper face along x, m/s.")
    y_min: Velocity | None = Field(None, description="Velocity of the lower face along y, m/s.")
    y_max: Velocity | None = Field(None, description="Velocity of the upper face along y, m/s.")
    z_min: Velocity | None = Field(None, description="Velocity of the lower face along z, m/s; 3D only.")
    z_max: Velocity | None = Field(None, description="Velocity of the upper face along z, m/s; 3D only.")


def require_grip(velocity: WallVelocity, words: Mapping[str, str], frictions: Mapping[str, float]) -> None:
    """Refuse a wall velocity normal to the wall, and one of a wall that neither sticks nor has friction."""
    for face in words:
        found = getattr(velocity, face)
        if found is None:
            continue
        axis = AXES.index(face[0])
        key = f"wall_velocity.{face}"
        if found[axis] != 0:
            raise flaw(
                f"is along the wall, so that its entry {axis + 1}, through it, must be 0; found {found[axis]:g}", key
            )
        if words[face] == PERIODIC:
            raise flaw(f'is for a wall, and domain.walls has "periodic" for {face}; leave it out', key)
        if words[face] not in STICKING and frictions[face] == 0:
            raise flaw(
                f'acts on nothing: domain.walls has "{words[face]}" for {face}, without friction; give "stick", or '
                f"domain.friction",
                key,
            )


# Each wall acts on nodes up to two cells away from it, and no node may belong to both walls of an axis.
FEWEST_CELLS = 5


class WallTypes(Faces):
    """The boundary condition at each face of the domain.

    slip: no motion through the wall, free motion along it. stick: no motion at all.
    separate: as slip, but the material may leave the wall. periodic: material that leaves here enters at the opposite
        face. open: no wall; particles that pass the face are removed.
    """

    default: Wall = Field("separate", description="For every face that is not named.")
    x_min: Wall | None = Field(None, description="Lower face along x.")
    x_max: Wall | None = Field(None, description="Upper face along x.")
    y_min: Wall | None = Field(None, description="Lower face along y.")
    y_max: Wall | None = Field(None, description="Upper face along y.")
    z_min: Wall | None = Field(None, description="Lower face along z; 3D only.")
    z_max: Wall | None = Field(None, description="Upper face along z; 3D only.")

    def faces(self, dimension: int) -> tuple[tuple[Wall, Wall], ...]:
        """Return the conditions of the lower and the upper face along each axis."""
        return tuple(
            (getattr(self, f"{axis}_min") or self.default, getattr(self, f"{axis}_max") or self.default)
            for axis in AXES[:dimension]
        )

    def any_open(self, dimension: int) -> bool:
        """Return whether material can leave through a face."""
        return any(OPEN in pair for pair in self.faces(dimension))


class Friction(Faces):
    """Coefficient of Coulomb friction of each face that slips or separates.

    The tangential force is the one that makes the material stick, but at most the coefficient times the normal force.
    """

    default: NotNegative = Field(0.0, description="For every face that is not named and does not stick.")
    x_min: NotNegative | None = Field(None, description="Lower face along x.")
    x_max: NotNegative | None = Field(None, description="Upper face along x.")
    y_min: NotNegative | None = Field(None, description="Lower face along y.")
    y_max: NotNegative | None = Field(None, description="Upper face along y.")
    z_min: NotNegative | None = Field(None, description="Lower face along z; 3D only.")
    z_max: NotNegative | None = Field(None, description="Upper face along z; 3D only.")


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
        words = listed(quoted(list(WALLS)))
        raise flaw(f'must be {words}, or a table with one of them per face; found "{value}"')
    return {"default": value}


def _or_table(single: dict[str, Any], default: object) -> Callable[[dict[str, Any]], None]:
    """Return a JSON Schema hook by which a table also accepts a single value for all faces."""

    def change(schema: dict[str, Any]) -> None:
        table = {key: schema.pop(key) for key in ("$ref", "allOf") if key in schema}
        schema |= {"anyOf": [single, table], "default": default}

    return change


class Domain(Table):
    """A box of square (2D) or cubic (3D) grid cells."""

    size: tuple[Positive, ...] = Field(
        description="Edge lengths, m; two numbers make a 2D scene, three a 3D one.",
        json_schema_extra={"minItems": 2, "maxItems": 3},
    )
    origin: Vector = Field(
        None, validate_default=True, description="Coordinates of the lower corner, m. Default: zeros."
    )
    spacing: Positive = Field(
        None, description="Grid spacing h, m, of which the size is a whole multiple; or give cells."
    )
    cells: tuple[Annotated[Integer, Field(ge=1, le=MOST_CELLS)], ...] = Field(
        None,
        description="Number of cells along each axis; or give spacing.",
        json_schema_extra={"minItems": 2, "maxItems": 3},
    )
    gravity: TimeVector = Field(
        None,
        validate_default=True,
        description="Gravity, m/s^2; numbers, or expressions of the time t (s). Default: none.",
    )
    walls: Annotated[WallTypes, BeforeValidator(_one_word_for_all)] = Field(
        WallTypes(),
        description="slip, stick, separate, periodic or open: one word for all faces, or a table.",
        json_schema_extra=_or_table({"enum": list(WALLS)}, "separate"),
    )
    friction: Annotated[Friction, BeforeValidator(_one_number_for_all)] = Field(
        Friction(),
        description="Coefficient of friction of walls that slip or separate: one number for all, or a table.",
        json_schema_extra=_or_table({"type": "number", "minimum": 0}, 0),
    )
    wall_velocity: WallVelocity | None = Field(
        None, description="Tangential velocity of walls that stick or have friction, m/s."
    )

    @field_validator("size")
    @classmethod
    def _two_or_three(cls, size: tuple[float, ...]) -> tuple[float, ...]:
        if len(size) not in NUMBER_WORDS:
            raise flaw(f"needs two numbers (2D) or three (3D); found {len(size)}")
        return size

    @model_validator(mode="after")
    def _both_spacing_and_cells(self) -> "Domain":
        """Compute the cells from the spacing, or the spacing from the cells."""
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
    def _faces_that_belong_together(self) -> "Domain":
        """Refuse friction where nothing slips, a periodic face without the other, and walls that move without grip."""
        words = self._words()
        for face, word in words.items():
            if word in PASSED | STICKING and getattr(self.friction, face) is not None:
                raise flaw(
                    f'is for a wall that can slip, and domain.walls has "{word}" for {face}; leave it out, or give '
                    f'"slip" or "separate" there',
                    f"friction.{face}",
                )
        if self.friction.default > 0 and set(words.values()) <= PASSED | STICKING:
            found = " or ".join(f'"{word}"' for word in sorted({*words.values()}, reverse=True))
            raise flaw(f"is for walls that can slip, and domain.walls has {found} for all; leave it out", "friction")
        for axis, count in zip(AXES, self.cells, strict=False):
            pair = words[f"{axis}_min"], words[f"{axis}_max"]
            if PERIODIC in pair and set(pair) != {PERIODIC}:
                face, other = (f"{axis}_min", f"{axis}_max")[:: 1 if pair[0] == PERIODIC else -1]
                raise flaw(
                    f'is "periodic" and {other} is "{words[other]}": material that leaves through one face enters '
                    f'through the other, so that both need "periodic"',
                    f"walls.{face}",
                )
            if PERIODIC in pair and count < FEWEST_PERIODIC_CELLS:
                raise flaw(
                    f'has "periodic" for faces with {count} cells between them; they need at least '
                    f"{FEWEST_PERIODIC_CELLS}",
                    "walls",
                )
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
            own = getattr(self.friction, face)
            found.append(0.0 if word in PASSED | STICKING else self.friction.default if own is None else own)
        return tuple(zip(found[::2], found[1::2], strict=True))

    @property
    def wall_velocities(self) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
        """Velocities of the lower and the upper face along each axis, m/s."""
        still, given = (0.0,) * len(self.size), self.wall_velocity or WallVelocity()
        found = [getattr(given, face) or still for face in self._words()]
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
