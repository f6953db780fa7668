"""Types of the values of a scene: numbers, counts, and vectors with one entry per axis."""

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic_core import PydanticCustomError

NUMBER_WORDS = {2: "two", 3: "three"}
AXES = "xyz"
# Pattern of names of bodies, colliders and so on.
NAME = r"^[^\W\d_][\w -]*$"
LARGEST = 1e15


class Table(BaseModel):
    """A table of a scene: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def flaw(sentence: str, key: str = "") -> PydanticCustomError:
    """Return the error that a validator raises for a fault of a value, or of a key of the table that it validates."""
    return PydanticCustomError("flaw", "{sentence}", {"sentence": sentence, "key": key})


def dimension_of(data: object) -> int | None:
    """Return 2 or 3, the length of `domain.size` in parsed TOML, or None where it is not readable."""
    domain = data.get("domain") if isinstance(data, dict) else None
    size = domain.get("size") if isinstance(domain, dict) else None
    return len(size) if isinstance(size, list | tuple) and len(size) in NUMBER_WORDS else None


def scene_dimension(info: ValidationInfo) -> int | None:
    """Return the dimension that the validation context carries; None when the scene's size is not readable."""
    if not isinstance(info.context, dict):
        raise RuntimeError("A Scene is built by load_scene or parse_scene, which know its dimension.")
    return info.context["dimension"]


def place_text(place: Iterable[float]) -> str:
    """Write a place as a list of numbers in TOML, to six digits."""
    return f"[{', '.join(f'{x:.6g}' for x in place)}]"


def _zeros(value: object, info: ValidationInfo) -> object:
    return (0.0,) * (scene_dimension(info) or 2) if value is None else value


def _as_long_as_the_scene(value: tuple, info: ValidationInfo) -> tuple:
    dimension = scene_dimension(info)
    if dimension is not None and len(value) != dimension:
        need = f"{NUMBER_WORDS[dimension]} numbers in this {dimension}D scene (as many as domain.size)"
        raise flaw(f"needs {need}; found {len(value)}")
    return value


def _not_enormous(value: float) -> float:
    """Refuse numbers whose powers overflow or underflow; no scene in SI units needs them."""
    if abs(value) > LARGEST:
        raise flaw(f"is beyond what can be computed with, {LARGEST:g} at most; found {value:g}")
    return value


def _not_minute(value: float) -> float:
    if value < 1 / LARGEST:
        raise flaw(f"is below what can be computed with, {1 / LARGEST:g} at least; found {value:g}")
    return value


Number = Annotated[float, Field(strict=True, allow_inf_nan=False), AfterValidator(_not_enormous)]
Positive = Annotated[
    float, Field(strict=True, allow_inf_nan=False, gt=0), AfterValidator(_not_enormous), AfterValidator(_not_minute)
]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0), AfterValidator(_not_enormous)]
Integer = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]

_ONE_PER_AXIS = Field(json_schema_extra={"minItems": 2, "maxItems": 3})


def list_of_axes(kind: Any, *, zeros: bool = False) -> Any:
    """Return the type of a list with one value per axis; None, which TOML cannot write, means zeros."""
    default = [BeforeValidator(_zeros)] if zeros else []
    return Annotated[tuple[kind, ...], *default, AfterValidator(_as_long_as_the_scene), _ONE_PER_AXIS]


# One number per axis; None means the default, zeros.
Vector = list_of_axes(Number, zeros=True)


def direction_as(example: str) -> Any:
    """Return the type of a vector that is not zero, such as the example."""

    def check(vector: tuple[float, ...]) -> tuple[float, ...]:
        if not any(vector):
            raise flaw(f"must have a direction, as {example}; found zeros")
        return vector

    return Annotated[Vector, AfterValidator(check)]


# Direction of an axis in 3D.
Axis = direction_as("[0, 0, 1] has")
