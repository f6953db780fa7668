"""Particles as round dots of their own size: flat in 2D, balls shaded by depth in 3D."""

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mpmcli.frames.frame import Frame
from mpmcli.render.colliders import ColliderActors, FlatColliders
from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import PIXELS_MAX, SIDE_MAX, Theme
from mpmcli.render.view import Slice, View

if TYPE_CHECKING:
    import pyvista as pv

# Diameter of a dot over the distance between particles: neighbours overlap slightly, so that a body looks continuous.
OVERLAP = 1.15
SMALLEST = 1.5  # smallest diameter of a dot, pixels, so that a single particle is visible
SMOOTHED = 400_000  # up to this number of particles, each pixel is the average of four, which makes round edges smooth
DOT_MAX = 255  # largest diameter of a dot that is drawn, pixels
# Logarithm of the ratio of consecutive dot sizes, in perspective and in parallel views, which have few sizes.
LEVEL, FINE_LEVEL = 0.04, 1e-4
FARTHEST = 16  # maximum number of squares on each side that are searched for dots that hide another
STRENGTH = 0.55  # fraction of the light that a deep gap absorbs
DEEP = 4.0  # depth of a deep gap, in diameters of a dot
COMPARED_DISTANCE = 1.2  # distance of the compared pixels, in diameters of a dot
MOST = 1.5  # upper bound of a gap, in units of `DEEP`: anything farther away is another body
DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))


class DotsPainter:
    """Draws frames, of which the largest has `count` particles, as dots."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme, colors: Coloring | Categories, count: int) -> None:
        """Prepare the window, and in 3D its light, the box of the domain and colliders."""
        self._scene, self._view, self._colors = scene, view, colors
        self.fields = colors.fields
        self._flat = scene.dimension == 2
        self._diameters = OVERLAP * np.array(scene.distances)
        largest = float(self._diameters.max()) * view.pixels_per_metre
        self._offscreen = OffscreenRenderer(view, theme, samples=samples_of(view.size, count, largest))
        self._corner = np.array(scene.lower)
        self._actors: dict[int, pv.Actor] = {}
        self._ground = FlatColliders(scene, view, theme, Slice((0, 1))) if self._flat and scene.colliders else None
        if not self._flat:
            self._offscreen.add_light()
            self._offscreen.add_box(scene)
            self._colliders = ColliderActors(scene, theme, self._offscreen)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return (h, w, 3) uint8; particles without a position are left out."""
        placed = np.isfinite(frame.position).all(axis=1)
        points = np.zeros((int(placed.sum()), 3))
        points[:, : self._scene.dimension] = frame.position[placed]
        colors = self._colors.particle_rgb(frame)[placed]
        diameters = self._diameters[np.clip(frame.body[placed], 0, len(self._diameters) - 1)]
        scale = self._view.scale_at(np.maximum(self._view.pixels(points)[:, 2], self._view.near))
        sizes = np.maximum(diameters * scale, SMALLEST)
        if not self._flat and len(points):
            seen = ~self._hidden(points, sizes)
            points, colors, sizes = points[seen], colors[seen], sizes[seen]
        # One actor for each size, the same in all frames.
        step = FINE_LEVEL if self._view.parallel else LEVEL
        level_of = np.rint(np.log(sizes) / step).astype(int)
        for actor in self._actors.values():
            actor.visibility = False
        for level in np.unique(level_of).tolist():
            chosen = level_of == level
            self._set(level, points[chosen], colors[chosen], math.exp(step * level))
        if not self._flat:
            self._colliders.pose(frame)
        self._offscreen.render()
        picture = self._offscreen.picture()
        if self._flat:
            if self._ground is None:
                return picture
            # Colliders are drawn between the dots and do not hide particles inside them.
            free = _blocks(~np.isfinite(self._offscreen.depth()), self._offscreen.samples)
            image = picture / np.float32(255)
            self._ground.draw(image, frame, free.mean(axis=(1, 3), dtype=np.float32))
            return (255.0 * image + 0.5).astype(np.uint8)
        depth, others = self._offscreen.depth(), None
        if self._colliders.meshes:
            others = self._colliders.depth_without(self._offscreen)
        return depth_shaded(picture, depth, float(self._diameters.max()), self._view, self._offscreen.samples, others)

    def _hidden(self, points: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return which dots are fully covered by others, (n,) bool: their omission changes no pixel."""
        pixels = self._view.pixels(points)
        inside = (pixels[:, :2] >= 0).all(axis=1) & (pixels[:, :2] < self._view.size).all(axis=1) & (pixels[:, 2] > 0)
        result = np.zeros(len(points), dtype=bool)
        # The edge of a disc may lack a sample; a disc centred in a square covers it and its eight neighbours.
        edge = 1.0 / self._offscreen.samples
        side = (0.5 * float(sizes.min()) - edge) / math.sqrt(8.0)
        if side >= 0.5 * edge and inside.any():
            reach = math.ceil((0.5 * float(sizes[inside].max()) + edge) / side)
            # For a camera among the dots, the comparison takes longer than drawing.
            if reach <= FARTHEST:
                result[inside] = hidden(pixels[inside], side, float(self._diameters.max()), reach, cover=1)
        return result

    def _set(self, level: int, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        """Show points as dots of `size` pixels, in the actor of their level."""
        import pyvista as pv

        # VTK stores positions in single precision, too coarse for a domain far from the origin.
        cloud = pv.PolyData((points - self._corner).astype(np.float32))
        cloud["rgb"] = colors
        if level not in self._actors:
            # Flat dots have the exact colours of the colour bar.
            self._actors[level] = self._offscreen.add_dots(cloud, lit=not self._flat)
            self._actors[level].position = tuple(self._corner.tolist())
            self._actors[level].prop.point_size = size * self._offscreen.samples
        self._actors[level].mapper.dataset = cloud
        self._actors[level].visibility = True


def samples_of(size: tuple[int, int], count: int, largest: float) -> int:
    """Return the samples along each axis of a pixel, from the number of dots and the widest one."""
    possible = 2 * max(size) <= SIDE_MAX and 4 * size[0] * size[1] <= PIXELS_MAX and 2 * largest <= DOT_MAX
    return 2 if possible and count <= SMOOTHED else 1


def _blocks(values: np.ndarray, samples: int) -> np.ndarray:
    """Return values (h * samples, w * samples) as (h, samples, w, samples)."""
    return values.reshape(len(values) // samples, samples, -1, samples)


def depth_shaded(
    picture: np.ndarray, depth: np.ndarray, diameter: float, view: View, samples: int, dots: np.ndarray | None = None
) -> np.ndarray:
    """Darken pixels deeper than their surroundings (eye-dome lighting, C. Boucheny, PhD thesis, Grenoble 2009).

    VTK's eye-dome lighting and SSAO were compared with it, and take three to five times as long. The picture is (h, w,
    3) uint8, the depth (h * samples, w * samples), m, inf for the background; `dots` is the depth of the dots alone if
    the picture has other objects, which are not darkened.
    """
    # The nearest sample of a pixel, because an edge belongs to the object in front.
    width, height = view.size
    nearest = first = _blocks(depth, samples).min(axis=(1, 3))
    if dots is not None:
        nearest = _blocks(dots, samples).min(axis=(1, 3))
    solid = np.isfinite(nearest)
    if not solid.any():
        return picture
    # At a very small distance a dot is larger than the picture.
    reach = max(1, min(round(COMPARED_DISTANCE * diameter * view.pixels_per_metre), max(view.size)))
    bare = np.where(solid, nearest, np.float32(view.far))
    padded = np.pad(bare, reach, mode="edge")
    gap = np.zeros_like(bare)
    for i, j in DIRECTIONS:
        other = padded[reach + i * reach :, reach + j * reach :][:height, :width]
        gap += np.clip((bare - other) / np.float32(DEEP * diameter), 0.0, MOST)
    shade = np.exp(-STRENGTH * 2.0 * gap / len(DIRECTIONS) * 2.0)
    shade[~solid | (first < nearest)] = 1.0
    return (picture * shade[:, :, None] + 0.5).astype(np.uint8)


def hidden(pixels: np.ndarray, cell: float, gap: float, reach: int = 1, cover: int = 0) -> np.ndarray:
    """Return which particles are invisible (n,): others, nearer by `gap`, m, cover all squares of their dots.

    `pixels` are (n, 3), from the left and from the top, and the distance, m; squares of side `cell`, pixels, are
    compared. `reach` and `cover` are the squares on each side of its own that a particle may touch, and fully covers.
    """
    if len(pixels) == 0:
        return np.zeros(0, dtype=bool)
    low = np.floor(pixels[:, :2].min(axis=0) / cell).astype(np.int64)
    column, row = (np.floor(pixels[:, :2] / cell).astype(np.int64) - low + reach).T
    nearest = np.full((row.max() + reach + 1, column.max() + reach + 1), np.inf)
    np.minimum.at(nearest, (row, column), pixels[:, 2])
    nearest = minimum_filter(nearest, 2 * cover + 1, mode="constant", cval=np.inf)
    nearest = maximum_filter(nearest, 2 * reach + 1, mode="constant", cval=np.inf)
    return pixels[:, 2] > nearest[row, column] + gap
