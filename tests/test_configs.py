"""Every scene of configs/ loads, starts, and runs a few steps on its own grid."""

import re
import tomllib

import numpy as np
import pytest
from command import CONFIGS, run_here

from mpmcli.materials.registry import laws, parameter_models
from mpmcli.output import open_result
from mpmcli.scene import load_scene
from mpmcli.scene.expand import PRESETS

SCENES = sorted(CONFIGS.glob("*.toml"))
# Those that run by default: a fluid in 3D, an emitter, a rigid body on a hinge, contact of surfaces, sand on colliders,
# snow, a yield stress, and the scene that test_docs.py runs. Other tests run the other laws and features.
USUAL = {
    "couette_2d", "dam_break_3d", "fountain_2d", "mud_slump_2d", "paddle_wheel_2d", "sand_obstacles_2d",
    "snowball_wall_2d", "stack_2d",
}  # fmt: skip


def test_these_are_the_scenes():
    assert [path.stem for path in SCENES] == [
        "billiard_2d",
        "block_slide_2d",
        "clay_drop_2d",
        "couette_2d",
        "crater_3d",
        "dam_break_2d",
        "dam_break_3d",
        "dam_break_obstacle_3d",
        "elliptical_drop_2d",
        "fountain_2d",
        "honey_coil_2d",
        "hourglass_2d",
        "jelly_drop_2d",
        "jelly_drop_3d",
        "jelly_stack_3d",
        "lava_slope_2d",
        "mesh_drop_3d",
        "metal_impact_2d",
        "mixed_2d",
        "mixer_2d",
        "mud_slump_2d",
        "paddle_wheel_2d",
        "rafts_2d",
        "rolling_3d",
        "rubber_bounce_2d",
        "sand_column_2d",
        "sand_column_3d",
        "sand_obstacles_2d",
        "shaken_tank_2d",
        "silo_3d",
        "snowball_wall_2d",
        "snowball_wall_3d",
        "soft_grains_2d",
        "stack_2d",
        "stirred_tank_2d",
    ]


def test_every_law_and_every_preset_has_a_scene():
    """A scene is what a user copies from."""
    tables = [tomllib.loads(path.read_text(encoding="utf-8")) for path in SCENES]
    materials = [body["material"] for table in tables for body in table.get("bodies", ())]
    presets = {material if isinstance(material, str) else material.get("preset") for material in materials}
    assert presets - {None} == set(PRESETS)
    scenes = [load_scene(path, laws=parameter_models()).scene for path in SCENES]
    assert {body.material.law for scene in scenes for body in scene.bodies} == set(laws())


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_config_says_what_it_is(path):
    """The header: schema for editors, what one sees, how long it takes, where it comes from."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#:schema ./scene.schema.json"
    header = "\n".join(line for line in lines[: lines.index("[domain]")] if line.startswith("#"))
    for part in ("# What you will see: ", "# How long it takes: ", "# Where it comes from: "):
        assert header.count(part) == 1, part


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_config_says_how_many_particles_it_has(path):
    """The header's round number is that of the plan, to the two digits it gives."""
    from mpmcli.scene import estimate_particles

    said = int(
        re.search(r"# How long it takes: ([\d,]+) particles", path.read_text(encoding="utf-8"))[1].replace(",", "")
    )
    particles = estimate_particles(load_scene(path, laws=parameter_models()).scene)
    assert said == pytest.approx(particles, rel=0.05)


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem not in USUAL)) for path in SCENES]
)
def test_a_config_runs(path, tmp_path):
    """A few steps to the first frames, which land on their times; nothing is lost; only what moves makes energy."""
    scene = load_scene(path, laws=parameter_models()).scene
    # A twentieth of an impact that lasts 0.1 ms, and of the others no more than they take to move.
    end = min(5e-3, scene.time.end / 20)
    outcome = run_here(
        "simulate", path, "-o", tmp_path / "result", "--set", f"time.end={end}", "--set", "time.frames=2", "--quiet"
    )
    assert (outcome.status, outcome.stdout, outcome.stderr) == (0, "", "")
    result = open_result(tmp_path / "result")
    assert result.dimension == scene.dimension and result.header.title == scene.title
    assert result.times.tolist() == [0.0, end / 2, end]
    stored = {"velocity", *result.field_names}
    assert stored == {"velocity", *scene.output.fields} | ({"status"} if scene.particle_count_varies else set())
    first, last = result.frame(0), result.frame(2)
    assert last.step >= 2
    lower = np.array(scene.domain.origin)
    assert (last.position >= lower).all() and (last.position <= lower + scene.domain.size).all()
    assert not np.array_equal(first.position, last.position)
    if scene.particle_count_varies:
        # What comes in brings energy and mass with it.
        return
    energies = [row.energy for row in result.ledger]
    # f32 rounds each position, and with it the potential, to 6e-8.
    moves = scene.domain.wall_speed > 0 or any(collider.motion.moves for collider in scene.colliders)
    assert moves or energies[2] <= energies[0] * (1 + 1e-5)
    assert result.ledger[2].mass == result.ledger[0].mass
