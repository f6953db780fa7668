"""The surface of the liquids in a picture: where it is seen, how far away, which way it faces, and what is under it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mpmcli.render.appearance import Appearance
from mpmcli.render.hidden import hidden
from mpmcli.render.liquids.pixel_rays import plane, rays
from mpmcli.render.liquids.screen_space import NOTHING, blurred, normals, smoothed, sphere_depths, thickness
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.view import View

# Radius of the spheres of particles, in distances between particles: they overlap.
RADIUS = 0.9
# What is within this of a particle is liquid, however far it is from the next: a drop.
CORE = 0.5
# Particles within this of a wall are mirrored in it.
MIRRORED = 1.2
# Standard deviations, in distances between particles: of the smoothing of the depth, the outline, the thickness and
# the normals.
SMOOTHING, OUTLINE, SPREAD, SOFTNESS = 2.2, 1.1, 1.2, 0.4
# The widest that any of them may be, pixels.
WIDEST = 60.0
# The largest sphere that is drawn as it is, pixels; larger ones, which are smoothed over as much, are drawn coarsely.
LARGEST = 24.0


@dataclass(frozen=True)
class Liquid:
    """The particles of one liquid.

    Attributes:
        appearance: of its material.
        distance: between neighbours at the start, m.
        position: (n, 3), m.
        pixels: (n, 3), from the left and from the top, and the distance from the camera, m.
        scale: (n,) pixels to the metre.
        volume: (n,) of each particle at rest, m^3.
    """

    appearance: Appearance
    distance: float
    position: np.ndarray
    pixels: np.ndarray
    scale: np.ndarray
    volume: np.ndarray

    @property
    def size(self) -> float:
        """Pixels from one particle to the next, in the middle of them."""
        return self.distance * float(np.median(self.scale))

    def reach(self) -> float:
        """Pixels around a particle in which it leaves a trace."""
        return min((RADIUS + 2) * self.distance * float(self.scale.max()) + 3, 2 * WIDEST)


@dataclass(frozen=True)
class Window:
    """The part of the picture that the liquids are in; it may stand out over the edges of the picture."""

    left: int
    top: int
    columns: int
    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    def inner(self, size: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return where it lies in a picture of a size (width, height), and which part of it does."""
        low = max(self.top, 0), max(self.left, 0)
        high = min(self.top + self.rows, size[1]), min(self.left + self.columns, size[0])
        part = slice(low[0] - self.top, high[0] - self.top), slice(low[1] - self.left, high[1] - self.left)
        return (slice(low[0], high[0]), slice(low[1], high[1])), part


@dataclass(frozen=True)
class Surface:
    """What is seen of the liquids in a window; directions are those of the camera: right, up, towards the viewer.

    Attributes:
        window: of the picture.
        alpha: (h, w) share of each pixel that they cover.
        depth: (h, w) distance, m; it means something where `alpha` is above 0.
        owner: (h, w) which liquid it is.
        normal: (h, w, 3).
        hollow: (h, w) from -1 of a ridge to 1 of a crease, about.
    """

    window: Window
    alpha: np.ndarray
    depth: np.ndarray
    owner: np.ndarray
    normal: np.ndarray
    hollow: np.ndarray


def window_of(liquids: Sequence[Liquid], view: View) -> Window | None:
    """Return the box around what can be seen of the liquids; None when nothing can."""
    reaches = [liquid.reach() for liquid in liquids]
    if not reaches:
        return None
    margin = int(np.ceil(max(reaches)))
    low = np.min([liquid.pixels[:, :2].min(axis=0) - reach for liquid, reach in zip(liquids, reaches, strict=True)], 0)
    high = np.max([liquid.pixels[:, :2].max(axis=0) + reach for liquid, reach in zip(liquids, reaches, strict=True)], 0)
    low = np.maximum(np.floor(low), -margin)
    high = np.minimum(np.ceil(high), np.array(view.size) + margin)
    if (high <= 0).any() or (low >= view.size).any():
        return None
    left, top, right, bottom = (int(number) for number in (*low, *high))
    return Window(left, top, right - left, bottom - top)


def surface_of(liquids: Sequence[Liquid], window: Window, view: View, scene: RenderScene) -> Surface:
    """Find the surface of the liquids, all of them as one body."""
    inside = all(_is_inside(liquid, scene) for liquid in liquids)
    whole = [_mirrored(liquid, view, scene) if inside else liquid for liquid in liquids]
    depth, owner, core = _nearest([_moved(liquid, window) for liquid in whole], window)
    entry, exit_ = _passage(window, view, scene) if inside else (None, None)
    if exit_ is not None:
        beyond = depth > exit_
        depth[beyond] = NOTHING
        core &= ~beyond
    known = depth < NOTHING
    distance = max(liquid.distance for liquid in liquids)
    scale = scale_at(view, np.where(known, depth, view.distance))
    depth = smoothed(depth, np.minimum(SMOOTHING * distance * scale, WIDEST), RADIUS * distance)
    if entry is not None:
        # The walls hold the liquid: its spheres do not stand out of the domain.
        depth = np.where(known & (entry < NOTHING), np.maximum(depth, entry), depth)
    size = min(max(liquid.size for liquid in liquids), WIDEST)
    soft = max(OUTLINE * size, 0.4)
    cover = blurred(known.astype(np.float32), soft)
    # A straight edge, blurred, falls by 1 / (sqrt(2 pi) soft) to the pixel: this makes it one pixel wide again.
    alpha = np.clip((cover - 0.5) * np.float32(2.5 * soft) + 0.5, 0, 1)
    alpha = np.maximum(alpha, blurred(core.astype(np.float32), 0.5))
    if entry is not None:
        alpha *= blurred((entry < NOTHING).astype(np.float32), 0.5)
    gap = (alpha > 0) & ~known
    if gap.any():
        filled = blurred(np.where(known, depth, 0), soft) / np.maximum(cover, 1e-6)
        depth = np.where(gap, filled, depth)
    across, up = plane(view, window.left, window.top, *window.shape)
    ahead = 1.0 if view.parallel else depth
    points = np.stack(np.broadcast_arrays(across * ahead, up * ahead, -depth), axis=-1).astype(np.float32)
    normal = _softened(normals(points, known), known, max(SOFTNESS * size, 0.5))
    return Surface(window, alpha, depth, owner, normal, _hollow(normal, alpha > 0, size))


def layers_of(
    liquids: Sequence[Liquid], window: Window, wall: np.ndarray, samples: int, shape: tuple[int, int]
) -> list[np.ndarray]:
    """Return how thick each liquid is along each pixel of the window, (h, w), m, up to what is solid.

    Args:
        wall: distance of what is solid, in `samples` by `samples` points to each pixel of a picture of a shape, m.
        shape: rows and columns.
    """
    rows, columns = (samples * count for count in shape)
    layers = []
    for liquid in liquids:
        column, row = np.floor(liquid.pixels[:, :2] * samples).astype(np.int64).T
        before = liquid.pixels[:, 2] < wall[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        spread = min(max(SPREAD * liquid.size, 0.5), WIDEST)
        local = _moved(liquid, window)
        layers.append(thickness(local.pixels, np.where(before, liquid.volume, 0), liquid.scale, spread, window.shape))
    return layers


def scale_at(view: View, distance: np.ndarray) -> np.ndarray:
    """Return pixels to the metre at distances from the camera, m."""
    if view.parallel:
        return np.full(np.shape(distance), view.pixels_per_metre)
    return view.pixels_per_metre * view.distance / distance


def _moved(liquid: Liquid, window: Window) -> Liquid:
    """Count pixels from the corner of a window."""
    return replace(liquid, pixels=liquid.pixels - np.array([window.left, window.top, 0.0]))


def _nearest(liquids: Sequence[Liquid], window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth of the nearest sphere, m, which liquid it is of, and where the cores are."""
    depth = np.full(window.shape, NOTHING, np.float32)
    owner = np.zeros(window.shape, np.int8)
    core = np.zeros(window.shape, bool)
    for k, liquid in enumerate(liquids):
        radius = RADIUS * liquid.distance
        seen = ~hidden(liquid.pixels, max(liquid.size, 2.0), 2 * radius)
        pixels, scale = liquid.pixels[seen], liquid.scale[seen]
        near = _spheres(pixels, scale, radius, window.shape)
        core |= _spheres(pixels, scale, CORE * liquid.distance, window.shape) < NOTHING
        owner[near < depth] = k
        depth = np.minimum(depth, near)
    return depth, owner, core


def _spheres(pixels: np.ndarray, scale: np.ndarray, radius: float, shape: tuple[int, int]) -> np.ndarray:
    """Return `sphere_depths`, worked out for squares of pixels where the spheres are large."""
    side = int(np.ceil(radius * float(scale.max()) / LARGEST)) if len(scale) else 1
    if side <= 1:
        return sphere_depths(pixels, scale, radius, shape)
    rows, columns = shape
    coarse = sphere_depths(pixels / (side, side, 1), scale / side, radius, (-(-rows // side), -(-columns // side)))
    return np.repeat(np.repeat(coarse, side, axis=0), side, axis=1)[:rows, :columns]


def _is_inside(liquid: Liquid, scene: RenderScene) -> bool:
    slack = 0.3 * liquid.distance
    low, high = np.array(scene.lower) - slack, np.array(scene.upper) + slack
    return bool(((liquid.position >= low) & (liquid.position <= high)).all())


def _mirrored(liquid: Liquid, view: View, scene: RenderScene) -> Liquid:
    """Add the mirror images of the particles at the walls: the surface then meets a wall without a gap or a dent."""
    images = []
    for axis in range(3):
        for wall in (scene.lower[axis], scene.upper[axis]):
            near = np.abs(liquid.position[:, axis] - wall) < MIRRORED * liquid.distance
            image = liquid.position[near]
            image[:, axis] = 2 * wall - image[:, axis]
            images.append(image)
    added = np.concatenate(images)
    pixels = view.pixels(added)
    front = pixels[:, 2] > max(view.near, liquid.distance)
    added, pixels = added[front], pixels[front]
    return replace(
        liquid,
        position=np.concatenate([liquid.position, added]),
        pixels=np.concatenate([liquid.pixels, pixels]),
        scale=np.concatenate([liquid.scale, scale_at(view, pixels[:, 2])]),
    )


def _passage(window: Window, view: View, scene: RenderScene) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays of pixels enter the domain and where they leave it, m; `NOTHING` twice where they miss."""
    low, high = np.array(scene.lower), np.array(scene.upper)
    start, direction = rays(view, window.left, window.top, *window.shape)
    first, last = np.full(window.shape, -np.inf), np.full(window.shape, np.inf)
    for axis in range(3):
        along = direction[..., axis]
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        one, other = (low[axis] - start[..., axis]) / along, (high[axis] - start[..., axis]) / along
        first, last = np.maximum(first, np.minimum(one, other)), np.minimum(last, np.maximum(one, other))
    hit = first <= last
    return tuple(np.where(hit, distance, NOTHING).astype(np.float32) for distance in (first, last))


def _softened(normal: np.ndarray, known: np.ndarray, deviation: float) -> np.ndarray:
    """Return normals averaged over their surroundings, and continued a little over the edges."""
    mean = np.stack([blurred(normal[..., k] * known, deviation) for k in range(3)], axis=-1)
    length = np.sqrt(np.einsum("ijk,ijk->ij", mean, mean))[..., None]
    return np.where(length > 1e-6, mean / np.maximum(length, 1e-6), normal)


def _hollow(normal: np.ndarray, covered: np.ndarray, size: float) -> np.ndarray:
    """Return minus the divergence of the normals, times a few particles' size."""
    spread = np.zeros(covered.shape, np.float32)
    spread[:, 1:-1] += 0.5 * (normal[:, 2:, 0] - normal[:, :-2, 0])
    spread[1:-1] -= 0.5 * (normal[2:, :, 1] - normal[:-2, :, 1])
    spread = np.where(covered, np.clip(spread * np.float32(size), -1, 1), 0)
    return -2.5 * blurred(spread, max(0.9 * size, 0.5))
