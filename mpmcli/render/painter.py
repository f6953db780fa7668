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

# Least ratio of height to width, and inverse of the largest, of pictures whose height follows from the scene.
FLATTEST = 0.2
# Iterations in which the sizes of the texts and of the picture settle.
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
    """Everything that the pictures of one result with one setting share, except the painter and its window.

    Attributes:
        settings: with the limits of the colours filled in.
        colors: explained by a colour bar or a legend; None without either.
        captions: above the pictures of a montage, by frame; empty for their times.
    """

    result: Result
    settings: Settings
    scene: RenderScene
    colors: Coloring | Categories | None
    layout: PictureLayout
    view: View
    captions: tuple[str, ...] = ()

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
    """Return what the pictures of a result share, and fill in what the settings leave open.

    Raises:
        InputError: the colours, the camera or the size are not possible.
    """
    scene, theme = render_scene_of(result), THEMES[settings.theme]
    scene = replace(
        scene,
        colliders=() if settings.colliders == "none" else scene.colliders,
        clear=settings.colliders == "clear",
    )
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
    # In other 3D pictures the walls are the edges of a box, part of the scene.
    walls = scene.dimension == 2 or settings.mode == "density"
    # A scale bar has no meaning in perspective.
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
    """Return the scene with every material that is not liquid drawn as grains."""
    appearances = (
        appearance if appearance.liquid else replace(appearance, finish="grains") for appearance in scene.appearances
    )
    return replace(scene, appearances=tuple(appearances))


def expected_times(result: Result) -> tuple[float, ...]:
    """Return the times, s, that determine the digits of labels: those of the whole run, also while it goes on.

    Otherwise the unit of a film could change from milliseconds to seconds while a run is being drawn.
    """
    header = result.header
    if header.end is not None and header.frames is not None and header.frames > 1:
        step = header.end / (header.frames - 1)
        if np.allclose(result.times, result.numbers * step, rtol=1e-3, atol=1e-3 * step):
            return 0.0, step, min(2 * step, header.end), header.end
    return tuple(result.times.tolist())


def usual_color(scene: RenderScene) -> str:
    """Return the default colouring of dots: by material where there are several, else by speed."""
    return "material" if len(scene.appearances) > 1 else "speed"
