"""Triangles from a file: STL, OBJ, PLY, VTU and what else PyVista or meshio read; welded, closed, facing outwards."""

import math
from pathlib import Path

import numpy as np

from mpmcli.scene.geometry_file import GeometryFileError, read_geometry
from mpmcli.scene.rotation import rotation
from mpmcli.scene.triangles import Surface

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

    Raises:
        MeshFileError: there is no such file, or it holds no mesh, or one that is open, or not oriented.
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
    surface = Surface(vertices, triangles)
    if surface.volume < 0:
        triangles = triangles[:, ::-1]
        surface = Surface(vertices, triangles)
    lower, upper = surface.bounds()
    if not surface.volume > 1e-12 * float(np.prod(upper - lower)):
        raise MeshFileError("its surface encloses no volume")
    steps = [np.linspace(a, b, _TRIED + 2)[1:-1] for a, b in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    winding = surface.winding(points)
    for wrong, said in ((winding < 0, "a part of its surface is inside out"), (winding > 1, "its parts overlap")):
        if wrong.any():
            where = ", ".join(f"{x:.6g}" for x in points[np.argmax(wrong)])
            raise MeshFileError(f"{said}, for example at [{where}] in its own units")
    return vertices, triangles
