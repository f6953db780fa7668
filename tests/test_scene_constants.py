"""Constants of a scene: names for numbers and for subexpressions, in every expression."""

import tomllib

import numpy as np
import pytest

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene, scene_to_toml
from mpmcli.scene.entry import value_of

SCENE = """
[constants]
depth = 0.3
omega = "2 * pi / 1.5"
ramp = "min(t / depth, 1)"
swirl = "omega * (x - 0.5) * ramp"

[domain]
size = [1.0, 1.0]
spacing = 0.05
gravity = ["0.1 * ramp", "-9.81 * depth"]

[time]
end = 0.1
frames = 2

[[bodies]]
name = "pool"
material = "water"
shape = { box = { min = [0.1, 0.1], max = [0.5, 0.5] } }
velocity = ["-omega * Y", "-depth ** 2"]

[[forces]]
acceleration = ["swirl", "2 - swirl ** 2"]
"""


def scene_of(text: str = SCENE, *overrides: str) -> Scene:
    return parse_scene(
        tomllib.loads(text), laws=parameter_models(), text=text, source="scene.toml", overrides=overrides
    ).scene


def test_constants_stand_for_what_they_say() -> None:
    """A name is a term of its own, whatever stands beside it: -w**2 is -(w**2)."""
    scene = scene_of()
    x, t, Y = np.array([0.1, 0.7]), 0.2, np.array([0.4, 0.9])
    swirl = 2 * np.pi / 1.5 * (x - 0.5) * (t / 0.3)
    first, second = (entry(x=x, t=t) for entry in scene.forces[0].acceleration)
    assert first == pytest.approx(swirl, rel=1e-15) and second == pytest.approx(2 - swirl**2, rel=1e-14)
    assert scene.bodies[0].velocity[0](Y=Y) == pytest.approx(-2 * np.pi / 1.5 * Y, rel=1e-15)
    assert scene.bodies[0].velocity[1] == pytest.approx(-0.09)
    assert scene.domain.gravity[0](t=9.0) == pytest.approx(0.1) and scene.domain.gravity[1] == pytest.approx(-2.943)


def test_an_override_changes_whatever_uses_the_constant() -> None:
    scene = scene_of(SCENE, "constants.depth=0.6")
    assert scene.domain.gravity[0](t=0.3) == pytest.approx(0.05)
    assert scene.forces[0].acceleration[0](x=1.0, t=0.3) == pytest.approx(2 * np.pi / 1.5 * 0.5 * 0.5)
    # Scenes whose expressions read alike and mean other things are not equal.
    assert scene.forces != scene_of().forces
    assert hash(scene.forces) != hash(scene_of().forces)


def test_the_effective_scene_is_the_same_scene() -> None:
    scene = scene_of()
    text = scene_to_toml(scene)
    assert 'swirl = "omega * (x - 0.5) * ramp"' in text and 'acceleration = ["swirl", ' in text
    again = scene_of(text)
    assert again == scene
    for before, after in zip(scene.forces[0].acceleration, again.forces[0].acceleration, strict=True):
        assert value_of(after, x=0.7, y=0.2, t=0.3) == value_of(before, x=0.7, y=0.2, t=0.3)
    plain = scene.model_copy(update={"constants": None})
    assert "constants" not in scene_to_toml(plain)


@pytest.mark.parametrize(("right", "wrong", "said"), [
    ('["swirl"', '["swirrl"', 'forces[0].acceleration[0]: has an unknown name "swirrl"; did you mean "swirl"?'),
    ('"0.1 * ramp"', '"swirl"', 'domain.gravity[0]: uses "swirl", which depends on "x"; the names here are t'),
    ("depth = 0.3", "depth = 0.3\npi = 3", "constants.pi: has a meaning in every expression already"),
    ("depth = 0.3", "depth = 0.3\nmin = 3", "constants.min: has a meaning in every expression already"),
    ("depth = 0.3", "depth = 0.3\nt = 3", "constants.t: has a meaning in every expression already"),
    ("depth = 0.3", "depth = 0.3\nlambda = 3", "constants.lambda: has a meaning in every expression already"),
    ("depth = 0.3", "depth = true", "constants.depth: must be a number up to 1e+15, or an expression in quotes"),
    ("depth = 0.3", "depth = nan", "constants.depth: must be a number up to 1e+15, or an expression in quotes"),
    ("depth = 0.3", 'depth = "0.3 +"', "constants.depth: is not an expression"),
    ("depth = 0.3", 'depth = "1 / 0"', "constants.depth: is not finite"),
    ("depth = 0.3", "'a b' = 1\ndepth = 0.3", "constants.a b: is not a valid name in an expression"),
    ('omega = "2', 'omega = "omega + 2', 'constants.omega: has an unknown name "omega"'),
    ('omega = "2', 'omega = "z + 2', 'constants.omega: has no "z" in a 2D scene'),
    ('["swirl"', '["swirl(2)"', 'forces[0].acceleration[0]: takes "swirl" for a function, which it is not'),
    ('["swirl"', '["swirl > 1"', "forces[0].acceleration[0]: needs a number where"),
])  # fmt: skip
def test_one_fault_has_one_sentence(right: str, wrong: str, said: str) -> None:
    assert right in SCENE
    with pytest.raises(InputError) as refused:
        scene_of(SCENE.replace(right, wrong, 1))
    (line,) = str(refused.value).splitlines()
    assert said in line and line.startswith("scene.toml:")


def test_what_grows_too_long_is_refused() -> None:
    """Each constant doubles the one before it."""
    doubled = ['a0 = "t + 1"', *(f'a{k} = "a{k - 1} * a{k - 1}"' for k in range(1, 20))]
    with pytest.raises(
        InputError, match=r"constants\.a\d+: is (too long with its constants put in|too large|nested more than)"
    ):
        scene_of(SCENE.replace("depth = 0.3", "depth = 0.3\n" + "\n".join(doubled)))
