"""Images of a sweep: beside the shards, the same however the sweep was computed, verified, and read again."""

import json
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from good_sweep import BASE, LAWS, SWEEP, refusal, sweep_of
from made_sweep import made_workers  # noqa: F401
from PIL import Image
from tiny_sweep import contents

from mpmcli.dataset import images
from mpmcli.dataset import open as open_dataset
from mpmcli.dataset.draw import draw
from mpmcli.dataset.merge import merge
from mpmcli.dataset.report import status_of, verify
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.errors import InputError

COUNT = 6
IMAGES = SWEEP + '[images]\nwhat = ["mask", "flow"]\nframes = "::4"\ncameras = "flat.toml"\n'
THROWN = (
    'base = "base.toml"\ncount = 4\n[vary]\n"bodies.jelly.velocity" = { choice = [[0, 0, 1], [1, 0, 0]] }\n[images]\n'
)
JELLY = """
[[bodies]]
name = "jelly"
material = "jelly"
shape = { ball = { center = [0.5, 0.5, 0.5], radius = 0.3 } }
"""
CAMERA = "[[cameras]]\nposition = [3.0, 0.5, 1.0]\n"
FLAT = '[[cameras]]\nname = "near"\nheight = 0.5\nsize = [32, 24]\n[[cameras]]\nname = "whole"\nsize = [32, 32]\n'


@pytest.fixture(autouse=True)
def camera_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("flat.toml").write_text(FLAT, encoding="utf-8")


def made(name: str, text: str = IMAGES, **settings: object) -> Path:
    """Compute the sweep into a directory, to its end."""
    assert run_sweep(sweep_of(text, count=COUNT), SweepSettings(Path(name), **settings)).status == "finished"
    return Path(name)


@pytest.mark.usefixtures("made_workers", "drawing")
def test_images_are_the_same_however_the_sweep_was_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one run; interrupted in each kind of task; [images] added later; of parts; in place of an earlier dataset."""
    truth = contents(made("whole"))
    # Number 4 is left out. Of 11 frames the last but two has a flow.
    assert {path.split("/")[1] for path in truth if path.startswith("images/")} == {f"{n:06d}" for n in (0, 1, 2, 3, 5)}
    _check_reader(Path("whole"))
    found = sorted(path.removeprefix("images/000005/") for path in truth if "000005" in path)
    of_camera = [
        f"{what}_{number:06d}.{end}" for what, end in (("flow", "npz"), ("mask", "png")) for number in (0, 4, 8)
    ]
    every = [f"{camera}/{name}" for camera in ("near", "whole") for name in of_camera]
    assert found == sorted(["cameras.json", "checksums.sha256", *every])
    assert verify(Path("whole")).faults == ()
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked % 4 == 0

    states = [run_sweep(sweep_of(IMAGES, count=COUNT), SweepSettings(Path("broken"), resume=True), stop=stop)]
    while states[-1].status == "interrupted":
        states.append(run_sweep(sweep_of(IMAGES, count=COUNT), SweepSettings(Path("broken"), resume=True), stop=stop))
    assert len(states) > 2 and sum(state.imaged for state in states) == 5 and contents(Path("broken")) == truth
    made("later", SWEEP)
    assert (status_of(Path("later")).imaged, status_of(Path("broken")).imaged) == (None, 5)
    assert "images    5" in status_of(Path("broken")).text()
    assert contents(made("later", resume=True)) == truth
    assert contents(made("later", overwrite=True)) == truth
    # Nor do they stay where none are asked for.
    assert not {path for path in contents(made("later", SWEEP, overwrite=True)) if "images" in path or "flat" in path}
    parts = [made(f"part-{i}", part=(i, 2)) for i in (1, 2)]
    merge(parts, Path("merged"))
    assert contents(Path("merged")) == truth and verify(Path("merged")).faults == ()


def _check_reader(path: Path) -> None:
    """Masks are those of the files, the matrices put particles on their label, and what is not there is named."""
    trajectory = open_dataset(path)[5]
    cameras = trajectory.cameras
    assert [*cameras] == ["near", "whole"] and cameras["near"].size == (32, 24)
    whole, mask, flow = cameras["whole"], trajectory.images("whole", "mask"), trajectory.images("whole", "flow", [8, 0])
    assert whole.frames.tolist() == [0, 4, 8] and whole.labels == {0: "background", 1: "pool", 2: "heap"}
    np.testing.assert_array_equal(whole.times, trajectory.times[whole.frames])
    assert (mask.shape, mask.dtype, flow.shape, flow.dtype) == ((3, 32, 32), np.uint8, (2, 32, 32, 2), np.float16)
    assert np.array_equal(mask[1], np.array(Image.open(path / "images/000005/whole/mask_000004.png")))
    points = np.pad(trajectory.position[4], [(0, 0), (0, 1)]) @ whole.world_to_camera[1, :3, :3].T
    points += whole.world_to_camera[1, :3, 3]
    column, row = np.floor((whole.K @ np.array([*points.T[:2], np.ones(len(points))]))[:2]).astype(int)
    seen = mask[1, row, column]
    # Dots are smaller than pixels, and the bodies overlap.
    assert (seen > 0).mean() > 0.6 and (seen == trajectory.body + 1)[seen > 0].mean() > 0.7
    for camera, what, frames, said in (
        ("far", "mask", None, 'the images of trajectory 5 have no camera "far": give "near" or "whole".'),
        ("near", "rgb", None, 'the images of trajectory 5 have no kind of image "rgb": give "mask" or "flow".'),
        ("near", "mask", [4, 5], 'trajectory 5 has no "mask" of frame 5: it has those of frames [0, 4, 8].'),
        ("near", "mask", [], 'trajectory 5 has no "mask" of no frame: it has those of frames [0, 4, 8].'),
    ):
        with pytest.raises(InputError) as refused:
            trajectory.images(camera, what, frames)
        assert str(refused.value) == said


@pytest.mark.usefixtures("made_workers", "drawing")
def test_only_what_is_missing_or_damaged_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    directory = made("d")
    truth, drawn, usual = contents(directory), [], images.draw_images
    place = directory / "images"
    lost, changed, half = (place / f"{n:06d}" for n in (0, 2, 3))
    (lost / "near" / "mask_000004.png").unlink()
    (changed / "cameras.json").write_text("{}", encoding="utf-8")
    # A killed worker leaves images without their checksums, and a file that has no name yet.
    (half / "checksums.sha256").unlink()
    with pytest.raises(InputError, match=r"mask_000004.png is missing: make the images again"):
        open_dataset(directory)[0].images("near", "mask")
    with pytest.raises(InputError, match=r"cameras.json is damaged \(frames\): make the images again"):
        open_dataset(directory)[2].images("near", "mask")
    (half / "near" / "flow_000000.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"flow_000000.npz is damaged .*: make the images again"):
        open_dataset(directory)[3].images("near", "flow", [0])
    (half / "near" / "flow_000000.npz").unlink()
    (half / "whole" / "mask_000008.png").rename(half / "whole" / "mask_000008.png.12345678.tmp")
    faults = verify(directory).faults
    assert [fault.partition(":")[0] for fault in faults] == [f"images of trajectory {n}" for n in (0, 2, 3)]
    assert all(fault.endswith("; mpmcli sweep --resume draws them.") for fault in faults)
    monkeypatch.setattr("made_sweep.draw_images", lambda *given: drawn.append(given[1].number) or usual(*given))
    assert contents(made("d", resume=True)) == truth
    assert sorted(drawn) == [0, 2, 3] and verify(directory).faults == ()
    with pytest.raises(InputError, match=r"d has images of another \[images\] than the sweep: put that table back"):
        made("d", IMAGES.replace("::4", "::2"), resume=True)


@pytest.mark.usefixtures("drawing")
def test_a_rehearsal_tells_the_images(made_workers: None) -> None:  # noqa: F811
    Path("sweep.toml").write_text(IMAGES, encoding="utf-8")
    Path("base.toml").write_text(BASE, encoding="utf-8")
    outcome = run_here("sweep", "sweep.toml", "--count", COUNT, "--workers", 1, "--dry-run", "--json")
    told = json.loads(outcome.stdout)
    # Five frames of each.
    assert [one["image_frames"] for one in told["trajectories"]] == [2] * COUNT
    assert told["image_bytes"] > 0 and told["seconds"] > told["image_seconds"] > 0
    stored = sum(path.stat().st_size for path in made("d").glob("images/*/*/*"))
    assert 0.3 < told["image_bytes"] / stored < 3
    text = run_here("sweep", "sweep.toml", "--count", COUNT, "--dry-run").stdout
    assert "images: of 12 frames, " in text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"mask"', '"masks"', 'sweep.toml:19: images.what[0]: must be "rgb"'),
        ('"mask"', '"normal"', '"normal" is for surfaces, and dots have none; give mode = "surface"'),
        ("::4", "9:9", "sweep.toml:20: images.frames: 9:9 selects no frame: trajectories have frames 0 to 4"),
        ("::4", "9", "sweep.toml:20: images.frames: 9: trajectories have frames 0 to 4"),
        ("::4", "some", 'sweep.toml:20: images.frames: "some" selects no frame: give a number, first, last, all'),
        ("flat.toml", "none.toml", "none.toml: there is no such file; give the path of a file of cameras in TOML"),
        ("flat.toml", "deep.toml", "deep.toml:3: cameras[0].fov: is for scenes in 3D"),
    ],
)
def test_bad_images_get_a_sentence(old: str, new: str, said: str) -> None:
    Path("deep.toml").write_text(FLAT.replace("height = 0.5", "fov = 40.0"), encoding="utf-8")
    assert said in "\n".join(refusal(IMAGES.replace(old, new)))


def test_a_scene_in_3d_needs_cameras() -> None:
    """In the base scene, where keys of cameras vary as others do, or in a file."""
    base = (
        BASE.replace("[1.0, 1.0]", "[1.0, 1.0, 1.0]")
        .replace("[32, 32]", "[8, 8, 8]")
        .replace("[0.0, -9.81]", "[0, 0, 0]")
    )
    base = base[: base.index("[[bodies]]")] + JELLY
    (said,) = refusal(THROWN, base)
    assert said.startswith("sweep.toml:5: images: needs cameras: add [[cameras]] to the base scene, or name a file")
    sweep = sweep_of(THROWN.replace("[vary]", '[vary]\n"cameras.0.fov" = { uniform = [20, 60] }'), base + CAMERA)
    fov = [draw(sweep, number).scene(LAWS).scene.cameras[0].fov for number in range(4)]
    assert len({*fov}) == 4 and min(fov) >= 20 and max(fov) <= 60
