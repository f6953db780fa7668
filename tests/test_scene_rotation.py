"""Shapes that are rotated as a whole: the form at a place is the form where it came from."""

import math
from pathlib import Path

import numpy as np
import pytest
import scenes
from good_scene import GOOD, refusal
from scenes import body, liquid

from mpmcli.scene import Scene, sample_bodies, scene_to_toml
from mpmcli.scene.primitives import Solid
from mpmcli.scene.primitives import rotation as rotation_about
from mpmcli.scene.surface import form_surface

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BALL_2D, BALL_3D = ({"ball": {"center": [0.3] * d, "radius": 0.15}} for d in (2, 3))
SHAPES = {
    2: {
        "box": {"box": {"min": [0.2, 0.3], "max": [0.7, 0.5]}},
        "ball": BALL_2D,
        "capsule": {"capsule": {"start": [0.2, 0.3], "end": [0.7, 0.5], "radius": 0.1}},
        "polygon": {"polygon": {"vertices": [[0.2, 0.2], [0.8, 0.3], [0.4, 0.7]]}},
        "composite": {
            "box": {"min": [0.2, 0.3], "max": [0.7, 0.5]},
            "add": [{"ball": {"center": [0.7, 0.5], "radius": 0.1}}],
            "subtract": [BALL_2D],
        },
    },
    3: {
        "box": {"box": {"min": [0.2, 0.3, 0.4], "max": [0.7, 0.5, 0.8]}},
        "ball": BALL_3D,
        "capsule": {"capsule": {"start": [0.2, 0.3, 0.4], "end": [0.7, 0.5, 0.4], "radius": 0.1}},
        "cylinder": {"cylinder": {"base": [0.4, 0.4, 0.2], "axis": [1, 0, 2], "radius": 0.2, "height": 0.5}},
        "mesh": {"mesh": {"file": "tetrahedron.obj", "scale": 0.7, "translate": [0.1, 0.2, 0.1]}},
        "composite": {"box": {"min": [0.2, 0.3, 0.4], "max": [0.7, 0.5, 0.8]}, "subtract": [BALL_3D]},
    },
}


def scene_of(shape: dict, d: int, directory: Path) -> Scene:
    """Return a scene with a body of this shape, and a collider of the same elsewhere."""
    (directory / "tetrahedron.obj").write_text(TETRAHEDRON)
    own = body("body", liquid(1e5), shape)
    return scenes.scene_of(own, size=[2.0] * d, origin=[-0.5] * d, spacing=0.05, contact={}, directory=directory)


def turn_of(rotated: object) -> np.ndarray:
    """Return the rotation that the key says."""
    if isinstance(rotated, dict):
        return rotation_about(rotated["axis"], math.radians(rotated["angle"]))
    s, c = math.sin(math.radians(rotated)), math.cos(math.radians(rotated))
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize("center", [None, "a corner"])
@pytest.mark.parametrize(("d", "name"), [(d, name) for d in SHAPES for name in SHAPES[d]])
def test_a_rotated_form_is_the_form_where_it_came_from(d: int, name: str, center: str | None, tmp_path: Path) -> None:
    """Inside, signed distance, volume and surface; about the middle of its bounding box, or about a point."""
    rotated = 30.0 if d == 2 else {"axis": [1.0, 2.0, -1.0], "angle": 50.0}
    about = {} if center is None else {"center": [0.2] * d}
    shape = SHAPES[d][name]
    before: Solid = scene_of(shape, d, tmp_path).bodies[0].shape.form
    asked = scene_of(shape | {"rotation": rotated} | about, d, tmp_path)
    after: Solid = asked.bodies[0].shape.form
    pivot = np.mean(before.bounds(), axis=0) if center is None else np.full(d, 0.2)
    lower, upper = after.bounds()
    places = np.random.default_rng(0).uniform(lower - 0.1, upper + 0.1, (2000, d))
    own = pivot + (places - pivot) @ turn_of(rotated)
    distance = before.signed_distance(own)
    assert after.signed_distance(places) == pytest.approx(distance, abs=1e-9)
    sure = np.abs(distance) > 1e-9
    assert np.array_equal(after.contains(places)[sure], before.contains(own)[sure])
    assert not after.contains(places)[np.any((places < lower) | (places > upper), axis=1)].any()
    assert after.volume == pytest.approx(before.volume, rel=1e-3)
    surface = form_surface(after)
    assert np.abs(after.signed_distance(surface.points)).max() < 0.01
    (particles,) = sample_bodies(asked)
    assert after.contains(particles.position).all()
    assert particles.mass * particles.count == pytest.approx(1000 * after.volume, rel=1e-12)
    # The complete scene says the same.
    assert "rotation" in scene_to_toml(asked)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (
            ", rotation = { axis = [0, 0, 1], angle = 30 } }",
            "bodies[0].shape.rotation: must be an angle, degrees, in 2D",
        ),
        (", center = [0, 0] }", "bodies[0].shape.center: is the centre of a rotation; give rotation as well"),
    ],
)
def test_a_rotation_that_does_not_fit_is_one_sentence(written: str, said: str) -> None:
    box = "shape = { box = { min = [0.0, 0.0], max = [1.0, 1.0] } }"
    (line,) = refusal(GOOD.replace(box, box[:-2] + written))
    assert said in line


def test_a_rotation_of_a_rotated_shape(tmp_path: Path) -> None:
    """In a composite that is rotated as well: a box turned forth and back is the box."""
    axis, inner = [1.0, 2.0, -1.0], {"box": {"min": [0.8, 0.3, 0.4], "max": [1.0, 0.5, 0.8]}}
    there, back = ({"rotation": {"axis": axis, "angle": angle}, "center": [0.2] * 3} for angle in (35.0, -35.0))
    far = {"ball": {"center": [0.3] * 3, "radius": 0.1}, "add": [inner | there]} | back
    form = scene_of(far, 3, tmp_path).bodies[0].shape.form
    places = np.random.default_rng(0).uniform(0.7, 1.1, (2000, 3))
    box = scene_of(inner, 3, tmp_path).bodies[0].shape.form
    assert form.signed_distance(places) == pytest.approx(box.signed_distance(places), abs=1e-9)


def test_a_plane_has_its_normal() -> None:
    plane = "shape = { plane = { point = [0, 0], normal = [0, 1] }, rotation = 10 }"
    (line,) = refusal(GOOD + f'[[colliders]]\nname = "floor"\n{plane}\n')
    assert "colliders[0].shape.plane: has a normal; leave rotation out" in line
