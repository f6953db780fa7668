"""`mpmcli validate` as people and pipelines call it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command import Outcome, run_here, started
from conftest import ROOT

from mpmcli.output import open_result
from mpmcli.validation.cases import all_cases

BAR = "bar_fixed_free"
PATIENCE = 120  # s


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the bar one resolution: two runs at the level coarse."""
    monkeypatch.setattr(type(all_cases()[BAR]), "levels", {"coarse": (13,)})


@pytest.mark.parametrize(("words", "said"), [
    (["bar_fixed_fre"], 'there is no case "bar_fixed_fre"; did you mean "bar_fixed_free"?'),
    (["zzz"], 'there is no case "zzz"; there are '),
    ([BAR, "--resume"], "name its directory with -o"),
    ([BAR, "--resume", "--overwrite", "-o", "x"], "give one of them"),
    ([BAR, "--resolution", "9"], "--resolution is for --write-scene"),
    (["--write-scene"], "prints the scene of one case; name it"),
    ([BAR, "--list", "--write-scene"], "give one of them"),
    ([BAR, "--levels", "finest"], "'finest' is not one of 'coarse', 'default', 'fine'"),
    ([BAR, "--workers", "0"], "0 is not in the range x>=1"),
    ([BAR, "-o", "."], "exists and is not empty: give another directory"),
])  # fmt: skip
def test_bad_usage_is_told_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.txt").write_text("mine")
    outcome = run_here("validate", *words)
    assert (outcome.status, outcome.stdout) == (2, "")
    (line,) = outcome.stderr.splitlines()
    assert line.startswith("error: ") and said in line
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_list_names_every_case() -> None:
    outcome = run_here("validate", "--list")
    assert outcome.status == 0 and outcome.stderr == ""
    assert [line.split()[0] for line in outcome.stdout.splitlines()[2:]] == list(all_cases())
    facts = json.loads(run_here("validate", "bar", "--list", "--json").stdout)
    assert [entry["case"] for entry in facts] == ["bar_fixed_fixed", BAR]
    assert facts[1]["resolutions"] == [13, 26, 52] and facts[1]["resolution"] == "cells along the bar"


def test_the_scene_of_a_case_runs_as_it_is(tmp_path: Path) -> None:
    outcome = run_here("validate", "bar", "--write-scene", "--resolution", "7")
    assert outcome.status == 0
    assert outcome.stderr == "this is the scene of bar_fixed_fixed; others are those of bar_fixed_free\n"
    (tmp_path / "bar.toml").write_text(outcome.stdout, encoding="utf-8")
    ran = run_here("simulate", tmp_path / "bar.toml", "-o", tmp_path / "result", "--quiet", "--set", "time.frames=2")
    assert (ran.status, ran.stderr) == (0, "")
    result = open_result(tmp_path / "result")
    assert result.times[-1] == 25.0 and result.header.precision == "f64"
    assert result.particle_counts[0] == 7 * 5 * 4


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """A report of the bar at one resolution, and what its command said."""
    directory = tmp_path_factory.mktemp("validate") / "report"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(all_cases()[BAR]), "levels", {"coarse": (13,)})
        return directory, run_here("validate", BAR, "--levels", "coarse", "-o", directory, "--workers", "2", "--json")


def test_json_has_error_order_speed_and_verdict_of_each_run(ran: tuple[Path, Outcome]) -> None:
    directory, outcome = ran
    assert outcome.status == 0
    facts = json.loads(outcome.stdout)
    assert sorted(path.name for path in directory.iterdir()) == ["figures", "report.md", "results.json"]
    runs = facts["cases"][0]["runs"]
    assert [(run["setting"], run["n"], run["verdict"]) for run in runs] == [
        ("default", 13, "pass"),
        ("f32", 13, "pass"),
    ]
    for run in runs:
        assert 0 < run["error"] == abs(run["values"]["period error"]) < 2e-3
        assert run["particles"] == 260 and run["steps"] > 300 and run["status"] == "finished"
        assert run["seconds"] > 0 and run["compile_seconds"] > 0 and run["particle_steps_per_s"] > 0
    assert facts["environment"]["workers"] == 2 and facts["environment"]["processor"]


def test_people_see_each_run_and_a_table(ran: tuple[Path, Outcome], short: None) -> None:
    directory, outcome = ran
    lines = outcome.stderr.splitlines()
    assert lines[0] == "1 case, 2 runs, 2 at a time, one thread each"
    assert [line.split()[0] for line in lines[1:3]] == ["1/2", "2/2"]
    assert all("bar_fixed_free, n = 13" in line and "period error 0.001" in line for line in lines[1:3])
    table = run_here("validate", BAR, "--levels", "coarse", "-o", directory, "--resume").stdout.splitlines()
    assert "1 of 1 cases pass" in table[-2] and table[-1] == f"report: {directory / 'report.md'}"


def test_what_is_done_is_not_done_again(ran: tuple[Path, Outcome], short: None) -> None:
    """A run that is missing is; nothing without --resume or --overwrite."""
    directory, _ = ran
    results = json.loads((directory / "results.json").read_text(encoding="utf-8"))
    (missing, kept) = results
    (directory / "results.json").write_text(json.dumps({kept: results[kept]}), encoding="utf-8")
    again = run_here("validate", BAR, "--levels", "coarse", "-o", directory, "--resume", "--json")
    assert again.status == 0 and "1 of 2 runs are done already, by the same program" in again.stderr.splitlines()
    after = json.loads((directory / "results.json").read_text(encoding="utf-8"))
    assert after[kept] == results[kept] and after[missing]["values"] == results[missing]["values"]
    refused = run_here("validate", BAR, "--levels", "coarse", "-o", directory)
    assert refused.status == 2 and "--resume to go on" in refused.stderr


def test_a_case_out_of_tolerance_is_exit_code_1(
    ran: tuple[Path, Outcome], short: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bounds of the same runs are made too tight."""
    directory, _ = ran
    case = all_cases()[BAR]
    tight = [type(measure)(measure.definition, 1e-9) for measure in case.measures]
    monkeypatch.setattr(case, "measures", tuple(tight))
    outcome = run_here("validate", BAR, "--levels", "coarse", "-o", directory, "--resume", "--quiet", "--json")
    assert outcome.status == 1 and outcome.stderr == ""
    (facts,) = json.loads(outcome.stdout)["cases"]
    assert facts["verdict"] == "fail" and "beyond its bound of 1e-09" in facts["reasons"][0]


def test_an_interrupt_keeps_what_is_done_and_ends_the_rest(tmp_path: Path) -> None:
    results = tmp_path / "report" / "results.json"
    words = ["validate", "bar", "--levels", "coarse", "-o", "report", "--workers", "1"]
    with started(tmp_path, *words, own_group=True) as process:
        waited_until = time.monotonic() + PATIENCE
        while not results.exists():
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < waited_until, "no run ended"
            time.sleep(0.05)
        # As a terminal does, to all processes.
        os.killpg(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and stdout == "" and "Traceback" not in stderr
    assert stderr.splitlines()[-1] == "interrupted; the runs that are done are kept: --resume -o report goes on"
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["results.json"]
    kept = json.loads(results.read_text(encoding="utf-8"))
    assert [result["status"] for result in kept.values()] == ["finished"] * len(kept)


CASE_FILE = '''\
"""A block that drifts through an empty box."""

import numpy as np

from mpmcli.validation.case import Case, Measure
from mpmcli.validation.shared import body, box, elastic, problem


class Drift(Case):
    """Without forces the velocity of every particle stays what it was."""

    name, title, group = "drift", "A block that drifts", "invariants"
    source, resolution = "Newton's first law", "cells along the box"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16)}
    measures = (Measure("velocity error (m/s): Largest change of a velocity.", 1e-12),)

    def tables(self, n):
        square = box([0.25, 0.375], [0.5, 0.625])
        block = body("block", elastic("neo_hookean", 1000.0, 1e5, 0.3), square, velocity=[1.0, 0.0])
        return problem({"size": [1.0, 1.0], "cells": [n, n]}, (0.1, 2), "velocity", [block])

    def measure(self, n, scene, frames):
        return {"velocity error": max(float(np.abs(f.velocity - [1.0, 0.0]).max()) for f, _ in frames)}


CASES = (Drift(),)
'''


def test_a_case_is_one_file_of_the_package(tmp_path: Path) -> None:
    """A file put beside the cases of mpmcli is listed, run in its own process, judged, and written into the report."""
    shutil.copytree(ROOT / "mpmcli", tmp_path / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "mpmcli" / "validation" / "cases" / "drift.py").write_text(CASE_FILE, encoding="utf-8")

    def said(*words: str) -> object:
        command = [sys.executable, "-m", "mpmcli", "validate", *words, "--levels", "coarse", "--json"]
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    assert {entry["case"] for entry in said("--list")} == {*all_cases(), "drift"}
    (case,) = said("drift", "-o", "report")["cases"]
    assert (case["verdict"], [run["n"] for run in case["runs"]]) == ("pass", [8, 8])
    assert all(0 <= run["error"] <= 1e-12 for run in case["runs"])
    assert "## A block that drifts" in (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "report" / "figures" / "drift.svg").exists()
