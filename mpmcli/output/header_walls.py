"""What the header of a run says of the walls, from the scene's tables in a file."""

from collections.abc import Mapping

from pydantic import ValidationError

from mpmcli.scene.domain import Walls
from mpmcli.scene.quantity import AXES


def words_of(walls: Mapping[str, str] | str | None, d: int) -> tuple[tuple[str, str], ...] | None:
    """Return the words of the faces along each axis, None where they are not known."""
    if walls is None:
        return None
    table = {"default": walls} if isinstance(walls, str) else walls
    try:
        return Walls.model_validate(table, context={"dimension": d}).faces(d)
    except ValidationError:
        return None


def sticking_axes(
    words: tuple[tuple[str, str], ...] | None, friction: Mapping[str, float] | float
) -> tuple[bool, ...] | None:
    """Return per axis whether a face normal to it sticks or has friction, None where walls are not known."""
    if words is None:
        return None
    numbers = friction if isinstance(friction, Mapping) else {"default": friction}
    rough = [numbers.get("default", 0) > 0 or any(numbers.get(f"{a}_{s}", 0) > 0 for s in ("min", "max")) for a in AXES]
    return tuple("stick" in pair or rubs for pair, rubs in zip(words, rough, strict=False))
