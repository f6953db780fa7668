"""Points and triangles from a file, by its ending: STL by meshio, PLY and OBJ here, and all others by PyVista.

meshio refuses an OBJ whose texture coordinates or normals are not as many as its vertices, and knows no voxels of VTU.
"""

import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationInfo

from mpmcli.scene.ply_file import read_ply


# Wavefront Technologies, Advanced Visualizer, appendix B1, Object Files (.obj): its lines v and f.
def read_obj(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the points (n, 3) float64, and the corners of each polygon; ValueError for a damaged file."""
    points: list[list[float]] = []
    polygons = []
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            if len(words) < 4:
                raise ValueError("a vertex lacks a coordinate")
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == [b"f"]:
            numbers = np.array([int(word.partition(b"/")[0]) for word in words[1:]], np.int64)
            # Counted from 1, or backwards from the latest vertex.
            if not numbers.all():
                raise ValueError("vertices count from 1")
            polygons.append(np.where(numbers > 0, numbers - 1, len(points) + numbers))
    return np.array(points, np.float64).reshape(-1, 3), polygons


def read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) float64, and the triangles (m, 3)."""
    from meshio import stl

    mesh = stl.read(path)
    return mesh.points.reshape(-1, 3).astype(np.float64), mesh.cells_dict.get("triangle", np.empty((0, 3), np.int64))


_READERS: dict[str, Callable[[Path], tuple[np.ndarray, list[np.ndarray] | np.ndarray]]] = {
    ".ply": lambda path: read_ply(path.read_bytes()),
    ".stl": read_stl,
    ".obj": lambda path: read_obj(path.read_bytes()),
}


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
    reader = _READERS.get(path.suffix.lower())
    try:
        with _quiet():
            if reader is None:
                return _by_vtk(path)
            points, polygons = reader(path)
        return Geometry(points, points, _triangles(polygons, len(points)))
    # Of a damaged file readers raise almost anything; meshio even ends the process.
    except (Exception, SystemExit):
        raise GeometryFileError from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep from the terminal what readers print."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def _triangles(polygons: list[np.ndarray] | np.ndarray, count: int) -> np.ndarray:
    """Return the triangles of polygons, a fan of each; ValueError for a corner that is none of `count` points."""
    if isinstance(polygons, np.ndarray):
        # All of one length.
        fans = [polygons[:, [0, k, k + 1]] for k in range(1, polygons.shape[1] - 1)]
        found = np.stack(fans, axis=1).reshape(-1, 3).astype(np.int64) if fans else np.empty((0, 3), np.int64)
    else:
        fans = [np.stack([np.full(len(p) - 2, p[0]), p[1:-1], p[2:]], axis=1) for p in polygons if len(p) > 2]
        found = np.concatenate([np.empty((0, 3), np.int64), *fans]).astype(np.int64)
    if found.size and not 0 <= found.min() <= found.max() < count:
        raise ValueError("a corner is no vertex")
    return found


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
