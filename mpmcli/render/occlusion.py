"""Occlusion: the fraction of the lamp's and of the sky's light that reaches a point past the particles.

Found on a coarse grid over the domain. VTK's SSAO was compared with it: it casts no
shadows, takes six times as long or more, and is not reproducible.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.render.particle_grid import blurred_along
from mpmcli.render.render_scene import Finish, Group, RenderScene
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import View

# How much of the light that falls on it a finish holds back from what is below: 1 is a full shadow.
OPACITY: dict[Finish, float] = {"water": 0.22, "syrup": 0.55, "translucent": 0.6}
CELLS_LONG, CELLS = 88, 140_000  # cells along the longest side of the domain, and in all
REACH = 0.7  # share of the height of the domain by which shadows may fall beside it
DEPTH_OF_CELL = 1.1  # optical depth of a cell that is filled by what is wholly opaque
# Directions of the sky's light: (tangent of the angle to the vertical, how many, weight).
SKY_RINGS = ((0.0, 1, 1.0), (0.8, 5, 0.8))
# Share of the light of a cell that spreads to its neighbours from layer to layer: the lamp and the sky are no points.
LAMP_SPREAD, SKY_SPREAD = 0.35, 1.0
LIFT = 1.4  # cells above a surface at which its light is looked up, so that it does not stand in its own shade
FADE = 0.55  # distance from the domain over which the floor fades into the gradient, in longest sides of the domain
LAMP_SHARE = 0.5  # share of the floor's light that comes from the lamp; the rest comes from the sky
STEP = 2  # pixels between which the floor is worked out, and interpolated


@dataclass(frozen=True)
class Occlusion:
    """Shares of light that arrive, on a grid (a, b, c): two level axes and the one against gravity."""

    lamp: np.ndarray  # (a, b, c) float32 from 0 to 1, in the middle of the cells; `sky` alike
    sky: np.ndarray
    floor_lamp: np.ndarray  # (a, b) on the floor of the domain; `floor_sky` alike
    floor_sky: np.ndarray
    axes: tuple[int, int, int]  # of the scene, that the axes of the grid are
    flip: bool  # whether up is against the last of them
    corner: np.ndarray  # of the grid, in the coordinates of the grid (after the flip), (3,), m
    edge: float  # of a cell, m

    def at(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the shares (n,) of the lamp's and of the sky's light at points (n, 3) with normals (n, 3)."""
        cells = (_local(points + (LIFT * self.edge) * normals, self.axes, self.flip) - self.corner) / self.edge - 0.5
        return _trilinear(self.lamp, cells), _trilinear(self.sky, cells)

    def on_floor(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same of points (n, 3) on the floor; what lies beside the grid is in the light."""
        cells = ((_local(points, self.axes, self.flip) - self.corner) / self.edge)[:, :2] - 0.5
        size = np.array(self.floor_lamp.shape)
        # Fades out over the last cells, so that no edge shows.
        inside = np.clip(np.minimum(cells, size - 1.0 - cells).min(axis=1) / 4.0, 0.0, 1.0)
        level = np.concatenate([cells, np.zeros_like(cells[:, :1])], axis=1)
        lamp, sky = (_trilinear(plane[:, :, None], level) for plane in (self.floor_lamp, self.floor_sky))
        return 1.0 - inside * (1.0 - lamp), 1.0 - inside * (1.0 - sky)


def _local(points: np.ndarray, axes: tuple[int, int, int], flip: bool) -> np.ndarray:
    local = points[:, list(axes)].astype(np.float32)
    if flip:
        local[:, 2] *= -1.0
    return local


def occlusion_of(
    scene: RenderScene, position: np.ndarray, volumes: np.ndarray, opacity: np.ndarray, lamp: np.ndarray
) -> Occlusion:
    """Cast light through particles, layer by layer from the top.

    Light comes to a cell from the layer above it, slantwise, and loses what fills that layer by the law of Beer and
    Lambert. Particles have positions (n, 3), m, volumes (n,), m^3, and opacities (n,) from 0, clear, to 1; `lamp` is
    the direction (3,) towards the lamp, above the horizon.
    """
    axis = int(np.argmax(np.abs(scene.up)))
    axes = (*(i for i in range(3) if i != axis), axis)
    flip = scene.up[axis] < 0
    ends = np.array([scene.lower, scene.upper])[:, list(axes)]
    if flip:
        ends[:, 2] = -ends[::-1, 2]
    low, size = ends[0], ends[1] - ends[0]
    edge = max(float(size.max()) / CELLS_LONG, float((size.prod() / CELLS) ** (1 / 3)))
    pad = np.array([1, 1, 0]) * (math.ceil(REACH * size[2] / edge) + 2)
    shape = tuple((np.ceil(size / edge - 1e-9).astype(int) + 2 * pad).tolist())
    corner = low - edge * pad
    cells = np.floor((_local(position, axes, flip) - corner) / edge).astype(int)
    flat = np.ravel_multi_index(tuple(np.clip(cells, 0, np.array(shape) - 1).T), shape)
    depth = np.bincount(flat, volumes * opacity, math.prod(shape)).reshape(shape).astype(np.float32)
    depth *= DEPTH_OF_CELL / edge**3
    for k in range(3):
        depth = blurred_along(depth, k)
    toward = _local(lamp[None], axes, flip)[0]
    slope = toward[:2] / max(float(toward[2]), 0.3)
    lamp_share, floor_lamp = _swept(depth, [(slope, 1.0)], LAMP_SPREAD)
    rings = []
    for slant, count, weight in SKY_RINGS:
        turns = [2 * math.pi * (k + 0.25) / count for k in range(count)]
        rings += [(slant * np.array([math.cos(turn), math.sin(turn)]), weight) for turn in turns]
    sky_share, floor_sky = _swept(depth, rings, SKY_SPREAD)
    return Occlusion(lamp_share, sky_share, floor_lamp, floor_sky, axes, flip, corner, edge)


def occlusion_by(
    scene: RenderScene, groups: Sequence[Group], lamp: np.ndarray, shades: Sequence[tuple[np.ndarray, np.ndarray]] = ()
) -> Occlusion | None:
    """Return what groups, and opaque shades (places (n, 3), volumes (n,)), take of a lamp's light; None without."""
    if not groups and not shades:
        return None
    counts = [len(group.position) for group in groups] + [len(places) for places, _ in shades]
    opacities = [OPACITY.get(group.appearance.finish, 1.0) for group in groups] + [1.0] * len(shades)
    cells = [np.full(len(group.position), group.distance**3) for group in groups]
    volumes = np.concatenate([*cells, *(volumes for _, volumes in shades)])
    places = np.concatenate([*(group.position for group in groups), *(places for places, _ in shades)])
    return occlusion_of(scene, places, volumes, np.repeat(opacities, counts), lamp)


def _swept(depth: np.ndarray, beams: list[tuple[np.ndarray, float]], spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what arrives in the cells (a, b, c) and on the floor (a, b), the mean over beams (slope (2,), weight)."""
    layers = np.ascontiguousarray(np.moveaxis(depth, 2, 0))
    arrived, floor = np.zeros_like(layers), np.zeros_like(layers[0])
    total = sum(weight for _, weight in beams)
    for slope, weight in beams:
        passed = np.exp(-layers * math.sqrt(1.0 + float(slope @ slope)))
        light = np.ones_like(floor)
        for k in range(len(layers) - 1, -1, -1):
            arrived[k] += (weight / total) * light
            light = _shifted(light * passed[k], slope)
            for axis in range(2):
                light += spread * (blurred_along(light, axis) - light)
        floor += (weight / total) * light
    return np.moveaxis(arrived, 0, 2), floor


def _shifted(plane: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return a plane (a, b) looked up at x + slope, in cells, linear between them and 1 beside it."""
    for axis in range(2):
        whole = math.floor(slope[axis])
        part = float(slope[axis]) - whole
        plane = (1.0 - part) * _moved(plane, whole, axis) + part * _moved(plane, whole + 1, axis)
    return plane


def _moved(plane: np.ndarray, count: int, axis: int) -> np.ndarray:
    plane = np.moveaxis(plane, axis, 0)
    moved, length = np.ones_like(plane), len(plane)
    if abs(count) < length:
        ahead, back = max(count, 0), max(-count, 0)
        moved[back : length - ahead] = plane[ahead : length - back]
    return np.moveaxis(moved, 0, axis)


def _trilinear(grid: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return values (n,) of a grid (a, b, c) at fractional indices (n, 3), which are held inside."""
    size = np.array(grid.shape)
    cells = np.clip(cells, 0.0, size - 1.0)
    base = np.minimum(cells.astype(np.int64), np.maximum(size - 2, 0))
    part = (cells - base).astype(np.float32)
    flat, steps = grid.reshape(-1), (size[1] * size[2], size[2], 1)
    start = base @ np.array(steps)
    result = np.zeros(len(cells), dtype=np.float32)
    for corner in range(8):
        picks = [corner >> k & 1 for k in range(3)]
        if any(pick and size[k] == 1 for k, pick in enumerate(picks)):
            continue
        weight = np.ones(len(cells), dtype=np.float32)
        for k, pick in enumerate(picks):
            weight *= part[:, k] if pick else 1.0 - part[:, k]
        result += weight * flat[start + sum(pick * step for pick, step in zip(picks, steps, strict=True))]
    return result


class Background:
    """A gradient, brighter below than above, and a floor that is found once, with the shadows of every frame on it."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme) -> None:
        self.view, self.theme = view, theme
        width, height = view.size
        down = np.linspace(0.0, 1.0, height)[:, None]
        ease = down * down * (3.0 - 2.0 * down)
        column = (1.0 - ease) * np.array(rgb(theme.sky)) + ease * np.array(rgb(theme.horizon))
        self.gradient = np.broadcast_to(column[:, None], (height, width, 3)).astype(np.float32)
        # Coarse nodes that span the picture, corners included.
        self.nodes = (-(-height // STEP) + 1, -(-width // STEP) + 1)
        rows, columns = np.meshgrid(*(np.arange(n) * STEP for n in self.nodes), indexing="ij")
        points, hit = _on_floor(scene, view, columns.ravel() + 0.5, rows.ravel() + 0.5)
        beside = np.maximum(np.array(scene.lower) - points, points - np.array(scene.upper))
        beside[:, int(np.argmax(np.abs(scene.up)))] = 0.0
        away = np.linalg.norm(np.maximum(beside, 0.0), axis=1)
        side = max(np.subtract(scene.upper, scene.lower))
        self.share = np.where(hit, np.exp(-((away / (FADE * side)) ** 2)), 0.0).astype(np.float32)
        # Contributions below a visible difference are skipped.
        self.seen = np.flatnonzero(self.share > 1e-3)
        self.points = points[self.seen]

    def image(self, occlusion: Occlusion | None) -> np.ndarray:
        """Return (h, w, 3) uint8, with the shadows that are cast, if any."""
        if not len(self.seen):
            return (255.0 * self.gradient + 0.5).astype(np.uint8)
        light = np.ones(len(self.share), dtype=np.float32)
        if occlusion is not None:
            lamp, sky = occlusion.on_floor(self.points)
            light[self.seen] = LAMP_SHARE * lamp + (1.0 - LAMP_SHARE) * sky
        # Interpolated in two parts: how much of the floor shows, and how bright it is.
        share, light = (self._spread(values) for values in (self.share, light))
        floor = np.array(rgb(self.theme.floor), dtype=np.float32)
        # Shadows are taken in light as the eye counts it, and are never black.
        bright = np.maximum(light, 0.0) ** 0.7 * 0.82 + 0.18
        image = self.gradient + share[..., None] * (floor * bright[..., None] - self.gradient)
        return (255.0 * np.clip(image, 0.0, 1.0) + 0.5).astype(np.uint8)

    def _spread(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values at the nodes to all pixels, (h, w)."""
        coarse = values.reshape(self.nodes)
        width, height = self.view.size
        for _ in range(2):
            # Along the rows, then along the columns.
            fine = np.empty((STEP * (len(coarse) - 1), coarse.shape[1]), dtype=np.float32)
            for k in range(STEP):
                fine[k::STEP] = (1.0 - k / STEP) * coarse[:-1] + (k / STEP) * coarse[1:]
            coarse = np.ascontiguousarray(fine.T)
        return coarse[:height, :width]


def _on_floor(scene: RenderScene, view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays of pixels meet the floor, (n, 3), and whether they do, from above, (n,)."""
    starts, rays = view.rays(x, y)
    axis = int(np.argmax(np.abs(scene.up)))
    level = scene.lower[axis] if scene.up[axis] > 0 else scene.upper[axis]
    fall = rays[:, axis] * np.sign(scene.up[axis])
    hit = fall < -1e-4 * np.linalg.norm(rays, axis=1)
    length = (level - starts[:, axis]) / np.where(hit, rays[:, axis], 1.0)
    hit &= length > 0.0
    return starts + np.where(hit, length, 0.0)[:, None] * rays, hit
