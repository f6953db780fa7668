"""Surfaces of colliders: areas and volumes by formula, the material before them, and what the domain holds of them."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mpmcli.scene.colliders import Collider
from mpmcli.scene.surface import Surface, collider_surface, form_surface, level_surface, surface_points

LOWER, UPPER = np.zeros(3), np.ones(3)


def collider(shape: dict[str, Any], d: int = 3, **more: Any) -> Collider:
    """A collider of a scene in d dimensions."""
    return Collider.model_validate({"name": "it", "shape": shape, **more}, context={"dimension": d, "constants": {}})


def surface(shape: dict[str, Any], d: int = 3, **more: Any) -> Surface:
    """Its surface in the unit box."""
    return collider_surface(collider(shape, d, **more), LOWER[:d], UPPER[:d])


def volume(found: Surface) -> float:
    """The volume behind a closed surface, by the divergence theorem."""
    middle = found.points[found.cells].mean(axis=1)
    d = found.points.shape[1]
    return float(np.sum(np.sum(middle * found.normals, axis=1) * found.sizes) / d)


BALL = {"ball": {"center": [0.5, 0.4, 0.5], "radius": 0.2}}
BOX = {"box": {"min": [0.2, 0.3, 0.1], "max": [0.5, 0.7, 0.9]}}
CAPSULE = {"capsule": {"start": [0.3, 0.3, 0.3], "end": [0.6, 0.5, 0.6], "radius": 0.1}}
CYLINDER = {"cylinder": {"base": [0.5, 0.5, 0.2], "axis": [0.2, 0.0, 1.0], "radius": 0.2, "height": 0.4}}
FLAT = {
    "box": {"box": {"min": [0.2, 0.3], "max": [0.5, 0.7]}},
    "ball": {"ball": {"center": [0.5, 0.4], "radius": 0.2}},
    "capsule": {"capsule": {"start": [0.3, 0.3], "end": [0.6, 0.7], "radius": 0.1}},
    "polygon": {"polygon": {"vertices": [[0.2, 0.2], [0.3, 0.8], [0.8, 0.2]]}},
}


@pytest.mark.parametrize("shape", [BALL, BOX, CAPSULE, CYLINDER, *FLAT.values()], ids=str)
@pytest.mark.parametrize("side", ["outside", "inside"])
def test_a_surface_encloses_its_form_and_faces_the_material(shape: dict[str, Any], side: str) -> None:
    """A circle of 64 pieces has 1.6e-3 less area than a circle: 2 pi^2 / (3 * 64^2)."""
    d = 2 if shape in FLAT.values() else 3
    found = surface(shape, d, side=side)
    form = collider(shape, d).form
    sign = 1 if side == "outside" else -1
    assert sign * volume(found) == pytest.approx(form.volume, rel=5e-3)
    thing = collider(shape, d, side=side)
    middle = found.points[found.cells].mean(axis=1)
    ahead = thing.signed_distance(middle + 1e-4 * found.normals)
    assert (ahead > thing.signed_distance(middle)).all()
    assert np.abs(form.signed_distance(found.points)).max() < 1e-12
    if d == 2:
        assert len(found.chains()) == 1
        return
    # Closed: each edge has a neighbour that runs the other way.
    edges = {(int(a), int(b)) for cell in found.cells for a, b in zip(cell, np.roll(cell, -1), strict=True)}
    assert all((b, a) in edges for a, b in edges)


class Lens:
    """Two balls that overlap, as a form that has neither corners nor a profile."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Its corners."""
        return np.array([0.1, 0.2, 0.2])[: self.d], np.array([0.9, 0.8, 0.8])[: self.d]

    def __init__(self, d: int) -> None:
        self.d = d
        self.centers = np.array([[0.4, 0.5, 0.5], [0.6, 0.5, 0.5]])[:, :d]

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """The nearer one's."""
        return np.min([np.linalg.norm(points - center, axis=1) for center in self.centers], axis=0) - 0.3


@pytest.mark.parametrize("d", [2, 3])
def test_a_form_of_its_distance_alone_is_found_as_a_level_set(d: int) -> None:
    lens = Lens(d)
    found = form_surface(lens)
    a = 0.1
    if d == 2:
        expected = 2 * (0.09 * (math.pi - math.acos(a / 0.3)) + a * math.sqrt(0.09 - a**2))
        assert len(found.chains()) == 1
    else:
        expected = 2 * math.pi * (2 / 3 * 0.027 + 0.09 * a - a**3 / 3)
    assert volume(found) == pytest.approx(expected, rel=2e-3)
    assert np.abs(lens.signed_distance(found.points)).max() < 1e-3
    assert len(level_surface(lens.signed_distance, *lens.bounds(), cells=20).cells) < len(found.cells)


def test_a_plane_is_cut_off_at_the_domain() -> None:
    diagonal = surface({"plane": {"point": [0.5, 0.5, 0.5], "normal": [1.0, 1.0, 0.0]}})
    assert diagonal.sizes.sum() == pytest.approx(math.sqrt(2.0), rel=1e-6)
    assert np.allclose(diagonal.normals, np.array([1.0, 1.0, 0.0]) / math.sqrt(2))
    line = surface({"plane": {"point": [0.0, 0.5], "normal": [0.0, -2.0]}}, 2)
    assert line.sizes.sum() == pytest.approx(1.0, rel=1e-6)
    assert np.allclose(line.normals, [0.0, -1.0])
    # A piston that waits outside of the domain is as large as the domain.
    piston = surface({"plane": {"point": [1.4, 0.5, 0.5], "normal": [-1.0, 0.0, 0.0]}}, velocity=[-1.0, 0.0, 0.0])
    assert piston.sizes.sum() == pytest.approx(1.0, rel=1e-6)
    assert np.allclose(piston.points[:, 0], 1.4)


def test_what_never_moves_is_cut_off_and_closed_again_and_containers_stay_open() -> None:
    large = {"box": {"min": [-0.5, -0.5, -0.5], "max": [1.5, 1.5, 0.25]}}
    floor = surface(large)
    assert (floor.points.min(axis=0) >= -1e-6).all() and (floor.points.max(axis=0) <= 1 + 1e-6).all()
    assert volume(floor) == pytest.approx(0.25, rel=1e-5)
    room = surface({"box": {"min": [-0.5, -0.5, 0.25], "max": [1.5, 1.5, 1.5]}}, side="inside")
    assert room.sizes.sum() == pytest.approx(1.0, rel=1e-5)
    assert np.allclose(room.normals, [0.0, 0.0, 1.0])
    outline = surface({"box": {"min": [-0.5, 0.2], "max": [0.5, 0.4]}}, 2)
    assert outline.sizes.sum() == pytest.approx(2 * 0.5 + 0.2, rel=1e-9)
    moving = surface(large, velocity=[0.0, 0.0, 1.0])
    assert volume(moving) == pytest.approx(2 * 2 * 0.75)


@pytest.mark.parametrize("spacing", [0.05, 0.02])
@pytest.mark.parametrize("shape", [BALL, BOX, CAPSULE, CYLINDER, *FLAT.values()], ids=str)
def test_points_of_a_surface_are_spread_evenly_over_it(shape: dict[str, Any], spacing: float) -> None:
    """As many as squares of the spacing, none far from another, and no hole in which one more has its place."""
    d = 2 if shape in FLAT.values() else 3
    found = surface(shape, d)
    points = surface_points(found, spacing)
    assert len(points) == pytest.approx(found.sizes.sum() / spacing ** (d - 1), rel=0.06)
    assert np.abs(collider(shape, d).form.signed_distance(points)).max() < 2e-3 * 0.3
    tree = cKDTree(points)
    assert tree.query(points, k=2)[0][:, 1].min() > 0.77 * spacing
    weights = np.random.default_rng(0).dirichlet(np.ones(d), (20, len(found.cells)))
    anywhere = np.einsum("kmc,mcd->kmd", weights, found.points[found.cells]).reshape(-1, d)
    assert tree.query(anywhere)[0].max() < spacing
    assert np.array_equal(points, surface_points(found, spacing))
    if "box" in shape or "polygon" in shape:
        corners = found.points
        assert tree.query(corners)[0].max() < (1e-12 if d == 2 else 0.78 * spacing)


def test_a_line_has_points_at_both_ends() -> None:
    line = surface({"plane": {"point": [0.0, 0.5], "normal": [0.0, 1.0]}}, 2)
    points = surface_points(line, 0.099)
    assert np.allclose(np.sort(points[:, 0]), np.linspace(0.0, 1.0, 11)) and np.allclose(points[:, 1], 0.5)
