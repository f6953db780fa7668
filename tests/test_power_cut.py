"""A power cut at any moment of a run leaves every frame that it had reported, and a run that can be resumed."""

from collections.abc import Callable
from pathlib import Path

import pytest
from durable_record import DurableRecord, Image, make_copy, recorded
from scenes import block, solid, tables_of
from test_resume import invented

from mpmcli.frames.frame import Frame
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result, store
from mpmcli.output.checkpoints import read_checkpoints, write_checkpoint
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.simulation import simulate as simulation
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.simulate import simulate
from mpmcli.solver.engine import run as engine_run
from mpmcli.solver.machine.backend import stop_backend

FRAMES, LATER = 4, 7
# Of the run, and steps in a launch, after each of which it writes a checkpoint.
PARTICLES, STEPS = 96, 4
PACKED = "run/out/particles.vtkhdf"


def falling_block(frames: int = FRAMES) -> LoadedScene:
    domain = {"size": [1.0, 1.0], "cells": [10, 10], "gravity": [0.0, -9.81]}
    one = block("block", solid(1e5), [0.3, 0.1], [0.7, 0.4])
    data = tables_of(one, domain=domain, end=frames / 64, frames=frames, precision="f32", contact={})
    return parse_scene(data, laws=parameter_models(), source="block.toml")


def run(
    root: Path, frames: int = FRAMES, *, resume: bool = False, told: Callable[[int], None] = lambda n: None
) -> None:
    settings = RunSettings(root / "run" / "out", arch="cpu", threads=1, resume=resume, checkpoint_every=0.0)
    stop_backend()
    summary = simulate(falling_block(frames), settings, on_frame=lambda row, so_far: told(so_far.frames))
    assert summary.status == "finished", summary.message


@pytest.fixture(scope="module")
def at_once() -> object:
    """Seal each frame at once, in a thread, and launch a few steps at a time, so that a short run has many files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine_run, "FIRST", PARTICLES * STEPS)
        patch.setattr(engine_run.LaunchBudget, "took", lambda *_: None)
        patch.setattr(simulation, "HOLD", 0.0)
        patch.setattr(store, "ASIDE", 0)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, at_once: object) -> dict:
    """A run from its first frame to its packed file, and all that a power cut in it could leave."""
    root = tmp_path_factory.mktemp("whole")
    reported = [0]
    with recorded(root, lambda: reported[0]) as record:
        run(root, told=lambda count: reported.__setitem__(0, count))
        record.cut("the end")
    assert reported == [FRAMES + 1]
    return {
        "record": record,
        "frames": list(open_result(root / "run" / "out").frames()),
        "bytes": (root / PACKED).read_bytes(),
        # The last one in which segments are back beside the packed file.
        "last": next(image for image, *_ in reversed(list(record.images.values())) if _has_both(image)),
    }


def _has_both(image: Image) -> bool:
    return str(PACKED) in map(str, image) and any("segments/frame" in str(path) for path in image)


def lost(image: Image, reported: int, expected: list[Frame], folder: Path) -> str:
    """Return what a copy lacks of the frames that had been reported, "" where it has them all."""
    if not reported:
        return ""
    result = open_result(make_copy(image, folder) / "run" / "out")
    if result.frame_count < reported:
        return f"{result.frame_count} of {reported} frames"
    if result.numbers.tolist() != list(range(result.frame_count)):
        return f"the order of frames: {result.numbers.tolist()}"
    for k, frame in enumerate(expected[:reported]):
        found = result.frame(k)
        if found.time != frame.time or found.step != frame.step:
            return f"time or step of frame {k}"
        for name in ("position", "velocity"):
            if getattr(found, name).tobytes() != getattr(frame, name).tobytes():
                return f"{name} of frame {k}"
    return ""


def check_all(record: DurableRecord, expected: list[Frame], tmp_path: Path) -> None:
    """Require that each copy has every frame that had been reported."""
    faults = []
    for k, (image, reported, moment) in enumerate(record.images.values()):
        try:
            fault = lost(image, reported, expected, tmp_path / f"copy{k}")
        except Exception as error:
            fault = repr(error)
        if fault:
            faults.append(f"{moment}, {reported} reported: {fault}")
    assert not faults, "\n".join(faults[:10])


def test_no_reported_frame_is_lost(whole: dict, tmp_path: Path) -> None:
    record = whole["record"]
    # Each frame is a file that is synced, renamed, and its folder synced.
    assert record.events > 3 * FRAMES
    assert {reported for _, reported, _ in record.images.values()} == set(range(FRAMES + 2))
    check_all(record, whole["frames"], tmp_path)


def test_the_record_notices_what_was_not_synced(tmp_path: Path) -> None:
    """A file that is renamed without a sync is empty after the cut, or has its former name."""
    (tmp_path / "root").mkdir()
    with recorded(tmp_path / "root", lambda: 0) as record:
        temporary = tmp_path / "root" / "a.tmp"
        temporary.write_text("content")
        temporary.replace(tmp_path / "root" / "a")
    images = [image for image, _, _ in record.images.values()]
    assert {} in images
    assert {"a": b""} in images
    assert all(content != b"content" for image in images for content in image.values())


def require_same_end(
    images: list[tuple[Image, int, str]], expected: bytes, tmp_path: Path, frames: int = FRAMES
) -> None:
    """Require that what each cut left is resumed to the file of the run that was not cut."""
    for k, (image, _, moment) in enumerate(images):
        root = make_copy(image, tmp_path / f"resumed{k}")
        run(root, frames, resume=True)
        assert (root / PACKED).read_bytes() == expected, moment


def test_resumed_after_a_cut_it_ends_with_the_same_bytes(whole: dict, tmp_path: Path) -> None:
    images = list(whole["record"].images.values())
    with_checkpoint = [entry for entry in images if any("step_" in path for path in entry[0])]
    assert with_checkpoint
    # Begun anew, gone on from a checkpoint, packed, or nothing left to do.
    chosen = [images[0], with_checkpoint[len(with_checkpoint) // 2], *images[-3:]]
    require_same_end(chosen, whole["bytes"], tmp_path)


def test_no_reported_frame_is_lost_while_a_finished_run_is_packed_again(whole: dict, tmp_path: Path) -> None:
    """After the cut the segments are back beside the packed file: no step is taken, but files are moved."""
    root = make_copy(whole["last"], tmp_path / "root")
    with recorded(root, lambda: FRAMES + 1) as record:
        run(root, resume=True)
    assert any("segments" in moment for _, _, moment in record.images.values())
    check_all(record, whole["frames"], tmp_path)
    assert (root / PACKED).read_bytes() == whole["bytes"]


@pytest.fixture(scope="module")
def longer(whole: dict, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """The finished run resumed to a later end, and all that a power cut in it could leave."""
    root = make_copy(whole["last"], tmp_path_factory.mktemp("longer") / "root")
    reported = [FRAMES + 1]
    with recorded(root, lambda: reported[0]) as record:
        run(root, LATER, resume=True, told=lambda count: reported.__setitem__(0, count))
    alone = tmp_path_factory.mktemp("alone")
    run(alone, LATER)
    assert (root / PACKED).read_bytes() == (alone / PACKED).read_bytes()
    frames = list(open_result(alone / "run" / "out").frames())
    return {"record": record, "frames": frames, "bytes": (alone / PACKED).read_bytes()}


@pytest.mark.slow
def test_no_reported_frame_is_lost_while_a_run_is_resumed(longer: dict, tmp_path: Path) -> None:
    check_all(longer["record"], longer["frames"], tmp_path)
    images = list(longer["record"].images.values())
    require_same_end(images[::4], longer["bytes"], tmp_path, LATER)


@pytest.mark.slow
def test_resumed_after_any_cut_it_ends_with_the_same_bytes(whole: dict, tmp_path: Path) -> None:
    images = list(whole["record"].images.values())
    require_same_end(images[::5], whole["bytes"], tmp_path)


def test_a_checkpoint_that_was_written_outlives_a_cut(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    with recorded(root, lambda: 0) as record:
        write_checkpoint(root, invented(7), 1000)
        record.images.clear()
        record.cut("the end")
    for k, (image, _, moment) in enumerate(record.images.values()):
        found = list(read_checkpoints(make_copy(image, tmp_path / f"copy{k}")))
        assert [point.step for point in found] == [7], moment
