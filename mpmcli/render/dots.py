"""Particles as round dots of their own size: flat in 2D, balls shaded by depth in 3D."""

import math
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.collider_actors import ColliderActors
from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.depth_shading import depth_shaded
from mpmcli.render.flat_colliders import flat_colliders
from mpmcli.render.hidden import hidden
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.theme import Theme
from mpmcli.render.view import View

if TYPE_CHECKING:
    import pyvista as pv

# Diameter of a dot over the distance between particles: neighbours overlap a little, so that a body looks whole.
OVERLAP = 1.15
# Smallest diameter of a dot, pixels, so that a single particle is visible.
SMALLEST = 1.5
# Up to this number of particles, each pixel is the average of four, which makes round edges smooth.
SMOOTHED = 400_000
# Largest diameter of a dot that is drawn, pixels.
DOT_MAX = 255
# Limits of software rendering: pixels along a side, beyond which it draws black, and in all, at 45 bytes each.
SIDE_MAX, PIXELS_MAX = 16_384, 64_000_000
# Number of sizes of dots in a perspective picture, one for each layer of distances.
LAYERS = 12
# Maximum number of squares on each side in which dots that hide another are sought.
FARTHEST = 16


class DotsPainter:
    """Draws frames as dots.

    Args:
        colors: of the particles.
        count: particles of the largest frame.
    """

    def __init__(self, scene: RenderScene, view: View, theme: Theme, colors: Coloring | Categories, count: int) -> None:
        self._scene = scene
        self._view = view
        self._colors = colors
        self.fields = colors.fields
        self._flat = scene.dimension == 2
        self._diameters = OVERLAP * np.array(scene.distances)
        largest = float(self._diameters.max()) * view.pixels_per_metre
        self._offscreen = OffscreenRenderer(view, theme, samples=samples_of(view.size, count, largest))
        self._levels = self._all_levels()
        self._corner = np.array(scene.lower)
        self._actors: dict[int, tuple[pv.PolyData, pv.Actor]] = {}
        self._ground = flat_colliders(scene, view, theme) if self._flat and scene.colliders else None
        if not self._flat:
            self._offscreen.add_light()
            self._offscreen.add_box(scene.lower, scene.upper, theme.wall)
            self._colliders = ColliderActors(scene, theme, self._offscreen)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return (h, w, 3) uint8; particles without a place are left out."""
        placed = np.isfinite(frame.position).all(axis=1)
        points = np.zeros((int(placed.sum()), 3))
        points[:, : self._scene.dimension] = frame.position[placed]
        colors, body = self._colors.particle_rgb(frame)[placed], frame.body[placed]
        sizes = self._pixels(points, body)
        if not self._flat and len(points):
            seen = ~self._hidden(points, sizes)
            points, colors, sizes = points[seen], colors[seen], sizes[seen]
        # The level whose size has the ratio nearest to one.
        level_of = np.searchsorted(np.sqrt(self._levels[1:] * self._levels[:-1]), sizes)
        for level, size in enumerate(self._levels.tolist()):
            chosen = level_of == level
            self._set(level, points[chosen], colors[chosen], size)
        if not self._flat:
            self._colliders.pose(frame)
        self._offscreen.render()
        picture = self._offscreen.picture()
        if self._flat:
            return picture if self._ground is None else self._above_colliders(picture, frame)
        depth, others = self._offscreen.depth(), None
        if self._colliders.meshes:
            others = self._colliders.depth_without(self._offscreen)
        return depth_shaded(picture, depth, float(self._diameters.max()), self._view, self._offscreen.samples, others)

    def _above_colliders(self, picture: np.ndarray, frame: Frame) -> np.ndarray:
        """Draw colliders between the dots: what lies in a collider is not hidden by it."""
        samples, (width, height) = self._offscreen.samples, self._view.size
        free = ~np.isfinite(self._offscreen.depth()).reshape(height, samples, width, samples)
        image = picture / np.float32(255)
        self._ground.draw(image, frame, free.mean(axis=(1, 3), dtype=np.float32))
        return (255.0 * image + 0.5).astype(np.uint8)

    def _pixels(self, points: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Return the diameter of each dot in pixels, (n,)."""
        scale = self._view.pixels_per_metre
        if not self._view.parallel:
            depth = self._view.pixels(points)[:, 2]
            scale = scale * self._view.distance / np.maximum(depth, self._view.near)
        diameters = self._diameters[np.clip(body, 0, len(self._diameters) - 1)]
        return np.maximum(diameters * scale, SMALLEST)

    def _hidden(self, points: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return which dots are wholly covered by others, (n,) bool: leaving them out changes no pixel."""
        pixels = self._view.pixels(points)
        inside = (pixels[:, :2] >= 0).all(axis=1) & (pixels[:, :2] < self._view.size).all(axis=1) & (pixels[:, 2] > 0)
        result = np.zeros(len(points), dtype=bool)
        # The edge of a disc may lack a sample; a disc centred in a square covers it and its eight neighbours.
        edge = 1.0 / self._offscreen.samples
        side = (0.5 * float(sizes.min()) - edge) / math.sqrt(8.0)
        if side >= 0.5 * edge and inside.any():
            reach = math.ceil((0.5 * float(sizes[inside].max()) + edge) / side)
            # For a camera among the dots, comparing takes longer than drawing.
            if reach > FARTHEST:
                return result
            result[inside] = hidden(pixels[inside], side, float(self._diameters.max()), reach, cover=1)
        return result

    def _all_levels(self) -> np.ndarray:
        """Return the diameters in which dots are drawn, pixels, increasing: the same in all frames."""
        view = self._view
        if view.parallel:
            return np.unique(np.maximum(self._diameters * view.pixels_per_metre, SMALLEST))
        nearest, farthest = (view.pixels_per_metre * view.distance / depth for depth in (view.near, view.far))
        low = max(float(self._diameters.min()) * farthest, SMALLEST)
        high = max(float(self._diameters.max()) * nearest, low)
        return np.geomspace(low, high, LAYERS) if high > 1.02 * low else np.array([high])

    def _set(self, level: int, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        """Set the points that the actor of a level shows."""
        import pyvista as pv
        from vtkmodules.util.numpy_support import numpy_to_vtk

        if level not in self._actors:
            mesh = pv.PolyData(np.zeros((1, 3), np.float32))
            mesh.point_data["rgb"] = np.zeros((1, 3), np.uint8)
            actor = self._offscreen.plotter.add_points(
                mesh,
                scalars="rgb",
                rgb=True,
                render_points_as_spheres=True,
                lighting=not self._flat,
                # Flat dots have exactly the colours of the colour bar.
                ambient=1.0 if self._flat else 0.45,
                diffuse=0.0 if self._flat else 0.65,
                specular=0.0,
                reset_camera=False,
            )
            # VTK stores positions in single precision, too coarse for a domain far from the origin.
            actor.position = tuple(self._corner.tolist())
            self._actors[level] = mesh, actor
        mesh, actor = self._actors[level]
        actor.visibility = len(points) > 0
        actor.prop.point_size = size * self._offscreen.samples
        if len(points) == 0:
            return
        shown = pv.PolyData((points - self._corner).astype(np.float32))
        rgb = numpy_to_vtk(np.ascontiguousarray(colors), deep=True)
        rgb.SetName("rgb")
        shown.GetPointData().SetScalars(rgb)
        mesh.ShallowCopy(shown)


def samples_of(size: tuple[int, int], count: int, largest: float) -> int:
    """Return the samples along each axis of a pixel, by the number of dots and the widest one."""
    possible = 2 * max(size) <= SIDE_MAX and 4 * size[0] * size[1] <= PIXELS_MAX and 2 * largest <= DOT_MAX
    return 2 if possible and count <= SMOOTHED else 1
