"""Pictures of frames: selects painters, finds missing or outdated files, and draws them in several processes."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import STATUS, Frame
from mpmcli.output.result import Result, open_result
from mpmcli.processes.pool import render_frames
from mpmcli.render.coloring import Categories, Coloring, color_by, material_colors
from mpmcli.render.density import DensityPainter, density_colors
from mpmcli.render.dots import DotsPainter
from mpmcli.render.outline import OutlinePainter
from mpmcli.render.picture_file import digest_of, settings_digest, write_picture
from mpmcli.render.picture_layout import PictureLayout, time_text
from mpmcli.render.render_scene import RenderScene, SharedGeometry, render_scene_of
from mpmcli.render.settings import THEMES, Settings, Theme, require_possible
from mpmcli.render.view import View, aspect_of, slice_of, view_of
from mpmcli.render.window import choose_window
from mpmcli.scene.colliders import Plane

# Smallest ratio of height to width, and inverse of the largest, of pictures whose height follows from the scene.
FLATTEST = 0.2
LARGEST, NARROWEST = (1280, 720), 640  # pixels of pictures whose size follows from the scene
LEVEL = 1e-6  # smallest horizontal length of a direction that is not vertical
HIDDEN = 0.05  # fraction of the particles within the box of a collider from which on it is cut open
FITTING_ROUNDS = 4  # iterations until the sizes of texts and picture are consistent
FOREIGN = "{path} is there already, and mpmcli render did not make it: give another place with -o, or --overwrite."


class Painter(Protocol):
    """Draws the scene of a frame; `fields` are read from each frame. Each process creates one painter."""

    fields: tuple[str, ...]

    def draw(self, frame: Frame) -> np.ndarray:
        """Return (h, w, 3) uint8, of the size of the view."""
        ...


@dataclass(frozen=True)
class RenderSetup:
    """The data shared by the pictures of one result and one setting, except the painter and its window."""

    result: Result
    settings: Settings  # with the limits of the colours filled in
    scene: RenderScene
    colors: Coloring | Categories | None  # explained by a colour bar or a legend; None without either
    layout: PictureLayout
    view: View
    captions: tuple[str, ...] = ()  # above the pictures of a montage, by frame; empty for their times

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that its colours read from a frame."""
        return () if self.colors is None else self.colors.fields

    def painter(self, shared: SharedGeometry | None = None) -> Painter:
        """Make the painter; it opens a window. With several painters, `shared` keeps what their pictures share."""
        settings, scene, view, colors = self.settings, self.scene, self.view, self.colors
        theme = THEMES[settings.theme]
        if settings.mode == "density":
            assert isinstance(colors, Coloring)
            return DensityPainter(self.result.header, scene, view, theme, slice_of(scene, settings.camera), colors)
        if settings.mode == "fluid" and scene.dimension == 3:
            from mpmcli.render.fluid import FluidPainter

            return FluidPainter(scene, view, theme)
        if settings.mode == "fluid":
            # Every material that is not liquid is drawn as grains.
            looks = (look if look.liquid else replace(look, finish="grains") for look in scene.appearances)
            return surface_painter(replace(scene, appearances=tuple(looks)), view, theme)
        if settings.mode == "surface":
            return surface_painter(scene, view, theme, colors if isinstance(colors, Coloring) else None, shared)
        assert colors is not None
        return DotsPainter(scene, view, theme, colors, int(self.result.particle_counts.max()))


def surface_painter(
    scene: RenderScene, view: View, theme: Theme, colors: Coloring | None = None, shared: SharedGeometry | None = None
) -> Painter:
    """Return the painter of smooth bodies: by triangles in 3D, by the density of particles in 2D."""
    if scene.dimension == 2:
        return OutlinePainter(scene, view, theme, colors)
    from mpmcli.render.surface_renderer import SurfaceRenderer

    return SurfaceRenderer(scene, view, theme, colors, shared)


def set_up(result: Result, settings: Settings) -> RenderSetup:
    """Return the shared data of the pictures of a result, with default settings filled in."""
    scene, theme = render_scene_of(result), THEMES[settings.theme]
    colliders = () if settings.colliders == "none" else scene.colliders
    held = () if settings.colliders == "none" or settings.arrows is None else scene.held
    scene = replace(scene, colliders=colliders, held=held, clear=settings.colliders == "clear")
    hollow = _hollow(scene, result) if settings.colliders == "auto" else ()
    if settings.colliders == "auto" and not hollow:
        settings = replace(settings, colliders="solid")
    if settings.mode == "dots" and settings.color is None:
        settings = replace(settings, color="material" if len(scene.appearances) > 1 else "speed")
    camera = settings.camera
    colors: Coloring | Categories | None
    if settings.mode == "density":
        colors = density_colors(result, slice_of(scene, camera), theme, settings.limits, settings.cmap)
        camera = "front" if camera not in ("side", "top") else camera
    elif settings.color is None or (settings.mode == "surface" and settings.color == "material"):
        inks = [appearance.color for appearance in scene.appearances]
        colors = material_colors(scene, inks) if len(inks) > 1 else None
    else:
        colors = color_by(settings.color, result, scene, theme, settings.limits, settings.cmap)
    if isinstance(colors, Coloring):
        settings = replace(settings, limits=colors.limits)
    width, height = settings.size or (LARGEST[0], None)
    # In other 3D pictures the walls are the edges of a box, part of the scene.
    walls = scene.dimension == 2 or settings.mode == "density"
    # A scale bar has no meaning in perspective.
    parallel = view_of(scene, camera, (width, width)).parallel
    size, times = (width, height or width), expected_times(result)
    layout = PictureLayout(size, scene, theme, times, colors, settings.grid, walls, parallel, settings.arrows or ())
    if height is None:
        aspect = min(max(aspect_of(scene, camera), FLATTEST), 1.0 / FLATTEST)
        for _ in range(FITTING_ROUNDS):
            layout = replace(layout, size=(width, layout.height_for(aspect)))
        if settings.size is None:
            layout = replace(layout, size=_within(layout, aspect))
        settings = replace(settings, size=layout.size)
        require_possible(*layout.size, f"{width}xauto")
    view = view_of(scene, camera, layout.viewport_size)
    # The half in front of a plane along the upward axis is left out; seen from above they are open anyway.
    towards = view.axes[2] * (np.array(scene.up) == 0.0)
    if hollow and np.linalg.norm(towards) > LEVEL:
        scene = replace(scene, hollow=hollow, towards=tuple(towards.tolist()))
    return RenderSetup(result, settings, scene, colors, layout, view)


def _within(layout: PictureLayout, aspect: float) -> tuple[int, int]:
    """Return the largest size within `LARGEST` without empty space, even as films require, at least `NARROWEST`."""
    (width, height), highest = layout.size, LARGEST[1]
    while height > highest and width > NARROWEST:
        width -= 16
        height = replace(layout, size=(width, min(height, highest))).height_for(aspect)
    return width, min(height, highest) // 2 * 2


def _hollow(scene: RenderScene, result: Result) -> tuple[int, ...]:
    """Return the colliders of a 3D scene that would hide their contents: many particles start within their boxes."""
    found = []
    for number, collider in enumerate(scene.colliders if scene.dimension == 3 else ()):
        if collider.side == "outside" and not collider.free and not isinstance(collider.form, Plane):
            lower, upper = collider.form.bounds()
            places = collider.motion.taken_back(result.present_frame(0, ()).position, 0.0)
            inside = ((places > lower) & (places < upper)).all(axis=1)
            found += [number] if inside.sum() > HIDDEN * len(inside) else []
    return tuple(found)


def expected_times(result: Result) -> tuple[float, ...]:
    """Return the times, s, of the whole run, also during it; they determine the digits and unit of labels."""
    header = result.header
    if header.end is not None and header.frames is not None and header.frames > 1:
        step = header.end / (header.frames - 1)
        if np.allclose(result.times, result.numbers * step, rtol=1e-3, atol=1e-3 * step):
            return 0.0, step, min(2 * step, header.end), header.end
    return tuple(result.times.tolist())


@dataclass(frozen=True)
class PlannedPicture:
    """The picture file of one frame, or of a montage."""

    k: int  # index of the frame in the result
    path: Path
    digest: str  # digest of everything that it depends on
    made: bool  # whether the file exists with this digest


# Numbers of particles of a frame with a missing value, and without a position.
Outcome = tuple[int, int]


@dataclass(frozen=True)
class PictureJob:
    """Draws pictures of some frames of a result at a path, in a worker process; the plan is by frame."""

    source: Path
    settings: Settings  # as `set_up` has filled them in
    plan: dict[int, PlannedPicture] = field(repr=False)

    def start(self) -> Callable[[int], Outcome]:
        """Open the result and a window, and return a function that draws and writes the picture of a frame."""
        setup = set_up(open_result(self.source), self.settings)
        renderer = PictureRenderer(setup)

        def make(k: int) -> Outcome:
            outcomes: list[Outcome] = []
            picture = renderer.picture([k], lambda _, outcome: outcomes.append(outcome))
            write_picture(self.plan[k].path, picture, self.plan[k].digest)
            return outcomes[0]

        return make


class PictureRenderer:
    """Draws whole pictures of frames, which are read one at a time."""

    def __init__(self, setup: RenderSetup) -> None:
        choose_window()
        self._setup = setup
        self._painter: Painter = setup.painter()

    def picture(self, ks: Sequence[int], watch: Callable[[int, Outcome], None] = lambda k, outcome: None) -> np.ndarray:
        """Return the picture of a frame, or the montage of several, (h, w, 3) uint8; `watch` is called with each."""
        setup, drawn, times, missing = self._setup, [], [], 0
        captions = [setup.captions[k] for k in ks] if setup.captions else None
        for k in ks:
            if setup.settings.mode == "density":
                # It needs the number of particles that share the mass of a body.
                frame = setup.result.frame(k, (*self._painter.fields, *({STATUS} & set(setup.result.field_names))))
            else:
                frame = setup.result.present_frame(k, self._painter.fields)
            drawn.append(self._painter.draw(frame))
            times.append(frame.time)
            unknown, colors = 0, setup.colors
            if isinstance(colors, Coloring) and setup.settings.mode != "density":
                unknown = int((~np.isfinite(colors.values(frame))).sum())
            missing += unknown
            watch(k, (unknown, int((~np.isfinite(frame.position).all(axis=1)).sum())))
        return setup.layout.compose(drawn, setup.view, times, missing, captions)


def picture_digest(result: Result, settings: Settings, ks: Sequence[int]) -> str:
    """Return a digest of the inputs of a picture of some frames.

    The ledger's row represents the particles, because it has their energies and momenta to the last bit. The text of a
    time depends on other frames.
    """
    times = expected_times(result)
    labels = [time_text(float(result.times[k]), times) for k in ks]
    frames = [[int(result.numbers[k]), int(result.particle_counts[k]), repr(result.ledger[k])] for k in ks]
    # Pictures of earlier versions have no arrows, and stay right.
    asked = {name: value for name, value in asdict(settings).items() if name != "arrows" or value is not None}
    return settings_digest(
        {**asked, "scene": result.header.stored.get("scene", ""), "frames": frames, "labels": labels}
    )


def plan_picture(
    result: Result, settings: Settings, ks: Sequence[int], path: Path, *, overwrite: bool
) -> PlannedPicture:
    """Return the picture of a frame, or a montage of several, and whether its file exists and is up to date.

    InputError: the file exists and is not of mpmcli; `overwrite` replaces it and draws it again.
    """
    digest, present = picture_digest(result, settings, ks), digest_of(path)
    # A digest of another form belongs to another kind of picture, such as that of a ledger.
    if present is not None and not re.fullmatch("[0-9a-f]{32}", present) and not overwrite:
        raise InputError(FOREIGN.format(path=path))
    return PlannedPicture(ks[0], path, digest, present == digest and not overwrite)


def make_pictures(
    source: Path, settings: Settings, plan: Sequence[PlannedPicture], workers: int, **calls: Callable[..., Any]
) -> None:
    """Draw the pictures of a plan that do not exist yet; `calls` are of `render_frames`."""
    due = {planned.k: planned for planned in plan if not planned.made}
    if due:
        # Chosen once, and inherited by the workers.
        choose_window()
        render_frames(PictureJob(source, settings, due), list(due), workers, **calls)
