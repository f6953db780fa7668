"""A body in the form of a closed mesh from a file: welded, closed, facing outwards."""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.geometry_file import GeometryFileError, file_version, read_geometry, scene_file
from mpmcli.scene.primitives import Solid, grid_points, rotation
from mpmcli.scene.quantity import Axis, Number, Positive, Table, Vector, flaw, place_text
from mpmcli.scene.triangles import ClosedSurface

# Points per axis at which the surface is tried for parts that overlap or are inside out.
_TRIED = 24


class MeshFileError(Exception):
    """A file makes no closed surface; the text says why, in words that follow the name of the file."""


def read_mesh(
    path: str | Path,
    scale: float = 1.0,
    axis: tuple[float, ...] | None = None,
    angle: float = 0.0,
    translate: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed surface in a file: vertices (n, 3), m, and triangles (m, 3) that face outwards.

    The vertices are multiplied by `scale`, turned by `angle` degrees about `axis` through the origin, and moved by
    `translate`. Vertices at the same place are one. A mesh of cells gives its surface.
    """
    vertices, triangles = _closed(*_welded(*_read(Path(path))))
    vertices = vertices * scale
    if axis is not None:
        vertices = vertices @ rotation(axis, math.radians(angle)).T
    return vertices + np.array(translate), triangles


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and triangles (m, 3) of the surface of what a file holds."""
    try:
        found = read_geometry(path)
    except GeometryFileError as error:
        raise MeshFileError(str(error) or "it is no mesh that can be read (STL, OBJ, PLY and VTU are)") from None
    if not len(found.triangles):
        raise MeshFileError("it holds no triangle")
    if not np.isfinite(found.vertices[np.unique(found.triangles)]).all():
        raise MeshFileError("it holds a vertex that is not finite")
    return found.vertices, found.triangles


def _welded(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make vertices at the same place one, and drop the triangles that become edges by it."""
    vertices, which = np.unique(points, axis=0, return_inverse=True)
    triangles = which.reshape(-1)[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    used, triangles = np.unique(triangles[~flat], return_inverse=True)
    return vertices[used], triangles.reshape(-1, 3)


def _closed(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a surface with its triangles facing outwards, or raise what keeps it from being closed."""
    directed = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    edges, which = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    which = which.reshape(-1)
    uses = np.bincount(which, minlength=len(edges))
    if odd := int(np.sum(uses % 2)):
        raise MeshFileError(f"its surface is open: {odd} of {len(edges)} edges have a triangle on one side only")
    ways = np.bincount(which, weights=np.where(directed[:, 0] < directed[:, 1], 1, -1), minlength=len(edges))
    if turned := int(np.sum(ways != 0)):
        raise MeshFileError(
            f"its triangles face different sides across {turned} of {len(edges)} edges; orient them alike"
        )
    surface = ClosedSurface(vertices, triangles)
    if surface.volume < 0:
        triangles = triangles[:, ::-1]
        surface = ClosedSurface(vertices, triangles)
    lower, upper = surface.bounds()
    if not surface.volume > 1e-12 * float(np.prod(upper - lower)):
        raise MeshFileError("its surface encloses no volume")
    steps = [np.linspace(a, b, _TRIED + 2)[1:-1] for a, b in zip(lower, upper, strict=True)]
    points = grid_points(*steps)
    winding = surface.winding(points)
    for wrong, said in ((winding < 0, "a part of its surface is inside out"), (winding > 1, "its parts overlap")):
        if wrong.any():
            where = place_text(points[np.argmax(wrong)])
            raise MeshFileError(f"{said}, for example at {where} in its own units")
    return vertices, triangles


MILLIMETRE = 1e-3


class Rotation(Table):
    """A rotation about an axis through the origin."""

    axis: Axis = Field(description="Axis, of any length.")
    angle: Number = Field(description="Angle, degrees, counter-clockwise seen against the axis.")


class Mesh(Table, Solid):
    """What a closed surface encloses, from a file; 3D only."""

    file: str = Field(description="The file, relative to the scene: STL, OBJ, PLY, VTU, ...")
    scale: Positive = Field(1.0, description="Metres per unit of the file; 0.001 for millimetres.")
    rotate: Rotation | None = Field(None, description="Rotation, after scaling. Default: none.")
    translate: Vector = Field(None, validate_default=True, description="What is added to all vertices in the end, m.")
    _surface: ClosedSurface = PrivateAttr()

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
    def surface(self) -> ClosedSurface:
        """The closed surface, m."""
        return self._surface

    @property
    def volume(self) -> float:
        return self._surface.volume

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self._surface.bounds()

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        inside = self._surface.winding(points) > 0
        if inset > 0:
            inside[inside] = self._surface.signed_distance(points[inside]) <= -inset
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        return self._surface.signed_distance(points)


def leaving(mesh: Mesh, lower: np.ndarray, upper: np.ndarray) -> str:
    """Say how a mesh leaves a domain by its size alone, and what would be right; "" where its place is at fault."""
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
def _surface_of(path: Path, version: tuple[int, int], *placement: Any) -> ClosedSurface:
    """Return the surface in a file; `version` tells versions of the file apart. Scenes that share it share one."""
    return ClosedSurface(*read_mesh(path, *placement))
