"""Images for training of what cameras see of the frames of a result: the request, the plan, and its execution."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.result import Result
from mpmcli.processes.pool import render_frames
from mpmcli.render.frame_choice import choose_frames
from mpmcli.render.image_files import (
    JSON,
    ImageSettings,
    digest_of,
    file_of,
    files_of,
    write_image,
    write_matrices,
)
from mpmcli.render.image_painter import ImagePainter
from mpmcli.render.picture_file import require_writable
from mpmcli.render.pictures import LARGEST
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.request import Request, require_sense
from mpmcli.render.settings import IMAGE_DIRECTORY, USUAL_WHAT, WHAT, Settings, parse_limits
from mpmcli.render.view import View, view_of_camera
from mpmcli.render.window import choose_window
from mpmcli.scene.camera_file import valid_cameras
from mpmcli.scene.cameras import PlacedCamera, placed_cameras
from mpmcli.scene.toml_file import read_toml

# A file of cameras, or its tables; None for those of the scene.
Cameras = Path | dict[str, Any] | None


@dataclass(frozen=True)
class ImagePlan:
    """Validated images of frames of a result in a directory; nothing is drawn yet."""

    result: Result
    asked: ImageSettings
    ks: tuple[int, ...]
    directory: Path
    due: tuple[int, ...]  # frames without all of their files
    listed: tuple[int, ...]  # `ks`, and the frames whose images are there already
    notes: tuple[str, ...]

    def carry_out(
        self, workers: int, *, watch: Callable[[int], None] = lambda done: None, stop: Callable[[], bool] = bool
    ) -> None:
        """Write the images that are missing, and the matrices; `watch` gets the number of frames that are done.

        KeyboardInterrupt: the polled `stop` is true. Finished images stay.
        """
        choose_window()
        write_matrices(self.result, self.asked, self.listed, self.directory)
        done, job = count(1), ImageJob(self.result, self.asked, self.directory)
        render_frames(job, self.due, workers, watch=lambda *_: watch(next(done)), stop=stop)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        cameras = [camera.name for camera in self.asked.cameras]
        numbers = [int(self.result.numbers[k]) for k in self.ks]
        found = {"directory": str(self.directory), "cameras": cameras, "what": self.asked.what, "frames": numbers}
        return {**found, "made": len(self.due) * len(cameras), "warnings": self.notes}


def image_request(result: Result, request: Request, given: Cameras, what: str | None) -> ImagePlan:
    """Return the plan of the images that options ask for; InputError: they are impossible, or exclude each other."""
    require_sense(request)
    others = {"--movie": request.movie, "--montage": request.montage, "--size": request.size, "--fps": request.fps}
    others |= {"--save-surface": request.save_surface, "--camera": request.camera != Request.camera}
    for option in (option for option, value in others.items() if value):
        raise InputError(f"{option} is for pictures, and --cameras writes images for training; leave it out.")
    if request.mode == "density":
        raise InputError("--mode density shows a slice, and cameras see dots, surface or fluid: give one of these.")
    names = USUAL_WHAT if what is None else tuple(name.strip() for name in what.split(","))
    for name in (name for name in names if name not in WHAT):
        raise InputError(f'--what "{name}" is not known: give some of {", ".join(WHAT)}, with commas.')
    cameras = cameras_of(result, given)
    settings = Settings(
        mode=request.mode,
        color=request.color or ("material" if request.mode == "dots" else None),
        size=(LARGEST[0], LARGEST[1]),
        theme=request.theme,
        limits=parse_limits(request.clim) if request.clim else None,
        cmap=request.cmap,
        colliders="solid" if request.colliders == "auto" else request.colliders,
    )
    directory = request.output or result.directory / IMAGE_DIRECTORY
    ks = choose_frames(request.frames or "all", result)
    return plan_images(result, ImageSettings(cameras, names, settings), ks, directory, overwrite=request.overwrite)


def cameras_of(result: Result, given: Cameras = None) -> tuple[PlacedCamera, ...]:
    """Return the cameras of a result; InputError: there are none, or they are faulty."""
    header, text, tables = result.header, "", given
    if isinstance(given, Path):
        text, tables = read_toml(given, "file of cameras")
    elif given is None:
        tables = {"cameras": [dict(table) for table in header.scene.cameras] or [{}]}
        if not header.scene.cameras and result.dimension == 3:
            raise InputError(f"{result.path}: the scene has no cameras: add [[cameras]] to it, or give --cameras FILE.")
    source = str(given if isinstance(given, Path) else result.path)
    cameras = valid_cameras(tables, result.dimension, header.scene.constants, header.end or 0.0, source, text)
    scene = render_scene_of(result)
    return tuple(placed_cameras(cameras, scene.lower, scene.upper, scene.up))


def plan_images(
    result: Result, asked: ImageSettings, ks: Sequence[int], directory: Path, *, overwrite: bool
) -> ImagePlan:
    """Return the plan of images; InputError: they are impossible, or other images are in the directory."""
    if "normal" in asked.what and asked.settings.mode == "dots":
        raise InputError("--what normal is for surfaces, and dots have none: give --mode surface.")
    scene, notes = render_scene_of(result), []
    corners = np.array([scene.lower, scene.upper])
    particles = result.present_frame(ks[0], ()).position
    for camera in asked.cameras:
        views = {int(result.numbers[k]): view_of_camera(scene, camera, float(result.times[k])) for k in ks}
        blind = [number for number, view in views.items() if not _sees(view, corners)]
        first = next(iter(views.values()))
        if blind:
            notes.append(f'camera "{camera.name}" sees nothing of the domain in frame {blind[0]}')
        elif scene.dimension == 3 and len(particles):
            gap = float(np.linalg.norm(particles - np.array(first.position), axis=1).min())
            if gap < max(scene.distances):
                notes.append(f'camera "{camera.name}" begins inside a body: a particle is {gap:.3g} m from it')
    path = directory / JSON
    require_writable(path)
    try:
        there = json.loads(path.read_text(encoding="utf-8")).get("digest", "") if path.exists() else None
    except (OSError, ValueError):
        there = ""
    if there not in (None, digest_of(result, asked)) and not overwrite:
        raise InputError(f"{directory} has images of other cameras or settings: give another -o, or --overwrite.")
    made = {k for k in range(result.frame_count) if all(map(Path.exists, files_of(result, asked, k, directory)))}
    made = set() if overwrite else made
    due = [k for k in ks if k not in made]
    return ImagePlan(result, asked, tuple(ks), directory, tuple(due), tuple(sorted(made | set(ks))), tuple(notes))


def _sees(view: View, corners: np.ndarray) -> bool:
    """Return whether any point of a lattice in the box of two corners is in the image."""
    axes = [np.linspace(low, high, 9) for low, high in corners.T]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, depth = view.pixels(points).T
    return bool(((x >= 0) & (x < view.size[0]) & (y >= 0) & (y < view.size[1]) & (depth > 0)).any())


@dataclass(frozen=True)
class ImageJob:
    """Draws and writes the images of a frame from all cameras, in a worker process."""

    result: Result
    asked: ImageSettings
    directory: Path

    def start(self) -> Callable[[int], None]:
        """Return the function that writes the images of a frame."""
        result, painter = self.result, ImagePainter(self.result, self.asked)

        def write(k: int) -> None:
            for camera, images in painter.images(k):
                for what, image in images.items():
                    write_image(file_of(self.directory, camera.name, what, int(result.numbers[k])), what, image)

        return write
