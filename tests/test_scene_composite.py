"""Unions and differences of shapes: volumes against closed forms, distances and insides against those of the parts."""

import math
from typing import Any

import numpy as np
import pytest
import scenes
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scenes import ball, body, box, liquid

from mpmcli.check.geometry import RESOLUTION, distance_between, thickness
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene, sample_bodies, scene_to_toml
from mpmcli.scene.shapes import Form, Shape, enclosed_volume


def form_of(dimension: int, **tables: Any) -> Form:
    """Return the form of a shape of a scene."""
    return Shape.model_validate(tables, context={"dimension": dimension}).form


RING = {**ball([0.5, 0.5], 0.4), "subtract": [ball([0.5, 0.5], 0.3)]}
LENS = 2 * math.pi / 3 - math.sqrt(3) / 2
DRILL = {"cylinder": {"base": [0.5, 0.5, -1.0], "axis": [0.0, 0.0, 1.0], "radius": 0.3, "height": 3.0}}
# Two unit balls through each other's centres share 5 pi / 12, two such discs 2 pi / 3 - sqrt(3) / 2.
VOLUMES = {
    "ring": (2, RING, math.pi * (0.4**2 - 0.3**2), 1e-14),
    "shell": (3, {**ball([0, 0, 0], 1), "subtract": [ball([0, 0, 0], 0.5)]}, 4 / 3 * math.pi * 7 / 8, 1e-14),
    "two boxes that touch": (2, {**box([0, 0], [1, 1]), "add": [box([1, 0], [2, 3])]}, 4.0, 1e-14),
    "nothing taken": (2, {**box([0, 0], [1, 1]), "subtract": [box([1, 0], [2, 3])]}, 1.0, 1e-14),
    "two discs": (2, {**ball([0, 0], 1), "add": [ball([1, 0], 1)]}, 2 * math.pi - LENS, 5e-7),
    "two balls": (3, {**ball([0, 0, 0], 1), "add": [ball([1, 0, 0], 1)]}, 2.25 * math.pi, 1e-5),
    "corner taken": (2, {**box([0, 0], [1, 1]), "subtract": [ball([0, 0], 0.5)]}, 1 - math.pi / 16, 5e-7),
    "drilled": (3, {**box([0, 0, 0], [1, 1, 0.5]), "subtract": [DRILL]}, 0.5 - math.pi * 0.045, 1e-5),
    "nested": (2, {**box([0, 0], [1, 1]), "subtract": [{**ball([0.5, 0.5], 0.4), "subtract": [ball([0.5, 0.5], 0.2)]}]},
         1 - math.pi * (0.4**2 - 0.2**2), 5e-7),
}  # fmt: skip


@pytest.mark.parametrize("name", VOLUMES)
def test_the_volume_of_a_composite(name: str) -> None:
    """Exact where the parts do not intersect, else by quadrature, whose error is the bound here."""
    d, tables, exact, error = VOLUMES[name]
    assert form_of(d, **tables).volume == pytest.approx(exact, rel=error)


@pytest.mark.parametrize(("d", "exact"), [(2, math.pi), (3, 4 / 3 * math.pi)])
def test_the_quadrature_of_a_ball(d: int, exact: float) -> None:
    """Extrapolated: 1e-8 in 2D, 1e-6 in 3D."""
    found = enclosed_volume(form_of(d, **ball([0.3] * d, 1.0)))
    assert found == pytest.approx(exact, rel={2: 1e-8, 3: 1e-6}[d])


numbers = st.floats(0.1, 0.9)
discs = st.builds(lambda x, y, r: ball([x, y], r), numbers, numbers, st.floats(0.05, 0.4))
boxes = st.builds(lambda x, y, a, b: box([x, y], [x + a, y + b]), numbers, numbers, numbers, numbers)
forms = discs | boxes


@given(first=forms, added=st.lists(forms, max_size=2), removed=st.lists(forms, max_size=2))
@example(first=box([0.5, 0.5], [1.35, 0.9]), added=[], removed=[box([0.5, 0.5], [1.4, 0.9])])
@settings(max_examples=20)
def test_a_composite_is_what_its_parts_say(first: dict, added: list, removed: list) -> None:
    """Inside: of any that is added and of none that is removed. Distance: its sign is the inside, and it is a bound.

    No point of a cloud on the other side is nearer than the distance. Quadrature agrees with the share of the cloud
    that lies inside, to five standard deviations.
    """
    form = form_of(2, **first, add=added, subtract=removed)
    points = np.random.default_rng(0).uniform(-0.5, 2.0, (20_000, 2))
    inside = np.any([form_of(2, **one).contains(points) for one in (first, *added)], axis=0)
    inside &= ~np.any([np.zeros(len(points), bool), *(form_of(2, **one).contains(points) for one in removed)], axis=0)
    distance = form.signed_distance(points)
    assert np.array_equal(form.contains(points), inside) and np.array_equal(distance < 0, inside)
    lower, upper = form.bounds()
    assert np.all((points[inside] >= lower) & (points[inside] <= upper))
    assert np.array_equal(form.contains(points, inset=0.02), distance <= -0.02)
    some = np.arange(0, len(points), 40)
    others = {own: points[inside != own] for own in (True, False)}
    for i in some:
        other = others[bool(inside[i])]
        if len(other):
            assert abs(distance[i]) <= np.linalg.norm(other - points[i], axis=1).min() + 1e-12
    share = form.volume / 2.5**2
    assert abs(inside.mean() - share) <= 5 * math.sqrt(max(share * (1 - share), 0) / len(points)) + 1e-6


def scene_of(shape: dict, size: tuple[float, ...] = (1.0, 1.0), other: dict | None = None) -> Scene:
    """Return a scene of water in a shape."""
    bodies = [body(f"b{i}", liquid(1e5, density=800.0), s) for i, s in enumerate((shape, other)) if s]
    return scenes.scene_of(*bodies, size=list(size), spacing=0.02, contact={})


def test_particles_of_a_ring_have_its_mass() -> None:
    """Between both circles, with exactly the mass of the ring; its effective scene is the same scene."""
    scene = scene_of(RING)
    (particles,) = sample_bodies(scene)
    away = np.linalg.norm(particles.position - 0.5, axis=1)
    assert away.min() >= 0.3 and away.max() <= 0.4
    assert particles.count * particles.mass == pytest.approx(800 * math.pi * 0.07, rel=1e-12)
    import tomllib

    again = parse_scene(tomllib.loads(scene_to_toml(scene)), laws=parameter_models()).scene
    assert again.bodies[0].shape == scene.bodies[0].shape


def test_a_body_may_lie_in_the_hole_of_another() -> None:
    """Bounding boxes overlap, the bodies do not; where they do, it is said."""
    assert len(scene_of(RING, other=ball([0.5, 0.5], 0.28)).bodies) == 2
    with pytest.raises(InputError, match=r'bodies\[1\].shape: body "b1" overlaps body "b0", for example at \['):
        scene_of(RING, other=ball([0.5, 0.5], 0.32))


def test_how_thick_and_how_far_apart() -> None:
    """A ring is as thick as its width; a disc in it is as far from it as their radii differ; beside it, as the gap."""
    ring = form_of(2, **RING)
    assert thickness(ring) == pytest.approx(0.1, abs=4 * RESOLUTION[2])
    inside, beside = (form_of(2, **ball([x, 0.5], 0.2)) for x in (0.5, 1.15))
    assert distance_between(ring, inside) == pytest.approx(0.1, abs=1e-3)
    assert distance_between(beside, ring) == pytest.approx(0.05, abs=1e-3)
    shell = form_of(3, **ball([0, 0, 0], 1), subtract=[ball([0, 0, 0], 0.5)])
    assert thickness(shell) == pytest.approx(0.5, abs=8 * RESOLUTION[3])


@pytest.mark.parametrize(("shape", "said"), [
    ({**RING, "subtract": [{}]},
    "shape.subtract[0]: needs exactly one of box, ball, capsule, cylinder, mesh, polygon; "),
    ({**RING, "add": [box([0, 0], [0, 1])]}, "shape.add[0].box.max: must be above min along x"),
    ({**RING, "add": [{**RING, "box": {}}]}, "shape.add[0].box.min: missing key: lower corner, m"),
    ({**RING, "substract": []}, 'shape.substract: unknown key; did you mean "subtract"?'),
    ({"subtract": [box([0, 0], [1, 1])]},
    "shape: needs exactly one of box, ball, capsule, cylinder, mesh, polygon, points"),
    ({**RING, "subtract": [box([0, 0], [1, 1])]}, 'body "b0" is too thin to hold a particle'),
])  # fmt: skip
def test_sentences(shape: dict, said: str) -> None:
    """What is wrong, at its path."""
    with pytest.raises(InputError) as caught:
        scene_of(shape)
    assert said in str(caught.value)
