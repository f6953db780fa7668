"""The surface of the liquids in a picture: coverage, depth, normals, and thickness of the liquid below it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.ndimage import gaussian_filter

from mpmcli.render.dots import hidden
from mpmcli.render.particle_grid import deposited, with_images
from mpmcli.render.render_scene import Appearance, RenderScene
from mpmcli.render.view import View

RADIUS = 0.9  # radius of the spheres of particles, in distances between particles: they overlap
CORE = 0.5  # radius of a single drop, in distances between particles
MIRRORED = 1.2  # particles closer to a wall than this are mirrored in it
# Standard deviations, in distances between particles: of the smoothing of the depth, the outline, the thickness and
# the normals.
SMOOTHING, OUTLINE, SPREAD, SOFTNESS = 2.2, 1.1, 1.2, 0.4
WIDEST = 60.0  # largest value of any of them, pixels
# The largest sphere drawn at full resolution, pixels; larger ones, which are smoothed as widely, are drawn coarsely.
LARGEST = 24.0
NOTHING = np.float32(1e9)  # depth, m, of a pixel that no liquid covers
BLOCK = 24  # rows that are smoothed together, few enough to stay in the cache
CUT = 2.0  # standard deviations at which a Gaussian is cut off
MOST_TAPS = 16  # taps to one side of a pixel; a wider filter takes wider steps instead


@dataclass(frozen=True)
class Liquid:
    """The particles of one liquid."""

    appearance: Appearance
    distance: float  # between neighbours at the start, m
    position: np.ndarray  # (n, 3), m
    pixels: np.ndarray  # (n, 3), from the left and from the top, and the distance from the camera, m
    scale: np.ndarray  # (n,) pixels to the metre
    volume: np.ndarray  # (n,) of each particle at rest, m^3

    @property
    def size(self) -> float:
        """Distance between particles in pixels, in the middle of the liquid."""
        return self.distance * float(np.median(self.scale))

    @property
    def reach(self) -> float:
        """Pixels around a particle in which it changes the picture."""
        return min((RADIUS + 2) * self.distance * float(self.scale.max()) + 3, 2 * WIDEST)


@dataclass(frozen=True)
class Window:
    """The part of the picture with liquids; it may extend beyond the edges of the picture."""

    left: int
    top: int
    columns: int
    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def middles(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres of its pixels, from the left (1, columns) and from the top (rows, 1) of the picture."""
        x = np.arange(self.left, self.left + self.columns) + 0.5
        y = np.arange(self.top, self.top + self.rows) + 0.5
        return x[None, :], y[:, None]

    def inner(self, size: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return its slices within a picture of a size (width, height), and the slices of the window itself."""
        low = max(self.top, 0), max(self.left, 0)
        high = min(self.top + self.rows, size[1]), min(self.left + self.columns, size[0])
        part = slice(low[0] - self.top, high[0] - self.top), slice(low[1] - self.left, high[1] - self.left)
        return (slice(low[0], high[0]), slice(low[1], high[1])), part


@dataclass(frozen=True)
class Surface:
    """The visible surface of the liquids in a window; directions are in camera axes: right, up, towards the viewer."""

    window: Window
    alpha: np.ndarray  # (h, w) fraction of each pixel that they cover
    depth: np.ndarray  # (h, w) distance, m; valid where `alpha` is above 0
    owner: np.ndarray  # (h, w) index of the liquid
    normal: np.ndarray  # (h, w, 3)
    hollow: np.ndarray  # (h, w) curvature, from about -1 at a ridge to 1 at a crease


def window_of(liquids: Sequence[Liquid], view: View) -> Window | None:
    """Return the box around the visible part of the liquids; None if none is visible."""
    if not liquids:
        return None
    margin = int(np.ceil(max(liquid.reach for liquid in liquids)))
    low = np.min([liquid.pixels[:, :2].min(axis=0) - liquid.reach for liquid in liquids], 0)
    high = np.max([liquid.pixels[:, :2].max(axis=0) + liquid.reach for liquid in liquids], 0)
    low = np.maximum(np.floor(low), -margin)
    high = np.minimum(np.ceil(high), np.array(view.size) + margin)
    if (high <= 0).any() or (low >= view.size).any():
        return None
    left, top, right, bottom = (int(number) for number in (*low, *high))
    return Window(left, top, right - left, bottom - top)


def surface_of(liquids: Sequence[Liquid], window: Window, view: View, scene: RenderScene) -> Surface:
    """Return the surface of the liquids, which are treated as one body."""
    low, high = np.array(scene.lower), np.array(scene.upper)
    slack = [(liquid.position, 0.3 * liquid.distance) for liquid in liquids]
    inside = all(((x >= low - more) & (x <= high + more)).all() for x, more in slack)
    whole = [_mirrored(liquid, view, scene) if inside else liquid for liquid in liquids]
    depth, owner, core = _nearest([_moved(liquid, window) for liquid in whole], window)
    size = min(max(liquid.size for liquid in liquids), WIDEST)
    soft = max(OUTLINE * size, 0.4)
    at_wall = np.zeros(window.shape, bool)
    if inside:
        entry, exit_, facing = _passage(window, view, scene)
        beyond = depth > exit_
        depth[beyond] = NOTHING
        core &= ~beyond
        # The walls bound the liquid, whose spheres extend beyond the domain.
        at_wall = (blurred(((depth < entry) & (entry < NOTHING)).astype(np.float32), soft) > 0.5) & (depth < NOTHING)
    known = depth < NOTHING
    free = known & ~at_wall
    distance = max(liquid.distance for liquid in liquids)
    scale = view.scale_at(np.where(known, depth, view.distance))
    depth[at_wall] = NOTHING
    depth = smoothed(depth, np.minimum(SMOOTHING * distance * scale, WIDEST), RADIUS * distance)
    if inside:
        depth = np.where(at_wall, entry, np.where(free & (entry < NOTHING), np.maximum(depth, entry), depth))
    cover = blurred(known.astype(np.float32), soft)
    # A straight edge, blurred, falls by 1 / (sqrt(2 pi) soft) to the pixel: this makes it one pixel wide again.
    alpha = np.clip((cover - 0.5) * np.float32(2.5 * soft) + 0.5, 0, 1)
    alpha = np.maximum(alpha, blurred(core.astype(np.float32), 0.5))
    if inside:
        alpha *= blurred((entry < NOTHING).astype(np.float32), 0.5)
    gap = (alpha > 0) & ~known
    if gap.any():
        filled = blurred(np.where(known, depth, 0), soft) / np.maximum(cover, 1e-6)
        depth = np.where(gap, filled, depth)
    across, up = view.plane(*window.middles)
    ahead = 1.0 if view.parallel else depth
    points = np.stack(np.broadcast_arrays(across * ahead, up * ahead, -depth), axis=-1).astype(np.float32)
    normal = normals(points, free)
    if at_wall.any():
        normal[at_wall] = facing[at_wall]
    # Averaged over the surroundings, and continued slightly beyond the edges.
    mean = np.stack([blurred(normal[..., k] * known, max(SOFTNESS * size, 0.5)) for k in range(3)], axis=-1)
    length = np.sqrt(np.einsum("ijk,ijk->ij", mean, mean))[..., None]
    normal = np.where(length > 1e-6, mean / np.maximum(length, 1e-6), normal)
    return Surface(window, alpha, depth, owner, normal, _hollow(normal, alpha > 0, size))


def layers_of(liquids: Sequence[Liquid], window: Window, wall: np.ndarray, samples: int) -> list[np.ndarray]:
    """Return the thickness of each liquid along the ray of each pixel of the window, (h, w), m, up to solid objects.

    The `wall` is the distance of solid objects, m, at `samples` by `samples` points per pixel of the picture.
    """
    rows, columns = wall.shape
    layers = []
    for liquid in liquids:
        column, row = np.floor(liquid.pixels[:, :2] * samples).astype(np.int64).T
        before = liquid.pixels[:, 2] < wall[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        spread = min(max(SPREAD * liquid.size, 0.5), WIDEST)
        local = _moved(liquid, window)
        layers.append(thickness(local.pixels, np.where(before, liquid.volume, 0), liquid.scale, spread, window.shape))
    return layers


def _moved(liquid: Liquid, window: Window) -> Liquid:
    return replace(liquid, pixels=liquid.pixels - np.array([window.left, window.top, 0.0]))


def _nearest(liquids: Sequence[Liquid], window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth of the nearest sphere, m, the index of its liquid, and the pixels of the cores."""
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
    """Return `sphere_depths`, computed for squares of pixels if the spheres are large."""
    side = int(np.ceil(radius * float(scale.max()) / LARGEST)) if len(scale) else 1
    if side <= 1:
        return sphere_depths(pixels, scale, radius, shape)
    rows, columns = shape
    coarse = sphere_depths(pixels / (side, side, 1), scale / side, radius, (-(-rows // side), -(-columns // side)))
    return np.repeat(np.repeat(coarse, side, axis=0), side, axis=1)[:rows, :columns]


def _mirrored(liquid: Liquid, view: View, scene: RenderScene) -> Liquid:
    """Add the mirror images of the particles at the walls, so that the surface meets a wall without a gap or a dent."""
    position, _ = with_images(liquid.position, MIRRORED * liquid.distance, scene.lower, scene.upper)
    pixels = view.pixels(position)
    front = pixels[:, 2] > max(view.near, liquid.distance)
    pixels = pixels[front]
    return replace(liquid, position=position[front], pixels=pixels, scale=view.scale_at(pixels[:, 2]))


def _passage(window: Window, view: View, scene: RenderScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distances at which the rays of pixels enter and leave the domain, m; `NOTHING` twice if they miss it.

    The last array (h, w, 3) has the normals of the faces through which they enter, in camera axes.
    """
    start, direction = view.rays(*window.middles)
    ends = np.array([scene.lower, scene.upper])[:, None, None] - start
    ends /= np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    first, last = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    hit = first <= last
    entered = ends.min(axis=0).argmax(axis=-1)
    outwards = -np.sign(np.take_along_axis(direction, entered[..., None], -1)) * view.axes.T[entered]
    return *(np.where(hit, distance, NOTHING).astype(np.float32) for distance in (first, last)), outwards


def _hollow(normal: np.ndarray, covered: np.ndarray, size: float) -> np.ndarray:
    """Return minus the divergence of the normals, times the size of a few particles."""
    spread = np.zeros(covered.shape, np.float32)
    spread[:, 1:-1] += 0.5 * (normal[:, 2:, 0] - normal[:, :-2, 0])
    spread[1:-1] -= 0.5 * (normal[2:, :, 1] - normal[:-2, :, 1])
    spread = np.where(covered, np.clip(spread * np.float32(size), -1, 1), 0)
    return -2.5 * blurred(spread, max(0.9 * size, 0.5))


def sphere_depths(pixels: np.ndarray, scale: np.ndarray, radius: float, shape: tuple[int, int]) -> np.ndarray:
    """Return the distance of the nearest sphere in every pixel, (h, w) float32, m; `NOTHING` if there is none.

    The centres (n, 3) are pixels from the left and from the top, and the distance, m; `scale` is the pixels per metre
    there. Each sphere is projected in parallel: a disc with the depth of the half sphere.
    """
    rows, columns = shape
    reach = radius * scale
    span = int(np.ceil(reach.max())) if len(reach) else 0
    # A sphere whose centre is outside by its radius may extend as far again.
    border = 2 * span + 1
    width = columns + 2 * border
    buffer = np.full((rows + 2 * border) * width, NOTHING, dtype=np.float32)
    column, row = np.floor(pixels[:, 0]).astype(np.int64), np.floor(pixels[:, 1]).astype(np.int64)
    inside = (column >= -span) & (column < columns + span) & (row >= -span) & (row < rows + span)
    column, row, pixels, reach = column[inside], row[inside], pixels[inside], reach[inside]
    home = (row + border) * width + column + border
    # A sphere smaller than a pixel is still drawn in the pixel of its centre.
    flat = (1.0 / np.maximum(reach, 0.75) ** 2).astype(np.float32)
    right, down = (pixels[:, 0] - column).astype(np.float32), (pixels[:, 1] - row).astype(np.float32)
    depth, radius = pixels[:, 2].astype(np.float32), np.float32(radius)
    across = [(np.float32(k + 0.5) - right) ** 2 * flat for k in range(-span, span + 1)]
    for drop in range(-span, span + 1):
        rest = 1 - (np.float32(drop + 0.5) - down) ** 2 * flat
        for shift in range(-span, span + 1):
            if np.hypot(max(abs(drop) - 1, 0), max(abs(shift) - 1, 0)) > span:
                continue
            bulge = rest - across[shift + span]
            hit = np.flatnonzero(bulge > 0)
            np.minimum.at(buffer, home[hit] + (drop * width + shift), depth[hit] - radius * np.sqrt(bulge[hit]))
    return buffer.reshape(-1, width)[border : border + rows, border : border + columns].copy()


def smoothed(depth: np.ndarray, deviation: np.ndarray, radius: float) -> np.ndarray:
    """Return a depth image (h, w), m, without the bumps of single particles and with unchanged edges.

    The narrow-range filter is applied along the rows, then along the columns: a Gaussian, of a deviation in pixels. A
    neighbour counts with its depth if that is within a range of the pixel's own, which grows with the depths included;
    as lying `radius` behind if it is farther back; and not at all, nor its mirror image, if it is in front.

    Source: N. Truong and C. Yuksel, "A narrow-range filter for screen-space fluid rendering", Proc. ACM Comput.
    Graph. Interact. Tech. 1 (2018), 17, section 4.
    """
    decay = (0.5 / np.maximum(deviation, 0.3) ** 2).astype(np.float32)
    covered = depth < NOTHING
    widest = float(deviation[covered].max()) if covered.any() else 0.0
    reach = int(np.ceil(CUT * widest))
    stride = max(1, int(np.ceil(reach / MOST_TAPS)))
    for step in (stride, stride, 1) if stride > 1 else (1, 1):
        taps = min(reach // step, MOST_TAPS)
        for _ in range(2):
            # Along the rows, then along the columns.
            depth = np.ascontiguousarray(_along_rows(depth, decay, radius, taps, step).T)
            decay = np.ascontiguousarray(decay.T)
    return _cleaned(depth, radius) if widest > 1 else depth


def _cleaned(depth: np.ndarray, radius: float) -> np.ndarray:
    """Remove the streaks of the one-dimensional filters by a filter of five by five pixels."""
    rows, columns = depth.shape
    padded = np.pad(depth, 2, constant_values=NOTHING)
    total, weight = np.zeros_like(depth), np.ones_like(depth)
    for i, j in product(range(-2, 3), repeat=2):
        difference = padded[2 + i : 2 + i + rows, 2 + j : 2 + j + columns] - depth
        share = np.float32(np.exp(-(i * i + j * j) / 6)) * (np.abs(difference) < np.float32(2 * radius))
        total += share * difference
        weight += share * (i != 0 or j != 0)
    return np.where(depth < NOTHING, depth + total / weight, depth)


def _along_rows(depth: np.ndarray, decay: np.ndarray, radius: float, taps: int, step: int) -> np.ndarray:
    """Filter along the rows, only where there is liquid."""
    reach = taps * step
    result = depth.copy()
    padded = np.pad(depth, ((0, 0), (reach, reach)), constant_values=NOTHING)
    for top in range(0, len(depth), BLOCK):
        rows = slice(top, top + BLOCK)
        used = np.flatnonzero((depth[rows] < NOTHING).any(axis=0))
        if len(used):
            columns = slice(used[0], used[-1] + 1)
            part = padded[rows, used[0] : used[-1] + 1 + 2 * reach]
            moved = _narrow_range(part, decay[rows, columns], np.float32(radius), taps, step)
            np.copyto(result[rows, columns], moved, where=depth[rows, columns] < NOTHING)
    return result


def _narrow_range(part: np.ndarray, decay: np.ndarray, radius: np.float32, taps: int, step: int) -> np.ndarray:
    """Return the depths of a part, without its margins, smoothed along rows by a Gaussian that ends at jumps."""
    reach, columns = taps * step, decay.shape[1]
    centre = part[:, reach : reach + columns]
    range_ = 4 * radius
    nearest, farthest = centre - range_, centre + range_
    behind = centre + radius
    total, weight = np.zeros_like(centre), np.ones_like(centre)
    # exp(-k^2 a) by recurrence: the ratio of neighbouring values is exp(-(2 k + 1) a), itself a geometric sequence.
    ratio = np.exp(-decay * np.float32(step * step))
    square = ratio * ratio
    gauss = np.ones_like(centre)
    for tap in range(1, taps + 1):
        gauss *= ratio
        ratio *= square
        shift = tap * step
        before = part[:, reach - shift : reach - shift + columns]
        after = part[:, reach + shift : reach + shift + columns]
        low, high = np.minimum(before, after), np.maximum(before, after)
        fits = low > nearest
        share = gauss * fits
        low_seen, high_seen = low < farthest, high < farthest
        low, high = np.where(low_seen, low, behind), np.where(high_seen, high, behind)
        total += share * ((low - centre) + (high - centre))
        weight += 2 * share
        np.minimum(nearest, low - range_, out=nearest, where=fits)
        np.maximum(farthest, high + range_, out=farthest, where=fits & high_seen)
        np.maximum(farthest, low + range_, out=farthest, where=fits & low_seen)
    return centre + total / weight


def blurred(image: np.ndarray, deviation: float) -> np.ndarray:
    """Return an image (h, w) blurred by a Gaussian, pixels; its sum is kept except for losses over the edges."""
    return gaussian_filter(image, deviation, mode="constant", truncate=3.0)


def thickness(
    pixels: np.ndarray, volumes: np.ndarray, scale: np.ndarray, deviation: float, shape: tuple[int, int]
) -> np.ndarray:
    """Return (h, w) float32, m: the volume of the particles in every pixel over the area of the pixel at their depth.

    In parallel projection its sum over a picture, times the area of a pixel, is the volume of the particles. Each
    particle is spread by a Gaussian of a deviation in pixels.
    """
    return blurred(deposited(pixels[:, :2] - 0.5, volumes * scale**2, shape).astype(np.float32), deviation)


def normals(points: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return unit normals (h, w, 3) of a surface, towards the viewer, who looks along the negative third axis.

    In each direction the difference to the neighbour with the smaller jump of depth is used, so that edges stay sharp.
    Points (h, w, 3) are in camera axes: to the right, up and towards the viewer, m; `covered` marks the surface.
    """
    across, down = (_smaller_step(points, covered, axis) for axis in (1, 0))
    # Rows run downwards.
    normal = np.cross(down, across)
    length = np.sqrt(np.einsum("ijk,ijk->ij", normal, normal))
    flat = ~(length > 0)
    normal /= np.where(flat, 1, length)[..., None]
    normal[flat] = (0.0, 0.0, 1.0)
    return normal


def _smaller_step(points: np.ndarray, covered: np.ndarray, axis: int) -> np.ndarray:
    """Return for each pixel the step to one neighbour along an axis, that of the smaller change of depth."""
    step = np.diff(points, axis=axis)
    pixel = float(np.median(np.abs(step[..., 1 - axis][step[..., 1 - axis] != 0]))) if step.any() else 0.0
    pair = covered[1:] & covered[:-1] if axis == 0 else covered[:, 1:] & covered[:, :-1]
    size = np.where(pair, np.abs(step[..., 2]), np.inf)
    step = np.where(pair[..., None], step, 0)
    ahead, back = ([(0, 0)] * axis + [end] + [(0, 0)] * (2 - axis) for end in ((0, 1), (1, 0)))
    steps = [np.pad(step, ends) for ends in (ahead, back)]
    sizes = [np.pad(size, ends[:2], constant_values=np.inf) for ends in (ahead, back)]
    smaller = np.where((sizes[0] < sizes[1])[..., None], *steps)
    # If neither is an edge, their mean is one order more accurate.
    low, high = np.minimum(*sizes), np.maximum(*sizes)
    alike = np.isfinite(high) & (high <= 2 * low + np.float32(0.5) * pixel)
    return np.where(alike[..., None], np.float32(0.5) * (steps[0] + steps[1]), smaller)
