"""What each pixel of an image shows: the nearest primitive, a dot or a triangle, and its distance from the camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.output.header import nearest_image
from mpmcli.render.colliders import ColliderMesh
from mpmcli.render.dots import OVERLAP
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.particle_grid import drawable
from mpmcli.render.reconstruction import Mesh, flat_mesh, group_mesh
from mpmcli.render.render_scene import Group, RenderScene, SharedGeometry, groups_of
from mpmcli.render.settings import THEMES
from mpmcli.render.surface_renderer import RADIUS, grain_places
from mpmcli.render.view import View

# Value of pixels that show nothing; bodies follow, then colliders.
BACKGROUND = 0
# Colours of a window, and thus primitives of an image.
MOST_PRIMITIVES = 2**24 - 1
# Particles from which the displacement of a vertex is fitted, and the width of their weights, in distances between
# neighbours.
NEIGHBOURS, WIDTH = 12, 1.5


@dataclass(frozen=True)
class Primitives:
    """The c dots, or triangles of v vertices, of a frame."""

    points: np.ndarray  # (v, 3), m; (c, 3) for dots
    labels: np.ndarray  # (c,) int, the values of masks
    cells: np.ndarray | None = None  # (c, 3) vertices, counter-clockwise from outside; None for dots
    diameters: np.ndarray | None = None  # (c,) of dots, m
    moved: np.ndarray | None = None  # (v, 3), displacement to the next frame, m; nan where unknown
    normals: np.ndarray | None = None  # (v, 3)
    culled: str = "back"  # the side of triangles that is not shown


def displacements(frame: Frame, following: Frame, period: np.ndarray) -> np.ndarray:
    """Return the displacement of each particle to the following frame, (n, d), m; nan if it is not there."""
    own, there = (np.arange(len(one.body)) if one.id is None else one.id for one in (frame, following))
    order = np.argsort(there)
    found = order[np.minimum(np.searchsorted(there, own, sorter=order), len(order) - 1)] if len(there) else own
    way = np.full(frame.position.shape, np.nan)
    same = there[found] == own if len(there) else np.zeros(len(own), bool)
    here = frame.position[same].astype(np.float64)
    way[same] = nearest_image(following.position[found[same]].astype(np.float64) - here, period)
    return way


def dots_of(scene: RenderScene, frame: Frame, moved: np.ndarray | None) -> Primitives:
    """Return the particles of a frame that have a position as dots."""
    rows = drawable(frame.position, scene.lower, scene.upper, max(scene.distances))
    body = np.clip(frame.body[rows], 0, len(scene.bodies) - 1)
    diameters = OVERLAP * np.array(scene.distances)[body]
    points = _in_3d(frame.position[rows])
    return Primitives(points, body + 1, None, diameters, None if moved is None else _in_3d(moved[rows]))


def surfaces_of(scene: RenderScene, frame: Frame, moved: np.ndarray | None, shared: SharedGeometry) -> list[Primitives]:
    """Return the surfaces of the groups of a frame; a triangle has the label of the nearest particle.

    Grains in 3D are dots, as in pictures.
    """
    found = []
    for group in groups_of(scene, frame):
        labels = np.clip(frame.body[group.rows], 0, len(scene.bodies) - 1) + 1
        way = None if moved is None else moved[group.rows]
        if group.appearance.finish == "grains" and scene.dimension == 3:
            diameters = np.full(len(labels), 2 * RADIUS * group.distance)
            found.append(Primitives(grain_places(scene, group), labels, None, diameters, way))
            continue
        mesh = mesh_of(scene, group, shared, frame)
        if len(mesh.triangles):
            points = mesh.points.astype(np.float64)
            middles = points[mesh.triangles].mean(axis=1)[:, : scene.dimension]
            labels = labels[KDTree(group.position).query(middles)[1]]
            if way is not None:
                known = np.isfinite(way).all(axis=1)
                places = points[:, : scene.dimension]
                way = _in_3d(_carried(places, group.position[known], way[known], group.distance))
            found.append(Primitives(points, labels, mesh.triangles, None, way, mesh.normals))
    return found


def mesh_of(scene: RenderScene, group: Group, shared: SharedGeometry, frame: Frame) -> Mesh:
    """Return the surface of a group, triangles at z = 0 in 2D."""
    if scene.dimension == 3:
        return group_mesh(scene, group, {}, shared, frame)
    return flat_mesh(group.position, group.distance, scene.lower, scene.upper)


def solids_of(scene: RenderScene, meshes: Sequence[ColliderMesh], frame: Frame) -> list[Primitives]:
    """Return the surfaces of the colliders of a frame in 3D."""
    found = []
    for mesh in meshes:
        if scene.shows(mesh.number, frame):
            shown, matrix = mesh.shown(), mesh.transform(frame.time)
            cells, normals = shown.regular_faces, shown.point_data["Normals"] @ matrix[:3, :3].T
            labels = np.full(len(cells), collider_label(scene, mesh.number))
            culled = "front" if scene.clear and mesh.casts else "back"
            points = np.asarray(shown.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
            found.append(Primitives(points, labels, cells, normals=normals, culled=culled))
    return found


def collider_label(scene: RenderScene, number: int) -> int:
    """Return the value of a collider in masks."""
    return len(scene.bodies) + 1 + number


def _in_3d(vectors: np.ndarray) -> np.ndarray:
    return np.pad(vectors.astype(np.float64), [(0, 0), (0, 3 - vectors.shape[1])])


def _carried(points: np.ndarray, position: np.ndarray, moved: np.ndarray, distance: float) -> np.ndarray:
    """Return the displacement at points (v, d) of the affine motion that fits the nearest particles best."""
    if not len(position):
        return np.full(points.shape, np.nan)
    d, k = points.shape[1], min(NEIGHBOURS, len(position))
    away, near = KDTree(position).query(points, k)
    away, near = away.reshape(-1, k), near.reshape(-1, k)
    weights = np.exp(-((away / (WIDTH * distance)) ** 2)) + 1e-12
    terms = np.concatenate([np.ones((*near.shape, 1)), (position[near] - points[:, None]) / distance], axis=2)
    matrix = np.einsum("vk,vki,vkj->vij", weights, terms, terms)
    # Few particles, or particles in a line, leave gradients at 0.
    matrix += 1e-6 * weights.sum(axis=1)[:, None, None] * np.diag([0.0, *[1.0] * d])
    right = np.einsum("vk,vki,vka->via", weights, terms, moved[near])
    return np.linalg.solve(matrix, right)[:, 0]


@dataclass(frozen=True)
class Visible:
    """What the pixels of an image show, (h, w) each.

    Attributes:
        number: of the primitive, -1 for none.
        mask: its label.
        depth: its distance from the camera along the line of sight, m; inf for none.
    """

    view: View
    primitives: tuple[Primitives, ...]
    number: np.ndarray
    mask: np.ndarray
    depth: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """The point that each pixel shows, (h, w, 3), m; nan for none."""
        h, w = self.depth.shape
        start, direction = self.view.rays(np.arange(w)[None, :] + 0.5, np.arange(h)[:, None] + 0.5)
        depth = np.where(np.isfinite(self.depth), self.depth, np.nan)
        return start + depth[..., None] * direction

    def at_pixels(self, name: str) -> np.ndarray:
        """Return an attribute of vertices, (v, 3) each, at each pixel, (h, w, 3): interpolated; nan where unknown."""
        found, points, first = np.full((*self.number.shape, 3), np.nan), self.points, 0
        for one in self.primitives:
            values = getattr(one, name)
            shown = (self.number >= first) & (self.number < first + len(one.labels))
            cells = self.number[shown] - first
            first += len(one.labels)
            if values is not None and one.cells is None:
                found[shown] = values[cells]
            elif values is not None:
                corners = one.cells[cells]
                found[shown] = np.einsum("pk,pka->pa", _weights(points[shown], one.points[corners]), values[corners])
        return found


def _weights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the barycentric weights (p, 3) of points (p, 3) near triangles (p, 3, 3)."""
    sides = corners[:, 1:] - corners[:, :1]
    inner = np.einsum("pia,pja->pij", sides, sides) + 1e-300 * np.eye(2)
    inner += 1e-12 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    right = np.einsum("pia,pa->pi", sides, points - corners[:, 0])
    two = np.clip(np.linalg.solve(inner, right[..., None])[..., 0], 0.0, 1.0)
    return np.concatenate([1.0 - two.sum(axis=1, keepdims=True), two], axis=1)


# A splat is the disc of a dot, without light.
DISC = """//VTK::Color::Impl
if (dot(offsetVCVSOutput.xy, offsetVCVSOutput.xy) > 1.0) discard;
ambientColor = vertexColorVSOutput.rgb; diffuseColor = vec3(0.0);
"""


class PrimitiveWindow:
    """A window that draws each primitive in a colour of its own, without light."""

    def __init__(self, scene: RenderScene, view: View) -> None:
        """Open a window of the size of a view."""
        self._corner = np.array(scene.lower)
        self._window = OffscreenRenderer(view, replace(THEMES["dark"], ground="#000000"), samples=1)
        self._primitives: Sequence[Primitives] = ()

    def draw(self, primitives: Sequence[Primitives], view: View) -> Visible:
        """Draw primitives as a view of the size of the window shows them; InputError: there are too many."""
        if primitives is not self._primitives:
            self._set(primitives)
        self._window.view = view
        self._window.render()
        r, g, b = np.moveaxis(self._window.pixels().astype(np.int64), 2, 0)
        number = r + 256 * g + 65536 * b - 1
        depth = np.where(number >= 0, self._window.depth(), np.float32(np.inf))
        labels = np.concatenate([[BACKGROUND], *(one.labels for one in primitives)])
        return Visible(view, tuple(primitives), number, labels[number + 1], depth)

    def _set(self, primitives: Sequence[Primitives]) -> None:
        """Replace what the window shows."""
        # VTK frees the buffers of what is removed in the current window, in which others may have the same numbers.
        self._window.plotter.render_window.MakeCurrent()
        self._window.plotter.renderer.RemoveAllViewProps()
        self._primitives, first = primitives, 1
        for one in primitives:
            numbers = np.arange(first, first + len(one.labels), dtype=np.uint32)
            first += len(one.labels)
            if first > MOST_PRIMITIVES:
                raise InputError(f"an image can show at most {MOST_PRIMITIVES:,} particles and triangles.")
            if len(numbers):
                colors = np.stack([numbers & 255, numbers >> 8 & 255, numbers >> 16], axis=1).astype(np.uint8)
                self._window.plotter.renderer.AddActor(self._actor(one, colors))

    def _actor(self, one: Primitives, colors: np.ndarray) -> Any:
        """Return the actor of primitives in these colours."""
        import pyvista as pv
        import vtk

        # VTK stores positions in single precision, too coarse for a domain far from the origin.
        points = (one.points - self._corner).astype(np.float32)
        if one.cells is None:
            mesh, mapper = pv.PolyData(points), vtk.vtkPointGaussianMapper()
            mesh.point_data["rgb"], mesh.point_data["radius"] = colors, 0.5 * one.diameters
            mapper.SetScalarModeToUsePointFieldData()
            mapper.SetScaleArray("radius")
            mapper.SetScaleFactor(1.0)
            mapper.EmissiveOff()
            mapper.SetSplatShaderCode(DISC)
        else:
            mesh, mapper = pv.PolyData.from_regular_faces(points, one.cells), vtk.vtkPolyDataMapper()
            mesh.cell_data["rgb"] = colors
            mapper.SetScalarModeToUseCellFieldData()
        mapper.SetInputData(mesh)
        mapper.SelectColorArray("rgb")
        mapper.SetColorModeToDirectScalars()
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.SetPosition(*self._corner.tolist())
        actor.GetProperty().LightingOff()
        if one.cells is not None:
            actor.GetProperty().SetFrontfaceCulling(one.culled == "front")
            actor.GetProperty().SetBackfaceCulling(one.culled == "back")
        return actor
