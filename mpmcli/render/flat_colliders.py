"""Colliders in a picture of a plane: of a 2D scene, or of a slice through a 3D one."""

import math
from collections.abc import Callable

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.theme import Theme, rgb
from mpmcli.render.view import View
from mpmcli.scene.colliders import Collider, Plane

# Pixels of a dark rim, at a picture 720 pixels high, and by which share it is darker.
RIM, DARKER = 2.0, 0.35
# Share of the colour of colliders that their inside has, the rest being the ground.
FILLED = 0.55


class FlatColliders:
    """Covers the pixels of a view by the signed distances of colliders, within the domain.

    Args:
        place: gives the points (n, d) of the scene, m, at which the middles of pixels lie, from places (n, 2) to the
            right and up of the domain's lower left corner in the picture, m.
        box: left, bottom, right and top of the domain in the picture, pixels.
    """

    def __init__(
        self,
        scene: RenderScene,
        view: View,
        theme: Theme,
        place: Callable[[np.ndarray], np.ndarray],
        box: tuple[float, float, float, float],
    ) -> None:
        self._scene, self._colliders, self._place = scene, scene.colliders, place
        self._edge = 1.0 / view.pixels_per_metre
        self._rim = RIM * view.size[1] / 720.0
        self._color, self._ground = np.array(rgb(theme.solid)), np.array(rgb(theme.ground))
        left, bottom, right, top = box
        width, height = view.size
        self._rows = slice(max(math.floor(top), 0), min(math.ceil(bottom), height))
        self._columns = slice(max(math.floor(left), 0), min(math.ceil(right), width))
        x = np.arange(self._columns.start, self._columns.stop) + 0.5
        y = np.arange(self._rows.start, self._rows.stop) + 0.5
        self._right, self._up = (x - left) * self._edge, (bottom - y) * self._edge
        inside = [
            np.clip(np.minimum(a - lo, hi - a) + 0.5, 0.0, 1.0) for a, lo, hi in ((x, left, right), (y, top, bottom))
        ]
        self._inside = (inside[1][:, None] * inside[0]).astype(np.float32)
        self._kept: dict[int, np.ndarray] = {}

    def draw(self, picture: np.ndarray, frame: Frame, free: np.ndarray | None = None) -> None:
        """Draw the colliders of a frame over a picture (h, w, 3) of float from 0 to 1.

        Args:
            free: share (h, w) of each pixel in which they may be seen; None for all of it.
        """
        if not self._colliders or not self._inside.size:
            return
        depth = np.full(self._inside.shape, -np.inf, np.float32)
        for number, collider in enumerate(self._colliders):
            if self._scene.shows(number, frame):
                np.maximum(depth, self._depth(number, collider, frame.time), out=depth)
        cover = np.clip(depth + 0.5, 0.0, 1.0) * self._inside
        if free is not None:
            cover = cover * free[self._rows, self._columns]
        rim = np.clip(self._rim + 0.5 - depth, 0.0, 1.0)[..., None]
        fill = self._ground + FILLED * (self._color - self._ground)
        color = fill + rim * ((1.0 - DARKER) * self._color - fill)
        shown = picture[self._rows, self._columns]
        shown += cover[..., None] * (color - shown)

    def _depth(self, number: int, collider: Collider, time: float) -> np.ndarray:
        """Return how many pixels (h, w) each pixel of the domain lies inside a collider, negative outside."""
        if number in self._kept:
            return self._kept[number]
        rows, columns = self._near(collider, time)
        right, up = np.meshgrid(self._right[columns], self._up[rows])
        depth = np.full(self._inside.shape, -np.inf, np.float32)
        if right.size:
            points = self._place(np.stack([right.ravel(), up.ravel()], axis=1))
            depth[rows, columns] = -collider.signed_distance(points, time).reshape(right.shape) / self._edge
        if not collider.motion.moves:
            self._kept[number] = depth
        return depth

    def _near(self, collider: Collider, time: float) -> tuple[slice, slice]:
        """Return the rows and columns in which a collider may be seen."""
        if isinstance(collider.form, Plane) or collider.side == "inside":
            return slice(None), slice(None)
        lower, upper = collider.form.bounds()
        d = len(lower)
        corners = np.array([[upper[a] if k >> a & 1 else lower[a] for a in range(d)] for k in range(2**d)])
        ends = collider.motion.placed(corners, time)
        origin = self._place(np.zeros((1, 2)))[0]
        found = []
        for axis, steps in ((np.array([0.0, 1.0]), self._up), (np.array([1.0, 0.0]), self._right)):
            along = (ends - origin) @ (self._place(axis[None])[0] - origin)
            reach = 2.0 * self._edge
            hit = np.flatnonzero((steps >= along.min() - reach) & (steps <= along.max() + reach))
            found.append(slice(hit[0], hit[-1] + 1) if len(hit) else slice(0, 0))
        return found[0], found[1]


def flat_colliders(scene: RenderScene, view: View, theme: Theme) -> FlatColliders:
    """Return the colliders of a 2D scene."""
    corners = view.pixels(np.array([scene.lower, scene.upper]))
    (left, bottom), (right, top) = corners[:, :2].tolist()
    return FlatColliders(
        scene, view, theme, lambda places: places + np.array(scene.lower[:2]), (left, bottom, right, top)
    )
