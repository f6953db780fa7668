"""The limits of a scene's check against closed forms and the solver, and what the command says of them."""

import json
import math
from collections.abc import Callable

import pytest
from check_scenes import FLUID, SOLID, box, check, found, loaded
from command import CONFIGS, run_here
from hypothesis import example, given
from hypothesis import strategies as st

from mpmcli.check.facts import SceneFacts
from mpmcli.check.scene_check import MOST_STEPS, SceneCheck, check_scene
from mpmcli.check.scene_limits import JET
from mpmcli.errors import InputError
from mpmcli.materials.fluid import Fluid
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import load_scene, scene_bounds
from mpmcli.scene.expand import PRESETS
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.stability.limits import COURANT, DEFORMATION

H = 1 / 64
SCENES = sorted(CONFIGS.glob("*.toml"))
# The kernels of this file, of test_check_start.py and of test_check_deformation.py: in f64 and between such walls. Its
# viscosity of water limits no step.
WATER = FLUID | {"viscosity": 1e-3}
WALLS = {"walls": "separate"}
F64 = {"precision": "f64"}
LIGHT = {"law": "neo_hookean", "density": 2.0, "youngs_modulus": 100.0, "poissons_ratio": 0.25}


def limit(checked: SceneCheck, name: str, state: str, body: str = "block") -> float:
    """Return the value of one limit."""
    (value,) = [one.value for one in checked.facts.limits if (one.name, one.state, one.body) == (name, state, body)]
    return value


def test_a_fluid_is_bounded_by_its_sound() -> None:
    """r h / (c sqrt(d)) at rest (6.1, 10.1); compressed to J = 1/(1 + v/c + g H/c^2) it is softer, and rest binds."""
    checked = check()
    c = math.sqrt(FLUID["bulk_modulus"] / FLUID["density"])
    assert limit(checked, "wave", "rest") == pytest.approx(Fluid.eases[0] * H / (c * math.sqrt(2)))
    (stiffest,) = [one for one in checked.facts.limits if (one.name, one.state) == ("wave", "stiffest")]
    v = math.sqrt(2 * 10 * 0.25)
    assert stiffest.bound.volume_ratio_min == pytest.approx(1 / (1 + v / c + 10 * 0.25 / c**2))
    assert checked.facts.binding.state == checked.facts.binding_at_start.state == "rest"
    assert checked.facts.step == checked.facts.step_at_start == pytest.approx(0.8 * limit(checked, "wave", "rest"))


def test_a_fluid_with_tension_opens_and_becomes_stiffer() -> None:
    """Its stiffness is K J, and a droplet that was thrown apart at v/c has J = 1 + v/c + g H/c^2 (10.1)."""
    checked = check(material=FLUID | {"tension_cutoff": False})
    c = math.sqrt(FLUID["bulk_modulus"] / FLUID["density"])
    J = 1 + math.sqrt(2 * 10 * 0.25) / c + 10 * 0.25 / c**2
    assert limit(checked, "wave", "stiffest") == pytest.approx(H / (c * math.sqrt(2 * J)))
    assert checked.facts.binding.state == "stiffest"


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_solid_is_bounded_by_its_waves(dimension: int) -> None:
    """h / sqrt((d lambda + 2 mu) / density) at rest (10.1), and lambda = mu = E / 2.5 for nu = 1/4."""
    d = dimension
    checked = check(
        material=LIGHT,
        domain={"size": [1.0] * d, "cells": [64] * d, "gravity": [0.0] * d},
        shape=box([0.25] * d, [0.5] * d),
    )
    assert limit(checked, "wave", "rest") == pytest.approx(H / math.sqrt((d + 2) * 40.0 / 2.0))


def test_viscosity_and_waves_share_the_step() -> None:
    """d (c dt/h)^2 + zeta-part of the volume, and 4 nu dt/h^2 = 1 for shear (10.1)."""
    checked = check(material=FLUID | {"viscosity": 1e4})
    nu = 10.0
    assert limit(checked, "viscosity", "rest") == pytest.approx(H**2 / (4 * nu))
    assert checked.facts.binding_at_start.name == "viscosity"
    assert "viscosity" in checked.facts.binding_at_start.fix


def test_the_speed_is_that_of_the_fall_and_its_jets() -> None:
    """v dt + g dt^2 = COURANT h with v = sqrt(v0^2 + 2 g H); an impact has the gradient 2 v / h."""
    checked = check(shape=box([0.25, 0.5], [0.5, 0.75]), velocity=[3.0, 0.0])
    v = math.sqrt(3.0**2 + 2 * 10 * 0.75)
    for speed, state, body in ((3.0, "rest", "block"), (JET * v, "stiffest", "")):
        dt = limit(checked, "speed", state, body)
        assert speed * dt + 10 * dt**2 == pytest.approx(COURANT * H)
    assert limit(checked, "deformation", "stiffest", "") == pytest.approx(DEFORMATION * H / (2 * v))


def test_a_bound_says_what_binds_and_in_which_state() -> None:
    """Snow that is thrown hardens, and the limit names what it becomes, with numbers of this scene."""
    snow = {"law": "snow", "density": 400.0, "hardening_limit": 10.0}
    checked = check(material=snow, shape=box([0.25, 0.25], [0.5, 0.5]), velocity=[5.0, 0.0])
    binding = checked.facts.binding
    assert (binding.name, binding.body, binding.state) == ("wave", "block", "stiffest")
    # Packed to its limit it is ten times as stiff; its elastic part gives a little more.
    assert 9.0 <= (checked.facts.step_at_start / checked.facts.step) ** 2 <= 12.0
    assert binding.bound.internal["plastic_volume_ratio"][0] == pytest.approx(1 - math.log(10) / 10, rel=1e-3)
    assert "plastic_volume_ratio" in binding.meaning
    assert "youngs_modulus" in binding.fix


def test_a_dense_body_packs_snow_harder() -> None:
    """What falls on the snow presses with its own density."""
    snow = {"name": "snow", "material": {"law": "snow", "density": 400.0}, "shape": box([0.0, 0.0], [0.5, 0.25])}
    stone = {"law": "neo_hookean", "youngs_modulus": 1e6, "poissons_ratio": 0.2}
    packed = []
    for density in (400.0, 1600.0):
        ball = {
            "name": "ball",
            "material": {**stone, "density": density},
            "shape": {"ball": {"center": [0.25, 0.6], "radius": 0.1}},
        }
        facts = SceneFacts(loaded([snow, ball]).scene)
        packed.append(facts.bodies[0].stiffest)
    assert packed[1] > 1.2 * packed[0]


@pytest.mark.parametrize("speed", [1.0, 4.0])
@pytest.mark.parametrize("shape", [{"ball": {"center": [0.5, 0.3], "radius": 0.127}}, box([0.38, 0.05], [0.62, 0.29])])
def test_snow_that_hits_the_floor_keeps_the_step_that_is_safe(backend_of: Callable, shape: dict, speed: float) -> None:
    """It is the smallest step, within the safety factor, and at most 2.2 times as long (a block that lands flat).

    Of eight balls of about this size and place, two take a step of half to two thirds of it for a moment.
    """
    snow = {"law": "snow", "density": 400.0}
    scene = loaded(
        material=snow,
        shape=shape,
        velocity=[0.0, -speed],
        domain=WALLS | {"gravity": [0.0, -9.81]},
        time={"end": 0.3, "frames": 10},
        solver=F64,
    )
    steps = [row.step_min for _, row in build_run(scene.scene, backend_of("f64", 1)).frames()]
    assert 0.8 < min(steps[1:]) / SceneFacts(scene.scene).step < 2.2


@pytest.mark.parametrize(
    ("material", "velocity"),
    [(WATER, 0.0), (FLUID | {"viscosity": 100.0}, 200.0), (SOLID, 200.0), ({"law": "snow", "density": 400.0}, 0.0)],
)
def test_the_first_step_is_the_solvers(backend_of: Callable, material: dict, velocity: float) -> None:
    """The solver measures its state and comes to the same step, where waves bind and where the speed does."""
    scene = loaded(material=material, velocity=[velocity, 0.0], domain=WALLS, solver=F64)
    step, binding = build_run(scene.scene, backend_of("f64", 1)).stable_step()
    checked = check_scene(scene)
    assert checked.facts.step_at_start == pytest.approx(step, rel=1e-9)
    assert checked.facts.binding_at_start.name == binding.name
    assert checked.facts.step <= checked.facts.step_at_start


MPM88 = """\
[domain]
size = [1.0, 1.0]
cells = [64, 64]
gravity = [0.0, -9.8]
[time]
end = 0.6
frames = 1
step = {step}
[solver]
precision = "f64"
[[bodies]]
name = "block"
material = {{ law = "fluid", density = 1.0, bulk_modulus = 400.0, tension_cutoff = false }}
shape = {{ box = {{ min = [0.2, 0.2], max = [0.6, 0.6] }} }}
"""


@pytest.mark.parametrize(("stable", "courant"), [(True, 0.512), (False, 0.8)])
def test_mpm88_is_called_right(backend_of: Callable, tmp_path, stable: bool, courant: float) -> None:
    """Taichi issue 3162: stable at a Courant number of 0.512 and exploding at 0.80; the limit is 1/sqrt(2).

    A fluid with tension coheres, so that its lone particles bear all stress. The solver, forced to that step, agrees.
    The issue has these numbers with steps of 2e-4 s and 128 and 200 cells.
    """
    path, step = tmp_path / "mpm88.toml", courant * H / 20
    path.write_text(MPM88.format(step=step))
    scene = load_scene(path, laws=parameter_models())
    checked = check_scene(scene)
    assert checked.passes() == stable
    errors = [finding for finding in checked.findings if finding.severity == "error"]
    assert [finding.rule for finding in errors] == ([] if stable else ["step-above-limit"])
    if not stable:
        assert errors[0].value == pytest.approx(courant * math.sqrt(2))
        assert f"{courant:.3f}" in errors[0].what and "0.707" in errors[0].what
    outcome = run_here("check", path, "--json")
    assert (outcome.status, json.loads(outcome.stdout)["ok"]) == (0 if stable else 1, stable)
    solver = build_run(scene.scene, backend_of("f64", 1), force=True)
    start = solver.frame()[1].energy

    def run() -> None:
        for _ in range(1500):
            solver.step(step)

    if stable:
        run()
        assert solver.frame()[1].energy <= start
    else:
        with pytest.raises(UnstableRunError):
            run()


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_config_passes(path) -> None:
    """No error and no warning in a scene of ours, and an expected number of steps within its range."""
    scene = load_scene(path, laws=parameter_models())
    checked = check_scene(scene)
    assert [finding.line for finding in checked.findings if finding.severity != "note"] == []
    assert checked.passes(strict=True)
    assert 0 < checked.facts.step <= checked.facts.step_at_start
    low, high = checked.forecast.steps_range
    assert low <= checked.forecast.steps <= high


def test_the_json_has_what_is_promised(tmp_path) -> None:
    """One document: ok, step, limits, findings, plan, forecast."""
    outcome = run_here("check", CONFIGS / "mixed_2d.toml", "--json")
    assert (outcome.status, outcome.stderr) == (0, "")
    told = json.loads(outcome.stdout)
    assert {"ok", "step", "step_at_start", "limits", "findings", "plan", "forecast"} <= told.keys()
    assert {"value", "name", "body", "state", "why", "fix", "binds"} <= told["limits"][0].keys()
    assert [one["body"] for one in told["limits"] if one["binds"]] == ["snow"]
    assert min(one["value"] for one in told["limits"]) * 0.8 == told["step"]
    assert {"laws", "nodes", "bytes_per_particle", "device_bytes", "passes"} <= told["plan"].keys()
    assert told["forecast"].keys() >= {"steps", "seconds", "compile_seconds", "device_bytes", "file_bytes", "frames"}
    assert told["forecast"]["seconds"] > told["forecast"]["compile_seconds"] > 0 and not told["forecast"]["measured"]


def test_the_table_names_what_binds(tmp_path, monkeypatch) -> None:
    """Text goes to stdout, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    outcome = run_here("check", CONFIGS / "snowball_wall_2d.toml")
    assert (outcome.status, outcome.stderr) == (0, "")
    for words in ("binds throughout", "binds at the start", "passes of a step", "on the device", "ok: nothing found"):
        assert words in outcome.stdout
    assert list(tmp_path.iterdir()) == []


def test_bodies_with_equal_limits_share_a_row() -> None:
    table = run_here("check", CONFIGS / "stack_2d.toml").stdout
    assert len([line for line in table.splitlines() if line.startswith("block_1, block_2 and 4 more  wave ")]) == 2
    assert "\nblock_3" not in table


def test_strict_turns_warnings_into_errors(tmp_path) -> None:
    """Exit 0 with a warning, 1 with --strict, 1 with an error, 2 with bad input."""
    path = CONFIGS / "dam_break_2d.toml"
    thin = ("--set", "bodies.column.shape.box.max=[1.0, 0.04]")
    assert run_here("check", path, *thin).status == 0
    outcome = run_here("check", path, "--strict", "--json", *thin)
    assert (outcome.status, json.loads(outcome.stdout)["ok"]) == (1, False)
    assert run_here("check", path, "--set", "time.step=0.01").status == 1
    assert run_here("check", path, "--set", "time.stop=1").status == 2


def test_options_of_scenes_are_refused_for_results(tmp_path) -> None:
    """One sentence, exit 2."""
    for option in (["--probe"], ["--set", "time.end=1"], ["--threads", "1"]):
        outcome = run_here("check", tmp_path / "result", *option)
        assert outcome.status == 2
        assert f"{option[0]} is for scenes" in outcome.stderr


def test_the_binding_step_is_the_smallest() -> None:
    """safety times the smallest bound, whatever the scene."""
    for keywords in ({}, {"material": SOLID}, {"velocity": [30.0, 0.0]}):
        checked = check(**keywords)
        assert checked.facts.step == 0.8 * min(one.value for one in checked.facts.limits)
        assert scene_bounds(loaded(**keywords).scene).speed > 0
    assert found("step-above-limit") == []


@given(
    preset=st.sampled_from(sorted(PRESETS)),
    size=st.floats(1e-4, 1e4),
    speed=st.floats(0, 1e5),
    gravity=st.sampled_from([0.0, 1e-3, 9.81, 1e6]),
    end=st.floats(1e-6, 1e3),
    step=st.one_of(st.just("auto"), st.floats(1e-9, 1.0)),
    count=st.sampled_from([1, 4, 25]),
)
@example(preset="clay", size=1e-4, speed=68583.0, gravity=0.0, end=912.0, step="auto", count=1)
def test_any_scene_can_be_checked(
    preset: str, size: float, speed: float, gravity: float, end: float, step: float | str, count: int
) -> None:
    """Whatever its numbers: a step that exists, steps within their range, sentences, and JSON.

    Or one sentence, where nobody could count the steps.
    """
    scene = loaded(
        material={"preset": preset},
        shape=box([0.25 * size, 0.1 * size], [0.5 * size, 0.3 * size]),
        domain={"size": [size, size], "gravity": [0.0, -gravity]},
        time={"end": end, "step": step},
        velocity=[speed, -speed],
        particles_per_cell=count,
    )
    if end > MOST_STEPS * SceneFacts(scene.scene).step:
        with pytest.raises(InputError, match=f"no run is possible: .* in a run of {end:.3g} s".replace("+", r"\+")):
            check_scene(scene)
        return
    checked = check_scene(scene)
    assert 0 < checked.facts.step <= checked.facts.step_at_start
    low, high = checked.forecast.steps_range
    assert low <= checked.forecast.steps <= high
    assert json.loads(json.dumps(checked.as_dict()))["ok"] == checked.passes()
    for finding in checked.findings:
        assert finding.what.endswith(".") and finding.fix.endswith(".") and "nan" not in finding.line
    assert checked.loaded.scene.title in checked.text()
