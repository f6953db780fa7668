"""Every sweep of configs/sweeps/ loads and draws scenes that can be computed; its base scene says what it is."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from command import CONFIGS, run_here

import mpmcli.dataset
from mpmcli.check.finding import passes
from mpmcli.check.scene_check import check_scene
from mpmcli.dataset.draw import draw
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.dataset.sweep_run import SweepSettings, rehearse, run_sweep
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import estimate_particles, load_scene

SWEEPS = sorted((CONFIGS / "sweeps").glob("*.toml"))
BASES = sorted((CONFIGS / "sweeps" / "base").glob("*.toml"))
LAWS = parameter_models()
DRAWN = 5


def test_these_are_the_sweeps():
    assert [path.stem for path in SWEEPS] == [
        "jelly_3d",
        "mixed_2d",
        "sand_boxes_2d",
        "sand_obstacles_2d",
        "thrown_blocks_2d",
        "thrown_stones_2d",
        "water_drop_2d",
    ]
    used = {load_sweep(path, laws=LAWS).base.name for path in SWEEPS}
    assert used == {path.name for path in BASES}


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_a_sweep_draws_scenes_that_pass_the_check(path):
    sweep = load_sweep(path, laws=LAWS)
    assert "How long it takes: " in sweep.text
    for number in range(DRAWN):
        loaded = draw(sweep, number).scene(LAWS)
        findings = check_scene(loaded).findings
        assert passes(findings), [finding.what for finding in findings if finding.severity == "error"]
        assert 1000 <= estimate_particles(loaded.scene) <= 4000


@pytest.mark.parametrize("path", BASES, ids=lambda path: path.stem)
def test_a_base_scene_says_what_it_is_and_passes_the_check(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#:schema ../../scene.schema.json"
    header = "\n".join(line for line in lines[: lines.index("[domain]")] if line.startswith("#"))
    for part in ("# What you will see: ", "# How long it takes: ", "# Where it comes from: "):
        assert header.count(part) == 1, part
    said = int(re.search(r"# How long it takes: ([\d,]+) particles", header)[1].replace(",", ""))
    particles = estimate_particles(load_scene(path, laws=LAWS).scene)
    assert said == pytest.approx(particles, rel=0.05)
    outcome = run_here("check", path)
    assert (outcome.status, outcome.stderr) == (0, "")


def test_a_shortened_sweep_runs(tmp_path):
    """Two trajectories of the drops of water, of three frames each, by the command's own workers."""
    path = CONFIGS / "sweeps" / "water_drop_2d.toml"
    shared = tomllib.loads(path.read_text(encoding="utf-8"))
    text = path.with_name("base") / path.name
    short = text.read_text(encoding="utf-8").replace("end = 1.0 ", "end = 0.01").replace("frames = 200", "frames = 2")
    (tmp_path / "base").mkdir()
    (tmp_path / shared["base"]).write_text(short, encoding="utf-8")
    copy = tmp_path / path.name
    copy.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    sweep = load_sweep(copy, laws=LAWS, count=2)
    settings = SweepSettings(tmp_path / "set", workers=1)
    forecast = [one.particles for one in rehearse(sweep, settings).trajectories]
    state = run_sweep(sweep, settings)
    assert (state.status, state.accepted) == ("finished", 2)
    dataset = mpmcli.dataset.open(tmp_path / "set")
    assert [each.frame_count for each in dataset] == [3, 3]
    assert [each.position.shape[1] for each in dataset] == forecast
    card = Path(tmp_path / "set" / "README.md").read_bytes()
    run_sweep(sweep, replace(settings, resume=True))
    assert Path(tmp_path / "set" / "README.md").read_bytes() == card
