"""Points and triangles from a file, by its ending: PLY, STL and OBJ are read here, all others by VTK.

VTK's readers trust what a file says of itself, and a damaged one may end the interpreter. They run in a process of
their own.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mpmcli.processes.questions import Question, ask, module_command
from mpmcli.scene.obj_file import read_obj
from mpmcli.scene.ply_file import read_ply
from mpmcli.scene.stl_file import read_stl

_READERS: dict[str, Callable[[bytes], tuple[np.ndarray, list[np.ndarray] | np.ndarray]]] = {
    ".ply": read_ply,
    ".stl": read_stl,
    ".obj": read_obj,
}
# Wall time for VTK to start and read, s; the process limits its own work as well.
_TIMEOUT = 600.0


@dataclass(frozen=True, eq=False)
class Geometry:
    """What a file holds.

    Attributes:
        points: (n, 3) float64.
        vertices, triangles: (k, 3) float64 and (m, 3) int64, of the surface.
        arrays: values of the points by name.
    """

    points: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


class GeometryFileError(Exception):
    """There is no such file, or it cannot be read; the text is empty in the latter case."""


def absence(path: Path) -> str:
    """Say why there is no file at a path, "" where there is one."""
    try:
        return "" if path.is_file() else "it is no file" if path.exists() else "there is no such file"
    # A name that is too long, or a directory that may not be read.
    except (OSError, ValueError):
        return "there is no such file"


def read_geometry(path: Path) -> Geometry:
    """Return the points and the triangles in a file.

    Raises:
        GeometryFileError: there is no such file, or it cannot be read.
    """
    if fault := absence(path):
        raise GeometryFileError(fault)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        return _by_vtk(path)
    try:
        points, polygons = reader(path.read_bytes())
        return Geometry(points, points, _triangles(polygons, len(points)))
    except (OSError, ValueError, LookupError, OverflowError, MemoryError):
        raise GeometryFileError from None


def _triangles(polygons: list[np.ndarray] | np.ndarray, count: int) -> np.ndarray:
    """Return the triangles of polygons, a fan of each, indices of `count` points.

    Raises:
        ValueError: a corner is no point.
    """
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
    with tempfile.TemporaryDirectory() as place:
        out = os.path.join(place, "geometry.npz")
        command = module_command("mpmcli.scene.vtk_file_process", str(path.absolute()), out)
        reply = ask(Question(command, _TIMEOUT, {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}))
        names = reply.answer.get("arrays")
        if reply.fault or not isinstance(names, list):
            raise GeometryFileError
        with np.load(out, allow_pickle=False) as found:
            arrays = {name: found[f"array_{k}"] for k, name in enumerate(names)}
            return Geometry(found["points"], found["vertices"], found["triangles"], arrays)
