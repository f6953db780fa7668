"""The types of what files say of a run in JSON and TOML: its header, the scene in it, and run.json.

Files are data that anybody may have changed. What has another type than mpmcli writes is refused, or left out, before
anything is computed from it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from mpmcli.scene.quantity import LARGEST


def _table(name: str = "table", /, *, extra: str = "allow", **kinds: Any) -> Any:
    """Return the type of a table whose entries have these types, if it has them; sentences of errors have its name."""
    table = TypedDict(name, kinds, total=False)
    table.__pydantic_config__ = ConfigDict(strict=True, extra=extra)
    return table


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Value = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
_Count = Annotated[int, Field(ge=0, le=2**62)]
_Text = Annotated[str, Field(max_length=10_000)]
_Any = dict[str, Any]

_Domain = _table(
    size=Sequence[_Value],
    origin=Sequence[_Value],
    spacing=_Value,
    gravity=Sequence[_Value | str],
    walls=str | _Any,
    friction=_Value | dict[str, _Value],
)
_Material = _table(law=_Text, density=_Value)
_Body = _table(name=_Text, material=_Material, shape=_Any, particles_per_cell=_Value)
_Scene = _table(
    domain=_Domain,
    time=_table(end=_Value, frames=_Count),
    solver=_Any,
    output=_Any,
    bodies=Sequence[_Body],
    emitters=Sequence[_Body],
    colliders=Sequence[_Any],
)
_Law = _table("_Law", extra="forbid", deformation=str, coherent=bool, projects=bool)
_Header = _table(
    version=str | None,
    title=str | None,
    dimension=Annotated[int, Field(ge=2, le=3)],
    spacing=_Value | None,
    origin=Sequence[_Value],
    size=Sequence[_Value],
    bodies=Sequence[_Text],
    materials=Sequence[_Text],
    laws=Sequence[_Law | str],
    precision=str,
    backend=_Any | None,
    scene=str,
    volumes=Sequence[_Number | None],
    emitter_volumes=Sequence[_Number | None],
)
_Failure = _table(message=str, limit=str, step=_Count, time=_Number | None)
_Record = _table(
    status=str,
    command=list[str],
    forced=bool,
    backend=_Any,
    frames_expected=_Count,
    frames_written=_Count,
    particles=_Count,
    steps=_Count,
    time=_Number | None,
    notes=list[str],
    timings=dict[str, _Number | None],
    limits=dict[str, _Count],
    energy=dict[str, _Number | None],
    failure=_Failure | None,
)
_KINDS = {"header": TypeAdapter(_Header), "scene": TypeAdapter(_Scene)}
_RECORD = TypeAdapter(_Record)


def require_kinds(name: str, facts: Mapping[str, Any]) -> None:
    """Raise ValueError where an entry of a "header", or of the "scene" in one, has another type than a run writes."""
    try:
        _KINDS[name].validate_python(dict(facts))
    except ValidationError as error:
        place = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise ValueError(f"the {name} has no valid {place}") from None


def sound_record(record: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a run.json that have the types which a run writes."""
    try:
        _RECORD.validate_python(record)
    except ValidationError as error:
        wrong = {one["loc"][0] for one in error.errors() if one["loc"]}
        return {name: value for name, value in record.items() if name not in wrong}
    return record
