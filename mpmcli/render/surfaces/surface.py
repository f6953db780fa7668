"""`--mode surface`: every material as a smooth body that looks like what it is."""

from typing import Protocol

import numpy as np

from mpmcli.output.frame import Frame
from mpmcli.render.subject import Subject
from mpmcli.render.theme import Theme
from mpmcli.render.view import View


class FieldColors(Protocol):
    """Colours that a surface takes from a field, instead of from its materials."""

    fields: tuple[str, ...]
    cmap: str
    limits: tuple[float, float]
    missing: str

    def values(self, frame: Frame) -> np.ndarray:
        """Return one number of each particle, (n,) float64."""
        ...


class Painter(Protocol):
    """What draws frames of one run into pictures of one view."""

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        ...

    def close(self) -> None:
        """Let go of what the painter holds."""
        ...


class SurfacePainter:
    """Draws the surfaces of the materials of one run; made once per process.

    Attributes:
        fields: that are read of each frame.
    """

    def __init__(self, subject: Subject, view: View, theme: Theme, colors: FieldColors | None = None) -> None:
        """Choose the way of drawing: in space by triangles, in the plane by the density of particles."""
        self.fields = () if colors is None else colors.fields
        self.view = view
        if subject.dimension == 3:
            from mpmcli.render.surfaces.solid_stage import SolidStage

            self.painter: Painter = SolidStage(subject, view, theme, colors)
        else:
            from mpmcli.render.surfaces.outline import OutlinePainter

            self.painter = OutlinePainter(subject, view, theme, colors)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return the picture of a frame, (h, w, 3) uint8."""
        return self.painter.draw(frame)

    def close(self) -> None:
        """Let go of the window, if there is one."""
        self.painter.close()
