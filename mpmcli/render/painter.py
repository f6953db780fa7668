"""The painter of a mode: made once in each process, and used for all its frames."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.output.result import Result
from mpmcli.render.canvas import Canvas
from mpmcli.render.color_by import color_by
from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.density import DensityPainter, density_colors, slice_of
from mpmcli.render.dots import DotsPainter
from mpmcli.render.settings import Settings, require_possible
from mpmcli.render.subject import Subject, subject_of
from mpmcli.render.theme import THEMES
from mpmcli.render.view import View, aspect_of, view_of

# Pictures whose height follows from the scene are no flatter than this, height over width, and no steeper.
FLATTEST = 0.2
# The texts around the scene grow with the picture, and the picture with the texts.
FITTING_ROUNDS = 4


class Painter(Protocol):
    """Draws the scene of a frame.

    Attributes:
        fields: that are read of each frame.
    """

    fields: tuple[str, ...]

    def draw(self, frame: Frame) -> np.ndarray:
        """Return (h, w, 3) uint8, of the size of the view."""
        ...


@dataclass(frozen=True)
class Studio:
    """All that pictures of one result with one setting share, but the painter and its window.

    Attributes:
        settings: with the limits of the colours filled in.
        colors: what a bar or a legend explains; None for none.
    """

    result: Result
    settings: Settings
    subject: Subject
    colors: Coloring | Categories | None
    canvas: Canvas
    view: View

    def painter(self) -> Painter:
        """Make the painter; it opens a window."""
        settings, subject, view = self.settings, self.subject, self.view
        theme = THEMES[settings.theme]
        count = int(self.result.particle_counts.max())
        if settings.mode == "density":
            assert isinstance(self.colors, Coloring)
            plane = slice_of(subject, settings.camera)
            return DensityPainter(self.result.header, subject, view, theme, plane, self.colors)
        if settings.mode == "fluid" and subject.dimension == 3:
            from mpmcli.render.liquids.fluid import FluidPainter

            return FluidPainter(subject, view, theme)
        if settings.mode in ("surface", "fluid"):
            from mpmcli.render.surfaces.surface import SurfacePainter

            if settings.mode == "fluid":
                subject = _grained(subject)
            return SurfacePainter(subject, view, theme, self.colors if isinstance(self.colors, Coloring) else None)
        assert self.colors is not None
        return DotsPainter(subject, view, theme, self.colors, count)


def open_studio(result: Result, settings: Settings) -> Studio:
    """Find out what pictures of a result need, and fill in what the settings leave open.

    Raises:
        InputError: the colours, the camera or the size are not possible.
    """
    subject, theme = subject_of(result), THEMES[settings.theme]
    camera = settings.camera
    colors: Coloring | Categories | None
    if settings.mode == "density":
        plane = slice_of(subject, camera)
        colors = density_colors(result, plane, theme, settings.limits, settings.cmap)
        camera = "front" if camera not in ("side", "top") else camera
    elif settings.color is None or (settings.mode == "surface" and settings.color == "material"):
        colors = _legend(subject) if len(subject.looks) > 1 else None
    else:
        colors = color_by(settings.color, result, subject, theme, settings.limits, settings.cmap)
    if isinstance(colors, Coloring):
        settings = replace(settings, limits=colors.limits)
    width, height = settings.size
    times = expected_times(result)
    # Elsewhere in 3D they are the edges of a box, and part of the scene.
    walls = subject.dimension == 2 or settings.mode == "density"
    # In perspective a length has no one size.
    parallel = view_of(subject, camera, (width, width)).parallel
    canvas = Canvas((width, height or width), subject, theme, times, colors, settings.grid, walls, parallel)
    if height is None:
        aspect = min(max(aspect_of(subject, camera), FLATTEST), 1.0 / FLATTEST)
        for _ in range(FITTING_ROUNDS):
            canvas = replace(canvas, size=(width, canvas.height_for(aspect)))
        settings = replace(settings, size=canvas.size)
        require_possible(*canvas.size, f"{width}xauto")
    return Studio(result, settings, subject, colors, canvas, view_of(subject, camera, canvas.stage_size))


def _grained(subject: Subject) -> Subject:
    """Let everything that is no liquid be drawn as grains."""
    looks = (look if look.liquid else replace(look, finish="grains") for look in subject.looks)
    return replace(subject, looks=tuple(looks))


def expected_times(result: Result) -> tuple[float, ...]:
    """Return times that all labels of a film are written for, s: some of those of the whole run, if it goes on too.

    Otherwise milliseconds would become seconds while a film of a run under way is drawn.
    """
    header = result.header
    if header.end is not None and header.frames is not None and header.frames > 1:
        step = header.end / (header.frames - 1)
        if np.allclose(result.times, result.numbers * step, rtol=1e-3, atol=1e-3 * step):
            return 0.0, step, min(2 * step, header.end), header.end
    return tuple(result.times.tolist())


def _legend(subject: Subject) -> Categories:
    """Return the legend of materials that look like what they are."""
    names, inks = tuple(look.name for look in subject.looks), tuple(look.color for look in subject.looks)
    return Categories("material", names, inks, subject.material_of)


def usual_color(subject: Subject) -> str:
    """Return what dots are coloured by where nobody says: materials where they differ, or else speed."""
    return "material" if len(subject.looks) > 1 else "speed"
