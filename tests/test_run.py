"""One run, from a scene to a stored result: what is kept, whatever happens."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from command import SCENE, run_here

from mpmcli.errors import RunError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.output import SegmentStore, open_result
from mpmcli.scene import load_scene
from mpmcli.simulation.simulate import RunSettings, simulate


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    """The directory of a run of SCENE."""
    directory = tmp_path_factory.mktemp("run")
    (directory / "drop.toml").write_text(SCENE, encoding="utf-8")
    outcome = run_here("simulate", directory / "drop.toml", "-o", directory / "first", "--quiet")
    assert outcome.status == 0, outcome
    return directory / "first"


def test_frames_land_on_their_times(first):
    result = open_result(first)
    assert result.times.tolist() == [0.05 * k / 4 for k in range(5)]
    assert [row.time for row in result.ledger] == result.times.tolist()
    for before, row in zip(result.ledger, result.ledger[1:], strict=False):
        # All steps to one frame sum to the time between the two.
        assert row.steps * row.step_min <= (row.time - before.time) * (1 + 1e-12)
        assert row.steps * row.step_max >= (row.time - before.time) * (1 - 1e-12)
    assert [result.frame(k).step for k in range(5)] == np.cumsum([row.steps for row in result.ledger]).tolist()


def test_the_record_says_what_was_run(first):
    record = json.loads((first / "run.json").read_text(encoding="utf-8"))
    expected = {"program": "mpmcli", "status": "finished", "frames_written": 5, "frames_expected": 5}
    expected |= {"particles": 256, "failure": None, "seeds": {}}
    assert {key: record[key] for key in expected} == expected
    assert sum(record["limits"].values()) == 4
    assert record["steps"] == open_result(first).frame(4).step
    assert record["backend"]["precision"] == "f32"


@pytest.mark.parametrize("sampling", ["jittered", "poisson"])
def test_the_record_has_the_seeds_of_what_is_random(tmp_path, sampling):
    random = SCENE.replace("[[bodies]]", f'[[bodies]]\nsampling = "{sampling}"\nseed = 5', 1)
    (tmp_path / "drop.toml").write_text(random, encoding="utf-8")
    assert run_here("simulate", tmp_path / "drop.toml", "-o", tmp_path / "out", "--quiet").status == 0
    assert list(json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["seeds"].values()) == [5]


def test_the_stored_scene_gives_the_same_bytes_again(first, tmp_path):
    """The effective scene is complete: no default and no "auto" is chosen differently the second time."""
    outcome = run_here("simulate", first / "scene.toml", "-o", tmp_path / "again", "--quiet")
    assert outcome.status == 0
    assert (tmp_path / "again" / "scene.toml").read_bytes() == (first / "scene.toml").read_bytes()
    one, other = open_result(first), open_result(tmp_path / "again")
    assert one.ledger == other.ledger
    for a, b in zip(one.frames(), other.frames(), strict=True):
        assert a.position.tobytes() == b.position.tobytes()
        assert a.velocity.tobytes() == b.velocity.tobytes()


def test_overwriting_replaces_the_result_and_nothing_else(first, tmp_path):
    """A series of the same run has the same bits in its frames."""
    directory = tmp_path / "result"
    shutil.copytree(first, directory)
    (directory / "notes.txt").write_text("mine")
    scene = first.parent / "drop.toml"
    outcome = run_here("simulate", scene, "-o", directory, "--format", "vtk", "--quiet")
    assert outcome.status == 2 and (directory / "particles.vtkhdf").exists()
    outcome = run_here("simulate", scene, "-o", directory, "--format", "vtk", "--quiet", "--overwrite")
    assert outcome.status == 0
    names = {path.name for path in directory.iterdir()}
    assert "notes.txt" in names and "particles.pvd" in names
    assert (first / "particles.vtkhdf").read_bytes() == (directory / "particles.vtkhdf").read_bytes()
    for frame in open_result(first).frames():
        mesh = meshio.read(directory / f"particles_{frame.index:06d}.vtu")
        assert mesh.points[:, :2].tobytes() == frame.position.tobytes()
        assert mesh.point_data["density"].tobytes() == frame.fields["density"].tobytes()


def test_an_unstable_run_keeps_its_frames_and_says_where_it_failed(tmp_path):
    """Under gravity of 1e9 m/s^2 a soft drop is crushed on the floor, whatever the step."""
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.replace("-9.81", "-1e9").replace("[0.25, 0.0]", "[0.25, 0.25]"), encoding="utf-8")
    soft = "bodies.drop.material.bulk_modulus=1e5"
    outcome = run_here("simulate", scene, "-o", tmp_path / "result", "--set", soft, "--json")
    assert outcome.status == 1 and "Traceback" not in outcome.stderr
    summary = json.loads(outcome.stdout)
    assert summary["status"] == "unstable" and summary["frames"] == 1
    (said,) = [line for line in outcome.stderr.splitlines() if line.startswith("error: ")]
    assert said == f"error: {summary['message']}"
    for part in ("unstable at step ", ", t = ", " s: particle ", 'body "drop" at (', ") m collapsed", "limit"):
        assert part in said, part
    record = json.loads((tmp_path / "result" / "run.json").read_text(encoding="utf-8"))
    assert record["status"] == "unstable"
    assert {"message", "step", "time", "particle", "body", "position", "limit"} <= set(record["failure"])
    result = open_result(tmp_path / "result")
    assert result.frame_count == 1 and result.kind == "packed"
    # The particle that is named is the row of the frame, and was last seen near its place there.
    place = result.frame(0).position[record["failure"]["particle"]]
    assert np.linalg.norm(place - record["failure"]["position"]) < 1.0


class FakeRun:
    """Gives three frames of one particle without a device, and raises its fault before the last."""

    fault: BaseException | None = None

    def __init__(self, *_: object, **__: object) -> None:
        self.particle_count, self.step_count, self.time = 1, 0, 0.0
        self.first_step_seconds = self.frame_seconds = self.measure_seconds = 0.0
        self.laws = ("fluid",)
        self.batch = SimpleNamespace(launch_cpu=SimpleNamespace(is_there=lambda: False))

    def frames(self, stop):
        for k in range(3):
            if k == 2 and self.fault is not None:
                raise self.fault
            self.step_count, self.time = 10 * k, float(k)
            position = np.full((1, 2), 0.5 + k, np.float32)
            body = np.zeros(1, np.int32)
            frame = Frame(k, float(k), 10 * k, position, 0 * position, body, body)
            yield frame, LedgerRow(k, 10, 0.1, 0.1, "wave", 1, 0.1, 1, 1, 1.0, 1.0, 1.0, 1.0, (0.0, 0.0), (0.0,))


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return `run(fault)`: the summary of a run whose engine raises it after two frames."""
    monkeypatch.setattr("mpmcli.simulation.simulate.start", lambda backend: backend)
    monkeypatch.setattr("mpmcli.simulation.simulate.build_run", FakeRun)
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    loaded = load_scene(scene, laws=parameter_models())

    def run(fault: BaseException | None, on_frame=lambda row, summary: None):
        monkeypatch.setattr(FakeRun, "fault", fault)
        return simulate(loaded, RunSettings(tmp_path / "result"), on_frame=on_frame)

    return run


def status_on_disk(directory: Path) -> str:
    """What run.json says."""
    return json.loads((directory / "run.json").read_text(encoding="utf-8"))["status"]


@pytest.mark.parametrize(
    ("fault", "status", "frames"),
    [(None, "finished", 3), (KeyboardInterrupt(), "interrupted", 2), (RunError("The disk is full."), "failed", 2)],
    ids=["nothing", "Ctrl-C", "disk"],
)
def test_a_run_ends_in_order_whatever_happens(run, tmp_path, fault, status, frames):
    summary = run(fault)
    assert summary.status == status and summary.frames == frames
    assert summary.message == {"finished": "", "failed": "The disk is full."}.get(status, "the run was interrupted")
    assert status_on_disk(tmp_path / "result") == status
    assert summary.path == tmp_path / "result" / "particles.vtkhdf"
    assert open_result(summary.path).frame_count == frames
    assert json.loads(json.dumps(summary.as_dict()))["frames"] == frames


def test_a_fault_of_ours_leaves_no_run_that_seems_to_go_on(run, tmp_path):
    with pytest.raises(ZeroDivisionError):
        run(ZeroDivisionError())
    assert status_on_disk(tmp_path / "result") == "failed"
    assert open_result(tmp_path / "result").frame_count == 2


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [(KeyboardInterrupt(), "interrupted", "packed"), (RunError("The disk has no room."), "failed", "no room")],
    ids=["interrupted", "failed"],
)
def test_a_run_that_cannot_be_packed_says_so_and_leaves_its_segments(run, tmp_path, monkeypatch, error, status, said):
    def finish(self: SegmentStore, stop: Callable[[], bool]) -> None:
        raise error

    monkeypatch.setattr(SegmentStore, "finish", finish)
    summary = run(None)
    assert summary.status == status_on_disk(tmp_path / "result") == status and said in summary.message
    assert summary.path == tmp_path / "result"
    assert open_result(summary.path).frame_count == 3


def test_every_frame_is_reported(run):
    seen = []
    run(None, lambda row, summary: seen.append((row.time, summary.frames, summary.status)))
    assert seen == [(0.0, 1, "running"), (1.0, 2, "running"), (2.0, 3, "running")]
