"""What only the whole scene shows: bodies that touch or overlap, and the bounds on speed and depth."""

import math

import pytest
import scenes
from scenes import ball, box, polygon

from mpmcli.errors import InputError
from mpmcli.scene import scene_bounds

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5}


def scene_of(*shapes, size=(4.0, 4.0), velocity=None, body=None, **domain):
    bodies = [scenes.body(f"b{i}", JELLY, shape, **(body or {})) for i, shape in enumerate(shapes)]
    if velocity:
        bodies[0]["velocity"] = velocity
    return scenes.scene_of(*bodies, size=list(size), spacing=0.1, contact={}, **domain)


def cylinder(base, axis, radius, height):
    return {"cylinder": {"base": base, "axis": axis, "radius": radius, "height": height}}


TOUCHING = {
    "boxes": (box([0, 0], [1, 1]), box([1, 0], [2, 1])),
    "boxes, up to round-off": (box([0, 0], [0.3, 1]), box([0.1 + 0.2, 0], [2, 1]), box([0.1 * 3, 1], [2, 2])),
    "box and ball": (box([0, 0], [1, 1]), ball([1.5, 0.5], 0.5)),
    "balls": (ball([1, 1], 0.5), ball([1 + math.sqrt(0.5), 1 + math.sqrt(0.5)], 0.5)),
    "ball in a notch": (polygon([(0, 0), (2, 0), (1, 1), (2, 2), (0, 2)]), ball([2.0, 1.0], math.sqrt(0.5))),
    "triangles of a square": (polygon([(0, 0), (2, 0), (2, 2)]), polygon([(0, 0), (2, 2), (0, 2)])),
    "cylinder on a box": (box([0, 0, 0], [1, 1, 1]), cylinder([0.5, 0.5, 1], [0, 0, 1], 0.5, 1)),
}
OVERLAPPING = {
    "boxes, barely": (box([0, 0], [1, 1]), box([0.999, 0.999], [2, 2])),
    "one inside the other": (box([0, 0], [3, 3]), ball([1.5, 1.5], 0.1)),
    "balls": (ball([1, 1], 0.5), ball([1.9, 1], 0.5)),
    "ball in a notch": (polygon([(0, 0), (2, 0), (1, 1), (2, 2), (0, 2)]), ball([1.9, 1.0], 0.8)),
    "equal": (ball([1, 1], 0.5), ball([1, 1], 0.5)),
    "crossing bars": (box([1, 1.9], [3, 2.1]), polygon([(1.9, 1), (2.1, 1), (2.1, 3), (1.9, 3)])),
    "cylinder in a box": (box([0, 0, 0], [1, 1, 1]), cylinder([0.5, 0.5, 0.95], [0, 0, 1], 0.5, 1)),
}


def size_for(shapes):
    return (4, 4, 4) if len(next(iter(shapes[0].values())).get("min", [0, 0])) == 3 else (4, 4)


@pytest.mark.parametrize("name", TOUCHING)
def test_bodies_may_touch(name):
    shapes = TOUCHING[name]
    scene_of(*shapes, size=size_for(shapes))
    scene_of(*reversed(shapes), size=size_for(shapes))


@pytest.mark.parametrize("name", OVERLAPPING)
def test_overlap_names_both_bodies(name):
    shapes = OVERLAPPING[name]
    for order in (shapes, shapes[::-1]):
        with pytest.raises(InputError, match=r'^<scene>: bodies\[1\].shape: body "b1" overlaps body "b0", for'):
            scene_of(*order, size=size_for(shapes))


def test_every_pair_that_overlaps_is_named():
    with pytest.raises(InputError) as refused:
        scene_of(box([0, 0], [1, 1]), box([2, 0], [3, 1]), box([0.5, 0], [2.5, 1]))
    assert len(str(refused.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("shape", "faces"),
    [
        (box([-0.5, 1], [1, 2]), ["x_min by 0.5 m"]),
        (box([1, 1], [2, 4.25]), ["y_max by 0.25 m"]),
        (ball([1, 1], 2), ["x_min by 1 m", "y_min by 1 m"]),
        (polygon([(0, 0), (5, 0), (0, 6)]), ["x_max by 1 m", "y_max by 2 m"]),
    ],
)
def test_a_body_outside_names_face_and_distance(shape, faces):
    with pytest.raises(InputError) as refused:
        scene_of(shape)
    (line,) = str(refused.value).splitlines()
    assert line.startswith('<scene>: bodies[0].shape: body "b0" leaves the domain through ')
    assert all(face in line for face in faces) and line.count(" by ") == len(faces)


def test_the_origin_moves_the_domain():
    scene_of(box([-2, -2], [2, 2]), origin=[-2.0, -2.0])
    with pytest.raises(InputError, match="x_min by 1 m"):
        scene_of(box([-3, -2], [2, 2]), origin=[-2.0, -2.0])


def test_a_body_may_reach_the_wall_up_to_round_off():
    # 0.2 + 0.4 is a little more than 0.6.
    scene_of(box([0, 0], [0.2 + 0.4, 0.6]), size=(0.6, 0.6))


def test_a_domain_has_room_between_its_walls():
    with pytest.raises(InputError, match="makes 4 cells along y, and opposite walls need at least 5 between them"):
        scene_of(box([0, 0], [0.1, 0.1]), size=(1.0, 0.4))


def test_the_speed_of_a_fall():
    bounds = scene_bounds(scene_of(box([1, 2], [2, 3]), gravity=[0.0, -10.0], velocity=[3.0, 4.0]))
    assert (bounds.dimension, bounds.spacing, bounds.gravity) == (2, 0.1, 10.0)
    assert bounds.height == pytest.approx(3.0)
    assert bounds.speed == pytest.approx(math.sqrt(25 + 2 * 10 * 3))


def test_gravity_in_any_direction_measures_from_the_corner_it_points_to():
    bounds = scene_bounds(scene_of(box([-2, -2], [-1, -1]), origin=[-2.0, -2.0], gravity=[6.0, 8.0]))
    # The corner (2, 2) is lowest, the corner (-2, -2) of the box highest.
    assert bounds.gravity == pytest.approx(10.0)
    assert bounds.height == pytest.approx(4 * 0.6 + 4 * 0.8)


def test_without_gravity_only_the_initial_speed_counts():
    scene = scene_of(
        ball([0, 0], 1.0),
        origin=[-2.0, -2.0],
        body={"velocity_gradient": [[-1.0, 0.0], [0.0, 1.0]], "velocity": [1.0, 0.0]},
    )
    bounds = scene_bounds(scene)
    # At the corner (-1, 1) of the bounding box: v = (1 + 1, 1).
    assert bounds.speed == pytest.approx(math.sqrt(5))
    assert bounds.gravity == 0 and bounds.height == pytest.approx(2.0)
    assert scene_bounds(scene_of(box([0, 0], [1, 1]))).speed == 0.0
