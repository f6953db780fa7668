"""What stands behind a 3D scene: a gradient that is brighter below than above, and a floor with shadows on it."""

import numpy as np

from mpmcli.render.render_scene import RenderScene
from mpmcli.render.shading.occlusion import Occlusion
from mpmcli.render.theme import Theme, rgb
from mpmcli.render.view import View

# Distance from the domain over which the floor fades into the gradient, in longest sides of the domain.
FADE = 0.55
# Share of the floor's light that comes from the lamp; the rest comes from the sky.
LAMP_SHARE = 0.5
# Pixels between which the floor is worked out, and interpolated.
STEP = 2


class Background:
    """The background of one run and view. Its floor under every pixel is found once, its shadows for every frame."""

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
        rows = np.empty((STEP * (self.nodes[0] - 1), self.nodes[1]), dtype=np.float32)
        for k in range(STEP):
            rows[k::STEP] = (1.0 - k / STEP) * coarse[:-1] + (k / STEP) * coarse[1:]
        fine = np.empty((rows.shape[0], STEP * (self.nodes[1] - 1)), dtype=np.float32)
        for k in range(STEP):
            fine[:, k::STEP] = (1.0 - k / STEP) * rows[:, :-1] + (k / STEP) * rows[:, 1:]
        return fine[:height, :width]


def _on_floor(scene: RenderScene, view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays of pixels meet the floor, (n, 3), and whether they do, from above, (n,)."""
    right, up, back = view.axes
    width, height = view.size
    metres = 1.0 / view.pixels_per_metre
    shift = (x - 0.5 * width)[:, None] * metres * right - (y - 0.5 * height)[:, None] * metres * up
    if view.parallel:
        starts, rays = np.array(view.position) + shift, np.broadcast_to(-back, shift.shape)
    else:
        starts, rays = np.broadcast_to(np.array(view.position), shift.shape), shift - view.distance * back
    axis = int(np.argmax(np.abs(scene.up)))
    level = scene.lower[axis] if scene.up[axis] > 0 else scene.upper[axis]
    fall = rays[:, axis] * np.sign(scene.up[axis])
    hit = fall < -1e-4 * np.linalg.norm(rays, axis=1)
    length = (level - starts[:, axis]) / np.where(hit, rays[:, axis], 1.0)
    hit &= length > 0.0
    return starts + np.where(hit, length, 0.0)[:, None] * rays, hit
