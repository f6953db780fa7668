"""Draws bodies in 2D: areas covered by particles, with soft light on their edges."""

import math

import numpy as np
from scipy.ndimage import affine_transform

from mpmcli.frames.frame import Frame
from mpmcli.render.colliders import FlatColliders, with_collider_images
from mpmcli.render.coloring import Coloring
from mpmcli.render.particle_grid import SPREAD, Grid, cover_of, disk_nodes, soft, spread, with_images
from mpmcli.render.render_scene import Appearance, Group, RenderScene, groups_of
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import Slice, View

SHARPNESS = 8  # steepness of the shares of bodies that meet in a pixel
SOFT = 0.016  # depth to which light reaches into a body, as a fraction of the height of the picture
RIM = 1.5  # pixels of a dark rim, in a picture 720 pixels high
DARKER = {"grains": 0.15, "crumbly": 0.20}  # fraction by which the rim is darker; 0.28 by default
LAMP = (-0.5, 0.87)  # direction of the light in the picture, to the right and upwards
# Radius of a grain of sand, in distances between particles, and variation of brightness of grains.
GRAIN, VARIETY = 0.62, 0.17
JITTER = 0.35  # random displacement of a grain, in distances, because heaps are not lattices
# Roughness of the edge of crumbs, as a fraction of the cover, and its scale, in distances.
ROUGHNESS, CRUMB = 0.55, 0.75
HOT, CRUST = np.float32([1.0, 0.62, 0.16]), np.float32([0.30, 0.05, 0.03])  # colours of lava, within and at its edge


# Shading of smooth bodies: fractions of body colour and of added white at the edge, steepness of the transition to the
# interior, fraction of body colour there, and fractions of white added towards the light and of colour kept away from
# it.
LOOKS = {
    "water": (1.0, 0.42, 1.25, 0.93, 0.25, 1.0),
    "syrup": (1.06, 0.0, 1.0, (0.86, 0.72, 0.6), 0.30, 1.0),
    "translucent": (0.96, 0.16, 1.0, 0.96, 0.30, 0.84),
    "crumbly": (0.95, 0.0, 1.0, 0.97, 0.0, (0.82, 0.89, 0.98)),
    "metal": (0.88, 0.0, 1.0, 1.0, 0.65, 0.62),
    "matte": (1.0, 0.0, 1.0, 0.97, 0.22, 0.78),
}


class OutlinePainter:
    """Draws the materials of a 2D run as filled bodies."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme, colors: Coloring | None = None) -> None:
        """Prepare a grid whose nodes are the pixels, and the part of it inside the domain."""
        self.scene, self.view, self.theme, self.colors = scene, view, theme, colors
        self.fields = () if colors is None else colors.fields
        width, height = view.size
        self.solid = FlatColliders(scene, view, theme, Slice((0, 1)))
        # Each pixel is a node; rows of the grid run upwards.
        edge = 1.0 / view.pixels_per_metre
        middle = np.array(view.focus)[:2]
        corner = middle + edge * (0.5 - 0.5 * np.array([width, height]))
        self.grid = Grid((float(corner[0]), float(corner[1])), edge, (height, width))
        x = corner[0] + edge * np.arange(width)
        y = corner[1] + edge * np.arange(height)
        self.inside = _within(y, scene.lower[1], scene.upper[1], edge)[:, None] * _within(
            x, scene.lower[0], scene.upper[0], edge
        )

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        height, width = self.grid.shape
        picture = np.empty((height, width, 3), dtype=np.float32)
        picture[:] = rgb(self.theme.ground)
        groups = groups_of(self.scene, frame)
        covers = [self._cover(group, frame) for group in groups]
        if groups:
            finest = min(group.distance for group in groups)
            alpha = np.clip(self._inwards(sum(covers), finest) + 0.5, 0.0, 1.0) * self.inside
            drawn = np.zeros_like(picture)
            weight = np.full((height, width), 1e-12, dtype=np.float32)
            for group, cover in zip(groups, covers, strict=True):
                share = np.maximum(cover, 0.0) ** SHARPNESS
                drawn += share[..., None] * self._colored(group, cover, frame)
                weight += share
            drawn /= weight[..., None]
            picture += alpha[..., None] * (drawn - picture)
        picture = np.clip(picture, 0.0, 1.0)[::-1]
        self.solid.draw(picture, frame)
        return (255.0 * picture + 0.5).astype(np.uint8)

    def _cover(self, group: Group, frame: Frame) -> np.ndarray:
        """Return the fraction of each pixel's surroundings that a group covers, (h, w); it is 1/2 at the edge."""
        grid, step = self._coarse_grid(group)
        position = with_collider_images(group.position, group.distance, self.scene, frame)
        cover = cover_of(position, group.distance, self.scene.lower, self.scene.upper, grid)
        if group.appearance.finish == "crumbly" and self.colors is None:
            cover = cover + ROUGHNESS * self._crumbs(group, grid) * np.clip(4.0 * cover * (1.0 - cover), 0.0, 1.0)
        return _finer(cover, step, self.grid.shape)

    def _coarse_grid(self, group: Group) -> tuple[Grid, int]:
        """Return the nodes of the cover, which span the picture, and their spacing, pixels."""
        step = max(int(group.distance / (3.0 * self.grid.edge)), 1)
        rows, columns = (-(-(size - 1) // step) + 1 for size in self.grid.shape)
        return Grid(self.grid.corner, self.grid.edge * step, (rows, columns)), step

    def _crumbs(self, group: Group, grid: Grid) -> np.ndarray:
        """Return noise of mean 0 that moves with the particles."""
        weights = group.distance**2 * group.hashes[:, 0].astype(np.float64)
        return spread(group.position, weights, CRUMB * group.distance, grid)

    def _colored(self, group: Group, cover: np.ndarray, frame: Frame) -> np.ndarray:
        """Return the colours (h, w, 3) of a group, regardless of its cover."""
        body, lit = self._relief(cover)
        if self.colors is not None:
            color = self._by_field(group, frame)
        else:
            color = self._by_look(group, np.clip(2.0 * body - 1.0, 0.0, 1.0), lit)
        rim = np.clip(1.0 - self._inwards(cover, group.distance) / (RIM * self.view.size[1] / 720.0), 0.0, 1.0)
        # Drops consist of rim alone and would be dark.
        rim *= np.clip(3.0 * body - 0.3, 0.0, 1.0)
        return color * (1.0 - DARKER.get(group.appearance.finish, 0.28) * rim)[..., None]

    def _by_look(self, group: Group, depth: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Return the colours (h, w, 3) of the material of a group from depth and light, the results of `_relief`."""
        base = np.array(rgb(group.appearance.color), dtype=np.float32)
        ground = np.array(rgb(self.theme.ground), dtype=np.float32)
        if np.abs(base - ground).max() < 0.15:
            # White on white: add enough ink to make it visible.
            base = base + np.float32(0.25) * (np.array(rgb(group.appearance.ink), dtype=np.float32) - base)
        if group.appearance.finish == "grains":
            return self._grainy(group, base, depth, lit)
        color = _shaded(group.appearance, base, depth, lit)
        if group.appearance.finish == "crumbly":
            grid, step = self._coarse_grid(group)
            noise = _finer(self._crumbs(group, grid), step, self.grid.shape)
            color = color * (1.0 + 0.10 * np.clip(noise, -1.0, 1.0))[..., None]
        return color

    def _inwards(self, cover: np.ndarray, distance: float) -> np.ndarray:
        """Return the distance in pixels (h, w) of each pixel from the edge, near it, from the slope of the cover."""
        steepest = self.grid.edge / (SPREAD * distance * math.sqrt(2.0 * math.pi))
        rise, slope = np.zeros_like(cover), np.zeros_like(cover)
        rise[1:-1] = 0.5 * (cover[2:] - cover[:-2])
        slope[:, 1:-1] = 0.5 * (cover[:, 2:] - cover[:, :-2])
        return (cover - 0.5) / np.maximum(np.sqrt(rise * rise + slope * slope), 0.12 * steepest)

    def _relief(self, cover: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cover in a wide neighbourhood of each pixel, and how its edge faces the light, from -1 to 1."""
        step = max(int(self.view.size[1] / 240), 1)
        height, width = (size - size % step for size in cover.shape)
        mask = np.clip((cover - 0.5) * 3.0 + 0.5, 0.0, 1.0)
        # Walls do not light bodies that touch them.
        mask = mask[:height, :width].reshape(height // step, step, width // step, step).mean(axis=(1, 3))
        body = soft(self._continued(mask, step), SOFT * self.view.size[1] / step)
        rise, slope = np.gradient(body)
        scale = 2.5 * SOFT * self.view.size[1] / step
        lit = -(LAMP[0] * slope + LAMP[1] * rise) * scale
        return _finer(body, step, cover.shape), _finer(np.clip(lit, -1.0, 1.0), step, cover.shape)

    def _continued(self, mask: np.ndarray, step: int) -> np.ndarray:
        """Return a mask of coarse pixels, continued behind the walls."""

        def within(axis: int, size: int) -> np.ndarray:
            low = (self.scene.lower[axis] - self.grid.corner[axis]) / (self.grid.edge * step)
            high = (self.scene.upper[axis] - self.grid.corner[axis]) / (self.grid.edge * step)
            first = min(max(math.ceil(low), 0), size - 1)
            return np.clip(np.arange(size), first, min(max(math.floor(high), first + 1), size) - 1)

        return np.ascontiguousarray(mask[within(1, mask.shape[0])[:, None], within(0, mask.shape[1])])

    def _by_field(self, group: Group, frame: Frame) -> np.ndarray:
        """Return colours (h, w, 3) from the mean value of the particles around each pixel."""
        values = np.asarray(self.colors.values(frame), dtype=np.float64)[group.rows]
        known = np.isfinite(values)
        deviation = SPREAD * group.distance
        position, source = with_images(group.position, 3.0 * deviation, self.scene.lower, self.scene.upper)
        grid, step = self._coarse_grid(group)
        area = group.distance**2
        sums = [
            spread(position, area * weight[source], deviation, grid)
            for weight in (np.where(known, values, 0.0), known.astype(float), np.ones(len(values)))
        ]
        number = np.divide(sums[0], sums[1], out=np.full_like(sums[0], np.nan), where=sums[1] > 0.5 * sums[2])
        return self.colors.rgb(_finer(number, step, self.grid.shape)) / np.float32(255)

    def _grainy(self, group: Group, base: np.ndarray, depth: np.ndarray, lit: np.ndarray) -> np.ndarray:
        """Return colours (h, w, 3) of grains, each a disk of its own brightness, over a darker ground."""
        radius = max(GRAIN * group.distance, 0.6 * self.grid.edge)
        best = np.zeros(self.grid.shape[0] * self.grid.shape[1], dtype=np.int64)
        moved = group.position + JITTER * group.distance * group.hashes[:, 1:]
        for rows, nodes, away in disk_nodes(moved, radius, self.grid):
            # The nearest particle is drawn; of two equally near, the later.
            key = ((1.0 - away / radius) * 4000).astype(np.int64) + 1
            np.maximum.at(best, nodes, (key << 32) + rows)
        near = (best >> 32).astype(np.float32) / 4000.0
        bright = 1.0 + VARIETY * group.hashes[:, 0] + 0.06 * group.hashes[:, 1]
        tone = bright[best & 0xFFFFFFFF].astype(np.float32)
        ball = np.clip(0.88 + 0.22 * near, 0.0, 1.04)
        shade = np.where(best > 0, tone * ball, 0.84).reshape(self.grid.shape)
        return (shade * (1.02 + 0.10 * lit - 0.06 * depth))[..., None] * base


def _shaded(appearance: Appearance, base: np.ndarray, depth: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return the colours (h, w, 3) of a smooth body; depth is 0 at the edge and 1 within, lit 1 towards the light."""
    depth, lit = depth[..., None], lit[..., None]
    if appearance.name.startswith("lava"):
        return (
            CRUST
            + np.clip(1.8 * depth, 0.0, 1.0) * (base - CRUST)
            + np.clip(1.6 * depth - 0.6, 0.0, 0.75) * (HOT - base)
        )
    rim, pale, rise, deep, shine, shade = LOOKS.get(appearance.finish, LOOKS["matte"])
    edge = rim * base + pale * (1.0 - base)
    color = edge + np.clip(rise * depth, 0.0, 1.0) * (np.float32(deep) * base - edge)
    color += shine * np.maximum(lit, 0.0) * (1.0 - color)
    return color + np.maximum(-lit, 0.0) * (np.float32(shade) - 1.0) * color


def _within(places: np.ndarray, low: float, high: float, edge: float) -> np.ndarray:
    """Return the fraction of pixels at `places` (n,), m, between low and high."""
    return np.clip(np.minimum((places - low) / edge, (high - places) / edge) + 0.5, 0.0, 1.0).astype(np.float32)


def _finer(values: np.ndarray, step: int, shape: tuple[int, int]) -> np.ndarray:
    """Interpolate values at the coarse nodes to all nodes, (h, w)."""
    if step == 1:
        return values[: shape[0], : shape[1]]
    return affine_transform(values, (1.0 / step, 1.0 / step), output_shape=shape, order=1, mode="nearest")
