"""Surfaces of rigid things: outlines of segments in 2D, triangles in 3D, and what lies of them within a box."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a thing.

    Attributes:
        points: (n, d), m.
        cells: (m, d) int64, indices of points. A segment has the thing on its left; a triangle has it behind, seen from
            where its corners run counterclockwise.
    """

    points: np.ndarray
    cells: np.ndarray

    @property
    def flipped(self) -> "Surface":
        """The same with the thing on the other side."""
        return Surface(self.points, self.cells[:, ::-1])

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the cells, away from the thing, (m, d); zeros where a cell has no extent."""
        corners = self.points[self.cells]
        along = corners[:, 1] - corners[:, 0]
        if self.points.shape[1] == 2:
            across = np.stack([along[:, 1], -along[:, 0]], axis=1)
        else:
            across = np.cross(along, corners[:, 2] - corners[:, 0])
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    @property
    def sizes(self) -> np.ndarray:
        """Lengths of the segments, m, or areas of the triangles, m^2, (m,)."""
        corners = self.points[self.cells]
        along = corners[:, 1] - corners[:, 0]
        if self.points.shape[1] == 2:
            return np.linalg.norm(along, axis=1)
        return 0.5 * np.linalg.norm(np.cross(along, corners[:, 2] - corners[:, 0]), axis=1)

    def chains(self) -> list[np.ndarray]:
        """Return the segments of a 2D surface joined to lines, points (k, 2) each; the last is the first of a ring."""
        following = dict(self.cells.tolist())
        starts = [start for start in following if start not in set(following.values())]
        found = []
        while following:
            line = [starts.pop() if starts else next(iter(following))]
            while line[-1] in following:
                line.append(following.pop(line[-1]))
            found.append(self.points[line])
        return found


def joined(surfaces: list[Surface], dimension: int) -> Surface:
    """Return several surfaces as one."""
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    cells = [surface.cells + start for surface, start in zip(surfaces, starts, strict=False)]
    none = np.empty((0, dimension))
    return Surface(
        np.concatenate([none, *(surface.points for surface in surfaces)]),
        np.concatenate([none.astype(np.int64), *cells]),
    )


def ring(points: np.ndarray) -> Surface:
    """Return a closed outline through points (n, 2), counterclockwise whichever way they go."""
    x, y = points.T
    if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0:
        points = points[::-1]
    numbers = np.arange(len(points))
    return Surface(points, np.stack([numbers, np.roll(numbers, -1)], axis=1))


def within(surface: Surface, lower: np.ndarray, upper: np.ndarray, *, caps: bool) -> Surface:
    """Return what lies of a surface within a box.

    Args:
        lower, upper: corners of the box, (d,), m.
        caps: whether a closed surface in 3D is closed again where the box cuts it.
    """
    if len(surface.points) == 0:
        return surface
    if (surface.points.min(axis=0) >= lower).all() and (surface.points.max(axis=0) <= upper).all():
        return surface
    if surface.points.shape[1] == 2:
        return _segments_within(surface, lower, upper)
    return _triangles_within(surface, lower, upper, caps)


def _segments_within(surface: Surface, lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Cut segments off at the box: each as a + s (b - a), from the last s at which it enters to the first it leaves."""
    a, b = surface.points[surface.cells[:, 0]], surface.points[surface.cells[:, 1]]
    along = b - a
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (lower - a) / along, (upper - a) / along
    beside = (along == 0) & ((a < lower) | (a > upper))
    into = np.where(along == 0, 0.0, np.minimum(first, second)).max(axis=1, initial=0.0)
    out = np.where(along == 0, 1.0, np.maximum(first, second)).min(axis=1, initial=1.0)
    kept = (into < out) & ~beside.any(axis=1)
    a, along, into, out = a[kept], along[kept], into[kept, None], out[kept, None]
    ends = np.stack([a + into * along, a + out * along], axis=1).reshape(-1, 2)
    points, numbers = np.unique(ends, axis=0, return_inverse=True)
    return Surface(points, numbers.reshape(-1, 2))


def _triangles_within(surface: Surface, lower: np.ndarray, upper: np.ndarray, caps: bool) -> Surface:
    from vtkmodules.vtkCommonDataModel import vtkPlane, vtkPlaneCollection
    from vtkmodules.vtkFiltersGeneral import vtkClipClosedSurface

    planes = vtkPlaneCollection()
    for axis in range(3):
        for corner, sign in ((lower, 1.0), (upper, -1.0)):
            plane = vtkPlane()
            plane.SetOrigin(*corner)
            plane.SetNormal(*(sign * np.eye(3)[axis]))
            planes.AddItem(plane)
    clip = vtkClipClosedSurface()
    clip.SetInputData(poly_data(surface))
    clip.SetClippingPlanes(planes)
    clip.SetScalarModeToLabels()
    clip.TriangulationErrorDisplayOff()
    clip.Update()
    result = clip.GetOutput()
    found = surface_of(result)
    if caps or len(found.cells) == 0:
        return found
    from vtkmodules.util.numpy_support import vtk_to_numpy

    # Label 0 marks what the input had.
    labels = vtk_to_numpy(result.GetCellData().GetScalars())
    return Surface(found.points, found.cells[labels == 0])


def poly_data(surface: Surface) -> Any:
    """Return triangles as VTK's."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(surface.points, dtype=np.float64), deep=True))
    numbers = np.ascontiguousarray(surface.cells, dtype=np.int64).ravel()
    offsets = np.arange(0, len(numbers) + 1, 3, dtype=np.int64)
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(numbers, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data


def surface_of(data: Any) -> Surface:
    """Return the triangles of VTK's polygonal data."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if data.GetNumberOfPolys() == 0:
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))
    points = vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)
    cells = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).astype(np.int64)
    return Surface(points, cells.reshape(-1, 3))
