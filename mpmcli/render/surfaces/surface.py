"""`--mode surface`: every material as a smooth body that looks like what it is."""

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.coloring import Coloring
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.surfaces.outline import OutlinePainter
from mpmcli.render.surfaces.surface_renderer import SurfaceRenderer
from mpmcli.render.theme import Theme
from mpmcli.render.view import View


class SurfacePainter:
    """Draws the surfaces of the materials of one run; made once per process.

    Attributes:
        fields: that are read of each frame.
    """

    def __init__(self, scene: RenderScene, view: View, theme: Theme, colors: Coloring | None = None) -> None:
        """Choose the way of drawing: in space by triangles, in the plane by the density of particles."""
        self.fields = () if colors is None else colors.fields
        self.view = view
        kind = SurfaceRenderer if scene.dimension == 3 else OutlinePainter
        self.painter = kind(scene, view, theme, colors)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        return self.painter.draw(frame)
