"""Scores of rollouts: what the formulas say of data, of shifted copies, and of what was predicted."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from conftest import ROOT
from made_dataset import COUNTS, PAUSE, made_dataset
from scenes import block, scene_of, solid

from mpmcli.dataset import baseline, score
from mpmcli.dataset.dataset import Dataset, open_dataset
from mpmcli.errors import InputError
from mpmcli.scene import scene_to_toml

FRAMES, SHIFT = 11, 1e-3
MOVED = np.array([SHIFT, 0.0])
OPEN = np.full(2, np.inf)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Four trajectories of eleven frames in a box of 1 m, in double precision."""
    return open_dataset(made_dataset(tmp_path / "made", dtype=np.float64))


def positions(dataset: Dataset) -> dict[str, np.ndarray]:
    return {str(number): dataset[number].position for number in dataset.numbers}


def scored(dataset: Dataset, arrays: dict[str, np.ndarray]) -> score.Score:
    """Write rollouts, read them, and score them."""
    file = dataset.path.parent / "rollouts.npz"
    np.savez(file, **arrays)
    return score.score_rollouts(dataset, score.read_rollouts(file, dataset))


def test_the_data_have_no_error(dataset: Dataset) -> None:
    found = scored(dataset, positions(dataset))
    assert found.numbers == dataset.numbers and list(found.horizons) == [1, 5, 10, FRAMES]
    for row in found.horizons.values():
        assert row["outside"] == row["outside_data"] == 0
        assert all(row[name] == pytest.approx(0, abs=1e-12) or np.isnan(row[name]) for name in score.COLUMNS)
    assert found.left == () and found.seconds is None


def test_a_copy_that_is_shifted_has_its_shift(dataset: Dataset) -> None:
    """mse and divergence are |s|^2, the centre is |s| away; energies are those of the data."""
    shifted = {name: x + MOVED for name, x in positions(dataset).items()}
    for row in scored(dataset, shifted).horizons.values():
        assert row["mse"] == pytest.approx(SHIFT**2, rel=1e-9)
        assert row["sinkhorn"] == pytest.approx(SHIFT**2, rel=5e-3)
        assert row["centre"] == pytest.approx(SHIFT, rel=1e-9)
        # A particle gives each node a part of its mass that is linear in its place, on nodes 0.2 m apart.
        assert 0 < row["density"] <= SHIFT / (score.MAP_CELLS * 0.05) * 1.001
        for name in ("energy", "momentum"):
            assert np.isnan(row[name]) or row[name] == pytest.approx(0, abs=1e-9)


def test_the_mean_square_is_that_of_lagrangebench(tmp_path: Path) -> None:
    """The mean of squared distances, to nearest images, over particles, and over the first rows; GNS' over axes too."""
    dataset = open_dataset(made_dataset(tmp_path / "made", dtype=np.float64, periodic="x", speed=40.0))
    random = np.random.default_rng(1)
    data = positions(dataset)
    predicted = {name: x + random.normal(0, 0.1, x.shape) for name, x in data.items()}
    wrapped = {name: np.stack([x[..., 0] % 1.0, x[..., 1]], -1) for name, x in predicted.items()}
    for given in (predicted, wrapped):
        found = scored(dataset, given)
        for rows, row in found.horizons.items():
            ways = {name: predicted[name][:rows] - data[name][:rows] for name in data}
            assert row["mse"] == pytest.approx(np.mean([(w**2).sum(-1).mean() for w in ways.values()]), rel=1e-6)
            assert row["mse"] / 2 == pytest.approx(np.mean([(w**2).mean() for w in ways.values()]), rel=1e-6)


def test_energy_and_momentum_are_those_of_velocities(dataset: Dataset) -> None:
    """A rollout that moves 1.1 times as far as the data has 1.21 times their energy, and 1.1 times their momentum."""
    trajectory = dataset[1]
    x = trajectory.position
    farther = x[:1] + 1.1 * (x - x[:1])
    row = scored(dataset, {"1": farther}).horizons[FRAMES]
    v, mass = np.diff(x, axis=0) / PAUSE, trajectory.header.masses(trajectory.body)
    energy = 0.5 * (mass * (v**2).sum(-1)).sum(1)
    momentum = np.linalg.norm((mass[:, None] * v).sum(1), axis=1)
    assert row["energy"] == pytest.approx((0.21 * energy / energy.max()).mean(), rel=1e-9)
    assert row["momentum"] == pytest.approx((0.1 * momentum / np.sqrt(2 * mass.sum() * energy.max())).mean(), rel=1e-9)


@pytest.mark.parametrize("count", [1, 24, 400])
@pytest.mark.parametrize("shift", [0.0, 0.1, 3.0])
def test_the_divergence_of_a_shifted_cloud(count: int, shift: float) -> None:
    """OT with squared distances from x to x + s is that from x to x plus |s|^2, with any regularisation."""
    x = np.random.default_rng(2).random((count, 2))
    moved = x + np.array([shift, 0.0])
    found = score.sinkhorn_divergence(x, moved[::-1], OPEN)
    assert found == pytest.approx(shift**2, rel=2e-3, abs=1e-9)
    if shift:
        assert score.sinkhorn_divergence(x, moved, np.array([shift, np.inf])) == pytest.approx(0, abs=1e-9)


def test_particles_outside_are_counted(dataset: Dataset) -> None:
    beyond = dataset[0].position.copy()
    beyond[-1, :3] = [0.5, -0.01]
    row = scored(dataset, {"0": beyond}).horizons[FRAMES]
    assert row["outside"] == pytest.approx(3 / COUNTS[0] / FRAMES) and row["outside_data"] == 0


def test_rows_are_the_frames_that_the_file_names(dataset: Dataset) -> None:
    """Every other frame from the third on, in coordinates of their own, from either kind of file, with times."""
    frames, origin = np.arange(2, FRAMES, 2), np.array([0.1, 0.2])
    own = {name: x[frames] + MOVED - origin for name, x in positions(dataset).items()}
    own |= {"frames": frames, "origin": origin, "seconds": np.arange(1.0, 5.0)}
    found = scored(dataset, own)
    assert found.horizons[len(frames)]["mse"] == pytest.approx(SHIFT**2, rel=1e-9) and found.seconds == 2.5
    file = dataset.path.parent / "rollouts.h5"
    with h5py.File(file, "w") as stored:
        for name, array in own.items():
            stored[name] = array
    again = score.score_rollouts(dataset, score.read_rollouts(file, dataset))
    assert json.dumps(again.as_dict()) == json.dumps(found.as_dict())


def test_when_a_rollout_leaves_the_error_bar(dataset: Dataset) -> None:
    """At the first frame whose root of the mean square exceeds the error of the simulator."""
    dataset.__dict__["error"] = {"position_m": {"grid": [2.5e-3] * FRAMES}}
    growing = {name: x + np.linspace(0, 1e-2, FRAMES)[:, None, None] * [1, 0] for name, x in positions(dataset).items()}
    assert scored(dataset, growing).left == (pytest.approx(3 * PAUSE),) * 4
    assert scored(dataset, positions(dataset)).left == (None,) * 4


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda x: {"7": x}, "rollout 7 is of no trajectory of"),
        (lambda x: {"0": x[:, 1:]}, r"rollout 0 has the shape \(11, 29, 2\); the trajectory has \(frames, 30, 2\)"),
        (lambda x: {"0": x[:4]}, "rollout 0 has 4 of 11 frames: say which by an array `frames`"),
        (lambda x: {"0": np.repeat(x, 2, 0)}, "rollout 0 has 22 frames, and the trajectory 11"),
        (lambda x: {"0": x[:2], "frames": [3, 11]}, "ascending numbers from 0 to 10"),
        (lambda x: {"0": np.where(np.arange(30)[:, None] == 4, np.nan, x)}, "not finite in row 0"),
        (lambda x: {"0": x, "origin": [0.0]}, "origin has 1 coordinates, and the trajectory 2"),
        (lambda x: {"0": x, "seconds": [1.0, 2.0]}, "seconds has 2 entries for 1 rollout"),
        (lambda x: {"first": x}, 'has an array "first": name rollouts by the numbers'),
        (lambda x: {"0": x.astype(str)}, 'the array "0" does not hold numbers'),
        (lambda x: {"frames": [0]}, "has no rollout"),
    ],
)
def test_rollouts_that_do_not_fit_are_refused(dataset: Dataset, change: object, told: str) -> None:
    with pytest.raises(InputError, match=told):
        scored(dataset, change(dataset[0].position))


def test_the_code_of_the_page_makes_rollouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A prediction with the velocity of the first two frames is right in both."""
    made_dataset(tmp_path / "results" / "drops")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "scoring.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```py\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    exec(code, {})
    done = run_here("score", "results/drops", "--rollouts", "results/ballistic.npz", "--json")
    assert json.loads(done.stdout)["horizons"]["1"]["mse"] < 1e-12 < json.loads(done.stdout)["horizons"]["11"]["mse"]


def test_the_command(dataset: Dataset, tmp_path: Path) -> None:
    """A table, or JSON; a file that is none is bad input."""
    file = tmp_path / "rollouts.npz"
    np.savez(file, **{name: x + MOVED for name, x in positions(dataset).items()})
    done = run_here("score", dataset.path, "--rollouts", file)
    assert done.status == 0 and "4 rollouts" in done.stdout and "MSE of LagrangeBench" in done.stdout
    told = json.loads(run_here("score", dataset.path, "--rollouts", file, "--json").stdout)
    assert told["horizons"]["11"]["mse"] == pytest.approx(SHIFT**2)
    whole = file.read_bytes()
    for content in (b"x", whole[:-100], whole[:3000] + bytes(8) + whole[3008:]):
        file.write_bytes(content)
        done = run_here("score", dataset.path, "--rollouts", file)
        assert done.status == 2 and "is no file of rollouts" in done.stderr


def test_the_solver_is_scored_on_coarser_grids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On its own grid a run has its own places; on one twice as coarse they differ, within a cell after a fall."""
    monkeypatch.setattr(baseline, "RATIOS", (1.0, 2.0))
    jelly = block("jelly", solid(1e5, law="fixed_corotated"), [0.4, 0.1], [0.8, 0.5]) | {"velocity": [1.0, -2.0]}
    asked = scene_of(jelly, domain={"size": [1.2, 1.2], "spacing": 0.05}, time={"end": 0.2, "frames": 4})
    scene, result, figure = tmp_path / "scene.toml", tmp_path / "result", tmp_path / "score.svg"
    scene.write_text(scene_to_toml(asked), encoding="utf-8")
    assert run_here("simulate", scene, "-o", result, "--arch", "cpu", "-q").status == 0
    done = run_here("score", result, "--baseline", "--arch", "cpu", "-o", figure, "--json")
    told = json.loads(done.stdout)
    assert done.status == 0 and list(told) == ["spacing x 1", "spacing x 2"]
    errors = [one["horizons"]["5"]["mse"] for one in told.values()]
    assert errors[0] == 0 and 1e-8 < errors[1] < 0.05**2
    assert all(one["seconds"] > 0 for one in told.values()) and figure.read_text().startswith("<?xml")
    again = run_here("score", result, "--baseline", "-o", figure)
    assert again.status == 2 and "has to be a new file" in again.stderr
    assert run_here("score", result).status == 2
