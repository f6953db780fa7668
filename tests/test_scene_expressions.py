"""Expressions in scenes: which keys take them, what they mean, how they are refused, and how they are written back."""

import tomllib

import numpy as np
import pytest
from command import run_here

from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.scene import highest_speed, load_scene, parse_scene, sample_bodies, scene_bounds, scene_to_toml
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.machine.backend import Backend

LAWS = parameter_models()
SCENE = """
domain = { size = [1.0, 0.8], spacing = 0.05, gravity = ["3 * sin(t)", -9.81] }
time = { end = 2.0, frames = 4 }
[[bodies]]
name = "pool"
material = { law = "fluid", density = 1000.0, bulk_modulus = 1e5 }
shape = { box = { min = [0.0, 0.0], max = [1.0, 0.3] } }
velocity = ["0.1 * sin(pi * X)", 0.5]
deformation = "1 - 1e-3 * Y"
[[bodies]]
name = "ball"
material = "jelly"
shape = { ball = { center = [0.5, 0.6], radius = 0.1 } }
deformation = [["1 + X / 10", 0], [0, 1]]
[[forces]]
name = "stir"
body = "ball"
acceleration = ["-4 * (x - X)", "cos(3 * t)"]
[output]
fields = ["velocity", "initial_position"]
"""


def loaded(tmp_path, *overrides, text=SCENE):
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path, overrides, laws=LAWS)


def test_the_effective_scene_says_the_same(tmp_path):
    scene = loaded(tmp_path).scene
    text = scene_to_toml(scene)
    again = parse_scene(tomllib.loads(text), laws=LAWS).scene
    assert again == scene and scene_to_toml(again) == text
    for line in ('gravity = ["3 * sin(t)", -9.81]', 'acceleration = ["-4 * (x - X)", "cos(3 * t)"]'):
        assert line in text.splitlines()
    assert 'deformation = "1 - 1e-3 * Y"' in text and 'velocity = ["0.1 * sin(pi * X)", 0.5]' in text
    assert loaded(tmp_path, "forces.stir.acceleration=[0, 'y']").scene != scene


def test_text_that_depends_on_nothing_is_a_number(tmp_path):
    scene = loaded(tmp_path, 'domain.gravity=["0", "-9.81 * cos(0)"]').scene
    assert scene.domain.gravity == (0.0, -9.81) and scene.domain.steady


# Override -> how the answer to it begins, after the override itself.
REFUSED = {
    "forces.stir.body=bal": 'forces[0].body: no body has the name "bal"; did you mean "ball"?',
    "forces.stir.acceleration=[0, 'z']": 'forces[0].acceleration[1]: has no "z" in a 2D scene; ',
    "forces.stir.acceleration=[1]": "forces[0].acceleration: needs two numbers in this 2D scene ",
    "forces=[{body='ball'}]": "forces[0].acceleration: missing key: m/s^2, one entry per axis; or give force, N",
    "forces.stir.accelration=[0, 1]": 'forces[0].accelration: unknown key; did you mean "acceleration"?',
    "domain.gravity=['x', 0]": 'domain.gravity[0]: has an unknown name "x"; the name here is t',
    "domain.gravity=[true, 0]": "domain.gravity[0]: must be a number or an expression in quotes; found true",
    "domain.gravity=[0, 1e16]": "domain.gravity[1]: is beyond what can be computed with, 1e+15 at most; found 1e+16",
    "bodies.pool.velocity=['x', 0]": 'bodies[0].velocity[0]: has an unknown name "x"; did you mean "X"? ',
    "bodies.pool.velocity=['sine(X)', 0]": 'bodies[0].velocity[0]: has an unknown function "sine"; did you mean "sin',
    "bodies.pool.velocity=['log(X - 0.5)', 0]": "bodies[0].velocity[0]: is nan at the particle at [0.0125, 0.0125]; ",
    "bodies.pool.velocity=[0, 'sqrt(X - 0.0125)']": "bodies[0].velocity[1]: has no finite slope along X at the ",
    "bodies.pool.deformation=[[1, 0], [0, 1]]": "bodies[0].deformation: must be J, one number or expression, as ",
    "bodies.ball.deformation='1 + X'": "bodies[1].deformation: must be F, 2 rows such as [[1, 0], [0, 1]], as the law ",
    "bodies.ball.deformation=[['X - 0.5', 0], [0, 1]]": "bodies[1].deformation: must keep det F above 0; it is -0.08",
    "bodies.pool.deformation='Y - 1'": "bodies[0].deformation: must keep J above 0; it is -0.9875 at the particle at ",
    "bodies.pool.initial_pressure=hydrostatic": "bodies[0].initial_pressure: sets the deformation, which is given as ",
    "bodies.ball.initial_pressure=hydrostatic": "bodies[1].initial_pressure: is for fluids: the law fixed_corotated ",
}


@pytest.mark.parametrize("override", REFUSED)
def test_each_bad_value_has_its_sentence(tmp_path, override):
    with pytest.raises(InputError) as error:
        loaded(tmp_path, override)
    found = str(error.value).removeprefix(f"--set {override}: ")
    assert found.startswith(REFUSED[override]) and "\n" not in found, found


def test_hydrostatic_needs_gravity_that_it_can_balance(tmp_path):
    text = SCENE.replace('deformation = "1 - 1e-3 * Y"', 'initial_pressure = "hydrostatic"')
    for gravity, said in {
        '["3 * sin(t)", -9.81]': "needs gravity that stays the same; domain.gravity depends on t",
        "[0, 0]": "needs gravity: give domain.gravity, or leave it out",
        "[0, -1000]": "requires 2.875e+05 Pa, more than the material can bear; give it a larger bulk_modulus",
    }.items():
        with pytest.raises(InputError) as error:
            loaded(tmp_path, f"domain.gravity={gravity}", text=text)
        assert str(error.value) == f"{tmp_path / 'scene.toml'}:9: bodies[0].initial_pressure: {said}"


def test_errors_name_the_line(tmp_path):
    with pytest.raises(InputError) as error:
        loaded(tmp_path, text=SCENE.replace("-4 * (x - X)", "-4 * (q - X)"))
    assert str(error.value).startswith(f"{tmp_path / 'scene.toml'}:18: forces[0].acceleration[0]: has an unknown name")


def body_of(tmp_path, *overrides):
    return sample_bodies(loaded(tmp_path, *overrides).scene)[0]


def test_the_gradient_of_the_velocity_is_the_affine_velocity(tmp_path):
    body = body_of(tmp_path, "bodies.pool.velocity=['0.1 * sin(pi * X)', 'X * Y - exp(Y)']")
    X, Y = body.position.T
    np.testing.assert_allclose(body.velocity, np.stack([0.1 * np.sin(np.pi * X), X * Y - np.exp(Y)], 1), rtol=1e-15)
    C = np.stack([0.1 * np.pi * np.cos(np.pi * X), 0 * X, Y, X - np.exp(Y)], 1).reshape(-1, 2, 2)
    np.testing.assert_allclose(body.affine, C, rtol=1e-14, atol=1e-16)


def test_numbers_add_a_gradient_and_expressions_replace_it(tmp_path):
    """v = velocity(X) + L (X - c), C = grad velocity + L where L is numbers; C = L alone where it is not."""
    velocity = "bodies.pool.velocity=['2 * X', 0]"
    body = body_of(tmp_path, velocity, "bodies.pool.velocity_gradient=[[0, 3], [4, 0]]")
    X, Y = body.position.T
    np.testing.assert_allclose(body.velocity, np.stack([2 * X + 3 * (Y - 0.15), 4 * (X - 0.5)], 1), atol=1e-15)
    np.testing.assert_array_equal(body.affine[7], [[2, 3], [4, 0]])
    body = body_of(tmp_path, velocity, "bodies.pool.velocity_gradient=[[0, 'X'], [4, 0]]")
    np.testing.assert_array_equal(body.velocity, np.stack([2 * X, 0 * X], 1))
    np.testing.assert_array_equal(body.affine, [[[0, x], [4, 0]] for x in X])


def test_an_affine_velocity_is_the_same_by_either_key(tmp_path):
    """As an expression and as velocity and velocity_gradient: the same start to rounding."""
    first = body_of(tmp_path, "bodies.pool.velocity=['1 - 2 * (Y - 0.15)', '2 * (X - 0.5)']")
    second = body_of(tmp_path, "bodies.pool.velocity=[1, 0]", "bodies.pool.velocity_gradient=[[0, -2], [2, 0]]")
    np.testing.assert_allclose(first.velocity, second.velocity, atol=1e-15)
    np.testing.assert_allclose(first.affine, second.affine, atol=1e-15)


def test_bounds_know_of_expressions(tmp_path):
    """The strongest gravity of the run, 3 m/s^2 sideways at t = pi/2, the largest velocity, and forces on top."""
    scene = loaded(tmp_path, "forces=[]").scene
    assert highest_speed(scene.bodies[0]) == pytest.approx(np.hypot(0.1, 0.5), rel=1e-3)
    assert scene_bounds(scene).gravity == pytest.approx(np.hypot(3, 9.81), rel=1e-4)
    driven = loaded(tmp_path).scene
    # |x - X| is 0.6 at most, and |cos| 1: both are found within the sampling of places and instants.
    extra = scene_bounds(driven).gravity - scene_bounds(scene).gravity
    assert np.hypot(4 * 0.5, 1) < extra <= np.hypot(4 * 0.6, 1) * (1 + 1e-9)
    assert scene_bounds(driven).speed > scene_bounds(scene).speed


def test_scenes_without_expressions_plan_as_before(tmp_path):
    plain = loaded(tmp_path, "forces=[]", "domain.gravity=[0.0, -9.81]").scene
    driven = loaded(tmp_path).scene
    backend = Backend("cpu", 2, "f32", True)
    before, after = make_plan(plain, backend), make_plan(driven, backend)
    assert before.passes[1:3] == ("scatter fixed_corotated", "scatter fluid")
    assert after.passes[1:3] == ("scatter fixed_corotated with forces", "scatter fluid")
    solid, fluid = after.laws
    # Forces select the particles of their body.
    assert solid.fields == {**before.laws[0].fields, "initial_position": 8, "body": 4}
    assert fluid.fields == before.laws[1].fields


def test_the_check_of_a_scene_takes_expressions(tmp_path):
    check = check_scene(loaded(tmp_path))
    assert check.passes() and check.forecast.steps > 0
    gradient = next(limit for limit in check.facts.limits if limit.name == "deformation" and limit.state == "rest")
    assert gradient.value == pytest.approx(0.5 / (0.1 * np.pi), rel=1e-3)


@pytest.mark.parametrize("form", ["vtkhdf", "vtk"])
def test_a_driven_run_is_stored_and_not_blamed(tmp_path, form):
    """Row i of initial_position is where particle i started, in every frame; energy and momentum have a source."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    outcome = run_here(
        "simulate", path, "-o", tmp_path / "result", "--format", form, "--quiet", "--set", "time.end=0.05"
    )
    assert outcome.status == 0, outcome.stderr
    result = open_result(tmp_path / "result")
    start = np.concatenate([body.position for body in sample_bodies(loaded(tmp_path).scene)])
    for frame in result.frames():
        np.testing.assert_allclose(frame.fields["initial_position"], start, rtol=1e-7)
    assert not np.array_equal(result.frame(4).position, result.frame(0).position)
    check = check_result(tmp_path / "result")
    # The pool is thrown up, which opens it: that is noted, too.
    assert check.verdict == "stable" and {finding.rule for finding in check.findings} <= {"driven", "volume-error"}
    assert check.figures["energy_growth"] is None and check.figures["momentum_frames"] == 0
