"""Liquids as bodies with a surface, drawn from the picture of their particles; everything else as dots.

Screen-space fluid rendering: W. J. van der Laan, S. Green and M. Sainz, "Screen space fluid rendering with curvature
flow", Proc. I3D 2009, 91-98, with another smoothing, see `screen_space`.
"""

from dataclasses import dataclass

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.depth_shading import depth_shaded
from mpmcli.render.dots import OVERLAP
from mpmcli.render.liquids.fluid_background import SAMPLES, FluidBackground
from mpmcli.render.liquids.fluid_shading import displayed, fluid_lights, linear, optics_of, shaded, transmitted
from mpmcli.render.liquids.liquid_surface import Liquid, Surface, layers_of, scale_at, surface_of, window_of
from mpmcli.render.liquids.pixel_rays import plane
from mpmcli.render.liquids.screen_space import NOTHING
from mpmcli.render.particle_grid import sampled
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.shading.lighting import lights_of
from mpmcli.render.shading.material_groups import Group, groups_of
from mpmcli.render.theme import Theme, rgb_bytes
from mpmcli.render.view import View

# Largest deviation of the brightness of a dot, up or down, which makes neighbours distinguishable.
TONE = 0.05
# What is behind a surface by less than this, in distances between particles, lies on it, as the edges of the domain do.
LIES_ON = 0.3
# Share of the shadow on the floor that is not seen through a liquid.
FALLS_THROUGH = 0.5
# Distance from a particle to which it changes the picture, in distances between particles.
LEAVES_TRACES = 4.0
# The most of a liquid that bends what lies behind it, in lengths of the scene.
BENDS = 0.3


@dataclass(frozen=True)
class Sample:
    """What one sample of each pixel shows, of the m pixels in which it shows a dot or a line.

    Attributes:
        row, column: (m,).
        light: (m, 3).
        distance: (m,), m.
    """

    row: np.ndarray
    column: np.ndarray
    light: np.ndarray
    distance: np.ndarray


class FluidPainter:
    """Draws the frames of one run in 3D.

    Attributes:
        fields: that are read of each frame: none.
    """

    fields: tuple[str, ...] = ()

    def __init__(self, scene: RenderScene, view: View, theme: Theme) -> None:
        self._scene, self._view = scene, view
        extent = np.subtract(scene.upper, scene.lower)
        # Absorption scales with the size of the scene: a beaker and a reservoir look alike.
        self._length = float(np.cbrt(np.prod(np.maximum(extent, 1e-3 * extent.max()))))
        lamp = lights_of(scene, view, theme).lamp
        self._background = FluidBackground(scene, view, theme, lamp)
        self._lights = fluid_lights(theme, view.axes @ lamp, view.axes @ np.array(scene.up))

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8; particles without a place (NaN) are left out."""
        groups = groups_of(self._scene, frame)
        solids = [group for group in groups if not group.appearance.liquid]
        picture, depth, dots = self._background.things(solids, [_colors(group) for group in solids], frame)
        image = self._background.base(groups, frame.time)
        samples = self._samples(picture, depth, dots, max((group.distance for group in solids), default=None))
        liquids = [self._liquid(group, frame) for group in groups if group.appearance.liquid]
        liquids = [liquid for liquid in liquids if len(liquid.pixels)]
        window = window_of(liquids, self._view)
        if window is None:
            _add(image, samples)
        else:
            surface = surface_of(liquids, window, self._view, self._scene)
            layers = layers_of(liquids, window, depth, SAMPLES, image.shape[:2])
            self._pour(image, samples, surface, liquids, layers)
        return (displayed(image) * 255 + 0.5).astype(np.uint8)

    def _liquid(self, group: Group, frame: Frame) -> Liquid:
        """Return those particles of a liquid that may be seen."""
        view = self._view
        pixels = view.pixels(group.position)
        seen = np.flatnonzero(pixels[:, 2] > max(view.near, 2 * group.distance))
        scale = scale_at(view, pixels[seen, 2])
        reach = (LEAVES_TRACES * group.distance * scale)[:, None]
        inside = (pixels[seen, :2] > -reach).all(axis=1) & (pixels[seen, :2] < np.array(view.size) + reach).all(axis=1)
        seen, scale = seen[inside], scale[inside]
        body = np.clip(frame.body[group.rows[seen]], 0, len(self._scene.bodies) - 1)
        volume = np.array(self._scene.distances)[body] ** 3
        return Liquid(group.appearance, group.distance, group.position[seen], pixels[seen], scale, volume)

    def _samples(
        self, picture: np.ndarray, depth: np.ndarray, dots: np.ndarray, distance: float | None
    ) -> list[Sample]:
        """Part a picture with several samples to a pixel, leaving out what shows nothing.

        Args:
            dots: the depth without colliders.
            distance: between the dots, m; None where there are none.
        """
        width, height = self._view.size
        shade = None
        if distance is not None:
            white = np.full((height, width, 3), 255, np.uint8)
            shade = depth_shaded(white, depth, OVERLAP * distance, self._view, SAMPLES, dots)[..., 0] / np.float32(255)
        samples = []
        for i in range(SAMPLES):
            for j in range(SAMPLES):
                far = depth[i::SAMPLES, j::SAMPLES]
                row, column = np.nonzero(np.isfinite(far))
                color = picture[i::SAMPLES, j::SAMPLES][row, column] / np.float32(255)
                if shade is not None:
                    color *= shade[row, column, None]
                samples.append(Sample(row, column, linear(color), far[row, column]))
        return samples

    def _pour(
        self,
        image: np.ndarray,
        samples: list[Sample],
        surface: Surface,
        liquids: list[Liquid],
        layers: list[np.ndarray],
    ) -> None:
        """Draw the liquids, and the samples before and behind them, into an image, in amounts of light."""
        picture, part = surface.window.inner(self._view.size)
        depth = np.full(image.shape[:2], NOTHING, np.float32)
        depth[picture] = np.where(surface.alpha > 0, surface.depth, NOTHING)[part]
        depth += np.float32(LIES_ON * min(liquid.distance for liquid in liquids))
        before = [sample.distance < depth[sample.row, sample.column] for sample in samples]
        # Part of the light that a liquid takes from the floor beside it falls through it on the floor under it.
        behind = image + np.float32(FALLS_THROUGH) * (self._background.bare - image)
        _add(behind, [_chosen(sample, ~front) for sample, front in zip(samples, before, strict=True)])
        alpha = np.zeros((*image.shape[:2], 1), np.float32)
        alpha[picture] = surface.alpha[part][..., None]
        wet = np.zeros_like(image)
        wet[picture] = self._lit(surface, liquids, layers, behind)[part]
        image += alpha * (wet - image)
        shown = []
        for sample, front in zip(samples, before, strict=True):
            place = sample.row, sample.column
            cover = np.where(front[:, None], 0, alpha[place])
            light = sample.light + cover * (wet[place] - sample.light)
            shown.append(Sample(*place, light, sample.distance))
        _add(image, shown)

    def _lit(self, surface: Surface, liquids: list[Liquid], layers: list[np.ndarray], behind: np.ndarray) -> np.ndarray:
        """Return the light (h, w, 3) of the pixels of the window that the liquids cover."""
        window, view = surface.window, self._view
        height, width = behind.shape[:2]
        row, column = np.nonzero(surface.alpha > 0)
        normal, depth, owner = surface.normal[row, column], surface.depth[row, column], surface.owner[row, column]
        across, up = plane(view, window.left, window.top, *window.shape)
        towards = np.tile(np.array([0, 0, 1], np.float32), (len(row), 1))
        if not view.parallel:
            towards[:, 0], towards[:, 1] = -across[0, column], -up[row, 0]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        through = np.ones((len(row), 3), np.float32)
        thickness = np.zeros(len(row), np.float32)
        for liquid, layer in zip(liquids, layers, strict=True):
            here = layer[row, column]
            thickness += here
            through *= transmitted(liquid.appearance, here, self._length)
        bend = np.minimum(thickness, BENDS * self._length) * scale_at(view, depth)
        light = np.zeros((*window.shape, 3), np.float32)
        for k, liquid in enumerate(liquids):
            mine = np.flatnonzero(owner == k)
            if len(mine) == 0:
                continue
            shift = optics_of(liquid.appearance).bend * bend[mine, None] * normal[mine, :2]
            x = np.clip(column[mine] + window.left + 0.5 - shift[:, 0], 0, width)
            y = np.clip(row[mine] + window.top + 0.5 + shift[:, 1], 0, height)
            light[row[mine], column[mine]] = shaded(
                liquid.appearance,
                normal[mine],
                towards[mine],
                through[mine],
                sampled(behind, y, x),
                surface.hollow[row[mine], column[mine]],
                self._lights,
            )
        return light


def _colors(group: Group) -> np.ndarray:
    """Return the colours of dots (n, 3) uint8, each a little lighter or darker."""
    tone = 1 + TONE * group.hashes[:, :1]
    return np.clip(np.array(rgb_bytes(group.appearance.color)) * tone + 0.5, 0, 255).astype(np.uint8)


def _chosen(sample: Sample, which: np.ndarray) -> Sample:
    return Sample(sample.row[which], sample.column[which], sample.light[which], sample.distance[which])


def _add(image: np.ndarray, samples: list[Sample]) -> None:
    """Average the samples of each pixel."""
    bare = image.copy()
    for sample in samples:
        place = sample.row, sample.column
        image[place] += (sample.light - bare[place]) / len(samples)
