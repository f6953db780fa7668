"""Draws liquids as bodies with a surface, found in screen space, and all other particles as dots.

Screen-space fluid rendering: W. J. van der Laan, S. Green and M. Sainz, "Screen space fluid rendering with curvature
flow", Proc. I3D 2009, 91-98, with another smoothing, see `liquid_surface.smoothed`.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.colliders import ColliderActors
from mpmcli.render.dots import OVERLAP, SMALLEST, depth_shaded
from mpmcli.render.lighting import lights_of, linear
from mpmcli.render.liquid_surface import NOTHING, Liquid, Surface, layers_of, surface_of, window_of
from mpmcli.render.occlusion import Background, occlusion_by
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.particle_grid import sampled
from mpmcli.render.render_scene import Appearance, Finish, Group, RenderScene, groups_of
from mpmcli.render.settings import Theme, rgb_bytes
from mpmcli.render.view import View

if TYPE_CHECKING:
    import pyvista as pv

TONE = 0.05  # largest deviation of the brightness of a dot, up or down, which makes neighbours distinguishable
# Objects less than this behind a surface, in distances between particles, lie on it, like the edges of the domain.
LIES_ON = 0.3
FALLS_THROUGH = 0.5  # fraction of the shadow on the floor that is not visible through a liquid
LEAVES_TRACES = 4.0  # distance up to which a particle changes the picture, in distances between particles
BENDS = 0.3  # largest thickness of a liquid that refracts the background, in lengths of the scene
SAMPLES = 2  # samples along each axis of a pixel in VTK's pictures
HEAD_ON = 0.02  # reflectance of water at normal incidence: ((n - 1) / (n + 1))^2, n = 1.33
SKIN = 0.05  # a skin of this thickness, in lengths of the scene, is added to every liquid, so that films are visible
RIM = 0.35  # light from behind is lost at the rim, where it would leave at a grazing angle
LINEAR = (np.arange(256, dtype=np.float32) / 255) ** np.float32(2.2)  # displayed values in linear light


class FluidPainter:
    """Draws the frames of one run in 3D."""

    fields: tuple[str, ...] = ()

    def __init__(self, scene: RenderScene, view: View, theme: Theme) -> None:
        """Prepare what all frames share: lights, background, and a window with box and colliders."""
        self._scene, self._view = scene, view
        extent = np.subtract(scene.upper, scene.lower)
        # Absorption scales with the size of the scene, so that a beaker and a reservoir look alike.
        self._length = float(np.cbrt(np.prod(np.maximum(extent, 1e-3 * extent.max()))))
        self._lamp = lights_of(scene, view, theme)["lampTo"]
        floor, directions = linear(theme.floor), (view.axes @ self._lamp, view.axes @ np.array(scene.up))
        around, strengths = ([0.25, 0.47, 0.85], [0.93, 0.96, 1.0], 0.8 * floor), (0.75, 0.45)
        if theme.name == "dark":
            around, strengths = ([0.10, 0.15, 0.24], [0.30, 0.36, 0.46], 0.6 * floor), (0.95, 0.36)
        self._lights = FluidLights(*(np.asarray(vector, np.float32) for vector in (*directions, *around)), *strengths)
        self._background = Background(scene, view, theme)
        # The background without shadows (h, w, 3), in amounts of light.
        self._bare = LINEAR[self._background.image(None)]
        # One window for lines, colliders and dots.
        self._offscreen = OffscreenRenderer(replace(view, size=(view.size[0] * SAMPLES, view.size[1] * SAMPLES)), theme)
        self._offscreen.add_box(scene, width=1.6 * SAMPLES)
        self._colliders = ColliderActors(scene, theme, self._offscreen)
        self._offscreen.add_light()
        self._actors: dict[tuple[int, int], pv.Actor] = {}

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8; particles without a place (NaN) are left out."""
        groups = groups_of(self._scene, frame)
        picture, depth, shade = self._things([group for group in groups if not group.appearance.liquid], frame)
        occlusion = occlusion_by(self._scene, groups, self._lamp, self._colliders.shades(frame.time))
        image = LINEAR[self._background.image(occlusion)]
        # The light and the distance of each sample of the pixels.
        places = list(np.ndindex(SAMPLES, SAMPLES))
        samples = [
            (LINEAR[picture[i::SAMPLES, j::SAMPLES]] * shade, depth[i::SAMPLES, j::SAMPLES, None]) for i, j in places
        ]
        shown = [np.where(np.isfinite(far), light, image) for light, far in samples]
        liquids = [self._liquid(group, frame) for group in groups if group.appearance.liquid]
        liquids = [liquid for liquid in liquids if len(liquid.pixels)]
        window = window_of(liquids, self._view)
        if window is not None:
            surface = surface_of(liquids, window, self._view, self._scene)
            layers = layers_of(liquids, window, depth, SAMPLES)
            place, part = window.inner(self._view.size)
            front, cover = np.full_like(image[..., :1], NOTHING), np.zeros_like(image[..., :1])
            front[place][..., 0] = np.where(surface.alpha > 0, surface.depth, NOTHING)[part]
            front += np.float32(LIES_ON * min(liquid.distance for liquid in liquids))
            cover[place][..., 0] = surface.alpha[part]
            # Part of the light that a liquid blocks passes through it to the floor below.
            floor = image + np.float32(FALLS_THROUGH) * (self._bare - image)
            behind = _mean([np.where(np.isfinite(far) & (far >= front), light, floor) for light, far in samples])
            wet = np.zeros_like(image)
            wet[place] = self._lit(surface, list(zip(liquids, layers, strict=True)), behind)[part]
            shown = [
                here + np.where(far < front, 0, cover) * (wet - here)
                for here, (_, far) in zip(shown, samples, strict=True)
            ]
        return (np.clip(_mean(shown), 0, 1) ** np.float32(1 / 2.2) * 255 + 0.5).astype(np.uint8)

    def _things(self, groups: list[Group], frame: Frame) -> tuple[np.ndarray, ...]:
        """Draw lines, colliders and the groups as dots.

        Returns the picture (2h, 2w, 3) uint8, the depth, inf for the background, and the fraction of light left.
        """
        for actor in self._actors.values():
            actor.SetVisibility(False)
        for group in groups:
            self._show(group)
        self._colliders.pose(frame)
        self._offscreen.render()
        picture, depth, shade = self._offscreen.picture(), self._offscreen.depth(), np.float32(1)
        if groups:
            dots = self._colliders.depth_without(self._offscreen) if self._colliders.meshes else None
            size = OVERLAP * max(group.distance for group in groups)
            shade = LINEAR[
                depth_shaded(np.full(self._bare.shape, 255, np.uint8), depth, size, self._view, SAMPLES, dots)
            ]
        return picture, depth, shade

    def _show(self, group: Group) -> None:
        """Show the dots of a group in the next picture, each slightly lighter or darker."""
        import pyvista as pv

        cloud = pv.PolyData(group.position.astype(np.float32))
        tone = 1 + TONE * group.hashes[:, :1]
        colors = np.array(rgb_bytes(group.appearance.color)) * tone
        cloud["rgb"] = np.clip(colors + 0.5, 0, 255).astype(np.uint8)
        if group.key not in self._actors:
            self._actors[group.key] = self._offscreen.add_dots(cloud)
        actor = self._actors[group.key]
        actor.mapper.dataset = cloud
        actor.SetVisibility(True)
        # All dots of a group have the size of those in its middle.
        distance = max(float(np.median(self._view.pixels(group.position)[:, 2])), self._view.near)
        size = OVERLAP * group.distance * float(self._view.scale_at(np.array(distance)))
        actor.prop.point_size = max(size, SMALLEST) * SAMPLES

    def _liquid(self, group: Group, frame: Frame) -> Liquid:
        """Return the particles of a liquid that may be visible."""
        view = self._view
        pixels = view.pixels(group.position)
        seen = np.flatnonzero(pixels[:, 2] > max(view.near, 2 * group.distance))
        scale = view.scale_at(pixels[seen, 2])
        reach = (LEAVES_TRACES * group.distance * scale)[:, None]
        inside = (pixels[seen, :2] > -reach).all(axis=1) & (pixels[seen, :2] < np.array(view.size) + reach).all(axis=1)
        seen, scale = seen[inside], scale[inside]
        body = np.clip(frame.body[group.rows[seen]], 0, len(self._scene.bodies) - 1)
        volume = np.array(self._scene.distances)[body] ** 3
        return Liquid(group.appearance, group.distance, group.position[seen], pixels[seen], scale, volume)

    def _lit(self, surface: Surface, layers: list[tuple[Liquid, np.ndarray]], behind: np.ndarray) -> np.ndarray:
        """Return the light (h, w, 3) of the pixels of the window covered by liquids."""
        window, view = surface.window, self._view
        height, width = behind.shape[:2]
        row, column = np.nonzero(surface.alpha > 0)
        normal, depth, owner = surface.normal[row, column], surface.depth[row, column], surface.owner[row, column]
        across, up = view.plane(*window.middles)
        towards = np.tile(np.array([0, 0, 1], np.float32), (len(row), 1))
        if not view.parallel:
            towards[:, 0], towards[:, 1] = -across[0, column], -up[row, 0]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        through = np.ones((len(row), 3), np.float32)
        thickness = np.zeros(len(row), np.float32)
        for liquid, layer in layers:
            here = layer[row, column]
            thickness += here
            through *= transmitted(liquid.appearance, here, self._length)
        bend = np.minimum(thickness, BENDS * self._length) * view.scale_at(depth)
        light = np.zeros((*window.shape, 3), np.float32)
        for k, (liquid, _) in enumerate(layers):
            mine = np.flatnonzero(owner == k)
            if len(mine) == 0:
                continue
            shift = optics_of(liquid.appearance).bend * bend[mine, None] * normal[mine, :2]
            x = np.clip(column[mine] + window.left + 0.5 - shift[:, 0], 0, width)
            y = np.clip(row[mine] + window.top + 0.5 + shift[:, 1], 0, height)
            here = row[mine], column[mine]
            points = normal[mine], towards[mine], through[mine], sampled(behind, y, x), surface.hollow[here]
            light[here] = shaded(liquid.appearance, *points, self._lights)
        return light


def _mean(images: list[np.ndarray]) -> np.ndarray:
    return sum(images[1:], images[0]) / np.float32(len(images))


@dataclass(frozen=True)
class Optics:
    """Optical properties of a liquid."""

    depths: float  # optical depth (natural logarithm) of the most absorbed colour over the length of the scene
    milk: float  # optical depth of scattering, equal for all colours
    body: float  # fraction of the scattered light that returns
    deepening: float  # exponent of the transmitted fraction that tints the scattered light
    gloss: float  # strength of highlights
    sharpness: float  # exponent of the highlight
    reflection: float  # fraction of the mirror image that is kept; 0 is dull
    bend: float  # shift of the background by refraction, as a fraction of the thickness
    glow: float = 0.0  # emitted light, as a fraction of full white


# Depths, milk, body, deepening, gloss, sharpness, reflection, bend, glow.
FINISHES: dict[Finish, Optics] = {
    "water": Optics(6.0, 0.4, 0.6, 0.12, 0.7, 260.0, 1.0, 0.03),
    "syrup": Optics(32.0, 1.0, 0.88, 0.2, 0.7, 160.0, 0.9, 0.03),
    "matte": Optics(200.0, 400.0, 0.9, 0.0, 0.10, 18.0, 0.15, 0.0),
}
LAVA = Optics(200.0, 400.0, 0.35, 0.0, 0.15, 30.0, 0.2, 0.0, 1.0)


def optics_of(appearance: Appearance) -> Optics:
    """Return the optical properties of a material."""
    if appearance.name.startswith("lava"):
        return LAVA
    return FINISHES.get(appearance.finish, FINISHES["matte"])


@dataclass(frozen=True)
class FluidLights:
    """The lights of a scene: a lamp, a sky and the floor, in linear light; directions (3,) are in camera axes."""

    lamp: np.ndarray  # direction to it, a unit vector
    up: np.ndarray  # direction
    zenith: np.ndarray  # colour (3,); `horizon` and `floor` alike
    horizon: np.ndarray
    floor: np.ndarray
    strength: float  # of the lamp
    ambient: float  # strength of the ambient light

    def around(self, direction: np.ndarray) -> np.ndarray:
        """Return the light from directions (..., 3): floor, horizon, sky, and the lamp as a large soft box."""
        rise = (direction @ self.up)[..., None]
        high = np.clip(rise, 0, 1) ** np.float32(0.6)
        low = _step(rise, -0.35, 0.02)
        sky = self.horizon + (self.zenith - self.horizon) * high
        box = _step((direction @ self.lamp)[..., None], 0.72, 0.97)
        return self.floor + (sky - self.floor) * low + np.float32(0.9 * self.strength) * box


def transmitted(appearance: Appearance, thickness: np.ndarray, length: float) -> np.ndarray:
    """Return the fraction of light (..., 3) transmitted by a thickness (...), m, by the law of Beer and Lambert.

    The optics give the absorption over the `length` of the scene, m, so that a beaker and a reservoir look alike.
    """
    optics = optics_of(appearance)
    loss = -np.log(np.clip(linear(appearance.color), 1e-3, 0.98))
    loss = loss / loss.max() * optics.depths + optics.milk
    return np.exp(-(thickness[..., None] + np.float32(SKIN * length)) * (loss / length).astype(np.float32))


def shaded(
    appearance: Appearance,
    normal: np.ndarray,
    towards: np.ndarray,
    through: np.ndarray,
    behind: np.ndarray,
    hollow: np.ndarray,
    lights: FluidLights,
) -> np.ndarray:
    """Return the light (n, 3) from n points of a surface.

    The unit vectors `normal`, outwards, and `towards` the eye are (n, 3); `through` is the result of `transmitted`, (n,
    3), `behind` the light (n, 3) of the background, and `hollow` (n,) as in `liquid_surface.Surface`.
    """
    optics = optics_of(appearance)
    color = linear(appearance.color)
    facing = np.clip(np.einsum("ij,ij->i", normal, towards), 0, 1)[:, None]
    lit = normal @ lights.lamp
    # Light scattered inside softens the edges of its own shadow.
    wrap = np.float32(0.45 if optics.milk < 100 else 0.1)
    diffuse = lights.strength * np.clip((lit + wrap) / (1 + wrap), 0, 1)
    ambient = lights.ambient * (0.62 + 0.38 * (normal @ lights.up)) * (1 - 0.35 * np.clip(hollow, -1, 1))
    body = np.float32(optics.body) * color * (diffuse + ambient)[:, None]
    if optics.deepening:
        body = body * through ** np.float32(optics.deepening)
    scattered = 1 - through.mean(axis=1, keepdims=True)
    rim = 1 - np.float32(RIM) * (1 - facing) ** 3
    rim *= np.float32(0.92) + np.float32(0.10) * (normal @ lights.up)[:, None]
    inside = behind * through * rim + body * scattered
    if optics.glow:
        inside = inside + np.float32(optics.glow) * glow(facing[:, 0], hollow)
    mirrored = 2 * facing * normal - towards
    fresnel = HEAD_ON + (1 - HEAD_ON) * (1 - facing) ** 5
    fresnel = np.float32(optics.reflection) * np.minimum(fresnel, np.float32(0.5))
    half = lights.lamp + towards
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.clip(np.einsum("ij,ij->i", normal, half), 0, 1) ** np.float32(optics.sharpness)
    spark = np.float32(optics.gloss * lights.strength) * highlight[:, None]
    return inside * (1 - fresnel) + lights.around(mirrored) * fresnel + spark


def glow(facing: np.ndarray, hollow: np.ndarray) -> np.ndarray:
    """Return the light (n, 3) of molten rock: yellow in its creases, red where it faces away and has cooled."""
    heat = np.clip(0.24 + 0.30 * facing**2 + 0.9 * hollow, 0, 1)[:, None]
    return np.concatenate([1.1 * heat, 0.62 * heat**2.4, 0.16 * heat**5], axis=1).astype(np.float32)


def _step(value: np.ndarray, low: float, high: float) -> np.ndarray:
    share = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return share * share * (3 - 2 * share)
