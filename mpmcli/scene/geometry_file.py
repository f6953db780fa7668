"""Points and triangles from a file, by its ending: STL, OBJ and PLY by trimesh, and all others by PyVista.

VTK ends the process where a binary PLY is cut off; trimesh raises. It refuses faces of different lengths in one, which
meshio takes.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationInfo

# The endings of files that trimesh reads.
_BY_TRIMESH = (".obj", ".ply", ".stl")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Points (n, 3) float64 and their arrays by name; vertices (k, 3) and triangles (m, 3) int64 of the surface."""

    points: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


class GeometryFileError(Exception):
    """There is no such file, or it cannot be read; the text is empty in the latter case."""


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


def absence(path: Path) -> str:
    """Say why there is no file at a path, "" where there is one."""
    try:
        return "" if path.is_file() else "it is no file" if path.exists() else "there is no such file"
    # A name that is too long, or a directory that may not be read.
    except (OSError, ValueError):
        return "there is no such file"


def read_geometry(path: Path) -> Geometry:
    """Return the points and the triangles in a file, or raise a GeometryFileError."""
    if fault := absence(path):
        raise GeometryFileError(fault)
    try:
        with _quiet():
            return _by_trimesh(path) if path.suffix.lower() in _BY_TRIMESH else _by_vtk(path)
    # Of a damaged file readers raise almost anything; meshio even ends the process.
    except (Exception, SystemExit):
        raise GeometryFileError from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep from the terminal what readers print."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def _by_trimesh(path: Path) -> Geometry:
    import trimesh

    try:
        found = trimesh.load(path, process=False, skip_materials=True)
    except ValueError:
        if path.suffix.lower() != ".ply":
            raise
        return _by_meshio(path)
    if isinstance(found, trimesh.Scene):
        found = found.to_mesh()
    vertices, triangles = np.array(found.vertices, np.float64), getattr(found, "faces", np.empty((0, 3), np.int64))
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError("a corner is no vertex")
    # Corners of STL, and those of OBJ that have several texture coordinates, are one point.
    first = np.unique(vertices, axis=0, return_index=True)[1]
    points = vertices if path.suffix.lower() == ".ply" else vertices[np.sort(first)]
    return Geometry(points, vertices, np.array(triangles))


def _by_meshio(path: Path) -> Geometry:
    """Return what a binary PLY holds whose faces have different numbers of corners, each as a fan of triangles."""
    from meshio import ply

    mesh = ply.read(path)
    fans = [block.data[:, [0, k, k + 1]] for block in mesh.cells for k in range(1, block.data.shape[1] - 1)]
    points = np.array(mesh.points, np.float64)
    return Geometry(points, points, np.concatenate(fans).astype(np.int64))


def _by_vtk(path: Path) -> Geometry:
    """Return what PyVista reads, with the surface of solid cells."""
    import pyvista as pv
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    shown, told = vtkObject.GetGlobalWarningDisplay(), vtkLogger.GetCurrentVerbosityCutoff()
    vtkObject.GlobalWarningDisplayOff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        found = pv.read(path)
        found = found.combine() if isinstance(found, pv.MultiBlock) else found
        _require_corners(found)
        surface, triangles = vtkDataSetSurfaceFilter(), vtkTriangleFilter()
        surface.SetInputData(found)
        triangles.SetInputConnection(surface.GetOutputPort())
        triangles.PassVertsOff()
        triangles.PassLinesOff()
        triangles.Update()
        result = triangles.GetOutput()
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)
        vtkLogger.SetStderrVerbosity(told)
    points, data = np.array(found.points, np.float64), found.point_data
    arrays = {str(name): np.asarray(data[name]) for name in data.keys()}  # noqa: SIM118
    arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "iuf"}
    if not result.GetNumberOfPolys():
        return Geometry(points, points[:0], np.empty((0, 3), np.int64), arrays)
    vertices = vtk_to_numpy(result.GetPoints().GetData()).astype(np.float64)
    corners = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    return Geometry(points, vertices, corners, arrays)


def _require_corners(found: Any) -> None:
    """Raise ValueError for a cell of a data set of VTK with a corner that is none of its points."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if found.IsA("vtkPolyData"):
        kinds = [found.GetPolys(), found.GetStrips()]
    else:
        kinds = [found.GetCells()] if found.IsA("vtkUnstructuredGrid") else []
    for cells in kinds:
        corners = vtk_to_numpy(cells.GetConnectivityArray())
        if corners.size and not 0 <= corners.min() <= corners.max() < found.GetNumberOfPoints():
            raise ValueError("a corner is no vertex")
