"""How thick shapes are, how far apart, and when they meet: against closed forms."""

import math
from typing import Any

import numpy as np
import pytest
from check_scenes import FLUID, box, forms_of, loaded
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.check.facts import arrivals
from mpmcli.check.geometry import RESOLUTION, close_pairs, distance_between, thickness
from mpmcli.scene.shapes import Ball, Box, Capsule, Cylinder, Form, Polygon

H = 1 / 64


def made(form: type[Any], dimension: int, **numbers: Any) -> Form:
    """Return a shape of a scene in 2D or 3D."""
    return form.model_validate(numbers, context={"dimension": dimension})


def polygon(*vertices: tuple[float, float]) -> Form:
    """Return a polygon."""
    return made(Polygon, 2, vertices=list(vertices))


SQUARE = polygon((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


def regular(n: int, inradius: float) -> Form:
    """Return a regular polygon about the origin."""
    angles = 2 * math.pi * (np.arange(n) + 0.3) / n
    reach = inradius / math.cos(math.pi / n)
    return polygon(*((reach * math.cos(a), reach * math.sin(a)) for a in angles))


def test_the_thickness_of_convex_shapes() -> None:
    """Box, ball and cylinder: exact."""
    assert thickness(made(Box, 3, min=[0.0, 0.0, 0.0], max=[3.0, 1.0, 2.0])) == 1.0
    assert thickness(made(Ball, 2, center=[0.0, 0.0], radius=0.3)) == 0.6
    for height, expected in ((0.1, 0.1), (5.0, 0.4)):
        cylinder = made(Cylinder, 3, base=[0.0] * 3, axis=[1.0, 1.0, 0.0], radius=0.2, height=height)
        assert thickness(cylinder) == expected


@pytest.mark.parametrize("n", [3, 4, 5, 8])
def test_the_thickness_of_a_polygon_is_its_inscribed_circle(n: int) -> None:
    """Twice the inradius, of a regular polygon, of a thin triangle (area / half perimeter), of an L of width 0.1."""
    assert thickness(regular(n, 0.4)) == pytest.approx(0.8, abs=4 * RESOLUTION[2])
    triangle = polygon((0.0, 0.0), (4.0, 0.0), (4.0, 0.3))
    perimeter = 4.3 + math.hypot(4, 0.3)
    assert thickness(triangle) == pytest.approx(4 * 0.6 / perimeter, abs=8 * RESOLUTION[2])


def test_an_angle_is_as_thick_as_its_arms() -> None:
    """The largest circle of an L sits in its corner."""
    arm = 0.1
    angle = polygon((0.0, 0.0), (1.0, 0.0), (1.0, arm), (arm, arm), (arm, 1.0), (0.0, 1.0))
    # It touches both outer edges and the inner corner: (arm - r) sqrt(2) = r.
    expected = 2 * arm * math.sqrt(2) / (1 + math.sqrt(2))
    assert thickness(angle) == pytest.approx(expected, abs=4 * RESOLUTION[2])


def test_distances_in_the_plane() -> None:
    """Between faces, corners, discs and polygons."""
    low, high = (made(Box, 2, min=a, max=b) for a, b in (([0.0, 0.0], [1.0, 1.0]), ([1.3, 1.4], [2.0, 2.0])))
    assert distance_between(low, high) == pytest.approx(0.5)
    assert distance_between(SQUARE, high) == pytest.approx(0.5)
    disc = made(Ball, 2, center=[2.0, 2.0], radius=0.2)
    assert distance_between(disc, SQUARE) == distance_between(low, disc) == pytest.approx(math.sqrt(2) - 0.2)
    assert distance_between(disc, made(Ball, 2, center=[2.0, 3.0], radius=0.3)) == pytest.approx(0.5)
    # A corner in the notch of another polygon, which its convex hull would cover.
    notch = polygon((2.0, 0.0), (2.0, 1.0), (1.5, 1.0), (1.9, 0.5), (1.5, 0.0))
    corner = polygon((1.8, 0.5), (1.0, 0.6), (1.0, 0.4))
    assert 0 < distance_between(notch, corner) <= 0.1


@given(
    tilt=st.floats(0, math.pi),
    gap=st.floats(1e-3, 1.0),
    radius=st.floats(0.1, 1.0),
    height=st.floats(0.1, 2.0),
)
def test_a_cylinder_and_what_lies_beside_it(tilt: float, gap: float, radius: float, height: float) -> None:
    """A ball beside the mantle, in any direction of the axis, and a box above a cylinder that lies on its side."""
    axis = np.array([math.cos(tilt), math.sin(tilt), 0.0])
    cylinder = made(Cylinder, 3, base=[0.0] * 3, axis=axis.tolist(), radius=radius, height=height)
    middle = axis * height / 2
    ball = made(Ball, 3, center=[*middle[:2].tolist(), radius + gap + 0.2], radius=0.2)
    assert distance_between(cylinder, ball) == pytest.approx(gap)
    above = made(Box, 3, min=[-5.0, -5.0, radius + gap], max=[5.0, 5.0, radius + gap + 1])
    assert distance_between(cylinder, above) == distance_between(above, cylinder) == pytest.approx(gap)


def test_only_close_bodies_are_paired() -> None:
    """By their distance, not by that of their bounding boxes."""

    def disc(name: str, x: float, y: float) -> dict:
        return {"name": name, "material": FLUID, "shape": {"ball": {"center": [x, y], "radius": 0.1}}}

    # The boxes of "b" and "c" overlap, and their outlines are 0.041 apart.
    scene = loaded([disc("a", 0.2, 0.2), disc("b", 0.41, 0.2), disc("c", 0.56, 0.39)]).scene
    pairs = {(i, j): distance for i, j, distance in close_pairs(scene, forms_of(scene), 0.02)}
    assert pairs == {(0, 1): pytest.approx(0.01)}


def test_free_flight_ends_at_the_floor_or_at_another_body() -> None:
    """sqrt(2 s / g) to within a cell of the floor, where the speed is sqrt(2 g s); pairs close in steadily."""
    scene = loaded(shape=box([0.25, 0.5], [0.5, 0.75])).scene
    (one,) = arrivals(scene)
    assert one.time == pytest.approx(math.sqrt(2 * (0.5 - H) / 10))
    assert one.speed == pytest.approx(math.sqrt(2 * 10 * 0.5))
    weightless = {"gravity": [0.0, 0.0]}
    still = {"name": "still", "material": FLUID, "shape": box([0.5, 0.25], [0.75, 0.5])}
    flying = {"name": "flying", "material": FLUID, "shape": box([0.1, 0.3], [0.2, 0.4]), "velocity": [2.0, 0.0]}
    for one in arrivals(loaded([still, flying], domain=weightless).scene):
        assert one.time == pytest.approx((0.3 - H) / 2)
        assert one.speed == 2.0
    (alone,) = arrivals(loaded([still], domain=weightless).scene)
    assert (alone.time, alone.speed) == (math.inf, 0.0)


def test_what_is_thrown_up_comes_down() -> None:
    """At v upwards from s above the floor: (v + sqrt(v^2 + 2 g s)) / g, and at rest on the floor at once."""
    (one,) = arrivals(loaded(shape=box([0.25, 0.25], [0.5, 0.3]), velocity=[0.0, 2.0]).scene)
    s = 0.25 - H
    assert one.time == pytest.approx((2 + math.sqrt(4 + 20 * s)) / 10)
    (resting,) = arrivals(loaded().scene)
    assert (resting.time, resting.speed) == (0.0, 0.0)


@given(gap=st.floats(0.01, 1.0), radius=st.floats(0.1, 1.0), tilt=st.floats(0.0, math.pi))
def test_a_capsule_and_what_lies_beside_it(gap: float, radius: float, tilt: float) -> None:
    """A disc at its end, a rectangle and a polygon beside it, another capsule across: gaps along the normal."""
    axis = np.array([math.cos(tilt), math.sin(tilt)])
    capsule = made(Capsule, 2, start=[0.0, 0.0], end=(2 * axis).tolist(), radius=radius)
    assert thickness(capsule) == 2 * radius
    disc = made(Ball, 2, center=((2 + radius + gap + 0.3) * axis).tolist(), radius=0.3)
    assert distance_between(capsule, disc) == distance_between(disc, capsule) == pytest.approx(gap)
    below = made(Box, 2, min=[-3.0, -radius - gap - 1], max=[3.0, -radius - gap])
    roof = polygon((-3.0, -radius - gap - 1), (3.0, -radius - gap - 1), (3.0, -radius - gap), (-3.0, -radius - gap))
    assert distance_between(below, capsule) == pytest.approx(gap)
    assert distance_between(capsule, roof) == pytest.approx(gap)
    across = made(Capsule, 2, start=[-3.0, -2 * radius - gap], end=[3.0, -2 * radius - gap], radius=radius)
    assert distance_between(capsule, across) == pytest.approx(gap)
