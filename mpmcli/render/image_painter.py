"""Computes the images of cameras: what they see of a frame, and where that is in the next one."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.output.result import Result
from mpmcli.render.colliders import collider_meshes
from mpmcli.render.image_files import ImageSettings
from mpmcli.render.pictures import Painter, RenderSetup, set_up
from mpmcli.render.render_scene import RenderScene, SharedGeometry
from mpmcli.render.view import View, view_of_camera
from mpmcli.render.visible import (
    BACKGROUND,
    Primitives,
    PrimitiveWindow,
    Visible,
    collider_label,
    displacements,
    dots_of,
    solids_of,
    surfaces_of,
)
from mpmcli.scene.cameras import PlacedCamera


class ImagePainter:
    """Computes the images of frames, one camera after the other, from the same geometry."""

    def __init__(self, result: Result, asked: ImageSettings) -> None:
        self._result, self._asked = result, asked
        self._shared = SharedGeometry()
        self._painters: dict[str, tuple[View, Painter]] = {}
        self._windows: dict[tuple[int, int], PrimitiveWindow] = {}

    @cached_property
    def _setup(self) -> RenderSetup:
        return set_up(self._result, self._asked.settings)

    @cached_property
    def _meshes(self) -> tuple:
        return collider_meshes(self._setup.scene) if self._setup.scene.dimension == 3 else ()

    def images(self, k: int) -> Iterator[tuple[PlacedCamera, dict[str, np.ndarray]]]:
        """Yield each camera with its images of the k-th frame by name.

        rgb is (h, w, 3) uint8, depth (h, w) float32, m, mask (h, w) uint8 or uint16, flow (h, w, 2) float16, pixels, to
        the right and down, normal (h, w, 3) float16, in the axes of the scene.
        """
        result, asked, scene, shared = self._result, self._asked, self._setup.scene, self._shared
        frame = result.present_frame(k, self._setup.fields if "rgb" in asked.what else ())
        later = result.present_frame(k + 1, ()) if "flow" in asked.what and k + 1 < result.frame_count else None
        moved = None if later is None else displacements(frame, later, result.header.period)
        primitives: list[Primitives] = []
        if set(asked.what) - {"rgb"}:
            dots = asked.settings.mode == "dots"
            primitives = [dots_of(scene, frame, moved)] if dots else surfaces_of(scene, frame, moved, shared)
            primitives += solids_of(scene, self._meshes, frame)
        for camera in asked.cameras:
            view, images = view_of_camera(scene, camera, frame.time), {}
            if "rgb" in asked.what:
                images["rgb"] = self._painter(camera, view).draw(frame)
            if set(asked.what) - {"rgb"}:
                shown = _with_flat(scene, self._window(view).draw(primitives, view), frame)
                images["depth"], images["mask"] = shown.depth, _smallest(shown.mask)
                if "normal" in asked.what:
                    images["normal"] = shown.at_pixels("normals").astype(np.float16)
                if later is not None:
                    after = view_of_camera(scene, camera, later.time)
                    images["flow"] = _flow(scene, shown, after, frame.time, later.time)
            yield camera, {what: image for what, image in images.items() if what in asked.what}

    def _painter(self, camera: PlacedCamera, view: View) -> Painter:
        if self._painters.get(camera.name, (None,))[0] != view:
            self._painters[camera.name] = view, replace(self._setup, view=view).painter(self._shared)
        return self._painters[camera.name][1]

    def _window(self, view: View) -> PrimitiveWindow:
        if view.size not in self._windows:
            self._windows[view.size] = PrimitiveWindow(self._setup.scene, view)
        return self._windows[view.size]


def _with_flat(scene: RenderScene, shown: Visible, frame: Frame) -> Visible:
    """Return what an image of a 2D scene shows with its colliders, behind all particles, and with one depth."""
    if scene.dimension == 3:
        return shown
    h, w = shown.depth.shape
    start, direction = shown.view.rays(np.arange(w)[None, :] + 0.5, np.arange(h)[:, None] + 0.5)
    places = (start + shown.view.distance * direction)[..., :2].reshape(-1, 2)
    mask = shown.mask.ravel().copy()
    free = (mask == BACKGROUND) & ((places > scene.lower[:2]) & (places < scene.upper[:2])).all(axis=1)
    for number, collider in enumerate(scene.colliders):
        if scene.shows(number, frame):
            inside = np.flatnonzero(free)[collider.signed_distance(places[free], frame.time) < 0]
            mask[inside], free[inside] = collider_label(scene, number), False
    mask = mask.reshape(h, w)
    depth = np.where(mask != BACKGROUND, np.float32(shown.view.distance), np.float32(np.inf))
    return replace(shown, mask=mask, depth=depth)


def _smallest(mask: np.ndarray) -> np.ndarray:
    return mask.astype(np.uint8 if mask.max(initial=0) < 256 else np.uint16)


def _flow(scene: RenderScene, shown: Visible, after: View, time: float, later: float) -> np.ndarray:
    """Return where what each pixel shows is in a later view, less where it is, (h, w, 2) float16; nan if unknown."""
    points, way, d = shown.points, shown.at_pixels("moved"), scene.dimension
    for number, collider in enumerate(scene.colliders):
        rows = shown.mask == collider_label(scene, number)
        places = points[rows][:, :d]
        way[rows] = 0.0
        way[rows, :d] = collider.motion.placed(collider.motion.taken_back(places, time), later) - places
    with np.errstate(invalid="ignore", divide="ignore"):
        there, here = (view.pixels(one.reshape(-1, 3)) for view, one in ((after, points + way), (shown.view, points)))
    return (there - here)[:, :2].reshape(*shown.depth.shape, 2).astype(np.float16)
