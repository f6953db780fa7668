"""Scenes as newcomers write them: rules that `check` must name for each, and rules that it must not."""

import tomllib

import pytest
from solver_state import scene_of

from mpmcli.check.scene_check import check_scene
from mpmcli.scene import LoadedScene

DOMAIN = "[domain]\nsize = [1.0, 1.0]\nspacing = 0.02\ngravity = [0.0, -9.81]\n[time]\nend = 1.0\nframes = 20\n"


def body(material: str, low: tuple[float, float], high: tuple[float, float], more: str = "") -> str:
    """Return the table of a body that is a box, named as its material."""
    shape = f"shape = {{ box = {{ min = {list(low)}, max = {list(high)} }} }}"
    return f'[[bodies]]\nname = "{material}"\nmaterial = "{material}"\n{shape}\n{more}\n'


def collider(name: str, low: tuple[float, float], high: tuple[float, float], more: str = "") -> str:
    """Return the table of a collider that is a box."""
    shape = f"shape = {{ box = {{ min = {list(low)}, max = {list(high)} }} }}"
    return f'[[colliders]]\nname = "{name}"\n{shape}\n{more}\n'


def board(name: str, low: tuple[float, float], high: tuple[float, float]) -> str:
    """Return the table of a collider that is a polygon."""
    corners = [list(low), [high[0], low[1]], list(high), [low[0], high[1]]]
    return f'[[colliders]]\nname = "{name}"\nshape = {{ polygon = {{ vertices = {corners} }} }}\n'


DAM = body("water", (0.0, 0.0), (0.3, 0.6))
DROP = body("jelly", (0.4, 0.3), (0.6, 0.5))
HEAP = body("sand", (0.3, 0.0), (0.7, 0.3))
DOMINOES = "".join(collider(f"tile{i}", (x, 0.0), (x + 0.04, 0.3), "density = 800") for i, x in enumerate((0.2, 0.4)))
DRUM = 'shape = { ball = { center = [0.5, 0.5], radius = 0.4 } }\nside = "inside"\n'
FUNNEL = collider("left", (0.0, 0.5), (0.42, 0.56)) + collider("right", (0.58, 0.5), (1.0, 0.56))
# Advice that concerns what most scenes below do not have.
FALSE = {"units", "gravity-up", "friction-coefficient", "friction-angle", "opening", "weld", "restitution", "thin-body"}
SCENES = {
    "a dam that breaks": (DAM, set(), {"no-pressure", "stand-off", "slippery"}),
    "a still pool": (body("water", (0.0, 0.0), (1.0, 0.3)), {"no-pressure"}, {"stand-off"}),
    "a pool in a tank that is shaken": (
        DOMAIN.replace("0.0, -9.81", '"sin(t)", -9.81') + body("water", (0.0, 0.0), (1.0, 0.3)),
        set(),
        {"no-pressure"},
    ),
    "a dam before a post": (DAM + collider("post", (0.6, 0.0), (0.7, 0.2)), {"stand-off"}, set()),
    "a jelly that falls": (DROP, set(), {"stand-off", "slippery"}),
    "a jelly on a post": (DROP + collider("post", (0.45, 0.0), (0.55, 0.2)), set(), {"stand-off"}),
    "two jellies": (
        DROP + body("jelly", (0.4, 0.6), (0.6, 0.8)).replace('name = "jelly"', 'name = "b"'),
        set(),
        {"contact"},
    ),
    "a beam that is held": (
        body("rubber", (0.0, 0.45), (0.5, 0.55)) + collider("grip", (0.0, 0.4), (0.1, 0.6), 'wall = "hold"'),
        set(),
        {"dissipation", "impact-loss", "stand-off"},
    ),
    "dominoes and a jelly": (DROP + DOMINOES, set(), {"stand-off"}),
    "dominoes in water": (body("water", (0.0, 0.0), (0.15, 0.6)) + DOMINOES, {"thin-body", "stand-off"}, set()),
    "a heap of sand": (HEAP, {"slippery"}, {"low-heap"}),
    "a low heap of sand": (body("sand", (0.3, 0.0), (0.7, 0.1)), {"low-heap"}, set()),
    "sand in a drum": (
        body("sand", (0.3, 0.2), (0.7, 0.4)) + f'[[colliders]]\nname = "drum"\n{DRUM}wall = "stick"',
        {"stand-off"},
        {"slippery"},
    ),
    "sand above a slot": (body("sand", (0.2, 0.6), (0.8, 0.8)) + FUNNEL, {"opening", "stand-off"}, set()),
    "water above a slot": (body("water", (0.2, 0.6), (0.8, 0.8)) + FUNNEL, {"stand-off"}, set()),
    "sand between posts": (
        body("sand", (0.2, 0.6), (0.8, 0.9))
        + collider("a", (0.0, 0.0), (0.2, 0.5))
        + collider("b", (0.7, 0.0), (1.0, 0.5)),
        {"stand-off"},
        set(),
    ),
    "a wall of crossed boards in sand": (
        HEAP + board("a", (0.1, 0.6), (0.5, 0.7)) + board("b", (0.2, 0.5), (0.3, 0.8)),
        {"stand-off"},
        set(),
    ),
    "centimetres": (
        DOMAIN.replace("9.81", "981").replace("1.0, 1.0", "100.0, 100.0").replace("0.02", "2.0")
        + body("water", (0.0, 0.0), (30.0, 60.0)),
        {"units"},
        {"gravity-up"},
    ),
    "up is down": (DOMAIN.replace("-9.81", "9.81") + DAM, {"gravity-up"}, {"units"}),
    "two balls of snow": (
        body("snow", (0.2, 0.3), (0.4, 0.5)) + body("clay", (0.6, 0.3), (0.8, 0.5)),
        {"weld"},
        set(),
    ),
    "angles for coefficients": (
        HEAP + collider("ramp", (0.8, 0.0), (1.0, 0.2), "friction = 30"),
        {"friction-coefficient"},
        set(),
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_what_is_said_of_a_scene_is_true_of_it(name: str) -> None:
    """Every scene has rules that concern it; those of others, in FALSE or named here, are not said of it."""
    text, must, must_not = SCENES[name]
    scene = scene_of(**tomllib.loads(text if text.startswith("[domain]") else DOMAIN + text))
    said = {finding.rule for finding in check_scene(LoadedScene(scene, (), "scene.toml")).findings}
    assert must <= said
    assert not said & ((FALSE - must) | must_not)
