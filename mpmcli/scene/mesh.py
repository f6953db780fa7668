"""A body in the form of a closed mesh, read from a file."""

import math
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.mesh_file import MeshFileError, read_mesh
from mpmcli.scene.quantity import Number, Positive, Table, Vector, flaw
from mpmcli.scene.triangle_distance import surface_distance
from mpmcli.scene.triangles import Surface

MILLIMETRE = 1e-3


def scene_file(name: str, info: ValidationInfo) -> Path:
    """Return the path of a file that a scene names, which is relative to the directory of the scene."""
    directory = info.context.get("directory") if isinstance(info.context, dict) else None
    return Path(directory or ".") / name


def file_version(path: Path) -> tuple[int, int]:
    """Return what tells versions of a file apart: when it was changed, ns, and its bytes; zeros where there is none."""
    try:
        stat = path.stat()
    # Of a name with a null character, ValueError.
    except (OSError, ValueError):
        return 0, 0
    return stat.st_mtime_ns, stat.st_size


class Rotation(Table):
    """A rotation about an axis through the origin."""

    axis: Annotated[Vector, Field(description="Axis, of any length.")]
    angle: Annotated[Number, Field(description="Angle, degrees, counter-clockwise seen against the axis.")]

    @model_validator(mode="after")
    def _axis_has_a_direction(self) -> "Rotation":
        if not any(self.axis):
            raise flaw("must have a direction, as [0, 0, 1] has; found zeros", "axis")
        return self


class Mesh(Table):
    """What a closed surface encloses, from a file; 3D only."""

    file: Annotated[str, Field(description="The file, relative to the scene: STL, OBJ, PLY, VTU, ...")]
    scale: Annotated[Positive, Field(description="Metres per unit of the file; 0.001 for millimetres.")] = 1.0
    rotate: Annotated[Rotation | None, Field(description="Rotation, after scaling. Default: none.")] = None
    translate: Annotated[
        Vector, Field(validate_default=True, description="What is added to all vertices in the end, m.")
    ] = None  # type: ignore[assignment]
    _surface: Surface = PrivateAttr()

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> "Mesh":
        path = scene_file(self.file, info)
        turn = (self.rotate.axis, self.rotate.angle) if self.rotate else (None, 0.0)
        try:
            self._surface = _surface_of(path.absolute(), file_version(path), self.scale, *turn, self.translate)
        except MeshFileError as error:
            raise flaw(f"{path}: {error}", "file") from None
        return self

    @property
    def surface(self) -> Surface:
        """The closed surface, m."""
        return self._surface

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3, by the divergence theorem."""
        return self._surface.volume

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (3,) each, m."""
        return self._surface.bounds()

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, 3) whether it lies inside, at least `inset` metres from the surface."""
        inside = self._surface.winding(points) > 0
        if inset > 0:
            inside[inside] = surface_distance(self._surface, points[inside]) >= inset
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 3) from the surface, (n,), m; negative inside.

        See `triangle_distance.SurfaceDistance` for what is exact.
        """
        distance = surface_distance(self._surface, points)
        return np.where(self._surface.winding(points) > 0, -distance, distance)


def leaving(mesh: Mesh, lower: np.ndarray, upper: np.ndarray) -> str:
    """Say how a mesh leaves a domain with these corners, (3,) each, m, by its size alone, and what would be right.

    Empty where its place is at fault; see `moved_inside`.
    """
    size, room = np.ptp(mesh.bounds(), axis=0), upper - lower
    if np.all(size <= room):
        return ""
    extents, domain = (" x ".join(f"{x:.4g}" for x in vector) for vector in (size, room))
    factor = mesh.scale * float(np.min(room / size))
    if mesh.scale == 1 and factor >= MILLIMETRE:
        cure = f"if it is in millimetres, give scale = {MILLIMETRE:g}"
    else:
        digits = -math.floor(math.log10(factor))
        cure = f"it would fit with scale = {math.floor(factor * 10.0**digits) / 10.0**digits:.3g}"
    return f"the mesh is {extents} m, the domain {domain} m; {cure}"


def moved_inside(mesh: Mesh, lower: np.ndarray, upper: np.ndarray) -> str:
    """Return the `translate` that would put a mesh, which is small enough, into a domain with these corners."""
    low, high = mesh.bounds()
    shift = np.maximum(lower - low, 0) - np.maximum(high - upper, 0)
    # Rounded towards the inside, by a millionth of the domain at most.
    unit = 10.0 ** (math.floor(math.log10(float((upper - lower).max()))) - 6)
    shift = np.sign(shift) * np.ceil(np.abs(shift) / unit - 0.01) * unit
    return f"[{', '.join(f'{x:.10g}' for x in np.array(mesh.translate) + shift)}]"


@lru_cache(maxsize=32)
def _surface_of(
    path: Path,
    version: tuple[int, int],
    scale: float,
    axis: tuple[float, ...] | None,
    angle: float,
    translate: tuple[float, ...],
) -> Surface:
    """Return the surface in a file; `version` tells versions of the file apart. Scenes that share it share one."""
    return Surface(*read_mesh(path, scale, axis, angle, translate))
