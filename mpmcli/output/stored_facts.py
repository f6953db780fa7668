"""The types of what files say of a run in JSON and TOML: its header, the scene in it, and run.json.

Files are data that anybody may have changed. What has another type than mpmcli writes is refused, or left out, before
anything is computed from it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from mpmcli.scene.quantity import LARGEST

_LENIENT = ConfigDict(strict=True, extra="allow")
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Value = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
_Count = Annotated[int, Field(ge=0, le=2**62)]
_Entry = _Value | str
_Text = Annotated[str, Field(max_length=10_000)]


class _Domain(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    size: Sequence[_Value]
    origin: Sequence[_Value]
    spacing: _Value
    gravity: Sequence[_Entry]
    walls: str | dict[str, Any]
    friction: _Value | dict[str, _Value]


class _Time(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    end: _Value
    frames: _Count


class _Material(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    law: _Text
    density: _Value


class _Body(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    name: _Text
    material: _Material
    shape: dict[str, Any]
    particles_per_cell: _Value


class _Scene(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    domain: _Domain
    time: _Time
    solver: dict[str, Any]
    output: dict[str, Any]
    bodies: Sequence[_Body]
    emitters: Sequence[_Body]
    colliders: Sequence[dict[str, Any]]


class _Law(TypedDict, total=False):
    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")
    deformation: str
    coherent: bool
    projects: bool


class _Header(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    version: str | None
    title: str | None
    dimension: Annotated[int, Field(ge=2, le=3)]
    spacing: _Value | None
    origin: Sequence[_Value]
    size: Sequence[_Value]
    bodies: Sequence[_Text]
    materials: Sequence[_Text]
    laws: Sequence[_Law | str]
    precision: str
    backend: dict[str, Any] | None
    scene: str
    volumes: Sequence[_Number | None]
    emitter_volumes: Sequence[_Number | None]


class _Failure(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    message: str
    limit: str
    step: _Count
    time: _Number | None


class _Record(TypedDict, total=False):
    __pydantic_config__ = _LENIENT
    status: str
    command: list[str]
    backend: dict[str, Any]
    frames_expected: _Count
    frames_written: _Count
    particles: _Count
    steps: _Count
    time: _Number | None
    notes: list[str]
    timings: dict[str, _Number | None]
    limits: dict[str, _Count]
    energy: dict[str, _Number | None]
    failure: _Failure | None


_HEADER, _SCENE, _RECORD = (TypeAdapter(kind) for kind in (_Header, _Scene, _Record))


def require_header(stored: Mapping[str, Any]) -> None:
    """Refuse the header of a file if one of its entries has another type than a run writes.

    Raises:
        ValueError: which entry.
    """
    _require(_HEADER, dict(stored), "header")


def require_scene(tables: Mapping[str, Any]) -> None:
    """Refuse the tables of a scene in a header if one that readers use has another type.

    Raises:
        ValueError: which one.
    """
    _require(_SCENE, dict(tables), "scene")


def sound_record(record: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a run.json that have the types which a run writes."""
    try:
        _RECORD.validate_python(record)
    except ValidationError as error:
        wrong = {one["loc"][0] for one in error.errors() if one["loc"]}
        return {name: value for name, value in record.items() if name not in wrong}
    return record


def _require(adapter: TypeAdapter, value: Any, name: str) -> None:
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        place = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise ValueError(f"the {name} has no valid {place}") from None
