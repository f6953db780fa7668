"""Colliders in pictures: flat in 2D, meshes in 3D, and the mirror images of particles behind them."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import Slice, View
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.primitives import box_corners
from mpmcli.scene.surface import Surface, collider_surface, poly_data, surface_of, without_doubles

if TYPE_CHECKING:
    import pyvista as pv

RIM, DARKER = 2.0, 0.35  # pixels of a dark rim in a picture 720 pixels high, and the fraction by which it is darker
FILLED = 0.55  # fraction of the collider colour in the interior; the rest is the background
SHARP = 30.0  # angle between triangles, degrees, from which on an edge is sharp
FINE = 1 / 60  # edges of triangles that carry light, as a fraction of the longest side of the domain
THICK = 1 / 88  # thickness of the layer under a surface that absorbs light, in the same unit
LINE, DARK = 1.5, 0.55  # width in pixels, in a picture 720 pixels high, and brightness of the lines along edges
NEAR = 2.0  # distance from a collider within which a particle has an image, in distances between particles
# Largest distance of the mirror in front of the collider, in the same unit: bodies stay about that distance away.
BEFORE = 0.75
# Depth behind an image that must be inside the collider, in the same unit, so that no image appears beyond a thin one.
BEHIND = 2.0
STEP = 1e-3  # step of finite differences, in the same unit


class FlatColliders:
    """Covers the pixels of a view of a plane by the signed distances of colliders, within the domain."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme, plane: Slice) -> None:
        self._scene, self._view, self._plane = scene, view, plane
        self._rim = RIM * view.size[1] / 720.0
        color, ground = np.array(rgb(theme.solid)), np.array(rgb(theme.ground))
        self._fill, self._dark = ground + FILLED * (color - ground), (1.0 - DARKER) * color
        self._middles = [np.arange(size) + 0.5 for size in view.size]
        self._kept: dict[int, np.ndarray] = {}

    @cached_property
    def _inside(self) -> np.ndarray:
        """The fraction of each pixel that lies in the domain, (h, w)."""
        low, high = np.sort(self._view.pixels(self._plane.corners(self._scene))[:, :2], axis=0)
        shares = (np.minimum(a - low[k], high[k] - a) + 0.5 for k, a in enumerate(self._middles))
        across, up = (np.clip(share, 0.0, 1.0) for share in shares)
        return (up[:, None] * across).astype(np.float32)

    @cached_property
    def _points(self) -> np.ndarray:
        """The points of the plane at the centres of the pixels, (h, w, 3), m."""
        x, y = self._middles
        points = self._view.rays(x[None, :], y[:, None])[0]
        if self._plane.normal is not None:
            points[..., self._plane.normal] = self._plane.place
        return points

    def draw(self, picture: np.ndarray, frame: Frame, free: np.ndarray | float = 1.0) -> None:
        """Draw the colliders of a frame over a picture (h, w, 3) from 0 to 1, in the `free` part (h, w) of pixels."""
        shown = [(k, it) for k, it in enumerate(self._scene.colliders) if self._scene.shows(k, frame)]
        if shown:
            depth = np.max([self._depth(number, collider, frame.time) for number, collider in shown], axis=0)
            cover = np.clip(depth + 0.5, 0.0, 1.0) * self._inside * free
            rim = np.clip(self._rim + 0.5 - depth, 0.0, 1.0)[..., None]
            picture += cover[..., None] * (self._fill + rim * (self._dark - self._fill) - picture)

    def _depth(self, number: int, collider: Collider, time: float) -> np.ndarray:
        """Return the depth in pixels of each pixel inside a collider, (h, w), negative outside."""
        if number in self._kept:
            return self._kept[number]
        place = self._near(collider, time)
        points = self._points[place][..., : self._scene.dimension]
        depth = np.full(self._inside.shape, -np.inf, np.float32)
        if points.size:
            distance = collider.signed_distance(points.reshape(-1, points.shape[-1]), time)
            depth[place] = -self._view.pixels_per_metre * distance.reshape(points.shape[:2])
        if not collider.motion.moves:
            self._kept[number] = depth
        return depth

    def _near(self, collider: Collider, time: float) -> tuple[slice, slice]:
        """Return rows and columns of the picture in which a collider may be visible."""
        if isinstance(collider.form, Plane) or collider.side == "inside":
            return slice(None), slice(None)
        corners = box_corners(*collider.form.bounds())
        ends = np.zeros((len(corners), 3))
        ends[:, : corners.shape[1]] = collider.motion.placed(corners, time)
        pixels = self._view.pixels(ends)[:, :2]
        left, top = np.clip(pixels.min(axis=0) - 2.0, 0, self._view.size).astype(int)
        right, bottom = np.clip(pixels.max(axis=0) + 3.0, 0, self._view.size).astype(int)
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True, eq=False)
class ColliderMesh:
    """The surface of one collider at its shape, as triangles fine enough for light and shadow."""

    collider: Collider
    number: int  # of the collider in the scene
    surface: Surface  # triangles with the material in front of them
    side: float  # longest side of the domain, m

    @property
    def casts(self) -> bool:
        """Whether it casts shadows: the ground and containers do not."""
        return self.collider.side == "outside" and not isinstance(self.collider.form, Plane)

    def transform(self, time: float) -> np.ndarray:
        """Return the matrix (4, 4) that maps points, relative to the pivot, to their positions at a time, s."""
        matrix = np.eye(4)
        matrix[:3, 3], matrix[:3, :3] = self.collider.motion.pose(time)
        return matrix

    def shown(self, *, fine: bool = False) -> Any:
        """Return PyVista's mesh relative to the pivot, normals split at sharp edges, long edges divided if fine."""
        return self._from_pivot(self._fine if fine else self.surface).compute_normals(
            cell_normals=False,
            split_vertices=True,
            feature_angle=SHARP,
            consistent_normals=False,
            auto_orient_normals=False,
        )

    def edges(self) -> Any:
        """Return its sharp edges and its rims as PyVista's lines relative to the pivot."""
        return self._from_pivot(self.surface).extract_feature_edges(
            SHARP, boundary_edges=True, non_manifold_edges=False, feature_edges=True, manifold_edges=False
        )

    def _from_pivot(self, surface: Surface) -> Any:
        return poly_data(Surface(surface.points - np.array(self.collider.motion.pivot), surface.cells))

    def shade(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return points (n, 3) under its surface that absorb light at a time, s, and their volumes (n,), m^3."""
        places, volumes = self._lit
        return self.collider.motion.placed(places, time), volumes

    @cached_property
    def _lit(self) -> tuple[np.ndarray, np.ndarray]:
        surface, thick = self._fine, THICK * self.side
        places = surface.points[surface.cells].mean(axis=1) - 0.5 * thick * surface.normals
        return places, thick * surface.sizes

    @cached_property
    def _fine(self) -> Surface:
        if len(self.surface.cells) == 0:
            return self.surface
        longest = FINE * self.side
        fine = poly_data(self.surface).subdivide_adaptive(
            max_edge_len=longest, max_tri_area=longest**2, max_n_passes=12
        )
        return without_doubles(surface_of(fine))


def collider_meshes(scene: RenderScene) -> tuple[ColliderMesh, ...]:
    """Return the surfaces of the colliders with an extent in a 3D scene."""
    lower, upper = np.array(scene.lower), np.array(scene.upper)
    side = float(np.max(upper - lower))
    surfaces = [collider_surface(collider, lower, upper) for collider in scene.colliders]
    for number in scene.hollow:
        surfaces[number] = _cut_open(surfaces[number], scene.towards)
    return tuple(
        ColliderMesh(collider, number, without_doubles(surface), side)
        for number, (collider, surface) in enumerate(zip(scene.colliders, surfaces, strict=True))
        if len(surface.cells)
    )


def _cut_open(surface: Surface, towards: tuple[float, ...]) -> Surface:
    """Return the part of a closed surface behind the plane through its middle that faces a direction, closed there.

    A surface that the domain cuts open stays as it is.
    """
    data = poly_data(surface)
    if not len(surface.cells) or data.n_open_edges:
        return surface
    middle = 0.5 * (surface.points.min(axis=0) + surface.points.max(axis=0))
    return surface_of(data.clip_closed_surface(-np.array(towards), origin=middle).triangulate())


class ColliderActors:
    """Shaded surfaces in a window, visible from the side of the material, so that a container hides no content."""

    def __init__(self, scene: RenderScene, theme: Theme, window: OffscreenRenderer) -> None:
        """Add the surfaces of all colliders, and their edges, to a window."""
        self._scene = scene
        self._actors: list[tuple[ColliderMesh, list[pv.Actor]]] = []
        self._shown = self._actors
        self.meshes = collider_meshes(scene)
        for mesh in self.meshes:
            surface = window.plotter.add_mesh(
                mesh.shown(),
                color=theme.solid,
                smooth_shading=True,
                culling="front" if scene.clear and mesh.casts else "back",
                ambient=0.45,
                diffuse=0.65,
                specular=0.0,
                reset_camera=False,
            )
            # Draw lines on the surface in front of it.
            surface.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            surface.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(1.0, 1.0)
            self._actors.append((mesh, [surface, *edge_actors(mesh, theme, window)]))

    def pose(self, frame: Frame) -> None:
        """Move the colliders of a frame to their positions."""
        self._shown = [(mesh, actors) for mesh, actors in self._actors if self._scene.shows(mesh.number, frame)]
        for mesh, actors in self._actors:
            shown, matrix = self._scene.shows(mesh.number, frame), mesh.transform(frame.time)
            for actor in actors:
                actor.visibility, actor.user_matrix = shown, matrix

    def shades(self, time: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the points that absorb light at a time, s; see `ColliderMesh.shade`."""
        return [mesh.shade(time) for mesh, _ in self._shown if mesh.casts]

    def depth_without(self, window: OffscreenRenderer) -> np.ndarray:
        """Return the depth of a picture without colliders, as `OffscreenRenderer.depth`; the window then shows it."""
        for show in (False, True):
            for _, actors in self._shown:
                for actor in actors:
                    actor.visibility = show
            if not show:
                window.render()
                depth = window.depth()
        return depth


def edge_actors(mesh: ColliderMesh, theme: Theme, window: OffscreenRenderer) -> "list[pv.Actor]":
    """Draw the sharp edges of a collider, if it has any, in a window."""
    edges = mesh.edges()
    if not edges.n_points:
        return []
    shade = tuple(DARK * part for part in rgb(theme.solid))
    width = max(LINE * window.plotter.window_size[1] / 720.0, window.samples)
    return [window.plotter.add_mesh(edges, color=shade, line_width=width, lighting=False, reset_camera=False)]


def with_collider_images(position: np.ndarray, distance: float, scene: RenderScene, frame: Frame) -> np.ndarray:
    """Return particles (n, d) of one distance between neighbours, m, and their images in the colliders of a frame."""
    shown = [collider for number, collider in enumerate(scene.colliders) if scene.shows(number, frame)]
    return np.concatenate([position, *(_images(position, distance, collider, frame.time) for collider in shown)])


def _images(position: np.ndarray, distance: float, collider: Collider, time: float) -> np.ndarray:
    """Return the images, m, of particles near a collider that mirror them into it where it is thick enough."""
    away = collider.signed_distance(position, time)
    near = (away > 0) & (away < NEAR * distance)
    points, away = position[near], away[near, None]
    step = STEP * distance
    normal = np.stack(
        [
            collider.signed_distance(points + shift, time) - collider.signed_distance(points - shift, time)
            for shift in step * np.eye(position.shape[1])
        ],
        axis=1,
    ) / (2 * step)
    # A particle is as far from its image as from another particle, if the mirror may be that far in front.
    mirror = np.clip(away - 0.5 * distance, 0.0, BEFORE * distance)
    images = points - 2 * (away - mirror) * normal
    thick = collider.signed_distance(images - BEHIND * distance * normal, time) < 0
    return images[thick]
