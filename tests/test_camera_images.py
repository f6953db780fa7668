"""Images for training: an independent projector finds particles, depths and motions where the matrices say."""

import json
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from command import run_here, started
from drawn_results import JELLY, WATER, frame, header, lattice, write
from PIL import Image
from scipy.spatial import KDTree

from mpmcli.dataset import open as open_dataset
from mpmcli.errors import InputError
from mpmcli.output import Result
from mpmcli.render import reconstruction
from mpmcli.render.camera_images import image_request
from mpmcli.render.image_files import read_image
from mpmcli.render.request import Request
from mpmcli.scene.camera_file import CameraFile
from mpmcli.scene.cameras import placed_cameras

SPACING = 0.05
DISTANCE = SPACING / 2
RING = {"name": "ring", "ring": {"count": 3, "radius": 2.5, "height": 0.8}}
FLY = {"name": "fly", "position": ["0.5 + 20 * t", -1.5, 1.2], "target": [0.5, 0.5, 0.4], "size": [200, 150]}
TURN, PUSH, JELLY_SPEED = 6.0, 2.0, np.array([-0.5, 1.0, 0.3])
WHEEL = {
    "name": "wheel",
    "shape": {"box": {"min": [0.3, 0.35, 0.6], "max": [0.6, 0.65, 0.8]}},
    "angular_velocity": TURN,
    "velocity": [PUSH, 0.0, 0.0],
}
FLAT_WHEEL = WHEEL | {"shape": {"box": {"min": [0.3, 0.6], "max": [0.5, 0.75]}}, "velocity": [PUSH, 0.0]}


def made(folder: Path, d: int) -> Result:
    """Return a result of water, and of jelly that moves at a constant velocity, beside a body that turns."""
    low, high = ([0.0] * d, [0.3, 1.0, 0.2] if d == 3 else [0.3, 0.2])
    water = lattice(low, high, DISTANCE)
    jelly = lattice([0.6, 0.5, 0.2] if d == 3 else [0.7, 0.2], [0.8, 0.7, 0.4] if d == 3 else [0.9, 0.4], DISTANCE)
    body = np.repeat([0, 1], [len(water), len(jelly)])
    frames = [frame(k, np.concatenate([water, jelly + 0.01 * k * JELLY_SPEED[:d]]), body) for k in range(3)]
    return write(folder, header([1.0] * d, SPACING, [WATER, JELLY], [WHEEL if d == 3 else FLAT_WHEEL]), frames)


def moved(name: str, points: np.ndarray, d: int, step: float) -> np.ndarray:
    """Return where points (n, 3) of a body at time 0 are after a step, s."""
    if name == "body 1":
        return points + step * np.pad(JELLY_SPEED[:d], (0, 3 - d))
    box = (WHEEL if d == 3 else FLAT_WHEEL)["shape"]["box"]
    centre = np.pad(np.mean([box["min"], box["max"]], axis=0), (0, 3 - d))
    c, s = np.cos(TURN * step), np.sin(TURN * step)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return centre + [PUSH * step, 0.0, 0.0] + (points - centre) @ turn.T


def images_of(result: Result, cameras: Sequence[dict[str, Any]], what: str, mode: str = "surface") -> Path:
    """Write images of all frames, and return their directory."""
    file = result.directory / "cameras.toml"
    file.write_text(tomli_w.dumps({"cameras": list(cameras)}), encoding="utf-8")
    plan = image_request(result, Request(mode=mode, output=result.directory / mode, overwrite=True), file, what)
    plan.carry_out(1)
    return plan.directory


class Projector:
    """A camera as cameras.json has it, in a frame."""

    def __init__(self, directory: Path, camera: int, k: int) -> None:
        content = json.loads((directory / "cameras.json").read_text(encoding="utf-8"))
        facts = content["cameras"][camera]
        self.K, self.matrix = np.array(facts["K"]), np.array(facts["world_to_camera"][k])
        self.flat, self.labels = facts["model"] == "orthographic", content["labels"]
        self.folder, self.number = directory / facts["name"], content["frames"][k]["number"]
        self.time = content["frames"][k]["time"]

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (n, 2) and depths (n,) of points (n, d)."""
        points = np.pad(points, [(0, 0), (0, 3 - points.shape[1])])
        inside = points @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        scaled = inside if self.flat else inside / inside[:, 2:]
        return (np.column_stack([scaled[:, :2], np.ones(len(points))]) @ self.K.T)[:, :2], inside[:, 2]

    def points(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return points (n, 3) at depths (n,) behind pixels (n, 2)."""
        plane = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.K).T
        inside = np.column_stack([plane[:, :2] * (1.0 if self.flat else depth[:, None]), depth])
        return (inside - self.matrix[:3, 3]) @ self.matrix[:3, :3]

    def image(self, what: str) -> np.ndarray:
        path = self.folder / f"{what}_{self.number:06d}"
        if what in ("rgb", "mask"):
            return np.array(Image.open(path.with_suffix(".png")))
        return np.load(path.with_suffix(".npz"))[what]

    def label(self, name: str) -> int:
        return next(int(value) for value, facts in self.labels.items() if facts["name"] == name)


def uncovered(pixels: np.ndarray, depth: np.ndarray, radius: np.ndarray, nearer: float) -> np.ndarray:
    """Return the points, (m,), with none that is nearer by that, m, in the circle about them in the image."""
    tree = KDTree(pixels)
    near = tree.query_ball_point(pixels, radius)
    return np.array([k for k, others in enumerate(near) if depth[others].min() > depth[k] - nearer])


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize(("d", "mode"), [(2, "dots"), (2, "surface"), (3, "dots"), (3, "surface")])
def test_particles_are_where_the_matrices_say(tmp_path: Path, d: int, mode: str) -> None:
    """99 % of those in view lie on their label within a pixel, at their depth within a distance between particles."""
    result = made(tmp_path, d)
    directory = images_of(result, [RING, FLY] if d == 3 else [{}], "rgb,depth,mask", mode)
    for camera in (0, 2, 3) if d == 3 else (0,):
        there = Projector(directory, camera, 1)
        shown = result.frame(1)
        pixels, depth = there.pixels(shown.position.astype(float))
        scale = there.K[0, 0] / (1.0 if d == 2 else depth)
        mask, image = there.image("mask"), there.image("depth")
        rows = np.arange(len(depth))
        if d == 3:
            # Dots are discs; a surface hides the layer below it, and is judged where it is not seen at a low angle.
            radius, nearer = (0.6, 0.3) if mode == "dots" else (1.0, 0.6)
            rows = uncovered(pixels, depth, radius * DISTANCE * scale, nearer * DISTANCE)
        corner = np.floor(pixels[rows]).astype(int)
        # What the collider covers is not judged.
        window = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
        h, w = mask.shape
        near = np.stack([(np.clip(corner[:, 1] + y, 0, h - 1), np.clip(corner[:, 0] + x, 0, w - 1)) for y, x in window])
        found, depths = mask[near[:, 0], near[:, 1]], image[near[:, 0], near[:, 1]]
        covered = (found == there.label("wheel")).any(axis=0)
        right = (found == shown.body[rows] + 1).any(axis=0)
        assert right[~covered].mean() >= 0.99 and (~covered).sum() > 100
        off = np.abs(depths - depth[rows]).min(axis=0)
        assert (off[~covered & right] < DISTANCE).mean() >= 0.99
        # Masks have no other values, and what has none has no depth.
        assert set(np.unique(mask)) <= {0, 1, 2, 3} and np.array_equal(np.isfinite(image), mask > 0)
        assert there.image("rgb").shape == (*mask.shape, 3)


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("d", [2, 3])
def test_flow_is_where_things_are_in_the_next_frame(tmp_path: Path, d: int) -> None:
    """Of a body that translates and of one that turns as well, also as a moving camera sees them, to 0.2 pixels."""
    result = made(tmp_path, d)
    directory = images_of(result, [RING, FLY] if d == 3 else [{}], "depth,mask,flow")
    for camera in (1, 3) if d == 3 else (0,):
        now, then = Projector(directory, camera, 0), Projector(directory, camera, 1)
        mask, depth, flow = now.image("mask"), now.image("depth"), now.image("flow").astype(float)
        assert np.isnan(flow[mask == 0]).all()
        for name in ("body 1", "wheel"):
            rows, columns = np.nonzero(mask == now.label(name))
            assert len(rows) > 50
            here = np.column_stack([columns, rows]) + 0.5
            there = then.pixels(moved(name, now.points(here, depth[rows, columns]), d, then.time - now.time))[0]
            wrong = np.abs(flow[rows, columns] - (there - here)).max(axis=1)
            assert np.quantile(wrong, 0.99) < 0.2, name
    assert not (directory / "camera" / "flow_000002.npz").exists()


@pytest.mark.usefixtures("drawing")
def test_normals_point_outwards(tmp_path: Path) -> None:
    """Those of the faces of the turning box, whose angle at 0.02 s is known, and of the flat top of the water."""
    there = Projector(images_of(made(tmp_path, 3), [RING], "mask,normal"), 0, 2)
    normal, mask = there.image("normal").astype(float), there.image("mask")
    angle = TURN * there.time
    axes = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    of_box = normal[mask == there.label("wheel")]
    assert (np.abs(of_box @ axes.T).max(axis=1) > 0.99).mean() > 0.95 and (of_box[:, 2] > 0.99).any()
    assert np.isnan(normal[mask == 0]).all() and (normal[mask == 1][:, 2] > 0.9).mean() > 0.3


@pytest.mark.usefixtures("drawing")
def test_a_pose_of_another_convention_is_the_same_camera(tmp_path: Path) -> None:
    """A camera of Blender looks along its -z with y up; so does one of transforms.json."""
    turn = np.array([[0.8, -0.36, 0.48], [0.6, 0.48, -0.64], [0.0, 0.8, 0.6]])
    place, away = np.array([1.7, -1.2, 1.3]), 2.0
    camera = {"position": place.tolist(), "target": (place - away * turn[:, 2]).tolist(), "up": turn[:, 1].tolist()}
    directory = images_of(made(tmp_path, 3), [camera | {"fov": 50.0, "size": [64, 64]}], "rgb")
    images = json.loads((directory / "transforms.json").read_text(encoding="utf-8"))["frames"]
    assert len(images) == 3 and (directory / images[2]["file_path"]).exists()
    pose = np.array(images[2]["transform_matrix"])
    np.testing.assert_allclose(pose, [*np.column_stack([turn, place]), [0, 0, 0, 1]], atol=1e-12)
    assert images[0]["fl_y"] == pytest.approx(32 / np.tan(np.radians(25)))
    # A point to the right of the camera, above and before it is at the right, above the middle.
    pixels, depth = Projector(directory, 0, 0).pixels((place + turn @ [0.1, 0.2, -2.0])[None])
    assert depth[0] == pytest.approx(2.0) and pixels[0, 0] > 32 and pixels[0, 1] < 32


@pytest.mark.usefixtures("drawing")
def test_surfaces_are_made_once_for_all_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_once, result, bytes_of = [], made(tmp_path, 3), []
    usual = reconstruction.reconstruct
    monkeypatch.setattr(reconstruction, "reconstruct", lambda *a, **k: made_once.append(1) or usual(*a, **k))
    for _ in range(2):
        directory = images_of(result, [RING, FLY | {"position": [0.5, -1.5, 1.2]}], "rgb,mask")
        bytes_of.append({path: path.read_bytes() for path in sorted(directory.glob("*/*"))})
    # Two bodies of two materials, three frames, two runs.
    assert len(made_once) == 12
    assert bytes_of[0] == bytes_of[1] and len(bytes_of[0]) == 24


@pytest.mark.usefixtures("drawing")
def test_the_command_goes_on_and_refuses_other_images(tmp_path: Path) -> None:
    result = made(tmp_path / "r", 2)
    call = ["render", str(result.directory), "--cameras", "--what", "mask", "--workers", "1"]
    run = run_here(*call)
    assert run.status == 0 and "3 frames from 1 camera" in run.stderr
    directory = result.directory / "cameras"
    assert run.stdout.strip() == str(directory)
    assert open_dataset(result.directory)[0].images("camera", "mask").shape == (3, 256, 256)
    (directory / "camera" / "mask_000001.png").unlink()
    assert "1 frame from 1 camera" in run_here(*call).stderr
    call[4] = "depth"
    refused = run_here(*call)
    assert refused.status == 2 and "has images of other cameras or settings" in refused.stderr
    assert run_here(*call, "--overwrite").status == 0


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("mode", ["dots", "surface"])
def test_what_rests_looks_the_same_in_all_frames(tmp_path: Path, mode: str) -> None:
    """The windows for colours and for masks share a process."""
    points = lattice([0.1, 0.1], [0.5, 0.4], DISTANCE)
    result = write(tmp_path, header([1.0, 1.0], SPACING, [JELLY]), [frame(k, points) for k in range(4)])
    directory = images_of(result, [{"size": [64, 64]}], "rgb,mask", mode)
    images = {path.read_bytes() for path in directory.glob("camera/rgb*")}
    there = Projector(directory, 0, 3)
    assert len(images) == 1 and (there.image("rgb")[there.image("mask") == 1] < 200).any(axis=1).mean() > 0.7


@pytest.mark.usefixtures("drawing")
def test_ctrl_c_leaves_whole_images(tmp_path: Path) -> None:
    """In two workers; the same command goes on."""
    points = lattice([0.1, 0.1], [0.5, 0.4], DISTANCE)
    result = write(tmp_path / "r", header([1.0, 1.0], SPACING, [JELLY]), [frame(k, points) for k in range(150)])
    directory = result.directory / "cameras"
    with started(tmp_path, "render", "r", "--cameras", "--workers", "2") as process:
        until = time.monotonic() + 120
        while len(list(directory.glob("*/*.npz"))) < 8:
            assert process.poll() is None and time.monotonic() < until, process.communicate()
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        stderr = process.communicate(timeout=120)[1]
    assert process.returncode == 130 and stderr.splitlines()[-1] == "interrupted", stderr
    there = {path: path.read_bytes() for path in directory.glob("*/*")}
    assert {path.suffix for path in there} == {".png", ".npz"} and len(there) < 599
    for path in there:
        read_image(path, path.name.partition("_")[0])
    run = run_here("render", result.directory, "--cameras", "--frame", "0:8", "--workers", "1")
    assert run.status == 0 and all(path.read_bytes() == content for path, content in there.items())
    told = json.loads((directory / "cameras.json").read_text(encoding="utf-8"))
    assert len(told["frames"]) >= 8 and len(list(directory.glob("*/mask_*.png"))) >= 8


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"position": [1.0, 0.0, 0.0], "target": [1.0, 0.0, 0.0]}, r"cameras\[0\].target: must not be the position"),
        ({"position": [1.0, 0.0, 0.0], "up": [0.0, 0.0, 0.0]}, "must have a direction"),
        ({"position": [1.0, 0.0, 0.0], "fov": 30.0, "focal": 100.0}, '"fov" is given as well'),
        ({"position": [1.0, 0.0, 0.0], "height": 1.0}, "is for scenes in 2D"),
        ({"posision": [1.0, 0.0, 0.0]}, "position"),
        ({}, "missing key, or path, ring, dome"),
        (RING | {"position": [1.0, 0.0, 0.0]}, "is given as well; leave one of them out"),
        ({"position": [1.0, 0.0, 0.0], "size": [4, 4]}, "must be two numbers of pixels from 16 to 8192"),
        (
            {"path": [{"time": 0.0, "position": [2.0, 0.0, 0.0]}, {"time": 0.5, "position": [0.0, 2.0, 0.0]}]},
            "must cover the run, from 0 to 1 s; found 0 to 0.5 s",
        ),
    ],
)
def test_bad_cameras_get_a_sentence(tmp_path: Path, tables: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        images_of(made(tmp_path, 3), [tables], "mask")


def test_bad_options_get_a_sentence(tmp_path: Path) -> None:
    result = made(tmp_path, 3)
    for request, what, sentence in (
        (Request(), None, "the scene has no cameras: add"),
        (Request(camera="top"), None, "--camera is for pictures"),
        (Request(), "rgb,colour", 'what "colour" is not known: give some of rgb, depth, mask, flow, normal'),
        (Request(mode="density"), None, "--mode density shows a slice"),
    ):
        with pytest.raises(InputError, match=sentence):
            image_request(result, request, None, what)
    file = tmp_path / "c.toml"
    file.write_text(tomli_w.dumps({"cameras": [RING]}), encoding="utf-8")
    with pytest.raises(InputError, match="--what normal is for surfaces"):
        image_request(result, Request(), file, "normal")
    file.write_text(tomli_w.dumps({"cameras": [{"position": [5.0, 5.0, 5.0], "target": [9.0, 9.0, 9.0]}]}))
    (note,) = image_request(result, Request(), file, None).notes
    assert note == 'camera "camera" sees nothing of the domain in frame 0'
    file.write_text(tomli_w.dumps({"cameras": [{"position": [0.7, 0.6, 0.3], "target": [0.0, 0.0, 0.0]}]}))
    (note,) = image_request(result, Request(), file, None).notes
    assert note.startswith('camera "camera" begins inside a body: a particle is ')
    assert not (tmp_path / "cameras").exists()


def test_where_cameras_are() -> None:
    """Rings at equal angles, domes on the upper half of a sphere, paths linear between their keys."""
    key = [{"time": 0.0, "position": [0.0, 0.0, 1.0]}, {"time": 2.0, "position": [4.0, 0.0, 1.0], "target": [1, 0, 0]}]
    tables = [
        RING | {"ring": {"count": 4, "radius": 2.0, "height": 1.0}, "target": ["t", 0.0, 0.5]},
        {"name": "dome", "dome": {"count": 50, "radius": 3.0}},
        {"name": "path", "path": key, "target": [1.0, 0.0, 0.0]},
    ]
    context = {"dimension": 3, "constants": {}}
    cameras = CameraFile.model_validate({"cameras": tables}, context=context).cameras
    placed = placed_cameras(cameras, (0.0,) * 3, (1.0,) * 3, (0.0, 0.0, 1.0))
    ring = np.array([camera.pose(0.5)[0] for camera in placed[:4]])
    assert [camera.name for camera in placed[:4]] == ["ring_0", "ring_1", "ring_2", "ring_3"]
    np.testing.assert_allclose(ring.mean(axis=0), [0.5, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(ring, axis=0), axis=1), 2.0 * np.sqrt(2))
    dome = np.array([camera.pose(0.0)[0] for camera in placed[4:54]]) - 0.5
    np.testing.assert_allclose(np.linalg.norm(dome, axis=1), 3.0)
    # The mean over a half sphere is at half of its height.
    np.testing.assert_allclose(dome.mean(axis=0), [0.0, 0.0, 1.5], atol=0.1)
    position, target = placed[54].pose(0.5)
    np.testing.assert_allclose(position, [1.0, 0.0, 1.0])
    np.testing.assert_allclose(target, [1.0, 0.0, 0.0])
