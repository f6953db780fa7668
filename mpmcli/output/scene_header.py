"""What a header says of the bodies of a scene, read from the scene's text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from mpmcli.scene import Scene
from mpmcli.scene.lattice import usual_particles_per_cell
from mpmcli.scene.shapes import BodyShape


@dataclass(frozen=True)
class BodyHeader:
    """A body of the scene.

    Attributes:
        name: of the body.
        material: its table in the scene: "law", "density", and the parameters of the law; {} where not known.
        volume: of its shape, m^3 (m^2 in 2D); None where not known.
        particles_per_cell: at the start.
    """

    name: str
    material: Mapping[str, Any]
    volume: float | None
    particles_per_cell: float

    @property
    def density(self) -> float | None:
        """At rest, kg/m^3; None where not known."""
        return self.material.get("density")


def body_headers(
    names: Sequence[str], tables: Sequence[Mapping[str, Any]], volumes: Sequence[float | None], d: int
) -> tuple[BodyHeader, ...]:
    """Return the bodies with these names; where the scene has other ones, their names are all that is known.

    Args:
        volumes: of each, where it is not that of the shape.
    """
    tables = tables if len(tables) == len(names) else [{} for _ in names]
    volumes = volumes if len(volumes) == len(names) else [None] * len(names)
    return tuple(
        BodyHeader(
            name,
            table.get("material", {}),
            _volume(table.get("shape", {}), d) if volume is None else volume,
            table.get("particles_per_cell", usual_particles_per_cell(d)),
        )
        for name, table, volume in zip(names, tables, volumes, strict=True)
    )


def volumes_from_files(scene: Scene) -> dict[str, Any]:
    """Return the entry with the volume of each body, where a shape is read from a file, which may be gone later."""
    if not any(body.shape.files for body in scene.bodies):
        return {}
    return {"volumes": [body.shape.form.volume for body in scene.bodies]}


def _volume(shape: Mapping[str, Any], d: int) -> float | None:
    try:
        return BodyShape.model_validate(shape, context={"dimension": d}).form.volume
    except (ValidationError, StopIteration):
        return None
