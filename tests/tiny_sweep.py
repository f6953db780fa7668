"""A sweep of runs that take some milliseconds each, and what the tests compare of its dataset."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from mpmcli.dataset.folder import Manifest, Row
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.materials.registry import parameter_models

BASE = """\
title = "Sand in a small box"
[domain]
size = [1.0, 1.0]
cells = [16, 16]
gravity = [0.0, -9.81]
[time]
end = 0.05
frames = 4
[[bodies]]
name = "sand"
material = { preset = "sand", friction_angle = 30.0 }
shape = { box = { min = [0.2, 0.0], max = [0.5, 0.3] } }
sampling = "jittered"
"""

SWEEP = """\
base = "base.toml"
count = {count}
seed = 3
[vary]
"bodies.sand.material.friction_angle" = {{ uniform = [25, 40] }}
"domain.gravity.1" = {{ uniform = [-9.81, -3.7] }}
[place]
body = "sand"
count = {{ integers = [1, 2] }}
size = {{ uniform = [[0.15, 0.15], [0.3, 0.3]] }}
region = {{ min = [0.1, 0.1], max = [0.9, 0.9] }}
min_distance = 0.1
"""


def write_sweep(directory: Path, count: int = 12, base: str = BASE, more: str = "") -> Path:
    """Write the sweep and its base scene, and return the path of the sweep."""
    (directory / "base.toml").write_text(base, encoding="utf-8")
    path = directory / "sweep.toml"
    path.write_text(more + SWEEP.format(count=count), encoding="utf-8")
    return path


def tiny_sweep(directory: Path, count: int = 12, base: str = BASE, more: str = "") -> Sweep:
    """Return the sweep."""
    return load_sweep(write_sweep(directory, count, base, more), laws=parameter_models())


def small_shards(monkeypatch: pytest.MonkeyPatch, trajectories: int = 4) -> None:
    """Let a shard hold a few trajectories."""
    monkeypatch.setattr("mpmcli.dataset.sweep_run.trajectory_bytes", lambda *_: 1000)
    monkeypatch.setattr("mpmcli.dataset.sweep_run.SHARD_BYTES", 1000 * trajectories)


def contents(directory: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a dataset but the manifest, by its path in it."""
    files = [path for path in directory.rglob("*") if path.is_file() and not path.name.startswith("manifest")]
    return {str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


def told(directory: Path) -> list[Row]:
    """Return the rows of the manifest without what a clock gave."""
    return [replace(row, seconds=0.0) for row in Manifest(directory).rows()]
