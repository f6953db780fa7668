"""Runs under hard conditions: violent impacts, far origins, and surroundings that a batch system may give."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command import SCENE, run_here

from mpmcli.materials.fluid import FULL
from mpmcli.output import open_result

FALL = """\
domain = { size = [0.5, 1.0], spacing = 0.025, gravity = [0.0, -9.81] }
time = { end = 0.6, frames = 24 }
[[bodies]]
name = "water"
material = { law = "fluid", density = 1000.0 }
shape = { box = { min = [0.0, 0.7], max = [0.3, 1.0] } }
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene file, to be written by the test."""
    return tmp_path / "scene.toml"


def test_a_flat_fall_ends_well_with_all_defaults(scene: Path) -> None:
    """Water falls flat on a separating floor, and its jets climb walls and run along the ceiling.

    Energy is lost only (9.9: 1e-3), and J stays near 1 where there is pressure: droplets along the walls must not pump
    either up. Water that opened remembers at most what the grid sees of stencils that are filled.
    """
    scene.write_text(FALL, encoding="utf-8")
    outcome = run_here("simulate", scene, "-o", scene.parent / "result", "--quiet")
    assert outcome.status == 0, outcome.stderr
    ledger = open_result(scene.parent / "result").ledger
    energy = np.array([row.energy for row in ledger])
    assert (energy - np.minimum.accumulate(energy)).max() <= 1e-3 * energy[0]
    assert min(row.volume_ratio_min for row in ledger) > 0.7
    assert max(row.volume_ratio_max for row in ledger) < 1 / FULL


def test_positions_far_from_zero_stay_apart(scene: Path) -> None:
    """At 10^6 m single precision has steps of 0.06 m, more than a cell; the stored positions must not."""
    scene.write_text(
        SCENE.replace("cells = [16, 16]", "cells = [16, 16]\norigin = [1e6, 1e6]").replace(
            "min = [0.25, 0.0], max = [0.75, 0.5]", "min = [1000000.25, 1000000.0], max = [1000000.75, 1000000.5]"
        ),
        encoding="utf-8",
    )
    outcome = run_here("simulate", scene, "-o", scene.parent / "result", "--quiet", "--set", "time.end=0.001")
    assert outcome.status == 0, outcome.stderr
    position = open_result(scene.parent / "result").frame(0).position
    assert len(np.unique(position, axis=0)) == len(position) == 256
    assert np.allclose(np.diff(np.unique(position[:, 0])), 1 / 32, atol=1e-9)


SURROUNDINGS = {
    "no HOME, and another arch in TI_ARCH": {"HOME": None, "TI_ARCH": "opengl"},
    "no cache": {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/none"},
}


@pytest.mark.parametrize("surroundings", SURROUNDINGS)
def test_a_run_needs_no_home(scene: Path, surroundings: str) -> None:
    """Batch systems leave HOME unset or its cache unwritable; the run ends with 0 and says nothing."""
    if not Path("/proc/self").exists():
        pytest.skip("this system has no /proc")
    scene.write_text(SCENE, encoding="utf-8")
    environment = {**os.environ, **SURROUNDINGS[surroundings]}
    done = subprocess.run(
        [sys.executable, "-m", "mpmcli", "simulate", scene, "-o", scene.parent / "result", "-q"],
        env={key: value for key, value in environment.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert open_result(scene.parent / "result").frame_count == 5


def test_kernels_are_kept_although_a_killed_process_left_its_lock(scene: Path) -> None:
    """A lock that is minutes old belongs to nobody, and would keep every later run compiling from the start."""
    scene.write_text(SCENE, encoding="utf-8")
    cache = scene.parent / "cache"
    lock = cache / "taichi" / "ticache" / "ticache.lock"
    lock.parent.mkdir(parents=True)
    lock.touch()
    os.utime(lock, (0, 0))
    command = [sys.executable, "-m", "mpmcli", "simulate", scene, "-o", scene.parent / "result", "-q"]
    subprocess.run(command, env={**os.environ, "XDG_CACHE_HOME": str(cache)}, check=True, timeout=120)
    assert not lock.exists()
    assert len(list(lock.parent.glob("*.tic"))) > 3


def buffered() -> dict[str, str]:
    """Return the environment without PYTHONUNBUFFERED.

    Buffered streams are flushed at exit, and Python changes the exit code to 120 where that fails.
    """
    return {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}


@pytest.mark.parametrize("arguments", [[], ["--json"]])
def test_a_reader_may_go_away(scene: Path, arguments: list[str]) -> None:
    """`mpmcli simulate ... 2>&1 | head -1`: the run goes on to its end."""
    scene.write_text(SCENE, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, "-m", "mpmcli", "simulate", scene, "-o", scene.parent / "result", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=buffered(),
    ) as process:
        process.stdout.close()
        assert process.wait(timeout=120) == 0
    assert open_result(scene.parent / "result").record["status"] == "finished"


@pytest.mark.parametrize(
    ("arguments", "status"), [(["--help"], 0), (["materials"], 0), (["schema"], 0), (["materials", "none"], 2)]
)
def test_a_closed_pipe_does_not_change_the_exit_code(arguments: list[str], status: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "mpmcli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=buffered()
    ) as process:
        process.stdout.close()
        assert process.wait(timeout=120) == status


def test_threads_are_bounded(scene: Path) -> None:
    scene.write_text(SCENE, encoding="utf-8")
    outcome = run_here("simulate", scene, "-o", scene.parent / "result", "--threads", 100000)
    assert outcome.status == 2 and outcome.stdout == ""
    assert "--threads 100000 is not possible; give 1 to " in outcome.stderr
    assert not (scene.parent / "result").exists()
