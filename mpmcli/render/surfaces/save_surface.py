"""Surfaces as files for other tools: one mesh per material and frame, .vtp and .obj, flat polygons in 2D."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.errors import InputError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.result import Result, open_result
from mpmcli.processes.pool import render_frames
from mpmcli.render.render_scene import RenderScene, render_scene_of
from mpmcli.render.shading.material_groups import Group, groups_of
from mpmcli.render.surfaces.coverage import FINENESS, cover_of, grid_over
from mpmcli.render.surfaces.reconstruction import Mesh, reconstruct

if TYPE_CHECKING:
    import pyvista as pv

# Most nodes of the grid on which a flat surface is found.
NODES = 3e7


def surface_paths(scene: RenderScene, directory: Path, index: int) -> list[Path]:
    """Return the files that `save_surface` writes for a frame whose every material has particles."""
    return [
        directory / f"surface_{slug(appearance.name)}_{index:06d}.{kind}"
        for appearance in scene.appearances
        for kind in ("vtp", "obj")
    ]


def slug(name: str) -> str:
    """Return a name as a part of the name of a file: small letters, digits and underlines."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "material"


def save_surface(scene: RenderScene, frame: Frame, directory: Path) -> list[Path]:
    """Write the surface of every material of a frame, `surface_<material>_<frame>.vtp` and `.obj`.

    A material without particles in the domain has a file without points, so that a series has no gaps. Lengths are
    metres; in 2D the surfaces are triangles at z = 0, seen from above.

    Args:
        directory: made if there is none; a surface of the same name is replaced.

    Returns:
        the paths written.

    Raises:
        InputError: the directory cannot be made.
        RunError: a file cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory} cannot be made for the surfaces: {error.strerror or error}.") from error
    groups = groups_of(scene, frame)
    written = []
    for number, appearance in enumerate(scene.appearances):
        meshes = [_mesh(scene, group) for group in groups if group.key[0] == number]
        mesh = _joined(meshes)
        stem = f"surface_{slug(appearance.name)}_{frame.index:06d}"
        for path, write in ((directory / f"{stem}.vtp", _write_vtp), (directory / f"{stem}.obj", _write_obj)):
            try:
                write(path, mesh, frame.time)
            except OSError as error:
                raise RunError(f"{path} could not be written: {error.strerror or error}.") from error
            written.append(path)
    return written


def write_series(scene: RenderScene, directory: Path, frames: Sequence[tuple[int, float]]) -> list[Path]:
    """Write `surface_<material>.vtp.series` for every material, which gives ParaView the times of its files.

    Args:
        frames: numbers and times, s, of the frames that have been saved, in any order.
    """
    written = []
    for appearance in scene.appearances:
        name = slug(appearance.name)
        files = [{"name": f"surface_{name}_{index:06d}.vtp", "time": time} for index, time in sorted(frames)]
        path = directory / f"surface_{name}.vtp.series"
        write_text(path, json.dumps({"file-series-version": "1.0", "files": files}, indent=1) + "\n")
        written.append(path)
    return written


@dataclass(frozen=True)
class SurfaceJob:
    """The surfaces of frames of a result, as a process of its own writes them."""

    source: Path
    directory: Path

    def start(self) -> Callable[[int], None]:
        """Open the result, and return what writes the surfaces of a frame."""
        result = open_result(self.source)
        scene = render_scene_of(result)

        def save(k: int) -> None:
            save_surface(scene, result.present_frame(k, ()), self.directory)

        return save


def save_surfaces(
    result: Result,
    ks: Sequence[int],
    directory: Path,
    workers: int,
    *,
    watch: Callable[[int, None], None] = lambda k, outcome: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Write the surfaces of some frames, and the list of them that ParaView opens.

    Raises:
        InputError: the directory cannot be made.
        RunError: a file cannot be written, or a process crashed.
        KeyboardInterrupt: `stop` returned True.
    """
    render_frames(SurfaceJob(result.path, directory), ks, workers, watch=watch, stop=stop)
    write_series(render_scene_of(result), directory, [(int(result.numbers[k]), float(result.times[k])) for k in ks])


def _mesh(scene: RenderScene, group: Group) -> Mesh:
    if scene.dimension == 3:
        return reconstruct(group.position, group.distance, scene.lower, scene.upper)
    return flat_mesh(group.position, group.distance, scene.lower, scene.upper)


def flat_mesh(position: np.ndarray, distance: float, lower: Sequence[float], upper: Sequence[float]) -> Mesh:
    """Return triangles at z = 0 that fill what particles (n, 2) cover by more than a half.

    Args:
        distance: between neighbouring particles at the start, m.
        lower, upper: corners of the domain, m.
    """
    low, high = np.array(lower[:2]), np.array(upper[:2])
    spare = 3.0 * distance
    # From wall to wall, but not where there is nothing.
    first = np.maximum(position.min(axis=0) - spare, low)
    last = np.minimum(position.max(axis=0) + spare, high)
    edge = max(distance / FINENESS, float(np.sqrt(np.prod(last - first) / NODES)))
    grid = grid_over(first.tolist(), last.tolist(), edge)
    cover = cover_of(position, distance, low.tolist(), high.tolist(), grid)
    # A ring of nodes without cover closes every contour: half a cell beyond the last node, which is on the wall.
    mesh = _filled(np.pad(np.clip(cover, 0.0, 1.0), 1), np.array(grid.corner) - edge, edge)
    points = mesh.points.copy()
    points[:, :2] = np.clip(points[:, :2], low, high)
    return Mesh(points, mesh.triangles, mesh.normals)


def _filled(cover: np.ndarray, corner: np.ndarray, edge: float) -> Mesh:
    """Return the triangles within the contour 1/2 of a cover on nodes from `corner`."""
    import pyvista as pv
    import vtk

    image = pv.ImageData(
        dimensions=(cover.shape[1], cover.shape[0], 1),
        spacing=(edge, edge, 1.0),
        origin=(float(corner[0]), float(corner[1]), 0.0),
    )
    # No node has exactly 1/2, where two contours would touch.
    image.point_data["cover"] = cover.astype(np.float64).ravel() + 1e-9
    lines = image.contour([0.5], scalars="cover")
    triangulator = vtk.vtkContourTriangulator()
    triangulator.SetInputData(lines)
    triangulator.Update()
    filled = pv.wrap(triangulator.GetOutput()).clean(point_merging=False)
    triangles = filled.regular_faces.astype(np.int64) if filled.n_cells else np.empty((0, 3), dtype=np.int64)
    points = np.asarray(filled.points, dtype=np.float32).reshape(-1, 3)
    a, b, c = (points[triangles[:, k], :2].astype(np.float64) for k in range(3))
    areas = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles = np.where((areas < 0)[:, None], triangles[:, ::-1], triangles)[areas != 0]
    return Mesh(points, triangles, np.tile(np.float32([0.0, 0.0, 1.0]), (len(points), 1)))


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    none = np.empty((0, 3), dtype=np.float32)
    offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    return Mesh(
        points=np.concatenate([none, *(mesh.points for mesh in meshes)]),
        triangles=np.concatenate(
            [np.empty((0, 3), np.int64), *(m.triangles + start for m, start in zip(meshes, offsets, strict=False))]
        ),
        normals=np.concatenate([none, *(mesh.normals for mesh in meshes)]),
    )


def poly_data(mesh: Mesh) -> "pv.PolyData":
    """Return a mesh as PyVista's, with its normals."""
    import pyvista as pv

    data = pv.PolyData.from_regular_faces(mesh.points, mesh.triangles) if len(mesh.points) else pv.PolyData()
    if len(mesh.points):
        data.point_data["Normals"] = mesh.normals
        data.GetPointData().SetActiveNormals("Normals")
    return data


def _write_vtp(path: Path, mesh: Mesh, time: float) -> None:
    import vtk

    data = poly_data(mesh)
    data.field_data["TimeValue"] = np.array([time])
    with sealed(path) as temporary:
        writer = vtk.vtkXMLPolyDataWriter()
        writer.SetFileName(str(temporary))
        writer.SetInputData(data)
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        if not writer.Write():
            raise OSError(f"VTK could not write {temporary}")


def _write_obj(path: Path, mesh: Mesh, time: float) -> None:
    def lines(form: str, values: np.ndarray) -> str:
        return (form * len(values)) % tuple(values.ravel().tolist())

    corners = np.repeat(mesh.triangles + 1, 2, axis=1)
    write_text(
        path,
        f"# time {time:.9g} s, lengths in metres\n"
        + lines("v %.9g %.9g %.9g\n", mesh.points)
        + lines("vn %.6g %.6g %.6g\n", mesh.normals)
        + lines("f %d//%d %d//%d %d//%d\n", corners),
    )
