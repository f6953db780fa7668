"""Images for training: what cameras see of frames, with the matrices of the cameras."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.result import Result, open_result
from mpmcli.processes.pool import render_frames
from mpmcli.render.colliders import collider_meshes
from mpmcli.render.frame_choice import choose_frames
from mpmcli.render.picture_file import require_writable, settings_digest, write_fault
from mpmcli.render.pictures import LARGEST, Painter, RenderSetup, set_up
from mpmcli.render.render_scene import RenderScene, SharedGeometry, render_scene_of
from mpmcli.render.request import Request, require_sense
from mpmcli.render.settings import Settings, parse_limits
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
from mpmcli.render.window import choose_window
from mpmcli.scene.cameras import CameraFile, PlacedCamera, camera_problems, placed_cameras
from mpmcli.scene.entry import definitions
from mpmcli.scene.load import report
from mpmcli.scene.problem import problems_of
from mpmcli.scene.toml_file import read_toml

# What an image may hold, and the endings of the files.
WHAT = {"rgb": ".png", "depth": ".npz", "mask": ".png", "flow": ".npz", "normal": ".npz"}
USUAL = ("rgb", "depth", "mask", "flow")
DIRECTORY, JSON, NERF = "cameras", "cameras.json", "transforms.json"
CONVENTION = (
    "A point X of the scene is at world_to_camera (X, 1) in the axes of the camera: x to the right, y down, z forward "
    "(OpenCV). K (x/z, y/z, 1) are its pixels, K (x, y, 1) for an orthographic camera; pixel (0, 0) is the upper left "
    "one, and its middle is at (0.5, 0.5)."
)


@dataclass(frozen=True)
class ImageSettings:
    """Everything that the images of a frame depend on."""

    cameras: tuple[PlacedCamera, ...]
    what: tuple[str, ...]
    settings: Settings


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
        done, job = count(1), ImageJob(self.result.path, self.asked, self.directory)
        render_frames(job, self.due, workers, watch=lambda *_: watch(next(done)), stop=stop)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        cameras = [camera.name for camera in self.asked.cameras]
        numbers = [int(self.result.numbers[k]) for k in self.ks]
        found = {"directory": str(self.directory), "cameras": cameras, "what": self.asked.what, "frames": numbers}
        return {**found, "made": len(self.due) * len(cameras), "warnings": self.notes}


def image_request(result: Result, request: Request, file: Path | None, what: str | None) -> ImagePlan:
    """Return the plan of the images that options ask for; InputError: they are impossible, or exclude each other."""
    require_sense(request)
    others = {"--movie": request.movie, "--montage": request.montage, "--size": request.size, "--fps": request.fps}
    others |= {"--save-surface": request.save_surface, "--camera": request.camera != Request.camera}
    for option in (option for option, value in others.items() if value):
        raise InputError(f"{option} is for pictures, and --cameras writes images for training; leave it out.")
    if request.mode == "density":
        raise InputError("--mode density shows a slice, and cameras see dots, surface or fluid: give one of these.")
    names = USUAL if what is None else tuple(name.strip() for name in what.split(","))
    for name in (name for name in names if name not in WHAT):
        raise InputError(f'--what "{name}" is not known: give some of {", ".join(WHAT)}, with commas.')
    cameras = cameras_of(result, file)
    settings = Settings(
        mode=request.mode,
        color=request.color or ("material" if request.mode == "dots" else None),
        size=(LARGEST[0], LARGEST[1]),
        theme=request.theme,
        limits=parse_limits(request.clim) if request.clim else None,
        cmap=request.cmap,
        colliders="solid" if request.colliders == "auto" else request.colliders,
    )
    directory = request.output or result.directory / DIRECTORY
    ks = choose_frames(request.frames or "all", result)
    return plan_images(result, ImageSettings(cameras, names, settings), ks, directory, overwrite=request.overwrite)


def cameras_of(result: Result, file: Path | None = None) -> tuple[PlacedCamera, ...]:
    """Return the cameras of a file, None for those of the scene; InputError: there are none, or they are faulty."""
    header, text = result.header, ""
    tables: dict[str, Any] = {"cameras": [dict(table) for table in header.scene.cameras]}
    if file is not None:
        text, tables = read_toml(file, "file of cameras")
    elif not header.scene.cameras and result.dimension == 2:
        tables = {"cameras": [{}]}
    elif not header.scene.cameras:
        raise InputError(f"{result.path}: the scene has no cameras: add [[cameras]] to it, or give --cameras FILE.")
    context = {"dimension": result.dimension, "constants": definitions(header.scene.constants, result.dimension)[0]}
    try:
        cameras = CameraFile.model_validate(tables, context=context).cameras
        problems = list(camera_problems(cameras, header.end or 0.0))
    except ValidationError as error:
        problems = problems_of(error, tables, CameraFile)
    if problems:
        raise InputError(report(problems, str(file or result.path), text))
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


def digest_of(result: Result, asked: ImageSettings) -> str:
    """Return a digest of all that images depend on but their frames."""
    facts = {
        "cameras": [repr(camera) for camera in asked.cameras],
        "what": asked.what,
        "settings": asdict(asked.settings),
    }
    return settings_digest({**facts, "scene": result.header.stored.get("scene", "")})


def files_of(result: Result, asked: ImageSettings, k: int, directory: Path) -> list[Path]:
    """Return the files of a frame; the last frame has no flow."""
    shown = [what for what in asked.what if what != "flow" or k + 1 < result.frame_count]
    number = int(result.numbers[k])
    return [file_of(directory, camera.name, what, number) for camera in asked.cameras for what in shown]


def file_of(directory: Path, camera: str, what: str, number: int) -> Path:
    """Return the file of an image."""
    return directory / camera / f"{what}_{number:06d}{WHAT[what]}"


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

    source: Path
    asked: ImageSettings
    directory: Path

    def start(self) -> Callable[[int], None]:
        """Open the result, and return the function that writes the images of a frame."""
        result = open_result(self.source)
        painter = ImagePainter(result, self.asked)

        def write(k: int) -> None:
            for camera, images in painter.images(k):
                for what, image in images.items():
                    _write(file_of(self.directory, camera.name, what, int(result.numbers[k])), what, image)

        return write


def _write(path: Path, what: str, image: np.ndarray) -> None:
    """Write an image atomically; InputError or RunError as of `write_fault`."""
    from PIL import Image

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with sealed(path, unique=True) as temporary:
            if WHAT[what] == ".png":
                Image.fromarray(image).save(temporary, format="png")
            else:
                with temporary.open("wb") as file:
                    np.savez_compressed(file, **{what: image})
    except OSError as error:
        raise write_fault(path, error) from error


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


def write_matrices(result: Result, asked: ImageSettings, ks: Sequence[int], directory: Path) -> None:
    """Write the matrices of all cameras and frames, and of pinhole cameras in the layout of NeRF tools."""
    scene = render_scene_of(result)
    labels = {BACKGROUND: {"name": "background", "kind": "background"}}
    labels |= {1 + b: {"name": name, "kind": "body"} for b, name in enumerate(scene.bodies)}
    for number, one in enumerate(scene.colliders):
        labels[collider_label(scene, number)] = {"name": one.name, "kind": "rigid body" if one.free else "collider"}
    cameras, images = [], []
    for camera in asked.cameras:
        views = [view_of_camera(scene, camera, float(result.times[k])) for k in ks]
        poses = [world_to_camera(view) for view in views]
        cameras.append(
            {
                "name": camera.name,
                "model": "orthographic" if camera.focal is None else "pinhole",
                "width": camera.size[0],
                "height": camera.size[1],
                "K": intrinsics(views[0]).tolist(),
                "near": min(view.near for view in views),
                "far": max(view.far for view in views),
                "world_to_camera": [pose.tolist() for pose in poses],
            }
        )
        for k, view, pose in zip(ks, views, poses, strict=True):
            K, number = intrinsics(view), int(result.numbers[k])
            images.append(
                {
                    "file_path": file_of(Path(), camera.name, "rgb", number).as_posix(),
                    "time": float(result.times[k]),
                    **dict(zip(("fl_x", "fl_y", "cx", "cy"), K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)),
                    **dict(zip("wh", camera.size, strict=True)),
                    # These tools have y up and z backward.
                    "transform_matrix": (np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
                }
            )
    content = {
        "program": "mpmcli",
        "version": __version__,
        "digest": digest_of(result, asked),
        "convention": CONVENTION,
        "units": {"length": "m", "time": "s", "depth": "m along z", "flow": "pixels to the next frame"},
        "what": {what: f"<camera>/{what}_<frame>{WHAT[what]}" for what in asked.what},
        "labels": labels,
        "frames": [{"number": int(result.numbers[k]), "time": float(result.times[k])} for k in ks],
        "cameras": cameras,
    }
    files = {JSON: content}
    if "rgb" in asked.what and all(camera.focal for camera in asked.cameras):
        files[NERF] = {"camera_model": "OPENCV", "frames": images}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, one in files.items():
            write_text(directory / name, json.dumps(one, indent=1) + "\n", unique=True)
    except OSError as error:
        raise write_fault(directory / JSON, error) from error


def world_to_camera(view: View) -> np.ndarray:
    """Return the matrix (4, 4) that maps points of the scene to the axes of a camera, see CONVENTION."""
    right, up, back = view.axes
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, -up, -back])
    matrix[:3, 3] = -matrix[:3, :3] @ np.array(view.position)
    return matrix


def intrinsics(view: View) -> np.ndarray:
    """Return the matrix K (3, 3) of a view, pixels; of an orthographic one, pixels per metre."""
    scale = view.pixels_per_metre * (1.0 if view.parallel else view.distance)
    width, height = view.size
    return np.array([[scale, 0.0, 0.5 * width], [0.0, scale, 0.5 * height], [0.0, 0.0, 1.0]])
