"""The room around a liquid: what lies behind it and before it, the floor, and the shadows on it."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.render.fluid_shading import linear, transmitted
from mpmcli.render.look import Look
from mpmcli.render.pixel_rays import rays
from mpmcli.render.screen_space import blurred, deposited
from mpmcli.render.stage import Stage
from mpmcli.render.subject import Subject
from mpmcli.render.theme import Theme, rgb
from mpmcli.render.view import View

if TYPE_CHECKING:
    import pyvista as pv

# Samples along each axis of a pixel in what VTK draws.
SAMPLES = 2
# Where the lamp is, in parts to the right, up and towards the viewer.
LAMP = (-0.42, 1.0, 0.40)
# Cells along the longer side of the map of shadows.
SHADOW_CELLS = 360
# What of the floor's light does not come from the lamp.
SHADE = {"light": 0.62, "dark": 0.35}
# Distance from the domain over which the floor fades into the room, in longest sides of the domain.
FADE = 0.55


def lamp_of(subject: Subject, view: View) -> np.ndarray:
    """Return the direction to the lamp (3,), over the left shoulder of the viewer, in the scene's axes."""
    up = np.array(subject.up)
    right = view.axes[0] - (view.axes[0] @ up) * up
    right = right / np.linalg.norm(right)
    direction = LAMP[0] * right + LAMP[1] * up + LAMP[2] * np.cross(right, up)
    return direction / np.linalg.norm(direction)


@dataclass(frozen=True)
class Caster:
    """Particles that throw a shadow: position (n, 3), m, volume of each, m^3, and their look."""

    position: np.ndarray
    volume: np.ndarray
    look: Look


class Room:
    """The background, the floor and its shadows, and one off-screen window for lines and dots.

    Args:
        length: over which a liquid takes what its optics say, m.
    """

    def __init__(self, subject: Subject, view: View, theme: Theme, length: float) -> None:
        self.lamp = lamp_of(subject, view)
        self._subject, self._view, self._theme, self._length = subject, view, theme, length
        fine = replace(view, size=(view.size[0] * SAMPLES, view.size[1] * SAMPLES))
        self._stage = Stage(fine, theme)
        self._stage.add_box(subject.lower, subject.upper, theme.wall, width=1.6 * SAMPLES)
        self._actors: dict[float, pv.Actor] = {}
        self._empty: tuple[np.ndarray, np.ndarray] | None = None
        self._lay_floor()

    def things(self, position: np.ndarray, colors: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Draw lines and dots; return their picture (2h, 2w, 3) uint8 and depth (2h, 2w), inf where there is nothing.

        Args:
            position: (n, 3) of the dots, m.
            colors: (n, 3) uint8.
            radius: (n,) m.
        """
        if len(position) == 0 and self._empty is not None:
            return self._empty
        for actor in self._actors.values():
            actor.SetVisibility(False)
        for size in np.unique(radius):
            here = radius == size
            self._show(position[here], colors[here], float(size))
        self._stage.render()
        seen = self._stage.picture(), self._stage.depth()
        if len(position) == 0:
            self._empty = seen
        return seen

    def base(self, casters: list[Caster]) -> np.ndarray:
        """Return the background (h, w, 3) in amounts of light, with the shadows that particles throw on the floor."""
        image = self._background.copy()
        if self._floor_rows is None:
            return image
        light = self._shadows(casters)
        if light is None:
            return image
        # Only where a shadow falls.
        dark = light.min(axis=2) < 0.998
        if not dark.any():
            return image
        rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
        column, row = self._floor_place
        here = (row > rows[0] - 1) & (row < rows[-1] + 2) & (column > columns[0] - 1) & (column < columns[-1] + 2)
        here &= self._floor_share > 0.01
        kept = 1 - self._floor_share[here, None] * (1 - sampled(light, row[here], column[here]))
        image[self._floor_rows][here] *= kept
        return image

    def _show(self, position: np.ndarray, colors: np.ndarray, radius: float) -> None:
        """Let the dots of one radius be these; the next picture shows them."""
        import pyvista as pv

        cloud = pv.PolyData(np.ascontiguousarray(position, np.float32))
        cloud["color"] = colors
        if radius not in self._actors:
            if not self._actors:
                self._stage.add_light()
            self._actors[radius] = self._stage.plotter.add_points(
                cloud,
                scalars="color",
                rgb=True,
                render_points_as_spheres=True,
                reset_camera=False,
                ambient=0.45,
                diffuse=0.65,
                specular=0.0,
            )
        actor = self._actors[radius]
        actor.mapper.dataset = cloud
        actor.SetVisibility(True)
        distance = np.median((np.array(self._view.position) - position) @ self._view.axes[2])
        scale = self._view.pixels_per_metre * (1.0 if self._view.parallel else self._view.distance / distance)
        actor.prop.point_size = float(max(2 * radius * scale * SAMPLES, 2.0))

    def _lay_floor(self) -> None:
        """Prepare what does not change with time: the background, and where on the floor each pixel looks."""
        width, height = self._view.size
        sky, horizon, floor = (
            linear(np.array(rgb(c))) for c in (self._theme.sky, self._theme.horizon, self._theme.floor)
        )
        share = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
        ease = share * share * (3 - 2 * share)
        image = np.broadcast_to(sky + (horizon - sky) * ease, (height, width, 3)).astype(np.float32)
        self._up = int(np.argmax(np.abs(self._subject.up)))
        self._level = [axis for axis in range(3) if axis != self._up]
        low, high = np.array(self._subject.lower), np.array(self._subject.upper)
        self._height = low[self._up] if self._subject.up[self._up] > 0 else high[self._up]
        origin, direction = rays(self._view, 0, 0, height, width)
        falls = direction[..., self._up] * self._subject.up[self._up]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self._height - origin[..., self._up]) / direction[..., self._up]
        seen = (falls < -1e-6) & (distance > 0)
        place = origin + np.where(seen, distance, 0)[..., None] * direction
        level_low, level_high = low[self._level], high[self._level]
        extent = level_high - level_low
        there = place[..., self._level]
        beside = np.maximum(np.maximum(level_low - there, there - level_high), 0)
        away = np.einsum("ijk,ijk->ij", beside, beside) / (FADE * (high - low).max()) ** 2
        fade = np.where(seen, np.exp(-away), 0).astype(np.float32)
        self._background = image + fade[..., None] * (floor - image)
        rows = np.flatnonzero((fade > 0.01).any(axis=1))
        self._floor_rows = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else None
        reach = 0.8 * float((high - low)[self._up])
        self._map_low = low[self._level] - reach
        self._map_cell = float((extent + 2 * reach).max()) / SHADOW_CELLS
        self._map_shape = tuple(int(np.ceil(n)) for n in ((extent + 2 * reach) / self._map_cell)[::-1])
        if self._floor_rows is not None:
            here = (there[self._floor_rows] - self._map_low) / self._map_cell
            self._floor_place = np.moveaxis(here, -1, 0).astype(np.float32)
            self._floor_share = fade[self._floor_rows]

    def _shadows(self, casters: list[Caster]) -> np.ndarray | None:
        """Return the share of light (r, c, 3) that reaches the floor through everything above it."""
        light = None
        for caster in casters:
            if len(caster.position) == 0:
                continue
            above = (caster.position[:, self._up] - self._height) / self.lamp[self._up]
            fallen = (caster.position - above[:, None] * self.lamp)[:, self._level]
            place = (fallen - self._map_low) / self._map_cell
            steep = abs(self.lamp[self._up])
            thickness = deposited(place, caster.volume / (steep * self._map_cell**2), self._map_shape)
            distance = float(np.cbrt(np.median(caster.volume)))
            soft = max(1.5 * distance, 0.004 * self._length * 2) / self._map_cell
            thickness = blurred(thickness, soft)
            if caster.look.liquid:
                through = transmitted(caster.look, 2.0 * thickness, self._length)
                through = 1 - (1 - through) * (1 - np.exp(-thickness / distance))[..., None]
                through = through * np.exp(-thickness / (0.35 * self._length))[..., None]
            else:
                through = np.repeat(np.exp(-thickness / distance)[..., None], 3, axis=2)
            light = through if light is None else light * through
        if light is None:
            return None
        shade = np.float32(SHADE[self._theme.name])
        return shade + (1 - shade) * light


def sampled(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return values between the pixels of an image (r, c, k), linear in between; the outermost go on outside."""
    rows, columns = image.shape[:2]
    row, column = np.clip(row - 0.5, 0, rows - 1.001), np.clip(column - 0.5, 0, columns - 1.001)
    j, i = row.astype(np.int32), column.astype(np.int32)
    v, u = (row - j)[..., None], (column - i)[..., None]
    flat, home = image.reshape(rows * columns, -1), j * columns + i
    upper = flat[home] * (1 - u) + flat[home + 1] * u
    lower = flat[home + columns] * (1 - u) + flat[home + columns + 1] * u
    return upper * (1 - v) + lower * v
