"""`mpmcli simulate` checks the scene first: it tells the warnings, and refuses errors unless told to go on."""

import json
from pathlib import Path

import pytest
from command import SCENE, run_here

from mpmcli.output import open_result


def with_step(step: str) -> str:
    """Return the scene with a step of its own, s; h / (c sqrt 2) = 1.4 ms is stable."""
    return SCENE.replace("frames = 4", f"frames = 4\nstep = {step}")


@pytest.fixture
def unstable(tmp_path: Path) -> Path:
    """A scene whose step is 3.5 times what is stable."""
    path = tmp_path / "scene.toml"
    path.write_text(with_step("5e-3"), encoding="utf-8")
    return path


def test_a_step_above_the_limit_is_refused_and_nothing_written(unstable: Path, tmp_path: Path) -> None:
    outcome = run_here("simulate", unstable, "-o", tmp_path / "result")
    assert outcome.status == 2 and outcome.stdout == ""
    assert outcome.stderr.startswith(f"error: {unstable}: ") and "0.005 s" in outcome.stderr
    assert outcome.stderr.splitlines()[-1] == "--force runs it all the same."
    assert not (tmp_path / "result").exists()


def test_force_takes_the_step_and_the_guard_ends_the_run(unstable: Path, tmp_path: Path) -> None:
    """3.5 times the stable step of a lone particle is twice that of a full block; what was written before stays."""
    outcome = run_here(
        "simulate",
        unstable,
        "-o",
        tmp_path / "result",
        "--force",
        "--json",
        "--set",
        "time.end=0.2",
        "--set",
        "time.frames=40",
    )
    assert outcome.status == 1
    summary = json.loads(outcome.stdout)
    assert summary["status"] == "unstable" and summary["frames"] >= 1
    assert any(note.startswith("error: ") for note in summary["notes"])
    result = open_result(tmp_path / "result")
    assert 'time.step = "auto"' in result.record["failure"]["suggestion"]
    assert result.record["forced"] is True
    assert result.frame_count == summary["frames"]
    assert all(row.limit == "forced" and row.step_max == pytest.approx(5e-3) for row in result.ledger[1:])
    checked = run_here("check", tmp_path / "result", "--json")
    found = json.loads(checked.stdout)
    assert checked.status == 1
    assert (found["verdict"], found["ok"], found["frames"]) == ("unstable", False, summary["frames"])
    assert found["limit"] == "forced"


def test_warnings_are_told_in_one_line_each_and_recorded(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(with_step("1e-5").replace("end = 0.05", "end = 1e-3"), encoding="utf-8")
    outcome = run_here("simulate", scene, "-o", tmp_path / "result")
    assert outcome.status == 0
    told = [line for line in outcome.stderr.splitlines() if line.startswith("warning: ")]
    assert len(told) == 1 and "step" in told[0]
    assert told[0] in open_result(tmp_path / "result").record["notes"]
    checked = run_here("check", tmp_path / "result" / "particles.vtkhdf")
    assert (checked.status, checked.stderr) == (0, "")
    assert "stable" in checked.stdout
