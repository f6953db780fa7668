"""What a scene may say about friction of walls, and the sentences for what it may not."""

import pytest
from scenes import block, scene_of

from mpmcli.errors import InputError
from mpmcli.scene import Scene


def scene(walls: object, friction: object, dimension: int = 2) -> Scene:
    one = block("a", "jelly", [0.2] * dimension, [0.5] * dimension)
    return scene_of(one, size=[1.0] * dimension, spacing=0.1, walls=walls, friction=friction)


@pytest.mark.parametrize(
    ("walls", "friction", "found"),
    [
        ("separate", 0.5, ((0.5, 0.5), (0.5, 0.5))),
        ("separate", {"default": 0.1, "y_min": 0, "x_max": 2.0}, ((0.1, 2.0), (0.0, 0.1))),
        ({"default": "slip", "y_min": "stick"}, 1, ((1.0, 1.0), (0.0, 1.0))),
        ("stick", 0.0, ((0.0, 0.0), (0.0, 0.0))),
    ],
)
def test_faces_have_their_coefficients(walls: object, friction: object, found: tuple) -> None:
    assert scene(walls, friction).domain.frictions == found


@pytest.mark.parametrize(("walls", "friction", "said"), [
    ("slip", -0.1, "domain.friction: must be at least 0; found -0.1"),
    ("slip", "rough", "domain.friction: must be a number, or a table with one per face"),
    ("slip", {"z_min": 0.2}, "domain.friction.z_min: is a face of a 3D scene and this one is 2D"),
    ("slip", {"floor": 0.2}, "domain.friction.floor"),
    ({"default": "slip", "y_min": "stick"}, {"y_min": 0.2}, "domain.friction.y_min: is for a wall that can slip"),
    ("stick", 0.2, 'domain.friction: is for walls that can slip, and domain.walls has "stick" for all'),
])  # fmt: skip
def test_faults_are_named(walls: object, friction: object, said: str) -> None:
    with pytest.raises(InputError) as caught:
        scene(walls, friction)
    assert said in str(caught.value)
