"""Certified datasets: formulas on synthetic runs, a sweep that says its error, kills and damage that lose nothing."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from good_sweep import SWEEP, refusal, sweep_of
from made_sweep import made_workers  # noqa: F401
from test_dataset_kills import kill_often
from tiny_sweep import contents, write_sweep

import mpmcli.dataset
from mpmcli.dataset import certify
from mpmcli.dataset.certify import certificates, certify_plan, cost_of_one, error_of, gap_of, matched, one_step, rms
from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.merge import merge
from mpmcli.dataset.report import verify
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.frames.frame import ACTIVE, STATUS, WAITING, Frame

CERTIFY = SWEEP + "[certify]\nfraction = 0.5\n"
ENDLESS = np.full(2, np.inf)


def frames_of(x: np.ndarray, **fields: np.ndarray) -> list[Frame]:
    """Return the frames of particles at x, (K, N, d)."""
    label = np.zeros(x.shape[1], np.int32)
    own = [{name: each[k] for name, each in fields.items()} for k in range(len(x))]
    return [Frame(k, 0.1 * k, k, one, 0 * one, label, label, own[k]) for k, one in enumerate(x)]


def walk(frames: int = 6, particles: int = 40) -> np.ndarray:
    return np.cumsum(np.random.default_rng(1).random((frames, particles, 2)), axis=0)


def test_twins_are_found_by_their_place_in_any_order() -> None:
    """With the k-th frame moved by k (0.03, 0.04) m, each particle is k 0.05 m from its twin."""
    x, order = walk(), np.random.default_rng(2).permutation(40)
    shift = np.arange(6)[:, None, None] * np.array([0.03, 0.04])
    for other in (x + shift, (x + shift)[:, order]):
        gap = gap_of(frames_of(x), frames_of(other), ENDLESS, 1e-6)
        np.testing.assert_allclose(rms(gap), 0.05 * np.arange(6), atol=1e-12)
    mine, its = matched(x[0], x[0][order], 1e-6)
    assert sorted(mine) == list(range(40)) and np.array_equal(order[its], mine)


def test_other_samples_have_no_twins() -> None:
    """With 38 of 40 the error is that of those; with 37 there is none. One place has one twin."""
    x = walk()
    for moved, found in ((2, True), (3, False)):
        other = x.copy()
        other[:, :moved] += 0.5
        gap = gap_of(frames_of(x), frames_of(other), ENDLESS, 1e-6)
        assert (gap is not None) == found
    mine, its = matched(np.zeros((3, 2)), np.array([[0.0, 0.0], [1.0, 1.0]]), 0.1)
    assert (len(mine), list(its)) == (1, [0])


def test_distances_are_those_of_images_and_of_particles_present() -> None:
    """Of a step of 0.9 in a period of 1, 0.1 is left; who waits in one of the runs does not count."""
    x = np.zeros((2, 4, 2))
    other = x + np.array([0.9, 0.0])
    other[0] = 0.0
    status = np.full((2, 4), ACTIVE)
    status[:, 0] = WAITING
    x[1, 0] = 7.0
    gap = gap_of(frames_of(x, **{STATUS: status}), frames_of(other), np.array([1.0, np.inf]), 1e-6)
    np.testing.assert_allclose(rms(gap), [0.0, 0.1])


def test_the_error_of_a_step_counts_while_states_are_the_same() -> None:
    """A gap of a k^2 / 2 has second differences a s^2 at stride s, up to the step from the last frame within a tenth.

    The gap after that, at random, shows nowhere.
    """
    k, a, strides = np.arange(41.0), 4e-4, (1, 2, 3)
    gap = np.zeros((41, 5, 2))
    gap[..., 1] = (a * k**2 / 2)[:, None]
    last = int(np.sqrt(0.2 / a))
    gap[last + max(strides) + 1 :] = 1 + np.random.default_rng(1).random((40 - last - max(strides), 5, 2))
    x = np.random.default_rng(3).random((41, 5, 2))
    found = one_step(x, gap, 1.0, ENDLESS)
    for s in strides:
        assert found[f"{s}"]["error"] == pytest.approx([0.0, a * s**2], abs=1e-12)
        assert found[f"{s}"]["std"] == pytest.approx(np.diff(x[::s], n=2, axis=0).std(axis=(0, 1)))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fraction = 2", "sweep.toml:19: certify.fraction: must be at most 1; found 2"),
        ("fraction = 0.0", "sweep.toml:19: certify.fraction: must be greater than 0; found 0.0"),
        ("fractoin = 0.1", 'sweep.toml:19: certify.fractoin: unknown key; did you mean "fraction"?'),
    ],
)
@pytest.mark.usefixtures("made_workers")
def test_a_faulty_table_is_named(text: str, sentence: str) -> None:
    assert refusal(SWEEP + f"[certify]\n{text}\n") == [sentence]


@pytest.mark.parametrize(("count", "certified"), [(4, 0), (12, 1), (60, 8), (400, 8), (1000, 20)])
@pytest.mark.usefixtures("made_workers")
def test_a_quarter_of_the_runs_is_the_most(count: int, certified: int) -> None:
    """Two percent, but eight if they cost less than a quarter; the dry run says which, and what they cost."""
    sweep = sweep_of(SWEEP + "[certify]\n", count=count)
    plan = certify_plan(sweep)
    assert len(plan["numbers"]) == certified and {*plan["numbers"]} <= {*range(count)}
    assert certified * cost_of_one(sweep) <= 0.25 * count
    assert (
        plan == certify_plan(replace(sweep, certify=sweep.certify)) != certify_plan(replace(sweep, seed=8))
        or not certified
    )
    if count == 12:
        told = run_here("sweep", "sweep.toml", "--dry-run", "--count", 12)
        assert "1 of 12 trajectories, chosen by the seed, computed again on two coarser grids" in told.stdout
        assert "8 would take more than 25% of the runs of the sweep: " + str(plan["numbers"][0]) in told.stdout
        rows = json.loads(run_here("sweep", "sweep.toml", "--dry-run", "--count", 12, "--json").stdout)["trajectories"]
        seconds = {row["number"]: row["certify_seconds"] for row in rows if row["certify_seconds"]}
        assert list(seconds) == plan["numbers"]
        # 2^(-3/2) and 1/2 of the cells' steps, and one run with other rounding.
        assert seconds[plan["numbers"][0]] == pytest.approx((2**-1.5 + 1.5) * rows[plan["numbers"][0]]["seconds"])


def made(name: str, monkeypatch: pytest.MonkeyPatch, part: tuple[int, int] = (1, 1), *, resume: bool = False) -> Path:
    """Make a dataset of twelve trajectories, six of them certified whatever it costs."""
    monkeypatch.setattr(certify, "MOST_COST", 10.0)
    monkeypatch.setattr(certify, "FEWEST", 1)
    run_sweep(sweep_of(CERTIFY, count=12), SweepSettings(Path(name), part=part, resume=resume))
    return Path(name)


@pytest.mark.usefixtures("made_workers")
def test_a_damaged_certificate_is_found_and_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = made("whole", monkeypatch)
    whole, (first, second, *_) = contents(dataset), sorted((dataset / "certify").iterdir())
    assert verify(dataset).faults == ()
    first.write_text(first.read_text(encoding="utf-8").replace("0.05", "0.06"), encoding="utf-8")
    second.unlink()
    outcome = run_here("dataset", "verify", dataset)
    assert outcome.status == 1 and f"{first} is damaged (its checksum differs)" in outcome.stdout
    assert f"trajectory {int(second.stem)} has no certificate; mpmcli sweep --resume computes it" in outcome.stdout
    made("whole", monkeypatch, resume=True)
    assert contents(dataset) == whole and verify(dataset).faults == ()


@pytest.mark.usefixtures("made_workers")
def test_kills_lose_no_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    """They only become more, and the last call has the files of one that was left alone."""
    whole, counts = contents(made("whole", monkeypatch)), [0]

    def work() -> None:
        made("d", monkeypatch, resume=True)

    def look() -> None:
        if Path("d/pending").exists() or not Path("d", MANIFEST).exists():
            return
        found, faults = certificates(Path("d"))
        assert not faults and len(found) >= counts[-1]
        counts.append(len(found))
        if contents(Path("d")) == whole:
            for path in list(Path("d/certify").iterdir())[2:]:
                path.unlink()
            counts.append(2)

    kill_often(work, 4, look)
    work()
    assert contents(Path("d")) == whole and verify(Path("d")).faults == ()


@pytest.mark.usefixtures("made_workers")
def test_parts_keep_theirs_and_exports_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    """A merged dataset is the whole one. Errors over trajectories are roots of mean squares."""
    whole = made("whole", monkeypatch)
    parts = [made(f"part{i}", monkeypatch, (i, 2)) for i in (1, 2)]
    assert all((part / "certify").is_dir() for part in parts)
    merge(parts, Path("merged"))
    assert contents(Path("merged")) == contents(whole) and verify(Path("merged")).faults == ()
    error = mpmcli.dataset.open("merged").error
    numbers = np.array(error["trajectories"])
    assert Manifest(whole).facts()["error"] == error == error_of(whole) and len(numbers) > 3
    assert error["position_m"]["grid"][-1] == pytest.approx(0.01 * np.sqrt(np.mean((0.1 + numbers) ** 2)))
    assert error["one_step"] == {"1": pytest.approx([0.3, 0.4])} and not any(error["parted_s"])
    card = (whole / "README.md").read_text(encoding="utf-8")
    assert "accelerations are off by 0.354 standard deviations" in card
    assert f"Rounding alone parts 0 of {len(numbers)} pairs of runs." in card and "| 10 | 0.1 |" in card
    assert "![Errors](certify.svg)" in card and (whole / "certify.svg").read_bytes().startswith(b"<?xml")
    assert run_here("export", whole, "--to", "npz", "-o", "out", "-q").status == 0
    assert json.loads(Path("out/metadata.json").read_text(encoding="utf-8"))["error"] == error


@pytest.mark.usefixtures("made_workers")
def test_a_dataset_can_be_certified_later_and_overwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    """[certify] changes no trajectory, so that --resume adds it; --overwrite without it leaves nothing of it."""
    run_sweep(sweep_of(SWEEP, count=12), SweepSettings(Path("later")))
    plain = contents(Path("later"))
    assert "certify" not in Manifest(Path("later")).facts() and mpmcli.dataset.open("later").error is None
    made("later", monkeypatch, resume=True)
    assert contents(Path("later")) == contents(made("whole", monkeypatch))
    shutil.copytree("later", "again")
    run_sweep(sweep_of(SWEEP, count=12), SweepSettings(Path("again"), overwrite=True))
    assert contents(Path("again")) == plain


def test_bodies_in_free_flight_have_no_error_but_rounding(tmp_path: Path) -> None:
    """They move by g t^2 / 2 on any grid; samples differ, so that the map of the mass does, by a part of a cell."""
    path = write_sweep(tmp_path, count=8)
    path.write_text(path.read_text(encoding="utf-8") + "[certify]\n", encoding="utf-8")
    done = run_here("sweep", path, "-o", tmp_path / "d", "--workers", 1, "--json")
    assert done.status == 0 and json.loads(done.stdout)["certified"] == 1
    dataset = mpmcli.dataset.open(tmp_path / "d")
    error, (number,) = dataset.error, dataset.error["trajectories"]
    assert error["left_out"] == [] and error["parted_s"] == [None]
    moved = 0.5 * abs(dataset[number].draws["domain.gravity.1"]) * np.array(error["time_s"]) ** 2
    rounding = 1e-6
    np.testing.assert_allclose(error["position_m"]["moved"], moved, atol=rounding)
    assert max(error["position_m"]["grid"]) < rounding and max(error["position_m"]["rounding"]) < rounding
    # The centre of another sample is elsewhere, and stays there.
    assert np.ptp(error["observables"]["centre"]) < 1e-5 and 0 < max(error["observables"]["density"]) < 0.2
    assert verify(tmp_path / "d").faults == ()
