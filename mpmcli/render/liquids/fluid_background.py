"""What lies behind a liquid and before it, the floor, and the shadows on it."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.collider_actors import ColliderActors
from mpmcli.render.dots import OVERLAP, SMALLEST
from mpmcli.render.liquids.fluid_shading import linear
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.shading.background import Background
from mpmcli.render.shading.lighting import occlusion_by
from mpmcli.render.shading.material_groups import Group
from mpmcli.render.theme import Theme
from mpmcli.render.view import View

if TYPE_CHECKING:
    import pyvista as pv

# Samples along each axis of a pixel in what VTK draws.
SAMPLES = 2


class FluidBackground:
    """The background, the floor and its shadows, and one off-screen window for lines and dots."""

    def __init__(self, scene: RenderScene, view: View, theme: Theme, lamp: np.ndarray) -> None:
        self._scene, self._view, self._lamp = scene, view, lamp
        self._background = Background(scene, view, theme)
        self._offscreen = OffscreenRenderer(replace(view, size=(view.size[0] * SAMPLES, view.size[1] * SAMPLES)), theme)
        self._offscreen.add_box(scene.lower, scene.upper, theme.wall, width=1.6 * SAMPLES)
        self._colliders = ColliderActors(scene, theme, self._offscreen)
        if scene.colliders:
            self._offscreen.add_light()
        # The background without shadows (h, w, 3), in amounts of light.
        self.bare = linear(self._background.image(None) / np.float32(255))
        self._actors: dict[tuple[int, int], pv.Actor] = {}
        self._empty: tuple[np.ndarray, ...] | None = None

    def things(self, groups: list[Group], colors: list[np.ndarray], frame: Frame) -> tuple[np.ndarray, ...]:
        """Draw lines, colliders and dots of a frame.

        Returns:
            Their picture (2h, 2w, 3) uint8, their depth (2h, 2w), inf where there is nothing, and that without
            colliders.

        Args:
            groups: what is drawn as dots.
            colors: (n, 3) uint8 of each group.
        """
        if not groups and self._empty is not None:
            return self._empty
        for actor in self._actors.values():
            actor.SetVisibility(False)
        for group, color in zip(groups, colors, strict=True):
            self._show(group, color)
        self._colliders.pose(frame)
        self._offscreen.render()
        seen = self._offscreen.picture(), *[self._offscreen.depth()] * 2
        if groups and self._colliders.meshes:
            seen = *seen[:2], self._colliders.depth_without(self._offscreen)
        if not groups and not self._scene.colliders:
            self._empty = seen
        return seen

    def base(self, groups: list[Group], time: float) -> np.ndarray:
        """Return the background (h, w, 3) in amounts of light, with the shadows of `things` on the floor."""
        occlusion = occlusion_by(self._scene, groups, self._lamp, self._colliders.shades(time))
        return linear(self._background.image(occlusion) / np.float32(255))

    def _show(self, group: Group, colors: np.ndarray) -> None:
        """Let the next picture show the dots of a group."""
        import pyvista as pv

        cloud = pv.PolyData(group.position.astype(np.float32))
        cloud["color"] = colors
        if group.key not in self._actors:
            if not self._actors and not self._scene.colliders:
                self._offscreen.add_light()
            self._actors[group.key] = self._offscreen.plotter.add_points(
                cloud,
                scalars="color",
                rgb=True,
                render_points_as_spheres=True,
                reset_camera=False,
                ambient=0.45,
                diffuse=0.65,
                specular=0.0,
            )
        actor = self._actors[group.key]
        actor.mapper.dataset = cloud
        actor.SetVisibility(True)
        # Dots of one group have one size, that of those in the middle.
        distance = max(float(np.median(self._view.pixels(group.position)[:, 2])), self._view.near)
        scale = self._view.pixels_per_metre * (1.0 if self._view.parallel else self._view.distance / distance)
        actor.prop.point_size = max(OVERLAP * group.distance * scale, SMALLEST) * SAMPLES
