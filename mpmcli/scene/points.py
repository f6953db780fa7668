"""Points and triangles from a file, and bodies given by points, each of which is a particle.

The suffix selects the reader: text, NPY and NPZ here; OBJ, OFF, PLY and STL by trimesh; others by PyVista. VTK ends the
process at a truncated binary PLY; trimesh raises. trimesh refuses a PLY with faces of different lengths; meshio reads
it.
"""

import csv
import io
import json
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.primitives import Solid
from mpmcli.scene.problem import hint_at, listed, quoted
from mpmcli.scene.quantity import AXES, Integer, Number, Positive, Table, Vector, flaw, scene_dimension

# The field of a result with the deformation that a law stores.
DEFORMATIONS = {"J": "volume_ratio", "F": "deformation_gradient"}
# Suffixes of files that trimesh reads, and those that PyVista reads: each file is complete, so that one digest covers
# it. No other file is opened: .pvd, .pvtu, .vtm and more name further files, a pickle runs code, and some readers end
# the process.
_BY_TRIMESH = (".obj", ".off", ".ply", ".stl")
_BY_VTK = (".glb", ".mesh", ".msh", ".vti", ".vtk", ".vtkhdf", ".vtp", ".vtr", ".vts", ".vtu")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Points (n, 3) float64 and their arrays by name; vertices (k, 3) and triangles (m, 3) int64 of the surface.

    `note` says which of several times is read; `header` is that of a result of mpmcli.
    """

    points: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    note: str = ""
    header: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ResultState:
    """The state of n particles of a result of mpmcli.

    Attributes:
        fields: its fields, (n,) or (n, k); deformation_gradient and affine are (n, d, d).
        body: table of the body, as the scene of the result has it; empty if they are of several bodies.
    """

    fields: Mapping[str, np.ndarray]
    body: Mapping[str, Any]


@dataclass(frozen=True)
class Choice:
    """What is read of a file: the number of a frame, or a time, s, by default the last; and a body of a result."""

    frame: int | None = None
    time: float | None = None
    body: str | None = None

    def of(self, times: np.ndarray) -> int:
        """Return the index of the frame among those at some times, s."""
        last = len(times) - 1
        if self.frame is not None and self.frame > last:
            raise GeometryFileError(f"it has frames 0 to {last}; found {self.frame}", "frame")
        if self.time is not None and abs(self.time - np.clip(self.time, times[0], times[-1])) > 1e-6 * np.ptp(times):
            raise GeometryFileError(f"its times are {times[0]:.6g} to {times[-1]:.6g} s; found {self.time:g}", "time")
        if self.time is not None:
            return int(np.abs(times - self.time).argmin())
        return last if self.frame is None else self.frame


LAST = Choice()


class GeometryFileError(Exception):
    """The fault of a file, in words that follow its name; empty if it cannot be read."""

    def __init__(self, said: str = "", key: str = "file") -> None:
        """Store the words, and the key of the scene that is at fault."""
        super().__init__(said)
        self.key = key


def scene_file(name: str, info: ValidationInfo) -> Path:
    """Return the path of a file that a scene names, which is relative to the directory of the scene."""
    directory = info.context.get("directory") if isinstance(info.context, dict) else None
    return Path(directory or ".") / name


def file_version(path: Path) -> tuple[int, int]:
    """Return the version of a file: time of its last change, ns, and size in bytes; zeros if it does not exist."""
    try:
        stat = path.stat()
    # ValueError: a name with a null character.
    except (OSError, ValueError):
        return 0, 0
    return stat.st_mtime_ns, stat.st_size


def absence(path: Path) -> str:
    """Return the reason why there is no file at a path, "" if there is one."""
    try:
        return "" if path.is_file() else "it is no file" if path.exists() else "there is no such file"
    # A name that is too long, or a directory that may not be read.
    except (OSError, ValueError):
        return "there is no such file"


def read_geometry(path: Path, choice: Choice = LAST) -> Geometry:
    """Return the points and the triangles in a file, at one of its times, or raise a GeometryFileError."""
    if path.suffix.lower() not in _BY_TRIMESH + _BY_VTK:
        known = listed([*_BY_TRIMESH, *_BY_VTK], "and")
        raise GeometryFileError(f"the files that are read are {known}; save it as one of these, such as VTU")
    if fault := absence(path):
        raise GeometryFileError(fault)
    try:
        # Readers print on the terminal.
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            return _by_trimesh(path) if path.suffix.lower() in _BY_TRIMESH else _by_vtk(path, choice)
    except GeometryFileError:
        raise
    # Readers raise almost any exception at a damaged file; meshio even ends the process.
    except (Exception, SystemExit):
        raise GeometryFileError from None


def distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of each distinct row of (n, k), k > 1, in the order of their values, and which each row is.

    By integer keys, since `np.unique` of rows compares them one by one: ten times as long.
    """
    first = which = np.zeros(len(rows), np.int64)
    for k, column in enumerate(rows.T):
        values, here = np.unique(column, return_inverse=True)
        which = which * len(values) + here
        if k > 0:
            _, first, which = np.unique(which, return_index=True, return_inverse=True)
    return first, which


def _by_trimesh(path: Path) -> Geometry:
    """Read points and maybe triangles by trimesh. Raises ValueError if a triangle has an unknown corner."""
    import trimesh

    try:
        found = trimesh.load(path, process=False, skip_materials=True)
    except ValueError:
        if path.suffix.lower() != ".ply":
            raise
        # A binary PLY whose faces have different numbers of corners: each is a fan of triangles.
        from meshio import ply

        mesh = ply.read(path)
        fans = [block.data[:, [0, k, k + 1]] for block in mesh.cells for k in range(1, block.data.shape[1] - 1)]
        points = np.array(mesh.points, np.float64)
        return Geometry(points, points, np.concatenate(fans).astype(np.int64))
    if isinstance(found, trimesh.Scene):
        found = found.to_mesh()
    vertices, triangles = np.array(found.vertices, np.float64), getattr(found, "faces", np.empty((0, 3), np.int64))
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError("a corner is no vertex")
    # Corners of STL, and those of OBJ that have several texture coordinates, are one point.
    first, _ = distinct_rows(vertices)
    if path.suffix.lower() != ".ply":
        return Geometry(vertices[np.sort(first)], vertices, np.array(triangles))
    stored = found.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = stored if isinstance(stored, dict) else stored.dtype.names or ()
    arrays = {name: np.asarray(stored[name], np.float64).reshape(len(vertices), -1)[:, 0] for name in names}
    return Geometry(vertices, vertices, np.array(triangles), arrays)


def _by_vtk(path: Path, choice: Choice) -> Geometry:
    """Return the geometry that PyVista reads, with the surface of solid cells."""
    import pyvista as pv
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject
    from vtkmodules.vtkFiltersCore import vtkPolyDataNormals, vtkTriangleFilter
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    shown, told = vtkObject.GetGlobalWarningDisplay(), vtkLogger.GetCurrentVerbosityCutoff()
    vtkObject.GlobalWarningDisplayOff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        reader, note, header = pv.get_reader(path), "", {}
        if path.suffix.lower() == ".vtkhdf":
            times, header = _times_in(path)
            step = choice.of(times)
            reader.reader.SetStep(step)
            if len(times) > 1:
                other = "; frame or time selects another" * (choice.frame is None and choice.time is None)
                note = f"{path.name} is read at frame {step} of 0 to {len(times) - 1}, t = {times[step]:.6g} s{other}"
        found = reader.read()
        found = found.combine() if isinstance(found, pv.MultiBlock) else found
        kinds = [found.GetCells()] if found.IsA("vtkUnstructuredGrid") else []
        if found.IsA("vtkPolyData"):
            kinds = [found.GetPolys(), found.GetStrips()]
        for cells in kinds:
            corners = vtk_to_numpy(cells.GetConnectivityArray())
            if corners.size and not 0 <= corners.min() <= corners.max() < found.GetNumberOfPoints():
                raise ValueError("a corner is no vertex")
        surface, triangles = vtkDataSetSurfaceFilter(), vtkTriangleFilter()
        surface.SetInputData(found)
        triangles.SetInputConnection(surface.GetOutputPort())
        triangles.PassVertsOff()
        triangles.PassLinesOff()
        # The surface of cells that are inside out faces both ways.
        alike = vtkPolyDataNormals()
        alike.SetInputConnection(triangles.GetOutputPort())
        alike.SplittingOff()
        last = triangles if found.IsA("vtkPolyData") else alike
        last.Update()
        result = last.GetOutput()
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)
        vtkLogger.SetStderrVerbosity(told)
    points, data = np.array(found.points, np.float64), found.point_data
    arrays = {str(name): np.asarray(data[name]) for name in data.keys()}  # noqa: SIM118
    arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "iuf"}
    if not result.GetNumberOfPolys():
        return Geometry(points, points[:0], np.empty((0, 3), np.int64), arrays, note, header)
    vertices = vtk_to_numpy(result.GetPoints().GetData()).astype(np.float64)
    corners = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    return Geometry(points, vertices, corners, arrays, note, header)


def _times_in(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the times, s, of a VTKHDF file, one without any, and the header of a result of mpmcli."""
    import h5py

    with h5py.File(path) as file:
        times = file["VTKHDF/Steps/Values"][()] if "VTKHDF/Steps/Values" in file else np.zeros(1)
        facts = file["mpmcli"].attrs if "mpmcli" in file else {}
        ours = "header" in facts and "scene" in facts
        return times, json.loads(facts["header"]) | {"scene": facts["scene"]} if ours else {}


# Readers of tables by suffix, and how programs name the columns of positions, axis by axis.
_TABLES = (".csv", ".npy", ".npz", ".txt", ".xyz")
_POSITIONS = ("{axis}", "{AXIS}", "Points:{k}", "Points_{k}", "points:{k}", "position:{k}")


def read_points(
    path: Path, d: int, velocity: str | Sequence[str] | None, choice: Choice = LAST
) -> tuple[np.ndarray, np.ndarray | None, ResultState | None, str]:
    """Return the points in a file, (n, d), the requested velocities, (n, d), the state, each or None, and a note.

    The file is a CSV or TXT whose first line names the columns, `_POSITIONS` among them; an XYZ or NPY without names,
    of d, 3 or 2 d columns x, y, z, vx, vy, vz; an NPZ, or an NPY of named columns; or a file that `read_geometry`
    reads. A GeometryFileError reports a fault. `velocity` names d columns, or an array of vectors.
    """
    if fault := absence(path):
        raise GeometryFileError(fault)
    suffix = path.suffix.lower()
    if given := [key for key, value in vars(choice).items() if value is not None and suffix != ".vtkhdf"]:
        raise GeometryFileError(f"{given[0]} is for VTKHDF files, which have several times; leave it out", given[0])
    if not isinstance(velocity, str | None) and len(velocity) != d:
        raise GeometryFileError(f"velocity must name {d} columns, such as [{', '.join(quoted(_names(d)[d:]))}]")
    if suffix in _TABLES:
        columns = _npy(path, d) if suffix == ".npy" else _npz(path) if suffix == ".npz" else _text(path, d)
        # The components of an array are columns `name:0`, `name:1`, as ParaView writes them.
        names = [f"{velocity}:{k}" for k in range(d)] if isinstance(velocity, str) else velocity
        if isinstance(velocity, str) and not {*names} <= {*columns}:
            raise GeometryFileError(f"velocity must name {d} columns, such as [{', '.join(quoted(_names(d)[d:]))}]")
        ways = [[way.format(axis=AXES[k], AXIS=AXES[k].upper(), k=k) for k in range(d)] for way in _POSITIONS]
        place = next((way for way in ways if {*way} <= {*columns}), ways[0])
        found = _chosen(columns, place), None if names is None else _chosen(columns, names), None, ""
    else:
        found = _data_set(path, d, velocity, choice)
    stored = found[2].fields if found[2] else {}
    for values in (*found[:2], *(stored.get(name) for name in (*DEFORMATIONS.values(), "affine"))):
        if values is not None and not np.isfinite(values).all():
            finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
            raise GeometryFileError(f"point {int(np.argmin(finite)) + 1} is not finite")
    if not len(found[0]):
        raise GeometryFileError("it holds no point")
    return found


def _names(d: int) -> list[str]:
    return [*AXES[:d], *(f"v{axis}" for axis in AXES[:d])]


def _chosen(columns: dict[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    for name in names:
        if name not in columns:
            hint = hint_at(name, list(columns), f"its columns are {listed(quoted(list(columns)), 'and')}")
            raise GeometryFileError(f'it has no column "{name}"; {hint}')
    return np.stack([columns[name] for name in names], axis=1)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _text(path: Path, d: int) -> dict[str, np.ndarray]:
    """Read columns of text, between commas, semicolons or white space; a first line of names may begin with #."""
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
        # The last comment before the numbers names the columns if no other line does.
        first = next((k for k, line in enumerate(lines) if line and not line.startswith("#")), len(lines))
        told = [line.lstrip("# ") for line in lines[:first] if line]
        head = lines[first] if first < len(lines) else ""
        sign = next((sign for sign in ";,\t" if sign in (head or "".join(told[-1:]))), None)
        rows = [(k, _words(line, sign)) for k, line in enumerate(lines, 1) if line and not line.startswith("#")]
    except (UnicodeDecodeError, csv.Error, OSError):
        raise GeometryFileError("it is not text with comma-separated values") from None
    if path.suffix.lower() == ".xyz" and head.isdigit():
        # The number of atoms, a comment, and lines of an element and its place.
        rows = [(k, words[1:]) for k, words in rows if k > first + 2]
    width = len(rows[0][1]) if rows else 0
    if rows and not any(map(_is_number, rows[0][1])):
        names, rows = rows[0][1], rows[1:]
    elif told and len(_words(told[-1], sign)) == width and not any(map(_is_number, _words(told[-1], sign))):
        names = _words(told[-1], sign)
    elif path.suffix.lower() == ".xyz" and width in (d, 3, 2 * d, 6):
        names = [f"{v}{axis}" for v in ("", "v") for axis in AXES[: d if width in (d, 2 * d) else 3]][:width]
    else:
        raise GeometryFileError("its first line must name the columns, such as x,y,z")
    for line, row in rows:
        if len(row) != len(names) or not all(map(_is_number, row)):
            raise GeometryFileError(f"line {line} must hold {len(names)} numbers, one for each column")
    values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, len(names))
    return dict(zip(names, values.T, strict=True))


def _words(line: str, sign: str | None) -> list[str]:
    """Return the words of a line between separators, None for white space; beside semicolons a comma is a point."""
    if sign is None:
        return line.split()
    found = [word.strip() for word in next(csv.reader([line], delimiter=sign))]
    return [word.replace(",", ".") for word in found] if sign == ";" else found


def _npz(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of one number or one vector per point, the latter as columns `name:0`, `name:1`, ..."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file}
    except Exception:
        raise GeometryFileError("it is not a file of numpy arrays") from None
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if array.dtype.kind in "fiu" and array.ndim in (1, 2):
            vectors = array.reshape(len(array), -1).astype(np.float64)
            columns |= {name if array.ndim == 1 else f"{name}:{k}": column for k, column in enumerate(vectors.T)}
    if len({len(column) for column in columns.values()}) > 1:
        shapes = listed([f"{name} {array.shape}" for name, array in arrays.items()], "and")
        raise GeometryFileError(f"its arrays must have a row for each point; they are {shapes}")
    return columns


def _npy(path: Path, d: int) -> dict[str, np.ndarray]:
    """Return the columns of a NumPy file by name: structured, or (n, d), or (n, 2 d) with velocities."""
    try:
        # Memory-mapped, so that a header cannot claim more than the file holds.
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    # Python's tokenizer and parser raise almost any exception at a damaged header.
    except Exception:
        raise GeometryFileError("it is not a numpy array") from None
    if found.dtype.names:
        return {name: found[name].reshape(-1).astype(np.float64) for name in found.dtype.names}
    if found.ndim != 2 or found.shape[1] not in (d, 2 * d) or found.dtype.kind not in "fiu":
        raise GeometryFileError(
            f"it must be of numbers, (n, {d}), or (n, {2 * d}) with velocities; it is {found.shape}"
        )
    return dict(zip(_names(d), found.astype(np.float64).T, strict=False))


def _data_set(
    path: Path, d: int, velocity: str | Sequence[str] | None, choice: Choice
) -> tuple[np.ndarray, np.ndarray | None, ResultState | None, str]:
    """Return positions, m, velocities, m/s, or None, the state in a file of a result, and a note on its reading."""
    try:
        found = read_geometry(path, choice)
    except GeometryFileError as error:
        said = str(error) or "it is not a readable file of points (CSV, XYZ, NPY, NPZ, PLY and VTU are)"
        raise GeometryFileError(said, error.key) from None
    state = None
    if found.header:
        found, state = _of_result(found, d, choice.body)
    elif choice.body is not None:
        raise GeometryFileError("it is no result of mpmcli, whose bodies have names", "body")
    if not len(found.points):
        raise GeometryFileError("it holds no point" + f" ({found.note})" * bool(found.note))
    position = _in_plane(found.points, d, "points")
    return position, _velocities(found, d, velocity), state, found.note


def _of_result(found: Geometry, d: int, body: str | None) -> tuple[Geometry, ResultState]:
    """Return the particles of a result that are there, those of one body if it is named, and their state."""
    names, rows = found.header["bodies"], np.ones(len(found.points), bool)
    if body is not None:
        if body not in names:
            hint = hint_at(body, names, f"its bodies are {listed(quoted(names), 'and')}")
            raise GeometryFileError(f'it has no body "{body}"; {hint}', "body")
        rows &= found.arrays["body"] == names.index(body)
    if "status" in found.arrays:
        rows &= found.arrays["status"] == 1
    arrays = {name: array[rows] for name, array in found.arrays.items()}
    state = {name: array.astype(np.float64) for name, array in arrays.items() if array.dtype.kind == "f"}
    for name in ("deformation_gradient", "affine"):
        if name in state:
            state[name] = state[name].reshape(-1, 3, 3)[:, :d, :d]
    scene = tomllib.loads(found.header["scene"])
    tables = [*scene.get("bodies", ()), *scene.get("emitters", ())]
    if "volume_ratio" not in state and "density" in arrays:
        rest = np.array([table["material"]["density"] for table in tables])
        state["volume_ratio"] = rest[arrays["body"]] / arrays["density"]
    labels = np.unique(arrays["body"])
    table = tables[labels[0]] if len(labels) == 1 else {}
    return replace(found, points=found.points[rows], arrays=arrays), ResultState(state, table)


def _velocities(found: Geometry, d: int, velocity: str | Sequence[str] | None) -> np.ndarray | None:
    """Return velocities, (n, d), from the array of a name or one per axis; None without a name."""
    if velocity is None:
        return None
    for name in {*([velocity] if isinstance(velocity, str) else velocity)} - {*found.arrays}:
        known = listed(quoted(list(found.arrays)), "and") if found.arrays else "none"
        raise GeometryFileError(f'its points have no array "{name}"; they have {known}')
    if not isinstance(velocity, str):
        return np.stack([np.array(found.arrays[name], np.float64).reshape(-1) for name in velocity], axis=1)
    values = np.array(found.arrays[velocity], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] not in (d, 3):
        raise GeometryFileError(f'its array "{velocity}" must have {d} numbers for each point')
    return _in_plane(values, d, "velocities")


def _in_plane(values: np.ndarray, d: int, what: str) -> np.ndarray:
    """Return vectors (n, 3) of a 2D scene without their z, which must be the same for all."""
    if d < values.shape[1] and np.ptp(values[:, d]) > 0:
        raise GeometryFileError(f"its {what} lie in space, and the scene is 2D; give points of one z")
    return values[:, :d]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, (n, d), m, their velocities, (n, d), m/s, and their state, or None; `note` says which time was read."""

    position: np.ndarray
    velocity: np.ndarray | None
    state: ResultState | None = None
    note: str = ""

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.position)


class Points(Table, Solid):
    """Points from a file, used as the particles of the body."""

    file: str = Field(description="The file, relative to the scene: CSV, XYZ, NPY, NPZ, PLY, VTU, ...")
    spacing: Positive | None = Field(
        None, description="Distance between neighbours, m; its square or cube is the volume of a particle."
    )
    total_volume: Positive | None = Field(
        None, description="Volume of the whole body, m^3 (m^2 in 2D), in place of spacing."
    )
    frame: Integer | None = Field(
        None, ge=0, description="Number of the frame, from 0, of a file with several times. Default: the last."
    )
    time: Number | None = Field(None, description="Time, s, in place of frame; the nearest frame is read.")
    body: str | None = Field(
        None, description="Name of the body of a result of mpmcli whose particles are read. Default: all."
    )
    velocity: str | tuple[str, ...] | None = Field(
        None,
        description='Velocities in the file, added to that of the body: names of columns, such as ["vx", "vy"], or the '
        "name of an array of vectors. Default: none.",
    )
    scale: Positive = Field(1.0, description="Metres per unit of the file; velocities are taken as they are.")
    translate: Vector = Field(
        None, validate_default=True, description="Translation, added to all points after scaling, m."
    )
    _cloud: Cloud = PrivateAttr()

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> "Points":
        """Read the file, once per version of it, and require either the spacing of the points or their total volume."""
        path, d = scene_file(self.file, info), scene_dimension(info) or len(self.translate)
        try:
            if None not in (self.frame, self.time):
                raise flaw("is given as well as frame; leave one of them out", "time")
            choice = Choice(self.frame, self.time, self.body)
            version = file_version(path)
            self._cloud = _cloud_of(path.absolute(), version, d, self.velocity, self.scale, self.translate, choice)
        except GeometryFileError as error:
            raise flaw(f"{path}: {error}", error.key) from None
        if (self.spacing is None) == (self.total_volume is None):
            places, hint = self._cloud.position, ""
            if len(places) > 1:
                # Distance of each point from its nearest neighbour.
                usual = float(np.median(self._cloud.tree.query(places[:10_000], k=2)[0][:, 1]))
                hint = f"; its points are some {usual:.3g} m apart" if usual else ""
            raise flaw(f"needs either spacing or total_volume, which the mass of the body follows from{hint}")
        return self

    @property
    def position(self) -> np.ndarray:
        """The points, (n, d), m."""
        return self._cloud.position

    @property
    def file_velocity(self) -> np.ndarray | None:
        """The velocities in the file, (n, d), m/s."""
        return self._cloud.velocity

    @property
    def state(self) -> ResultState | None:
        """The state in the file if it is a result of mpmcli."""
        return self._cloud.state

    @property
    def notes(self) -> tuple[str, ...]:
        """Which of several times is read."""
        return (self._cloud.note,) * bool(self._cloud.note)

    def deformation(self, stores: str, places: np.ndarray) -> np.ndarray | None:
        """Return J, (n,), or F, (n, d, d), of the points nearest to some places, as a law stores; None if unknown."""
        found = self.state.fields.get(DEFORMATIONS[stores]) if self.state else None
        return None if found is None else found[self._cloud.tree.query(places)[1]]

    @property
    def volume(self) -> float:
        n, d = self.position.shape
        return n * self.spacing**d if self.total_volume is None else self.total_volume

    @property
    def edge(self) -> float:
        """Edge of the square or cube of a particle, m."""
        n, d = self.position.shape
        return (self.volume / n) ** (1 / d)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.position.min(axis=0), self.position.max(axis=0)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the particles, as balls of diameter `edge`, (n,), m."""
        return self._cloud.tree.query(points)[0] - self.edge / 2


@lru_cache(maxsize=32)
def _cloud_of(
    path: Path, version: tuple[int, int], d: int, velocity: Any, scale: float, translate: Any, choice: Choice
) -> Cloud:
    """Return the points in a file; `version` distinguishes versions of the file."""
    position, *found = read_points(path, d, velocity, choice)
    return Cloud(position * scale + np.array(translate), *found)
