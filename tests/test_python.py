"""mpmcli in Python: the page runs, windows are slices of trajectories, and bad input has its sentence."""

import json
import pickle
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import ROOT, SCENE, run_here
from good_sweep import BASE, SWEEP, sweep_of
from made_dataset import made_trajectory, write_dataset
from made_result import write_made
from made_sweep import COUNT, VERDICTS, made_workers  # noqa: F401

import mpmcli
import mpmcli.dataset
from mpmcli.dataset import Dataset
from mpmcli.errors import InputError, RunError
from mpmcli.frames.frame import ACTIVE, BLOCKED, RETIRED, WAITING
from mpmcli.output import Result, open_result

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
FOUND = """
import json
import numpy as np
assert isinstance(result, mpmcli.output.Result)
shapes = {name: array.shape for name, array in window.items()}
said = {"shapes": shapes, "time": table.time.tolist(), "energy": energy.tolist(), "count": len(windows)}
print(json.dumps(said | {"spread": np.array([*spread.values()]).tolist(), "lowest": float(lowest)}))
"""


def blocks(language: str, text: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_the_page_runs_and_a_run_has_the_bytes_of_the_command(tmp_path: Path, run_python: Callable) -> None:
    (tmp_path / "drop.toml").write_text(blocks("toml", README)[0], encoding="utf-8")
    found = json.loads(run_python("\n".join(blocks("python", PAGE)) + FOUND).stdout.splitlines()[-1])
    # Sand of a lower angle spreads farther.
    assert found["spread"][0] > found["spread"][1] > 0.2
    result = open_result(tmp_path / "results" / "python")
    assert found["time"] == result.times.tolist()
    assert found["energy"] == pytest.approx([row.energy for row in result.ledger], rel=1e-15)
    ledger = result.ledger
    assert ledger["kinetic"].tolist() == [row.kinetic for row in ledger] and ledger["linear_momentum"].shape == (11, 2)
    assert ledger["energy"] == pytest.approx(found["energy"], rel=1e-15) and ledger[-1] == list(ledger)[-1]
    for name, said in (("kinetik", 'did you mean "kinetic"'), ("emitted", "it has time, steps, ")):
        with pytest.raises(InputError, match=f'has no "{name}"; .*{said}'):
            ledger[name]
    assert found["lowest"] == result.frame(10).position[:, 1].min()
    n = result.frame(0).position.shape[0]
    assert found["shapes"] == {
        **{"position": [3, n, 2], "target": [1, n, 2], "time": [4], "body": [n], "material": [n], "trajectory": []}
    }
    assert found["count"] == 8
    words = ["simulate", "drop.toml", "-o", "results/command", "--set", "time.end=0.2", "--set", "time.frames=10"]
    run_python(["-m", "mpmcli", *words, "--quiet"])
    files = [tmp_path / "results" / name / "particles.vtkhdf" for name in ("python", "command")]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_the_readme_runs(tmp_path: Path, run_python: Callable) -> None:
    (code,) = blocks("python", README)
    short = code.replace('"time.frames": 30', '"time.end": 0.02, "time.frames": 30')
    assert short != code and run_python(f"{short}\nprint(position.shape)").stdout.startswith("(12000, 2)")


def test_the_package_is_light_until_a_function_is_asked_for(run_python: Callable) -> None:
    code = "import mpmcli, sys; print(len([m for m in sys.modules if m.startswith('mpmcli')])); print(dir(mpmcli))"
    count, names = run_python(code).stdout.splitlines()
    assert count == "1" and all(name in names for name in mpmcli.__all__)
    with pytest.raises(AttributeError, match="no attribute 'simulate'"):
        _ = mpmcli.simulate


def test_windows_are_slices_of_trajectories(tmp_path: Path) -> None:
    made = [made_trajectory(k, frames=frames, particles=10 + k) for k, frames in enumerate((11, 4, 9))]
    dataset = mpmcli.open(write_dataset(tmp_path / "set", made))
    windows = dataset.windows("train", past=2, future=1, stride=2, fields=["pressure"])
    places = [(one, first) for one in made for first in range(len(one.time) - 4)]
    assert len(windows) == len(places) == 12
    copied = pickle.loads(pickle.dumps(windows))
    for k, (one, first) in enumerate(places):
        for found in (windows[k], copied[k]):
            np.testing.assert_array_equal(found["position"], one.position[[first, first + 2]])
            np.testing.assert_array_equal(found["target"], one.position[[first + 4]])
            np.testing.assert_array_equal(found["pressure"], one.fields["pressure"][[first, first + 2]])
            np.testing.assert_array_equal(found["time"], one.time[[first, first + 2, first + 4]])
            np.testing.assert_array_equal(found["body"], one.body)
            assert found["trajectory"] == one.number and "present" not in found
    np.testing.assert_array_equal(windows[-1]["target"], windows[11]["target"])
    with pytest.raises(IndexError):
        windows[12]
    assert len(dataset.windows("valid")) == 0
    assert [found["trajectory"] for found in dataset.windows(past=5, future=4)] == [0, 0, 0, 2]


def test_windows_say_which_particles_are_there(tmp_path: Path) -> None:
    made = made_trajectory(0, frames=5, particles=4)
    status = np.full((5, 4), ACTIVE, np.int8)
    status[:2, 0], status[3:, 1], status[:, 2] = WAITING, RETIRED, BLOCKED
    made = replace(made, fields={**made.fields, "status": status})
    dataset = mpmcli.open(write_dataset(tmp_path / "set", [made]))
    np.testing.assert_array_equal(dataset.windows(past=2)[1]["present"], status[1:4] == ACTIVE)


def test_open_tells_a_result_from_a_dataset(tmp_path: Path) -> None:
    result = mpmcli.open(write_made(tmp_path / "run"))
    assert isinstance(result, Result)
    held = "2D, 6 frames from 0 to 0.1 s, 4 particles; unknown"
    assert repr(result) == f"<Result {tmp_path}/run/particles.vtkhdf: {held}>"
    dataset = mpmcli.open(write_dataset(tmp_path / "set", [made_trajectory(3), made_trajectory(4, split="test")]))
    assert isinstance(dataset, Dataset)
    assert repr(dataset) == f"<Dataset {tmp_path}/set: 2 trajectories (train 1, test 1)>"
    assert repr(dataset[4]) == "<Trajectory 4 (test): 11 frames to 0.1 s, 24 particles, pressure, deformation_gradient>"
    assert repr(dataset.windows()) == f"<Windows of {tmp_path}/set: 5 of 6 and 1 frames>"


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_cloud_has_the_arrays_of_a_frame(tmp_path: Path, dimension: int) -> None:
    result = mpmcli.open(write_made(tmp_path / "run", dimension=dimension))
    cloud, frame = result.to_pyvista(3), result.frame(3)
    np.testing.assert_array_equal(cloud.points[:, :dimension], frame.position)
    np.testing.assert_array_equal(cloud["velocity"][:, :dimension], frame.velocity)
    np.testing.assert_array_equal(cloud["body"], frame.body)
    assert set(result.field_names) <= set(cloud.point_data)


@pytest.mark.usefixtures("made_workers")
def test_a_sweep_opens_its_dataset_and_its_export_has_the_verdicts(tmp_path: Path) -> None:
    """Without the trajectories that are left out."""
    sweep_of(SWEEP, BASE, COUNT)
    dataset = mpmcli.sweep("sweep.toml", "set", count=COUNT, progress=False)
    assert set(dataset.numbers) == {*range(COUNT)} - {*VERDICTS}
    assert run_here("export", "set", "--to", "npz", "-o", "out", "-q").status == 0
    told = json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))["verdict"]
    assert told == {f"{number:06d}": "stable" for number in dataset.numbers}


@pytest.mark.parametrize(
    ("status", "error"), [("unstable", RunError), ("failed", RunError), ("interrupted", KeyboardInterrupt)]
)
def test_a_run_that_ends_early_raises(monkeypatch: pytest.MonkeyPatch, status: str, error: type) -> None:
    summary = SimpleNamespace(status=status, message="it ended at 0.1 s", check=None)
    monkeypatch.setattr("mpmcli.api.simulate", lambda *_: summary)
    with pytest.raises(error, match="it ended"):
        mpmcli.run(tomllib.loads(SCENE), "out", progress=False)


@pytest.mark.parametrize(("ask", "sentence"), [
    (lambda data, _: mpmcli.load_scene("dam_brek_2d"), 'did you mean "dam_break_2d"?'),
    (lambda data, _: mpmcli.load_scene(data, **{"time.edn": 1.0}), 'unknown key; did you mean "end"?'),
    (lambda data, _: mpmcli.run(data), "the scene comes from no file that could name its result: give output"),
    (lambda data, _: mpmcli.run(mpmcli.load_scene(data)), "give output, a directory"),
    (lambda data, _: mpmcli.load_scene(mpmcli.load_scene(data), title="b"), "give its overrides to load_scene"),
    (lambda data, _: mpmcli.run(data, "out", resume=True, overwrite=True), "give one of them"),
    (lambda data, _: mpmcli.sweep("none.toml"), "none.toml: there is no such file"),
    (lambda data, dataset: dataset.windows("trian"), 'there is no split "trian": the splits are "train", "valid"'),
    (lambda data, dataset: dataset.windows(past=0), "a window has one past frame or more"),
    (lambda data, dataset: dataset.windows(fields=["heat"])[0], 'holds no field "heat"'),
])  # fmt: skip
def test_bad_input_has_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ask: Callable, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    dataset = mpmcli.open(write_dataset(tmp_path / "set", [made_trajectory(0)]))
    with pytest.raises(InputError, match=re.escape(sentence)):
        ask(tomllib.loads(SCENE), dataset)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_overrides_are_values_of_python(tmp_path: Path) -> None:
    shape = {"ball": {"center": np.array([0.5, 0.5]).tolist(), "radius": np.float64(0.2)}}
    changes = {"bodies.drop.shape": shape, "domain.gravity": np.array([0.0, -1.0]), "title": 'a "drop"', "time.end": 1}
    scene = mpmcli.load_scene(tomllib.loads(SCENE), **changes).scene
    assert scene.bodies[0].shape.form.radius == 0.2 and scene.domain.gravity == (0.0, -1.0)
    assert scene.title == 'a "drop"' and scene.time.end == 1.0
