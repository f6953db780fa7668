"""Surfaces of particles: closed triangle meshes in 3D, flat polygons in 2D, and files of both for other tools."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mpmcli.errors import InputError, RunError
from mpmcli.frames.frame import Frame
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.result import Result, open_result
from mpmcli.processes.pool import render_frames
from mpmcli.render.particle_grid import FINENESS, Grid, blurred_along, cover_of, drawable, with_images
from mpmcli.render.render_scene import Group, RenderScene, SharedGeometry, groups_of, render_scene_of

# Smoothing length of the kernel of splashsurf, in particle radii, fraction of the full density at the surface, and
# rounds of Laplacian smoothing, weighted so that thin sheets keep their volume.
USUAL, CLOSE = (2.5, 0.5, 20), (1.8, 0.55, 2)
CUBE = 1.1  # edge of a marching cube, in particle radii
IMAGE_REACH = 5.0  # radii from a wall within which particles have images behind it: the support of the usual kernel
# Edge of the cells in which particles are counted, in radii, and largest number of cells.
FULLNESS_CELL, FULLNESS_CELLS = 4.0, 4e6
# Filled fractions of space below which a vertex is not smoothed and above which it is fully smoothed.
ALONE, HALF = 0.03, 0.22
CONTACT = 3.0  # radii from a wall within which a particle touches it; lateral radii of its surroundings
NODES = 3e7  # largest number of nodes of the grid for a flat surface


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in three dimensions, v vertices and t triangles."""

    points: np.ndarray  # (v, 3) float32, m
    triangles: np.ndarray  # (t, 3) int64, counter-clockwise from outside
    normals: np.ndarray  # (v, 3) float32, outwards, of length one
    attributes: dict[str, np.ndarray] = field(default_factory=dict)  # (v,) or (v, k) float32, from the particles


def reconstruct(
    position: np.ndarray,
    distance: float,
    lower: Sequence[float],
    upper: Sequence[float],
    attributes: Mapping[str, np.ndarray] | None = None,
    *,
    close: bool = False,
) -> Mesh:
    """Return the surface of particles: splashsurf's level set of their density, smoothed.

    At the walls the particles are mirrored, so that their density does not fade, and the mesh is cut off at the wall
    and flat there. The order of vertices and triangles does not depend on threads. Method: Loeschner, Boettcher, Jeske,
    Bender (2023), Weighted Laplacian smoothing for surface reconstruction of particle-based fluids.

    Positions (n, 3) and the distance between neighbours at the start are in m; positions that are not finite or far
    from the domain are left out. Attributes are (n,) or (n, k) finite numbers, interpolated to the vertices. A `close`
    surface keeps lumps and makes single particles small, which suits crumbs but not sheets.
    """
    from pysplashsurf import laplacian_smoothing_parallel, reconstruction_pipeline

    keep = drawable(position, lower, upper, distance)
    # Relative to the middle of the domain and in particle radii, for best single precision.
    radius, middle = 0.5 * distance, 0.5 * (np.array(lower) + np.array(upper))
    low, high = (((np.array(corner) - middle) / radius).astype(np.float32) for corner in (lower, upper))
    particles = np.clip((position[keep] - middle) / radius, low, high).astype(np.float32)
    carried = {name: np.asarray(values, dtype=np.float32)[keep] for name, values in (attributes or {}).items()}
    if not len(particles):
        return empty_mesh(carried)
    points, source = with_images(particles, IMAGE_REACH, low, high)
    length, threshold, rounds = CLOSE if close else USUAL
    # The pipeline's own clean-up and smoothing depend on the order of threads; both are done below, after sorting.
    surface, _ = reconstruction_pipeline(
        points,
        attributes_to_interpolate={name: np.ascontiguousarray(values[source]) for name, values in carried.items()},
        particle_radius=1.0,
        smoothing_length=length,
        cube_size=CUBE,
        iso_surface_threshold=threshold,
        multi_threading=True,
        # With vector instructions the sums of two subdomains at one node differ in the last bit.
        simd=False,
        subdomain_grid=True,
        subdomain_grid_auto_disable=False,
    )
    mesh = surface.mesh
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    if not len(faces):
        return empty_mesh(carried)
    order = np.lexsort(vertices.T)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    triangles = rank[faces.astype(np.int64)]
    # Rotate each triangle so that its lowest vertex comes first, and sort the triangles.
    turn = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (turn + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.argsort(triangles[:, 0] * len(order) + triangles[:, 1], kind="stable")]
    # These are views of the mesh's own memory.
    vertices[:], faces[:] = vertices[order], triangles
    weights, connectivity = _fullness(points, vertices), mesh.vertex_vertex_connectivity()
    laplacian_smoothing_parallel(mesh, connectivity, iterations=rounds, beta=1.0, weights=weights)
    # Smoothing has reallocated the vertices, so that the earlier view is no longer valid.
    raw = np.asarray(mesh.vertices)
    vertices = np.clip(raw, low, high)
    kept = _area_vectors(vertices, triangles).any(axis=1)
    kept &= ~_pressed_flat(raw, triangles, particles, low, high) & _inside(raw, triangles, low, high)
    triangles = triangles[kept]
    return Mesh(
        points=(vertices * radius + middle).astype(np.float32),
        triangles=triangles,
        normals=vertex_normals(vertices, triangles),
        attributes={name: np.asarray(surface.point_attributes[name])[order] for name in carried},
    )


def group_mesh(
    scene: RenderScene, group: Group, attributes: Mapping[str, np.ndarray], shared: SharedGeometry, frame: Frame
) -> Mesh:
    """Return the surface of a group of a frame in 3D; see `reconstruct`."""
    close = group.appearance.finish == "crumbly"
    domain = scene.lower, scene.upper
    key = ("mesh", group.key, *attributes)
    return shared.once(
        frame, key, lambda: reconstruct(group.position, group.distance, *domain, attributes, close=close)
    )


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return normals (v, 3) float32 of vertices: means over their triangles, weighted by area."""
    areas = _area_vectors(points, triangles)
    normals = np.empty((len(points), 3))
    corners = triangles.ravel()
    for axis in range(3):
        normals[:, axis] = np.bincount(corners, np.repeat(areas[:, axis], 3), len(points))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0).astype(np.float32)


def empty_mesh(attributes: Mapping[str, np.ndarray] | None = None) -> Mesh:
    """Return a mesh without points, and with attributes of these names."""
    none = np.empty((0, 3), dtype=np.float32)
    return Mesh(none, np.empty((0, 3), dtype=np.int64), none, {name: v[:0] for name, v in (attributes or {}).items()})


def _area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (t, 3), twice the area of each triangle times its normal."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _pressed_flat(
    raw: np.ndarray, triangles: np.ndarray, particles: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return which triangles (t,) belong to the image of a particle that is close to a wall but does not touch it.

    Cut off at the wall, such an image is a sheet without thickness that lies on it. Vertices (v, 3) are `raw`, in
    radii, before they are cut off; particles (n, 3) are without images.
    """
    vertices = np.clip(raw, low, high)
    flat = np.zeros(len(triangles), dtype=bool)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for wall, inwards in ((low[axis], 1.0), (high[axis], -1.0)):
            rows = np.flatnonzero((inwards * (raw[:, axis] - wall) < 0.0)[triangles].all(axis=1))
            close = particles[inwards * (particles[:, axis] - wall) < CONTACT][:, others]
            middles = vertices[triangles[rows]].mean(axis=1)[:, others]
            flat[rows] |= np.isinf(KDTree(close).query(middles, distance_upper_bound=CONTACT)[0])
    return flat


def _inside(raw: np.ndarray, triangles: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return which triangles (t,) belong to a surface with a vertex in the domain; the others are of images alone."""
    edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2).T
    graph = coo_array((np.ones(edges.shape[1], bool), edges), (len(raw), len(raw)))
    count, surface = connected_components(graph, directed=False)
    inside = np.bincount(surface, ((raw >= low) & (raw <= high)).all(axis=1), count) > 0
    return inside[surface[triangles[:, 0]]]


def _fullness(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return weights (v,) of smoothing: 1 where particles (m, 3) fill half of the space, 0 where they are isolated.

    Lengths are in particle radii. Smoothing would shrink a drop of one particle to a point.
    """
    low = vertices.min(axis=0).astype(np.float64)
    size = np.ptp(vertices, axis=0) + 1.0
    edge = max(FULLNESS_CELL, float((np.prod(size) / FULLNESS_CELLS) ** (1 / 3)))
    # A margin of one cell on each side, so that no neighbour is missing.
    shape = tuple((size / edge).astype(int) + 3)
    cells = np.clip(((points - low) / edge).astype(int) + 1, 0, np.array(shape) - 1)
    count = np.bincount(np.ravel_multi_index(tuple(cells.T), shape), minlength=int(np.prod(shape)))
    share = count.reshape(shape).astype(np.float32) * (8.0 / edge**3)
    for axis in range(3):
        share = blurred_along(share, axis)
    at = np.clip(((vertices - low) / edge).astype(int) + 1, 0, np.array(shape) - 1)
    slope = np.clip((share[tuple(at.T)] - ALONE) / (HALF - ALONE), 0.0, 1.0)
    return (slope * slope * (3.0 - 2.0 * slope)).astype(np.float32)


def surface_paths(scene: RenderScene, directory: Path, index: int) -> list[Path]:
    """Return the files that `save_surface` writes for a frame whose every material has particles."""
    return [
        directory / f"surface_{slug(appearance.title)}_{index:06d}.{kind}"
        for appearance in scene.appearances
        for kind in ("vtp", "obj")
    ]


def slug(name: str) -> str:
    """Return a name as part of a file name: lower-case letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "material"


def save_surface(scene: RenderScene, frame: Frame, directory: Path) -> list[Path]:
    """Write the surface of every material of a frame, `surface_<material>_<frame>.vtp` and `.obj`; return the paths.

    A material without particles in the domain has a file without points, so that a series has no gaps. Lengths are
    metres; in 2D the surfaces are triangles at z = 0, seen from above. The directory is created if missing.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory} cannot be made for the surfaces: {error.strerror or error}.") from error
    groups = groups_of(scene, frame)
    form = reconstruct if scene.dimension == 3 else flat_mesh
    paths = surface_paths(scene, directory, frame.index)
    for number in range(len(scene.appearances)):
        chosen = [group for group in groups if group.key[0] == number]
        mesh = _joined([form(group.position, group.distance, scene.lower, scene.upper) for group in chosen])
        for path, write in zip(paths[2 * number :], (_write_vtp, _write_obj), strict=False):
            try:
                write(path, mesh, frame.time)
            except OSError as error:
                raise RunError(f"{path} could not be written: {error.strerror or error}.") from error
    return paths


def write_series(scene: RenderScene, directory: Path, frames: Sequence[tuple[int, float]]) -> list[Path]:
    """Write `surface_<material>.vtp.series`, the times, s, of frames by number, for every material; return paths."""
    names = [slug(appearance.title) for appearance in scene.appearances]
    paths = [directory / f"surface_{name}.vtp.series" for name in names]
    for path, name in zip(paths, names, strict=True):
        files = [{"name": f"surface_{name}_{index:06d}.vtp", "time": time} for index, time in sorted(frames)]
        write_text(path, json.dumps({"file-series-version": "1.0", "files": files}, indent=1) + "\n")
    return paths


@dataclass(frozen=True)
class SurfaceJob:
    """Writes the surfaces of frames of a result in a worker process."""

    source: Path
    directory: Path

    def start(self) -> Callable[[int], None]:
        """Open the result, and return the function that writes the surfaces of a frame."""
        result = open_result(self.source)
        scene = render_scene_of(result)

        def save(k: int) -> None:
            save_surface(scene, result.present_frame(k, ()), self.directory)

        return save


def save_surfaces(
    result: Result, ks: Sequence[int], directory: Path, workers: int, **calls: Callable[..., Any]
) -> None:
    """Write the surfaces of some frames, and the list of them that ParaView opens; `calls` are of `render_frames`."""
    render_frames(SurfaceJob(result.path, directory), ks, workers, **calls)
    write_series(render_scene_of(result), directory, [(int(result.numbers[k]), float(result.times[k])) for k in ks])


def flat_mesh(position: np.ndarray, distance: float, lower: Sequence[float], upper: Sequence[float]) -> Mesh:
    """Return triangles at z = 0 that fill what particles (n, 2) cover by more than a half; see `reconstruct`."""
    low, high = np.array(lower[:2]), np.array(upper[:2])
    spare = 3.0 * distance
    # From wall to wall, but without empty space.
    first = np.maximum(position.min(axis=0) - spare, low)
    last = np.minimum(position.max(axis=0) + spare, high)
    edge = max(distance / FINENESS, float(np.sqrt(np.prod(last - first) / NODES)))
    columns, rows = np.maximum(np.ceil((last - first) / edge - 1e-6), 1).astype(int).tolist()
    grid = Grid(tuple((first + 0.5 * edge).tolist()), edge, (rows, columns))
    cover = cover_of(position, distance, low.tolist(), high.tolist(), grid)
    # A ring of nodes without cover closes every contour: half a cell beyond the last node, which is on the wall.
    mesh = _filled(np.pad(np.clip(cover, 0.0, 1.0), 1), np.array(grid.corner) - edge, edge)
    mesh.points[:, :2] = np.clip(mesh.points[:, :2], low, high)
    return mesh


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
    areas = _area_vectors(points.astype(np.float64), triangles)[:, 2]
    triangles = np.where((areas < 0)[:, None], triangles[:, ::-1], triangles)[areas != 0]
    return Mesh(points, triangles, np.tile(np.float32([0.0, 0.0, 1.0]), (len(points), 1)))


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    meshes = [empty_mesh(), *meshes]
    offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, offsets, strict=False)]
    points, normals = (np.concatenate(part) for part in zip(*((m.points, m.normals) for m in meshes), strict=True))
    return Mesh(points, np.concatenate(triangles), normals)


def _write_vtp(path: Path, mesh: Mesh, time: float) -> None:
    """Write a mesh with its normals and its time, s, as VTK's XML."""
    import pyvista as pv
    import vtk

    data = pv.PolyData()
    if len(mesh.points):
        data = pv.PolyData.from_regular_faces(mesh.points, mesh.triangles)
        data.point_data["Normals"] = mesh.normals
        data.GetPointData().SetActiveNormals("Normals")
    data.field_data["TimeValue"] = np.array([time])
    with sealed(path, unique=True) as temporary:
        writer = vtk.vtkXMLPolyDataWriter()
        writer.SetFileName(str(temporary))
        writer.SetInputData(data)
        if not writer.Write():
            raise OSError(f"VTK could not write {temporary}")


def _write_obj(path: Path, mesh: Mesh, time: float) -> None:
    """Write a mesh with its normals as OBJ, with y up, and its time, s, in a comment."""
    # Programs read OBJ with y up, and the up of a scene in 3D is z; a flat mesh lies in the plane x, y already.
    flat = not mesh.points[:, 2].any()
    points, normals = (v if flat else v[:, [0, 2, 1]] * [1, 1, -1] for v in (mesh.points, mesh.normals))

    def lines(form: str, values: np.ndarray) -> str:
        return (form * len(values)) % tuple(values.ravel().tolist())

    corners = np.repeat(mesh.triangles + 1, 2, axis=1)
    write_text(
        path,
        f"# time {time:.9g} s, lengths in metres, y up{'' if flat else ': x, z, -y of the scene'}\n"
        + lines("v %.9g %.9g %.9g\n", points)
        + lines("vn %.6g %.6g %.6g\n", normals)
        + lines("f %d//%d %d//%d %d//%d\n", corners),
        unique=True,
    )
