"""The painter of a mode: made once in each process, and used for all its frames."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.output.result import Result
from mpmcli.render.color_by import color_by, material_colors
from mpmcli.render.coloring import Categories, Coloring
from mpmcli.render.density import DensityPainter, density_colors, slice_of
from mpmcli.render.dots import DotsPainter
from mpmcli.render.picture_layout import PictureLayout
from mpmcli.render.render_scene import RenderScene, render_scene_of
from mpmcli.render.settings import Settings, require_possible
from mpmcli.render.surfaces.outline import OutlinePainter
from mpmcli.render.theme import THEMES, Theme
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
class RenderSetup:
    """All that pictures of one result with one setting share, but the painter and its window.

    Attributes:
        settings: with the limits of the colours filled in.
        colors: what a bar or a legend explains; None for none.
    """

    result: Result
    settings: Settings
    scene: RenderScene
    colors: Coloring | Categories | None
    layout: PictureLayout
    view: View

    def painter(self) -> Painter:
        """Make the painter; it opens a window."""
        settings, scene, view = self.settings, self.scene, self.view
        theme = THEMES[settings.theme]
        count = int(self.result.particle_counts.max())
        if settings.mode == "density":
            assert isinstance(self.colors, Coloring)
            plane = slice_of(scene, settings.camera)
            return DensityPainter(self.result.header, scene, view, theme, plane, self.colors)
        if settings.mode == "fluid" and scene.dimension == 3:
            from mpmcli.render.liquids.fluid import FluidPainter

            return FluidPainter(scene, view, theme)
        if settings.mode in ("surface", "fluid"):
            if settings.mode == "fluid":
                scene = _grained(scene)
            return surface_painter(scene, view, theme, self.colors if isinstance(self.colors, Coloring) else None)
        assert self.colors is not None
        return DotsPainter(scene, view, theme, self.colors, count)


def surface_painter(scene: RenderScene, view: View, theme: Theme, colors: Coloring | None = None) -> Painter:
    """Return the painter of smooth bodies: by triangles in 3D, by the density of particles in 2D."""
    if scene.dimension == 2:
        return OutlinePainter(scene, view, theme, colors)
    from mpmcli.render.surfaces.surface_renderer import SurfaceRenderer

    return SurfaceRenderer(scene, view, theme, colors)


def set_up(result: Result, settings: Settings) -> RenderSetup:
    """Find out what pictures of a result need, and fill in what the settings leave open.

    Raises:
        InputError: the colours, the camera or the size are not possible.
    """
    scene, theme = render_scene_of(result), THEMES[settings.theme]
    camera = settings.camera
    colors: Coloring | Categories | None
    if settings.mode == "density":
        plane = slice_of(scene, camera)
        colors = density_colors(result, plane, theme, settings.limits, settings.cmap)
        camera = "front" if camera not in ("side", "top") else camera
    elif settings.color is None or (settings.mode == "surface" and settings.color == "material"):
        inks = [appearance.color for appearance in scene.appearances]
        colors = material_colors(scene, inks) if len(inks) > 1 else None
    else:
        colors = color_by(settings.color, result, scene, theme, settings.limits, settings.cmap)
    if isinstance(colors, Coloring):
        settings = replace(settings, limits=colors.limits)
    width, height = settings.size
    times = expected_times(result)
    # Elsewhere in 3D they are the edges of a box, and part of the scene.
    walls = scene.dimension == 2 or settings.mode == "density"
    # In perspective a length has no one size.
    parallel = view_of(scene, camera, (width, width)).parallel
    layout = PictureLayout((width, height or width), scene, theme, times, colors, settings.grid, walls, parallel)
    if height is None:
        aspect = min(max(aspect_of(scene, camera), FLATTEST), 1.0 / FLATTEST)
        for _ in range(FITTING_ROUNDS):
            layout = replace(layout, size=(width, layout.height_for(aspect)))
        settings = replace(settings, size=layout.size)
        require_possible(*layout.size, f"{width}xauto")
    return RenderSetup(result, settings, scene, colors, layout, view_of(scene, camera, layout.viewport_size))


def _grained(scene: RenderScene) -> RenderScene:
    """Let everything that is no liquid be drawn as grains."""
    appearances = (
        appearance if appearance.liquid else replace(appearance, finish="grains") for appearance in scene.appearances
    )
    return replace(scene, appearances=tuple(appearances))


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


def usual_color(scene: RenderScene) -> str:
    """Return what dots are coloured by where nobody says: materials where they differ, or else speed."""
    return "material" if len(scene.appearances) > 1 else "speed"
