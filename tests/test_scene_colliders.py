"""Colliders in a scene: how they move, how far points are from them, and one sentence for each fault."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ball, body, box, plane, polygon, scene_of

from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.machine.backend import Backend

BALL = ball([0.5, 0.5], 0.1)


def scene(*colliders: dict, dimension: int = 2, end: float = 2.0, **tables: object) -> Scene:
    """Return a small block in a corner, with these colliders."""
    box = {"min": [0.0] * dimension, "max": [0.1] * dimension}
    return scene_of(
        body("a", "jelly", {"box": box}),
        domain={"size": [1.0] * dimension, "spacing": 0.05},
        end=end,
        colliders=[{"name": f"c{k}", "shape": BALL} | table for k, table in enumerate(colliders)],
        **tables,
    )


@given(rate=st.floats(-5, 5), speed=st.floats(-3, 3), time=st.floats(0, 2))
@settings(max_examples=40, deadline=None)
def test_velocity_and_offset_say_the_same(rate: float, speed: float, time: float) -> None:
    """A motion given by its velocity, or by its offset, is in the same place: sin and its derivative, to 1e-9."""
    by_rate, by_place = scene(
        {"velocity": [f"{rate!r} * cos({rate!r} * t)", speed], "angular_velocity": speed},
        {"offset": [f"sin({rate!r} * t)", f"{speed!r} * t"], "angle": f"{speed!r} * t"},
    ).colliders
    offset, angle = by_rate.motion.at(time)
    expected = [math.sin(rate * time), speed * time]
    assert offset == pytest.approx(expected, abs=1e-9) and angle == pytest.approx(speed * time, abs=1e-9)
    offset, angle = by_place.motion.at(time)
    assert offset == pytest.approx(expected, abs=1e-9) and angle == pytest.approx(speed * time, abs=1e-9)


def test_keyframes_are_joined_by_straight_lines() -> None:
    keys = [{"time": 0.5, "offset": [0.1, 0.0]}, {"time": 1.0, "offset": [0.3, -0.2], "angle": 2.0}]
    motion = scene({"keyframes": keys}).colliders[0].motion
    for time, offset, angle in ((0.0, [0.1, 0], 0), (0.5, [0.1, 0], 0), (0.75, [0.2, -0.1], 1), (1.7, [0.3, -0.2], 2)):
        found, turned = motion.at(time)
        assert found == pytest.approx(offset, abs=1e-9) and turned == pytest.approx(angle, abs=1e-9)


def test_a_point_keeps_its_distance_as_the_collider_moves() -> None:
    """Distances are those of the start, of points that are taken along; 3D, about an axis across the grid."""
    shape = box([0.4, 0.4, 0.3], [0.6, 0.5, 0.7])
    moves = {"velocity": [0.1, "0.2*t", 0.0], "angular_velocity": "1 + t", "axis": [1, 2, -1], "pivot": [0.4, 0.5, 0.5]}
    collider = scene({"shape": shape} | moves, dimension=3).colliders[0]
    points = np.random.default_rng(0).uniform(0.2, 0.8, (100, 3))
    at_start, later = collider.signed_distance(points), collider.motion.placed(points, 1.3)
    assert np.abs(later - points).max() > 0.3
    assert collider.signed_distance(later, 1.3) == pytest.approx(at_start, abs=1e-12)
    # The angle is 1.3 + 1.3^2 / 2, by Rodrigues' formula through the exponential of a matrix.
    axis = np.array([1, 2, -1]) / math.sqrt(6)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]) * (1.3 + 1.3**2 / 2)
    turned, term = np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ cross / k
        turned = turned + term
    place = np.array([0.4 + 0.13, 0.5 + 0.1 * 1.3**2, 0.5])
    assert later == pytest.approx(place + (points - [0.4, 0.5, 0.5]) @ turned.T, abs=1e-9)


def test_a_container_has_its_material_inside() -> None:
    outside, inside = scene({}, {"side": "inside", "shape": ball([0.5, 0.5], 0.8)}).colliders
    assert outside.signed_distance(np.array([[0.5, 0.9]])) == pytest.approx([0.3])
    assert inside.signed_distance(np.array([[0.5, 0.9]])) == pytest.approx([0.4])


@pytest.mark.parametrize(("collider", "said"), [
    ({"wall": "sticky"}, "colliders[0].wall"),
    ({"wall": "open"}, 'colliders[0].wall: must be "slip", "stick", "separate" or "hold"'),
    ({"wall": "stick", "friction": 0.2}, "colliders[0].friction: is for a surface that slips or separates"),
    ({"friction": -1}, "colliders[0].friction: must be at least 0"),
    ({"velocity": [1.0, 0.0], "offset": ["t", 0.0]}, 'colliders[0].offset: "velocity" is given as well'),
    ({"angular_velocity": 1.0, "angle": "t"}, 'colliders[0].angle: "angular_velocity" is given as well'),
    ({"velocity": [1.0, 0.0], "keyframes": [{"time": 0.0}]}, 'colliders[0].keyframes: "velocity" is given as well'),
    ({"keyframes": [{"time": 1.0}, {"time": 1.0}]}, "colliders[0].keyframes: must have times that rise"),
    ({"axis": [0, 0, 1]}, "colliders[0].axis: is for 3D scenes"),
    ({"offset": ["floor(3*t)", 0.0]}, "colliders[0].offset[0]: jumps between 0 and time.end"),
    ({"velocity": ["1/t", 0.0]}, "colliders[0].velocity[0]: must be finite from time 0 to time.end"),
    ({"angle": "log(t)"}, "colliders[0].angle: must be finite"),
    ({"shape": {}}, "colliders[0].shape: needs exactly one of"),
    ({"shape": plane([0, 0], [0, 0])}, "must have a direction"),
    ({"shape": {"plane": {"point": [0, 0], "normal": [0, 1]}, "subtract": [BALL]}},
     "colliders[0].shape.plane: is a shape alone; leave add and subtract out"),
    ({"shape": ball([50.0, 0.5], 10.0)}, '"c0" (20 x 20 m) lies outside of the domain'),
    ({"shape": polygon([[0, -1e9], [0.1, -1e9], [0.1, 0.1]])}, '"c0" spans 6e+10 cells, and 1e+08 is the most'),
    ({"shape": ball([0.0, 0.0], 0.08)}, 'body "a" overlaps collider "c0" at the start'),
    ({"speed": 1.0}, "colliders[0].speed"),
])  # fmt: skip
def test_faults_are_named(collider: dict, said: str) -> None:
    with pytest.raises(InputError) as caught:
        scene(collider)
    assert said in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_the_speed_counts_that_of_turning_and_of_a_pivot_that_moves() -> None:
    """v + w R: R to the farthest corner of the form, or to that of the domain from the farthest place of the pivot."""
    box = {"box": {"min": [0.2, 0.5], "max": [0.6, 0.8]}}
    moves = {"velocity": [0.3, -0.4], "angular_velocity": 2.0, "pivot": [0.2, 0.5]}
    plane = {"plane": {"point": [0.2, 0.5], "normal": [0.0, -1.0]}}
    small, large = scene({"shape": box} | moves, {"shape": plane} | moves).colliders
    domain = scene().domain
    assert small.fastest(domain, 2.0) == pytest.approx(0.5 + 2.0 * 0.5)
    assert large.fastest(domain, 2.0) == pytest.approx(0.5 + 2.0 * (math.hypot(0.8, 0.5) + 2.0 * 0.5))


def test_a_device_without_double_precision_moves_no_collider() -> None:
    moving = scene({"velocity": [1.0, 0.0]})
    with pytest.raises(InputError, match="moving colliders are not available with --arch metal; use --arch cpu"):
        make_plan(moving, Backend("metal", 1, "f32", True))


def test_colliders_need_names_of_their_own_and_solids_that_know_them() -> None:
    with pytest.raises(InputError, match=r'colliders\[1\]\.name: "one" is the name of colliders\[0\] already'):
        scene({"name": "one"}, {"name": "one"})
    with pytest.raises(InputError, match='"total" supports walls and colliders that hold'):
        scene({}, solver={"solids": "total"})


@pytest.mark.parametrize(
    ("dimension", "table", "fault"),
    [
        (2, {"angular_velocity": [0, 0, 1]}, "colliders turn in their plane in this 2D scene"),
        (3, {"angular_velocity": [0, 0, 1]}, r"that about the key axis, such as axis = \[0, 0, 1\]; found \[0, 0, 1\]"),
        (3, {"angle": ["90*t", 0, 0]}, "angle: must be one number or expression: that about the key axis"),
    ],
)
def test_a_rate_that_is_a_vector_names_the_axis(dimension: int, table: dict, fault: str) -> None:
    shape = ball([0.5] * dimension, 0.1)
    with pytest.raises(InputError, match=fault):
        scene({"shape": shape} | table, dimension=dimension)


@pytest.mark.parametrize(
    ("joint", "keys"),
    [
        ({"type": "hinge"}, "axis, motor, point, strength and type"),
        ({"type": "slider", "axis": [0, 1]}, "axis, motor, strength and type"),
    ],
)
def test_an_unknown_key_of_a_joint_is_answered_by_those_of_its_type(joint: dict, keys: str) -> None:
    with pytest.raises(InputError, match=f"speed: unknown key; the keys here are {keys}$"):
        scene({"density": 100.0, "joint": joint | {"speed": 3}})
