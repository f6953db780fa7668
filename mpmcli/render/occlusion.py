"""Occlusion: the fractions of the light of the lamp and of the sky that reach a point through the particles.

They are computed on a coarse grid over the domain. VTK's SSAO and shadow maps were compared: their shadows are hard and
also fall from lines, clear bodies lose their picture, heaps of particles turn black, and they take longer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy.ndimage import correlate1d, map_coordinates

from mpmcli.render.particle_grid import blurred_along
from mpmcli.render.render_scene import Finish, Group, RenderScene
from mpmcli.render.settings import Theme, rgb
from mpmcli.render.view import View

# Fraction of the incident light that a finish blocks; 1 is a full shadow.
OPACITY: dict[Finish, float] = {"water": 0.22, "syrup": 0.55, "translucent": 0.6}
CELLS_LONG, CELLS = 88, 140_000  # cells along the longest side of the domain, and largest total
SHADOW_REACH = 0.7  # distance beyond the domain to which shadows may fall, as a fraction of its height
DEPTH_OF_CELL = 1.1  # optical depth of a cell filled with opaque material
STEEPEST = 3.5  # largest lateral shift of light from layer to layer, cells
# Directions of the sky's light: lateral shift from layer to layer, cells, and weight.
TURNS = 2 * math.pi * (np.arange(5) + 0.25) / 5
SKY = [((0.0, 0.0), 0.2), *(((0.8 * math.cos(turn), 0.8 * math.sin(turn)), 0.16) for turn in TURNS)]
# Fraction of the light of a cell that spreads to its neighbours per layer, because lamp and sky are not points.
LAMP_SPREAD, SKY_SPREAD = 0.35, 1.0
LIFT = 1.4  # cells above a surface at which its light is evaluated, so that it does not shade itself
FADE = 0.55  # distance from the domain over which the floor fades into the gradient, in longest sides of the domain
STEP = 2  # pixels along each side of the blocks in which the floor is computed


@dataclass(frozen=True)
class Occlusion:
    """Fractions of light on a grid (c, a, b): from the floor upwards, and along two horizontal axes."""

    lamp: np.ndarray  # (c, a, b) float32 from 0 to 1, in the middle of the cells; `sky` alike
    sky: np.ndarray
    floor: np.ndarray  # (a, b) of both lights, on the floor of the domain
    axes: list[int]  # of the scene, that those of the grid are; `signs` (3,): whether along or against them
    signs: np.ndarray
    corner: np.ndarray  # of the grid, along its axes, (3,), m
    edge: float  # of a cell, m

    def at(self, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
        """Return the fractions (n,) of the lamp's and of the sky's light at points (n, 3) with normals (n, 3)."""
        cells = self._cells(points + (LIFT * self.edge) * normals)
        return [map_coordinates(share, cells, order=1, mode="nearest") for share in (self.lamp, self.sky)]

    def on_floor(self, points: np.ndarray) -> np.ndarray:
        """Return the fractions of both at points (n, 3) on the floor; points beyond the grid are fully lit."""
        return map_coordinates(self.floor, self._cells(points)[1:], order=1, mode="constant", cval=1.0)

    def _cells(self, points: np.ndarray) -> np.ndarray:
        return (points[:, self.axes] * self.signs - self.corner).T / self.edge - 0.5


def occlusion_by(
    scene: RenderScene, groups: Sequence[Group], lamp: np.ndarray, shades: Sequence[tuple[np.ndarray, np.ndarray]] = ()
) -> Occlusion:
    """Return the occlusion by groups and by opaque shades (points (n, 3), volumes (n,)).

    The optical depth of each cell is that of the particles in it, by the law of Beer and Lambert; `lamp` is the
    direction (3,) towards the lamp, above the horizon.
    """
    blocked = [OPACITY.get(group.appearance.finish, 1.0) * group.distance**3 for group in groups]
    blocked = [np.full(len(group.position), amount) for group, amount in zip(groups, blocked, strict=True)]
    volumes = np.concatenate([np.empty(0), *blocked, *(volumes for _, volumes in shades)])
    places = np.concatenate(
        [np.empty((0, 3)), *(group.position for group in groups), *(places for places, _ in shades)]
    )
    axes = np.argsort(np.abs(scene.up), stable=True)[[2, 0, 1]].tolist()
    signs = np.array([sum(scene.up), 1.0, 1.0])
    low, high = np.sort(signs * np.array([scene.lower, scene.upper])[:, axes], axis=0)
    size = high - low
    edge = max(float(size.max()) / CELLS_LONG, float((size.prod() / CELLS) ** (1 / 3)))
    pad = np.array([0, 1, 1]) * (math.ceil(SHADOW_REACH * size[0] / edge) + 2)
    shape = tuple((np.ceil(size / edge - 1e-9).astype(int) + 2 * pad).tolist())
    corner = low - edge * pad
    cells = np.clip(((places[:, axes] * signs - corner) / edge).astype(int), 0, np.array(shape) - 1)
    depth = np.bincount(np.ravel_multi_index(tuple(cells.T), shape), volumes, math.prod(shape)).reshape(shape)
    depth = (depth * (DEPTH_OF_CELL / edge**3)).astype(np.float32)
    for axis in range(3):
        depth = blurred_along(depth, axis)
    rise, *aside = signs * lamp[axes]
    lamp_share, lamp_floor = _swept(depth, [(np.array(aside) / max(rise, 0.3), 1.0)], LAMP_SPREAD)
    sky_share, sky_floor = _swept(depth, SKY, SKY_SPREAD)
    # Shadows fade out over the last cells, so that no edge is visible.
    inwards = (np.clip(np.minimum(np.arange(n), np.arange(n)[::-1]) / 4.0, 0.0, 1.0) for n in shape[1:])
    floor = 1.0 - np.minimum.outer(*inwards) * (1.0 - 0.5 * (lamp_floor + sky_floor))
    return Occlusion(lamp_share, sky_share, floor.astype(np.float32), axes, signs, corner, edge)


def _swept(
    depth: np.ndarray, beams: Sequence[tuple[Sequence[float], float]], spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the light in the cells (c, a, b) and on the floor (a, b), summed over beams (slope (2,), weight)."""
    arrived, floor = np.zeros_like(depth), np.zeros_like(depth[0])
    taps = np.arange(-math.ceil(STEEPEST) - 1, math.ceil(STEEPEST) + 2)
    for slope, weight in beams:
        passed = np.exp(-depth * math.hypot(1.0, *slope))
        # The light from `slope` aside, linear between the cells, is then spread.
        hats = (np.maximum(1.0 - np.abs(taps - aside), 0.0) for aside in slope)
        kernels = [np.convolve(hat, (spread / 4, 1.0 - spread / 2, spread / 4), "same") for hat in hats]
        light = np.ones_like(floor)
        for k in reversed(range(len(depth))):
            arrived[k] += weight * light
            light = light * passed[k]
            for axis, kernel in enumerate(kernels):
                light = correlate1d(light, kernel, axis, mode="constant", cval=1.0)
        floor += weight * light
    return arrived, floor


class Background:
    """A gradient, brighter below than above, and a floor, computed once, with the shadows of each frame."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme) -> None:
        """Compute the gradient, and where lines of sight meet the floor, with its share of each pixel."""
        width, height = view.size
        down = np.linspace(0.0, 1.0, height)[:, None]
        ease = down * down * (3.0 - 2.0 * down)
        column = (1.0 - ease) * np.array(rgb(theme.sky)) + ease * np.array(rgb(theme.horizon))
        gradient = column[:, None].astype(np.float32)
        self.size = height, width
        self.coarse = -(-height // STEP), -(-width // STEP)
        rows, columns = STEP * (np.indices(self.coarse) + 0.5)
        starts, rays = view.rays(columns, rows)
        up = np.array(scene.up)
        level = min(up @ scene.lower, up @ scene.upper)
        # Intersections of lines of sight with the floor, from above.
        with np.errstate(all="ignore"):
            fall = (rays * up).sum(axis=-1)
            length = (level - (starts * up).sum(axis=-1)) / fall
            points = starts + length[..., None] * rays
            beside = np.maximum(np.maximum(np.array(scene.lower) - points, points - np.array(scene.upper)), 0.0)
        away = np.linalg.norm(beside * (up == 0.0), axis=-1) / (FADE * max(np.subtract(scene.upper, scene.lower)))
        share = np.where((fall < -1e-4) & (length > 0.0), np.exp(-np.square(away)), 0.0)
        # Contributions below a visible difference are skipped.
        self.seen = share > 1e-3
        self.points = points[self.seen]
        share = self._finer(share)
        self.rest, self.floor = (1.0 - share) * gradient, share * np.array(rgb(theme.floor), dtype=np.float32)

    def image(self, occlusion: Occlusion | None) -> np.ndarray:
        """Return (h, w, 3) uint8, with the shadows that are cast, if any."""
        light = np.ones(self.coarse)
        if occlusion is not None:
            light[self.seen] = occlusion.on_floor(self.points)
        # Shadows are applied in perceived brightness and are never black.
        image = self.rest + self.floor * self._finer(np.maximum(light, 0.0) ** 0.7 * 0.82 + 0.18)
        return (255.0 * np.clip(image, 0.0, 1.0) + 0.5).astype(np.uint8)

    def _finer(self, coarse: np.ndarray) -> np.ndarray:
        """Interpolate values at the centres of blocks of pixels to all pixels, (h, w, 1)."""
        rows, columns = self.coarse
        image = Image.fromarray(coarse.astype(np.float32)).resize(
            (STEP * columns, STEP * rows), Image.Resampling.BILINEAR
        )
        return np.asarray(image)[: self.size[0], : self.size[1], None]
