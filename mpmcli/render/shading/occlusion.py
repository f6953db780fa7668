"""Occlusion: the fraction of the lamp's and of the sky's light that reaches a point past the particles.

Found on a coarse grid over the domain. VTK's SSAO was compared with it (docs/shading.md): it casts no
shadows, takes six times as long or more, and is not reproducible.
"""

import math
from dataclasses import dataclass

import numpy as np

from mpmcli.render.particle_grid import blurred_along
from mpmcli.render.render_scene import RenderScene

# Cells along the longest side of the domain, and in all.
CELLS_LONG, CELLS = 88, 140_000
# Share of the height of the domain by which shadows may fall beside it.
REACH = 0.7
# Optical depth of a cell that is filled by what is wholly opaque.
DEPTH_OF_CELL = 1.1
# Directions of the sky's light: (tangent of the angle to the vertical, how many, weight).
SKY_RINGS = ((0.0, 1, 1.0), (0.8, 5, 0.8))
# Share of the light of a cell that spreads to its neighbours from layer to layer: the lamp and the sky are no points.
LAMP_SPREAD, SKY_SPREAD = 0.35, 1.0
# Cells above a surface at which its light is looked up, so that it does not stand in its own shade.
LIFT = 1.4


@dataclass(frozen=True)
class Occlusion:
    """Shares of light that arrive, on a grid (a, b, c): two level axes and the one against gravity.

    Attributes:
        lamp, sky: (a, b, c) float32 from 0 to 1, in the middle of the cells.
        floor_lamp, floor_sky: (a, b) on the floor of the domain.
        axes: of the scene, that the axes of the grid are.
        flip: whether up is against the last of them.
        corner: of the grid, in the coordinates of the grid (after the flip), (3,), m.
        edge: of a cell, m.
    """

    lamp: np.ndarray
    sky: np.ndarray
    floor_lamp: np.ndarray
    floor_sky: np.ndarray
    axes: tuple[int, int, int]
    flip: bool
    corner: np.ndarray
    edge: float

    def at(self, points: np.ndarray, normals: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the shares (n,) of the lamp's and of the sky's light at points (n, 3) with normals (n, 3)."""
        places = points if normals is None else points + (LIFT * self.edge) * normals
        cells = (self._local(places) - self.corner) / self.edge - 0.5
        return _trilinear(self.lamp, cells), _trilinear(self.sky, cells)

    def on_floor(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same of points (n, 3) on the floor; what lies beside the grid is in the light."""
        cells = ((self._local(points) - self.corner) / self.edge)[:, :2] - 0.5
        size = np.array(self.floor_lamp.shape)
        # Fades out over the last cells, so that no edge shows.
        inside = np.clip(np.minimum(cells, size - 1.0 - cells).min(axis=1) / 4.0, 0.0, 1.0)
        found = [_bilinear(plane, cells) for plane in (self.floor_lamp, self.floor_sky)]
        return tuple(1.0 - inside * (1.0 - share) for share in found)

    def _local(self, points: np.ndarray) -> np.ndarray:
        local = points[:, list(self.axes)].astype(np.float32)
        if self.flip:
            local[:, 2] *= -1.0
        return local


def occlusion_of(
    scene: RenderScene, position: np.ndarray, volumes: np.ndarray, opacity: np.ndarray, lamp: np.ndarray
) -> Occlusion:
    """Cast light through particles, layer by layer from the top.

    Light comes to a cell from the layer above it, slantwise, and loses what fills that layer by the law of Beer and
    Lambert.

    Args:
        position: (n, 3) in or near the domain, m.
        volumes: (n,) of the particles, m^3.
        opacity: (n,) from 0, clear, to 1.
        lamp: direction (3,) towards the lamp, above the horizon.
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
    blank = Occlusion(*(np.ones((1, 1, 1)),) * 2, *(np.ones((1, 1)),) * 2, axes, flip, corner, edge)
    cells = np.floor((blank._local(position) - corner) / edge).astype(int)
    cells = np.clip(cells, 0, np.array(shape) - 1)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    depth = np.bincount(flat, volumes * opacity, math.prod(shape)).reshape(shape).astype(np.float32)
    depth *= DEPTH_OF_CELL / edge**3
    for k in range(3):
        depth = blurred_along(depth, k)
    toward = blank._local(lamp[None])[0]
    slope = toward[:2] / max(float(toward[2]), 0.3)
    lamp_share, floor_lamp = _swept(depth, [(slope, 1.0)], LAMP_SPREAD)
    rings = [(_around(slant, k, count), weight) for slant, count, weight in SKY_RINGS for k in range(count)]
    sky_share, floor_sky = _swept(depth, rings, SKY_SPREAD)
    return Occlusion(lamp_share, sky_share, floor_lamp, floor_sky, axes, flip, corner, edge)


def _around(radius: float, k: int, count: int) -> np.ndarray:
    angle = 2 * math.pi * (k + 0.25) / count
    return radius * np.array([math.cos(angle), math.sin(angle)])


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
    if count == 0:
        return plane
    moved = np.ones_like(plane)
    length = plane.shape[axis]
    if abs(count) < length:
        to, source = (
            (slice(0, length - count), slice(count, length))
            if count > 0
            else (
                slice(-count, length),
                slice(0, length + count),
            )
        )
        if axis == 0:
            moved[to] = plane[source]
        else:
            moved[:, to] = plane[:, source]
    return moved


def _bilinear(plane: np.ndarray, cells: np.ndarray) -> np.ndarray:
    return _trilinear(plane[:, :, None], np.concatenate([cells, np.zeros_like(cells[:, :1])], axis=1))


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
