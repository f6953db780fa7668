"""Runs that were killed or interrupted go on with the bytes of runs that were not."""

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import SCENE, run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from made_result import made_frame, made_header, made_row
from scenes import block, box, collider, liquid, solid, tables_of
from test_checksums import flip, place_of
from test_output_frames import make_frame
from test_output_segments import fill

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.output import SegmentStore, open_result
from mpmcli.output.checkpoints import CHECKPOINTS, Checkpoint, read_checkpoints, write_checkpoint
from mpmcli.output.layout import DAMAGED, FrameIndex, sealed_segments
from mpmcli.output.vtkhdf import read_index_of
from mpmcli.scene import Scene, load_scene, parse_scene
from mpmcli.simulation.resume import Resumption, find_resumption, go_on, require_same_run, take_over
from mpmcli.simulation.simulate import Checkpointer, RunSettings, simulate
from mpmcli.solver.engine import run as engine_run
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.engine.saved_state import SavedState
from mpmcli.solver.machine.backend import choose_backend, start, stop_backend

SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 2e5, "poissons_ratio": 0.3, "friction_angle": 30.0}
JELLY = solid(2e5, poissons_ratio=0.3)
# Sand, water from an emitter, a paddle that turns ever faster, gravity that swings, an open face.
PADDLE = {"wall": "slip", "friction": 0.3, "velocity": [0.3, "-0.5 + t"], "angular_velocity": "20*t"}
CHANGING = tables_of(
    block("sand", SAND, [0.1, 0.0], [0.6, 0.2]),
    domain={"size": [1.0, 1.0], "cells": [20, 20], "gravity": ["2*sin(9*t)", -9.81], "walls": {"y_max": "open"}},
    time={"end": 0.4, "frames": 7},
    fields=["velocity", "density"],
    emitters=[block("jet", liquid(2e4, volume_correction=True), [0.75, 0.7], [0.9, 0.75], velocity=[0.0, -1.5])],
    colliders=[collider("paddle", box([0.3, 0.25], [0.5, 0.35]), **PADDLE)],
    contact={},
)
# Two elastic bodies that collide on grids of their own.
TOTAL = tables_of(
    *(
        block(f"block {k}", JELLY, [0.1 + 0.5 * k, 0.3], [0.4 + 0.5 * k, 0.6], velocity=[2.0 - 4.0 * k, 0.0])
        for k in range(2)
    ),
    domain={"size": [1.0, 1.0], "cells": [16, 16]},
    time={"end": 0.1, "frames": 4},
    solids="total",
    contact={},
)
# Stops at the n-th point where a run can stop, by SIGKILL.
KILLED = """
import os, signal, sys
from pathlib import Path
from types import SimpleNamespace
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import load_scene
from mpmcli.simulation import simulate as simulation
from mpmcli.simulation.simulate import RunSettings, simulate
from mpmcli.solver.engine import run as engine_run
scene, directory, form = sys.argv[1:]
engine_run.FIRST, simulation.HOLD = 2000, 0.0
engine_run.LaunchBudget.took = lambda *_: None
def told(row, summary):
    if summary.frames == 3:
        os.kill(os.getpid(), signal.SIGKILL)
loaded = load_scene(scene, laws=parameter_models())
simulate(loaded, RunSettings(Path(directory), form=form, checkpoint_every=0.0), on_frame=told)
"""


def run_of(scene: Scene) -> Run:
    """Return a run of a scene on a fresh backend."""
    stop_backend()
    backend = replace(choose_backend("cpu", 1, "f32"), optimisation="few")
    start(backend)
    return build_run(scene, backend)


@pytest.fixture
def short_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a run stop every few steps."""
    monkeypatch.setattr(engine_run, "FIRST", 2000)
    monkeypatch.setattr(engine_run.LaunchBudget, "took", lambda *_: None)


@pytest.mark.parametrize("data", [CHANGING, TOTAL], ids=["all that changes", "total"])
def test_a_state_that_is_loaded_elsewhere_goes_on_with_the_same_bytes(data, short_launches):
    scene = parse_scene(data, laws=parameter_models(), source="<test>").scene
    run = run_of(scene)
    saved: list[tuple[int, str, SavedState]] = []
    expected = []

    def keep() -> bool:
        state = run.save().copied()
        saved.append((len(expected), json.dumps(state.numbers), state))
        return False

    expected.extend(run.frames(keep))
    assert len(saved) >= 4
    frames, numbers, state = saved[len(saved) // 2]
    assert 0 < frames < len(expected)
    other = run_of(scene)
    other.load(SavedState(json.loads(numbers), state.arrays))
    found = list(other.frames())
    assert len(found) == len(expected) - frames
    for (frame, row), (before, same) in zip(found, expected[frames:], strict=True):
        assert repr(row) == repr(same)
        assert frame.position.tobytes() == before.position.tobytes()
        assert frame.velocity.tobytes() == before.velocity.tobytes()


def test_a_run_that_goes_on_for_longer_knows_how_fast_its_colliders_become():
    """Their speed grows: at most half a cell in a step at the new end, not at that of the checkpoint."""
    states = {}
    for end in (0.1, 10.0):
        changed = {**CHANGING, "emitters": [], "time": {**CHANGING["time"], "end": end}}
        scene = parse_scene(changed, laws=parameter_models(), source="<test>").scene
        run = run_of(scene)
        states[end] = run.save().copied()
        bound = scene.domain.spacing / 2 / max(one.fastest(scene.domain, end) for one in scene.colliders)
    run.load(states[0.1])
    assert run.state.collider == pytest.approx(bound)


def test_frames_of_a_forced_run_are_kept_by_no_other():
    """Before the first checkpoint as well."""
    for began in (False, True):
        found = SimpleNamespace(checkpoint=None, record={"forced": began})
        go_on(None, found, None, forced=began)
        with pytest.raises(InputError, match="resume it in the same way"):
            go_on(None, found, None, forced=not began)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A directory with drop.toml, its result (packed) and the series of the same run."""
    directory = tmp_path_factory.mktemp("resume")
    (directory / "drop.toml").write_text(SCENE, encoding="utf-8")
    for form, name in (("vtkhdf", "packed"), ("vtk", "series")):
        outcome = run_here("simulate", directory / "drop.toml", "-o", directory / name, "--format", form, "-q")
        assert outcome.status == 0, outcome
    return directory


def files_of(directory: Path) -> dict[str, bytes]:
    """Return the content of every file of a result but run.json, which has times."""
    return {path.name: path.read_bytes() for path in directory.iterdir() if path.is_file() and path.name != "run.json"}


@pytest.mark.parametrize(("form", "name"), [("vtkhdf", "packed"), ("vtk", "series")])
def test_a_killed_run_that_is_resumed_has_the_bytes_of_one_that_was_not(whole, tmp_path, form, name):
    words = [sys.executable, "-c", KILLED, str(whole / "drop.toml"), str(tmp_path / "killed"), form]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert any(read_checkpoints(tmp_path / "killed"))
    kept = open_result(tmp_path / "killed")
    assert kept.frame_count == 3
    outcome = run_here(
        "simulate", whole / "drop.toml", "-o", tmp_path / "killed", "--format", form, "--threads", 2, "--resume"
    )
    assert outcome.status == 0 and "resumed: 3 frames kept, computed again from step" in outcome.stderr
    assert files_of(tmp_path / "killed") == files_of(whole / name)
    record = json.loads((tmp_path / "killed" / "run.json").read_text(encoding="utf-8"))
    assert record["status"] == "finished" and record["frames_written"] == 5
    assert [entry["frames"] for entry in record["resumed"]] == [3] and record["resumed"][0]["step"] > 0
    assert record["steps"] == open_result(whole / name).frame(4).step


def interrupted(whole: Path, directory: Path, calls: int, **options: object) -> None:
    """Interrupt a run of the drop at the n-th point where it can stop."""
    count = 0

    def stop() -> bool:
        nonlocal count
        count += 1
        return count >= calls

    stop_backend()
    loaded = load_scene(whole / "drop.toml", laws=parameter_models())
    summary = simulate(loaded, RunSettings(directory, **options), stop=stop)
    assert summary.status == "interrupted"


def test_an_interrupted_run_goes_on_later_and_longer(whole, tmp_path, short_launches):
    """First to the end that it had, then to twice the time, as a run of twice the time."""
    interrupted(whole, tmp_path / "part", 3)
    assert (tmp_path / "part" / "particles.vtkhdf").exists()
    resume = ("simulate", whole / "drop.toml", "-o", tmp_path / "part", "--resume", "-q")
    assert run_here(*resume, "--checkpoint", 0).status == 0
    assert files_of(tmp_path / "part") == files_of(whole / "packed")
    before = (tmp_path / "part" / "particles.vtkhdf").stat().st_mtime_ns
    outcome = run_here(*resume)
    assert outcome.status == 0 and (tmp_path / "part" / "particles.vtkhdf").stat().st_mtime_ns == before
    longer = ("--set", "time.end=0.1", "--set", "time.frames=8")
    assert run_here("simulate", whole / "drop.toml", "-o", tmp_path / "long", "-q", *longer).status == 0
    outcome = run_here(*resume, *longer)
    assert outcome.status == 0, outcome
    record = json.loads((tmp_path / "part" / "run.json").read_text(encoding="utf-8"))
    assert record["resumed"][-1]["step"] > 0
    assert files_of(tmp_path / "part") == files_of(tmp_path / "long")


def test_a_finished_run_that_is_resumed_with_another_format_has_its_series(whole, tmp_path):
    """No frame is computed for it, and one that goes on without it has none."""
    shutil.copytree(whole / "packed", tmp_path / "run")
    resume = ("simulate", whole / "drop.toml", "-o", tmp_path / "run", "--resume", "-q")
    assert run_here(*resume, "--format", "vtk").status == 0
    assert files_of(tmp_path / "run") == files_of(whole / "series")
    assert run_here(*resume, "--set", "time.end=0.1", "--set", "time.frames=8").status == 0
    assert set(files_of(tmp_path / "run")) == set(files_of(whole / "packed"))


def test_a_run_that_was_not_begun_begins(whole, tmp_path):
    outcome = run_here("simulate", whole / "drop.toml", "-o", tmp_path / "new", "--resume", "-q")
    assert outcome.status == 0
    assert files_of(tmp_path / "new") == files_of(whole / "packed")


def find(whole: Path, directory: Path, *overrides: str) -> object:
    return find_resumption(load_scene(whole / "drop.toml", overrides, laws=parameter_models()), directory)


@pytest.mark.parametrize(("overrides", "part"), [
    (["time.safety=0.3"], "time.safety was"),
    (["bodies.drop.material.density=900.0"], "bodies[0].material.density was 1000.0 and is 900.0"),
    (["output.fields=['velocity']"], "output.fields"),
    (["time.frames=8"], "may only grow, both by the same factor"),
    (["time.end=0.025", "time.frames=2"], "may only grow, both by the same factor"),
])  # fmt: skip
def test_another_scene_is_refused_with_the_keys_that_differ(whole, overrides, part):
    with pytest.raises(InputError) as error:
        find(whole, whole / "packed", *overrides)
    assert part in str(error.value)


@pytest.mark.parametrize(("key", "value"), [("version", "0.0.1"), ("backend", {"arch": "cuda", "precision": "f32"})])
def test_frames_of_another_version_or_backend_are_refused_before_a_step(whole, key, value):
    found = find(whole, whole / "packed")
    header = dict(found.index.header)
    require_same_run(found, header | {"scene": "another"}, whole)
    with pytest.raises(InputError, match=f"holds frames whose {key} is "):
        require_same_run(found, header | {key: value}, whole)


def test_what_is_no_run_is_refused_and_left_alone(whole, tmp_path):
    (tmp_path / "scene.toml").write_text("mine = 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="no run that could be resumed"):
        find(whole, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
    outcome = run_here("simulate", whole / "drop.toml", "-o", tmp_path / "x", "--resume", "--overwrite")
    assert outcome.status == 2 and "give one of them" in outcome.stderr and not (tmp_path / "x").exists()


def test_a_damaged_segment_and_all_after_it_are_computed_again(whole, tmp_path):
    """Without a checkpoint before the damage the run begins anew, and keeps what is sound."""
    words = [sys.executable, "-c", KILLED, str(whole / "drop.toml"), str(tmp_path / "killed"), "vtkhdf"]
    subprocess.run(words, capture_output=True, text=True, timeout=300)
    segment = tmp_path / "killed" / "segments" / "frame_000001.vtkhdf"
    segment.write_bytes(segment.read_bytes()[:1000])
    found = find(whole, tmp_path / "killed")
    assert found.frames == 1 and (found.checkpoint is None or found.checkpoint.frame <= 1)
    shutil.rmtree(tmp_path / "killed" / CHECKPOINTS)
    outcome = run_here("simulate", whole / "drop.toml", "-o", tmp_path / "killed", "--resume")
    assert outcome.status == 0 and "1 frame kept, computed again from the start" in outcome.stderr
    assert files_of(tmp_path / "killed") == files_of(whole / "packed")


def files_of_effective(whole, tmp_path):
    """Return the files of a run of the effective scene, in which no modulus is "auto"."""
    assert run_here("simulate", whole / "packed" / "scene.toml", "-o", tmp_path / "fresh").status == 0
    return files_of(tmp_path / "fresh")


@pytest.mark.parametrize("damage", ["torn", "a particle", "a table"])
def test_a_damaged_packed_file_is_computed_again(whole, tmp_path, damage):
    """By the scene that lies beside it; the sentence on the damage names the way."""
    shutil.copytree(whole / "packed", tmp_path / "run")
    packed = tmp_path / "run" / "particles.vtkhdf"
    if damage == "torn":
        packed.write_bytes(packed.read_bytes()[:5000])
    else:
        flip(packed, place_of(packed, *(("VTKHDF/Points", 7) if damage == "a particle" else ("ledger/mass", 1))))
    outcome = run_here("simulate", tmp_path / "run" / "scene.toml", "-o", tmp_path / "run", "--resume")
    assert outcome.status == 0 and "0 frames kept, computed again from the start" in outcome.stderr
    assert files_of(tmp_path / "run") == files_of_effective(whole, tmp_path)


def test_a_damaged_packed_file_is_kept_until_it_has_been_computed_again(whole, tmp_path):
    """A run that is interrupted meanwhile has lost nothing that it had."""
    shutil.copytree(whole / "packed", tmp_path / "run")
    packed = tmp_path / "run" / "particles.vtkhdf"
    packed.write_bytes(packed.read_bytes()[:5000])
    torn = packed.read_bytes()
    take_over(tmp_path / "run", find(whole, tmp_path / "run"))
    assert packed.with_name(DAMAGED).read_bytes() == torn and not packed.exists()
    outcome = run_here("simulate", tmp_path / "run" / "scene.toml", "-o", tmp_path / "run", "--resume")
    assert outcome.status == 0 and files_of(tmp_path / "run") == files_of_effective(whole, tmp_path)


def test_frames_that_were_packed_while_their_segments_stay_are_there_once(whole, tmp_path):
    """As if the run was killed before it could remove them; then the packed file is damaged."""
    shutil.copytree(whole / "packed", tmp_path / "run")
    (tmp_path / "run" / "segments").mkdir()
    packed, segment = (tmp_path / "run" / name for name in ("particles.vtkhdf", "segments/frame_000000.vtkhdf"))
    shutil.copy(packed, segment)
    resume = ("simulate", whole / "drop.toml", "-o", tmp_path / "run", "--resume")
    for damaged in (packed, segment):
        damaged.write_bytes(damaged.read_bytes()[:5000])
        outcome = run_here(*resume)
        assert outcome.status == 0 and "all 5 frames are there" in outcome.stderr
        assert files_of(tmp_path / "run") == files_of(whole / "packed") and not segment.parent.exists()
        segment.parent.mkdir()
        shutil.copy(packed, segment)


def invented(step: int) -> Checkpoint:
    """A checkpoint with a few numbers and arrays."""
    arrays = {"a": np.arange(step, step + 40, dtype=np.float32), "b": np.full((3, 2), step)}
    numbers = {"time": 0.1 * step, "drift": float("inf"), "frames": [step, 0, 0.0]}
    return Checkpoint(step, step, 0.1 * step, {"arch": "cpu", "precision": "f32"}, False, numbers, arrays)


def test_two_checkpoints_are_kept_and_read_back(tmp_path):
    for step in (3, 5, 1000):
        write_checkpoint(tmp_path, invented(step), 1000)
    found = list(read_checkpoints(tmp_path))
    assert [point.step for point in found] == [1000, 5]
    for point in found:
        assert point.numbers == invented(point.step).numbers
        assert all(np.array_equal(point.arrays[name], array) for name, array in invented(point.step).arrays.items())


@settings(max_examples=150)
@given(data=st.data())
def test_a_checkpoint_with_a_flipped_bit_is_not_read_or_says_the_same(tmp_path_factory, data: st.DataObject):
    """A flip in the names and dates of the archive may leave all numbers as they are."""
    directory = tmp_path_factory.mktemp("flipped")
    content = bytearray(write_checkpoint(directory, invented(7), 1000).read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= 1 << data.draw(st.integers(0, 7))
    (directory / CHECKPOINTS / "step_000000007.npz").write_bytes(bytes(content))
    for point in read_checkpoints(directory):
        expected = invented(7)
        assert (point.frame, point.step, point.numbers) == (expected.frame, expected.step, expected.numbers)
        assert set(point.arrays) <= {"a", "b"}
        for name, array in point.arrays.items():
            assert np.array_equal(array, expected.arrays[name])


@pytest.mark.parametrize("sound", [1, 2, 3])
def test_no_segment_stays_from_the_damaged_one_on(tmp_path: Path, sound: int) -> None:
    fill(tmp_path, [make_frame(k, 5, 2) for k in range(4)], finish=False)
    before = sealed_segments(tmp_path)
    assert len(before) == 4
    before[sound].write_bytes(before[sound].read_bytes()[:1000])
    index = FrameIndex.joined([read_index_of(path) for path in before[:sound]])
    take_over(tmp_path, Resumption(index, None, False, {}))
    assert sealed_segments(tmp_path) == before[:sound]


class SizedArrays(dict):
    nbytes = 1000


def test_frames_before_a_checkpoint_are_sealed(tmp_path: Path) -> None:
    store = SegmentStore(tmp_path, made_header(2), hold=1e9)
    for k in range(3):
        store.write(made_frame(k, 2), made_row(k, 2))
    assert store.frames_written == 0
    saved = SimpleNamespace(numbers={"frames": [3, 0, 0.0]}, arrays=SizedArrays(a=np.zeros(3)))
    run = SimpleNamespace(save=lambda: saved, step_count=30, time=0.05)
    backend = {"arch": "cpu", "precision": "f32"}
    Checkpointer(tmp_path, run, store, backend, size=1000, forced=False, every=0.0).take()
    (point,) = read_checkpoints(tmp_path)
    on_disk = sum(len(read_index_of(path).times) for path in sealed_segments(tmp_path))
    assert point.frame == on_disk == store.frames_written == 3
