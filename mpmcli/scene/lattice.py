"""The lattice of particles that fill a shape: how many lie in a cell of the grid."""

from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo

from mpmcli.scene.quantity import Integer, flaw, scene_dimension


def usual_particles_per_cell(dimension: int) -> int:
    """Return the particles per cell of a body that does not give them: two per axis."""
    return 2**dimension


def _filled_lattice(value: object, info: ValidationInfo) -> object:
    return usual_particles_per_cell(scene_dimension(info) or 2) if value is None else value


def _whole_lattice(count: int, info: ValidationInfo) -> int:
    """Refuse a lattice whose number of particles per cell is no square (2D) or cube (3D)."""
    dimension = scene_dimension(info)
    shape = info.data.get("shape")
    of_points = shape is not None and getattr(shape, "points", None)
    if dimension is None or info.data.get("sampling", "lattice") != "lattice" or of_points:
        return count
    root = round(count ** (1 / dimension))
    if root**dimension == count:
        return count
    below = root if root**dimension < count else root - 1
    nearest = f"{below**dimension} or {(below + 1) ** dimension}"
    raise flaw(
        f"must be a {'square' if dimension == 2 else 'cube'} number for a lattice in {dimension}D, "
        f'for example {nearest}; found {count}. With sampling = "jittered" any number will do'
    )


ParticlesPerCell = Annotated[
    Integer,
    Field(ge=1, le=10**4),
    BeforeValidator(_filled_lattice),
    AfterValidator(_whole_lattice),
    Field(
        validate_default=True,
        description="Particles per cell of the grid; a square (2D) or cube (3D) number for a lattice. "
        "Default: 4 in 2D, 8 in 3D; that of the points where the shape is points.",
    ),
]
