"""Rules on the faces of a domain that need its size: periodic ones come in pairs, and which walls can move."""

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from mpmcli.scene.quantity import AXES, Number, Table, flaw, list_of_axes, scene_dimension

PERIODIC = "periodic"
# Particles are put back into the domain when they are sorted. Until then they reach up to three nodes beyond a face,
# and no node may have two images.
FEWEST_PERIODIC_CELLS = 7

Velocity = list_of_axes(Number)


class WallVelocity(Table):
    """Velocity of each face that moves along itself: one that sticks, or that has friction."""

    x_min: Annotated[Velocity | None, Field(description="Of the lower face along x, m/s.")] = None
    x_max: Annotated[Velocity | None, Field(description="Of the upper face along x, m/s.")] = None
    y_min: Annotated[Velocity | None, Field(description="Of the lower face along y, m/s.")] = None
    y_max: Annotated[Velocity | None, Field(description="Of the upper face along y, m/s.")] = None
    z_min: Annotated[Velocity | None, Field(description="Of the lower face along z, m/s; 3D only.")] = None
    z_max: Annotated[Velocity | None, Field(description="Of the upper face along z, m/s; 3D only.")] = None

    @field_validator("z_min", "z_max")
    @classmethod
    def _needs_a_third_axis(cls, value: tuple | None, info: ValidationInfo) -> tuple | None:
        if value is not None and scene_dimension(info) == 2:
            raise flaw("is a face of a 3D scene and this one is 2D; leave it out")
        return value

    def of(self, face: str) -> tuple[float, ...] | None:
        """Return what is given for a face by its name, None where there is nothing."""
        return getattr(self, face)


def require_pairs(words: Mapping[str, str], cells: Sequence[int]) -> None:
    """Refuse a periodic face without the one across from it, and an axis with too few cells between two.

    Args:
        words: of the walls by the name of their face; cells: of the domain per axis.
    """
    for axis, count in zip(AXES, cells, strict=False):
        pair = words[f"{axis}_min"], words[f"{axis}_max"]
        if PERIODIC not in pair:
            continue
        if set(pair) != {PERIODIC}:
            face, other = (f"{axis}_min", f"{axis}_max")[:: 1 if pair[0] == PERIODIC else -1]
            raise flaw(
                f'is "periodic" and {other} is "{words[other]}": material that leaves through one face enters through '
                f'the other, so that both need "periodic"',
                f"walls.{face}",
            )
        if count < FEWEST_PERIODIC_CELLS:
            raise flaw(
                f'has "periodic" for faces with {count} cells between them; they need at least {FEWEST_PERIODIC_CELLS}',
                "walls",
            )


def require_grip(velocity: WallVelocity, words: Mapping[str, str], frictions: Mapping[str, float]) -> None:
    """Refuse the velocity of a wall through itself, and that of one which nothing holds to the material.

    Args:
        words, frictions: of the walls by the name of their face.
    """
    for face in words:
        found = velocity.of(face)
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
        if words[face] != "stick" and frictions[face] == 0:
            raise flaw(
                f'acts on nothing: domain.walls has "{words[face]}" for {face}, without friction; give "stick", or '
                f"domain.friction",
                key,
            )
