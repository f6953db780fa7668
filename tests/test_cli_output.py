"""What commands print: what was asked for on stdout, everything else on stderr."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from command import CONFIGS, ROOT, SCENE, Outcome, run_here

from mpmcli import __version__
from mpmcli.output import open_result
from mpmcli.simulation.summary import RunSummary


@dataclass(frozen=True)
class Results:
    """A directory with scene.toml, its result in `packed`, and the same as a series in `series`."""

    directory: Path
    packed: Outcome
    series: Outcome


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Results:
    directory = tmp_path_factory.mktemp("results")
    scene = directory / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    packed = run_here("simulate", scene, "-o", directory / "packed", "--json")
    series = run_here("simulate", scene, "-o", directory / "series", "--format", "vtk", "--quiet")
    return Results(directory, packed, series)


@pytest.fixture
def run(results, monkeypatch):
    """Return `run(*arguments)`: a command, run beside the results."""
    monkeypatch.chdir(results.directory)
    return run_here


def test_json_is_all_there_is_on_stdout(results):
    outcome = results.packed
    assert outcome.status == 0
    summary = json.loads(outcome.stdout)
    assert summary["status"] == "finished" and summary["frames"] == 5 and summary["particles"] == 256
    assert summary["path"] == str(results.directory / "packed" / "particles.vtkhdf")
    assert set(summary["timings"]) == {"start_s", "compile_s", "solve_s", "watch_s", "output_s", "wall_s"}
    assert summary["notes"][0].startswith("drop: bulk_modulus = ")
    lines = outcome.stderr.splitlines()
    assert lines[0] == summary["notes"][0]
    assert lines[1].startswith("256 particles on ")
    assert "steps of about" in lines[2]
    assert "by a table of measured kinds" in lines[2] or "its kernels are stored" in lines[2]
    # A slow machine has time for lines of progress.
    assert all("/5 frames: t = " in line for line in lines[3:])


def test_a_run_ends_with_the_verdict_of_its_check(results, run):
    """The same findings as those of `mpmcli check`; warnings are lines, notes are left out."""
    summary = json.loads(results.packed.stdout)
    checked = json.loads(run("check", "packed", "--json").stdout)
    assert summary["check"] == checked | {"path": summary["check"]["path"]}
    crushed = "--force", "--set", "bodies[0].velocity=[0.0, -20.0]", "--set", "bodies[0].material.bulk_modulus=1e5"
    outcome = run("simulate", "scene.toml", "-o", "fast", *crushed)
    verdict = run("check", "fast").stdout.splitlines()
    said = outcome.stdout[outcome.stdout.index("\ncheck: ") :].splitlines()[1:]
    assert outcome.status == 0 and said[0] == "check: suspect" and ": suspect, " in verdict[0]
    assert said[1:] and said[1:] == [line for line in verdict if line.startswith("warning: ")]


def test_quiet_says_nothing(results):
    assert results.series == Outcome(0, "", "")
    assert (results.directory / "series" / "particles.pvd").is_file()


def test_few_particles_run_on_one_thread_with_the_same_bytes(results, tmp_path):
    """One thread where it is faster, unless --threads says otherwise; the frames do not depend on it."""
    run_here("simulate", results.directory / "scene.toml", "-o", tmp_path / "three", "--threads", "3", "--quiet")
    places = results.directory / "packed", tmp_path / "three"
    threads = [open_result(place).record["backend"]["threads"] for place in places]
    assert threads == [1, 3]
    for one, three in zip(*(open_result(place).frames() for place in places), strict=True):
        assert one.position.tobytes() == three.position.tobytes()
        assert one.velocity.tobytes() == three.velocity.tobytes()


@pytest.mark.parametrize(
    ("path", "kind"), [("packed", "packed"), ("packed/particles.vtkhdf", "packed"), ("series/particles.pvd", "packed")]
)
def test_info_says_what_a_result_holds(run, path, kind):
    facts = json.loads(run("info", path, "--json").stdout)
    expected = {"title": "A drop", "kind": kind, "status": "finished", "frames": 5, "particles": 256}
    expected |= {"fields": ["velocity", "density", "pressure"], "bodies": ["drop"], "time_s": [0.0, 0.05]}
    assert {key: facts[key] for key in expected} == expected
    outcome = run("info", path)
    assert outcome.status == 0 and outcome.stderr == ""
    told = dict(line.split("  ", 1) for line in outcome.stdout.splitlines())
    assert told["frames"].strip() == "5"
    assert "failure" not in told


def test_info_reads_a_run_that_goes_on(run, tmp_path):
    """Sealed segments and a record that says "running" are all that a run under way shows."""
    from mpmcli.output import RunRecord, SegmentStore

    result = open_result(Path("packed"))
    store, record = SegmentStore(tmp_path, result.header.stored), RunRecord(tmp_path, frames_expected=5)
    for k in range(2):
        store.write(result.frame(k), result.ledger[k])
        record.observe(result.ledger[k])
    record.write()
    (tmp_path / "segments" / "frame_000002.vtkhdf.tmp").write_bytes(b"not sealed")
    facts = json.loads(run("info", tmp_path, "--json").stdout)
    expected = {"kind": "segments", "status": "running", "frames": 2, "frames_expected": 5}
    assert {key: facts[key] for key in expected} == expected


def test_info_of_a_scene_says_what_it_takes(run):
    facts = json.loads(run("info", "scene.toml", "--set", "time.frames=9", "--json").stdout)
    expected = {"dimension": 2, "cells": [16, 16], "particles": 256, "frames": 10, "bodies": ["drop: fluid, box"]}
    assert {key: facts[key] for key in expected} == expected
    assert "bytes per particle" in run("info", "scene.toml").stdout


def test_json_has_no_infinity(run, tmp_path):
    """A run that broke down may end with an infinite energy."""
    from dataclasses import replace

    from mpmcli.output import SegmentStore

    result = open_result(Path("packed"))
    store = SegmentStore(tmp_path, result.header.stored)
    store.write(result.frame(0), replace(result.ledger[0], elastic=float("inf")))
    outcome = run("info", tmp_path, "--json")
    assert json.loads(outcome.stdout, parse_constant=pytest.fail)["energy_J"] == [None, None]


def test_debug_shows_where(run):
    assert "Traceback" not in run("simulate", "nothing.toml").stderr
    for arguments in (["--debug", "simulate", "nothing.toml"], ["simulate", "nothing.toml", "--debug"]):
        outcome = run(*arguments)
        assert outcome.status == 2 and outcome.stdout == ""
        assert outcome.stderr.startswith("Traceback") and "error: nothing.toml: there is no" in outcome.stderr


def test_a_fault_of_ours_is_one_sentence_too(run, monkeypatch):
    def fault(*_: object, **__: object) -> None:
        raise KeyError("surprise")

    monkeypatch.setattr("mpmcli.output.open_result", fault)
    outcome = run("info", "packed")
    assert outcome.status == 1 and outcome.stdout == ""
    assert outcome.stderr == "error: KeyError: 'surprise' (a fault of mpmcli; --debug shows where)\n"
    assert "Traceback" in run("--debug", "info", "packed").stderr


def test_version(run):
    outcome = run("--version")
    assert outcome.status == 0 and outcome.stdout == f"mpmcli, version {__version__}\n"


@pytest.mark.parametrize("command", ["simulate", "check", "info", "materials", "schema", "bench", "completion"])
def test_every_command_explains_itself(run, command):
    outcome = run(command, "--help")
    assert outcome.status == 0 and outcome.stdout.startswith(f"Usage: mpmcli {command}")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_that_calls_mpmcli(run, shell):
    outcome = run("completion", shell)
    assert outcome.status == 0
    assert f"_MPMCLI_COMPLETE={shell}_complete" in outcome.stdout


@pytest.mark.skipif(not shutil.which("bash"), reason="there is no bash on this machine")
def test_completion_completes(run_python, tmp_path):
    words = {"COMP_WORDS": "mpmcli simulate --ove", "COMP_CWORD": "2", "_MPMCLI_COMPLETE": "bash_complete"}
    code = "import sys; sys.argv = ['mpmcli']; from mpmcli.cli import main; main()"
    assert run_python(code, environment=words, check=False).stdout.split() == ["plain,--overwrite"]


def test_the_schema_of_the_configs_is_what_the_command_prints(run):
    """`mpmcli schema > configs/scene.schema.json` after a change of the scene."""
    outcome = run("schema")
    assert outcome.stdout == (CONFIGS / "scene.schema.json").read_text(encoding="utf-8")


def test_a_reader_may_leave_early(tmp_path):
    """As in `mpmcli schema | head -n 1`: no traceback, whatever the exit code."""
    import subprocess

    command = f'"{sys.executable}" -m mpmcli schema | head -c 1'
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=Path(__file__).parent.parent)
    assert done.stdout == "{" and done.stderr == ""


def test_json_that_cannot_be_written_is_told(run_python):
    """On a full disk, to a closed stdout, and where stdout has no code for a letter."""
    words = [sys.executable, "-m", "mpmcli", "schema"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert done.returncode == 1 and done.stderr.startswith("error: The result could not be printed on stdout (No space")
    done = run_python(["-m", "mpmcli", "schema"], environment={"PYTHONIOENCODING": "ascii"})
    assert json.loads(done.stdout)["title"] == "Scene"


@pytest.mark.parametrize(
    ("laws", "largest", "told"),
    [(["fluid"], 1.96, True), (["fluid"], 1.05, False), (["fluid", "neo_hookean"], 1.96, False)],
)
def test_a_wide_range_of_J_is_explained_in_liquids_alone(laws: list[str], largest: float, told: bool) -> None:
    """Spray has come apart; a solid may be stretched."""
    plan = SimpleNamespace(laws=[SimpleNamespace(law=name) for name in laws])
    row = SimpleNamespace(energy=1.0, kinetic=1.0, elastic=0.0, potential=0.0, volume_ratio_min=0.98, blocked=None)
    row.volume_ratio_max = largest
    timings = dict.fromkeys(("start_s", "compile_s", "solve_s", "output_s", "wall_s"), 1.0)
    summary = RunSummary(Path("r"), 1, 2, {}, (), plan, frames=2, timings=timings, first=row, last=row)
    (line,) = (line for line in summary.text().splitlines() if line.startswith("volume ratio J at the end: 0.98 to "))
    assert line.endswith(", above 1 where liquid has come apart, as in spray") == told
