"""Colliders of a 3D scene in an off-screen window, moved with every frame."""

from typing import TYPE_CHECKING

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.collider_mesh import ColliderMesh, collider_meshes
from mpmcli.render.offscreen import OffscreenRenderer
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.theme import Theme, rgb

if TYPE_CHECKING:
    import pyvista as pv

# Pixels, at a picture 720 pixels high, and brightness of the lines along edges.
LINE, DARK = 1.5, 0.55


class ColliderActors:
    """Shaded surfaces, of which only the side that faces the material is seen: so a container hides nothing in it.

    Args:
        window: that shows them.
    """

    def __init__(self, scene: RenderScene, theme: Theme, window: OffscreenRenderer) -> None:
        self._scene = scene
        self._actors: list[tuple[ColliderMesh, list[pv.Actor]]] = []
        self._shown = self._actors
        self.meshes = collider_meshes(scene)
        for mesh in self.meshes:
            surface = window.plotter.add_mesh(
                mesh.shown(),
                color=theme.solid,
                smooth_shading=True,
                culling="front" if scene.clear and mesh.casts else "back",
                ambient=0.45,
                diffuse=0.65,
                specular=0.0,
                reset_camera=False,
            )
            # A line on the surface is in front of it.
            surface.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            surface.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(1.0, 1.0)
            self._actors.append((mesh, [surface, *edge_actors(mesh, theme, window.plotter, window.samples)]))

    def pose(self, frame: Frame) -> None:
        """Put those of a frame where they are."""
        self._shown = [(mesh, actors) for mesh, actors in self._actors if self._scene.shows(mesh.number, frame)]
        for _, actors in self._actors:
            for actor in actors:
                actor.visibility = False
        for mesh, actors in self._shown:
            for actor in actors:
                actor.visibility = True
                actor.user_matrix = mesh.transform(frame.time)

    def shades(self, time: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return what they take of the light at a time, s; see `ColliderMesh.shade`."""
        return [mesh.shade(time) for mesh, _ in self._shown if mesh.casts]

    def depth_without(self, window: OffscreenRenderer) -> np.ndarray:
        """Return the depth of a picture of everything else, as `OffscreenRenderer.depth`; the window shows it then."""
        for show in (False, True):
            for _, actors in self._shown:
                for actor in actors:
                    actor.visibility = show
            if not show:
                window.render()
                depth = window.depth()
        return depth


def edge_actors(mesh: ColliderMesh, theme: Theme, plotter: "pv.Plotter", samples: int) -> "list[pv.Actor]":
    """Draw the sharp edges of a collider, if it has any; `samples` as those of a window."""
    edges = mesh.edges()
    if not edges.n_points:
        return []
    shade = tuple(DARK * part for part in rgb(theme.solid))
    width = max(LINE * plotter.window_size[1] / 720.0, samples)
    return [plotter.add_mesh(edges, color=shade, line_width=width, lighting=False, reset_camera=False)]
