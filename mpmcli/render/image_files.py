"""The files of images for training: their names, their bytes, and the matrices of the cameras beside them."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mpmcli import __version__
from mpmcli.errors import InputError
from mpmcli.output.checksums import DAMAGE, first_line
from mpmcli.output.durable import sealed, write_text
from mpmcli.output.result import Result
from mpmcli.render.picture_file import settings_digest, write_fault
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.settings import WHAT, Settings
from mpmcli.render.view import View, view_of_camera
from mpmcli.render.visible import BACKGROUND, collider_label
from mpmcli.scene.cameras import PlacedCamera

JSON, NERF = "cameras.json", "transforms.json"
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


def write_image(path: Path, what: str, image: np.ndarray) -> None:
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


def read_image(path: Path, what: str) -> np.ndarray:
    """Read an image in the form of `ImagePainter.images`; InputError: it is missing or damaged."""
    from PIL import Image

    try:
        if WHAT[what] == ".png":
            with Image.open(path, formats=["PNG"]) as image:
                return np.array(image)
        with np.load(path) as file:
            return file[what]
    except FileNotFoundError:
        raise InputError(f"{path} is missing: make the images again.") from None
    # Pillow and zipfile raise almost any exception at a damaged file.
    except Exception as error:
        raise InputError(f"{path} is damaged ({first_line(error)}): make the images again.") from error


@dataclass(frozen=True, eq=False)
class CameraMatrices:
    """Where a camera is in F frames, see CONVENTION; lengths in m."""

    K: np.ndarray  # (3, 3), pixels; of an orthographic camera pixels per metre
    world_to_camera: np.ndarray  # (F, 4, 4)
    frames: np.ndarray  # (F,) their numbers
    times: np.ndarray  # (F,), s
    size: tuple[int, int]  # width and height, pixels
    near: float  # distances between which the domain lies
    far: float
    model: str  # "pinhole" or "orthographic"
    labels: dict[int, str]  # the name of each value of a mask


def read_matrices(directory: Path) -> tuple[dict[str, CameraMatrices], list[str]]:
    """Return the cameras of images by name, and what the images hold; InputError: there are none, or it is damaged."""
    path = directory / JSON
    if not path.is_file():
        raise InputError(f"{directory} has no images: make them by [images] in a sweep, or by mpmcli render --cameras.")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        numbers, times = (np.array([one[key] for one in told["frames"]]) for key in ("number", "time"))
        labels = {int(value): one["name"] for value, one in told["labels"].items()}
        cameras = {}
        for one in told["cameras"]:
            matrices, size = (np.array(one[name]) for name in ("K", "world_to_camera")), (one["width"], one["height"])
            facts = size, one["near"], one["far"], one["model"], labels
            cameras[one["name"]] = CameraMatrices(*matrices, numbers, times, *facts)
        return cameras, list(told["what"])
    except DAMAGE as error:
        raise InputError(f"{path} is damaged ({first_line(error)}): make the images again.") from error


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
