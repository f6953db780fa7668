"""Shapes: exact volumes, and containment that agrees with volume, bounds and symmetry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial import KDTree

from mpmcli.scene.primitives import edge_distances
from mpmcli.scene.shapes import Ball, Box, Capsule, Cylinder, Polygon


def make(model, dimension, **values):
    return model.model_validate(values, context={"dimension": dimension})


L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 3), (0, 3)]
SHAPES = [
    (make(Box, 2, min=(-1.0, 2), max=(0.5, 3)), 1.5),
    (make(Box, 3, min=(-1.0, 2, 0), max=(0.5, 3, 4)), 6.0),
    (make(Ball, 2, center=(1.0, 2), radius=0.5), math.pi * 0.25),
    (make(Ball, 3, center=(1.0, 2, 3), radius=0.5), math.pi / 6),
    (make(Cylinder, 3, base=(0, 0, 1), axis=(0, 0, -3), radius=0.5, height=2), math.pi * 0.5),
    (make(Cylinder, 3, base=(1, 2, 3), axis=(1, 2, -2), radius=0.5, height=2), math.pi * 0.5),
    (make(Capsule, 2, start=(1.0, 2), end=(-0.5, 0), radius=0.4), 2 * 0.4 * 2.5 + math.pi * 0.16),
    (make(Capsule, 3, start=(0, 0, 1), end=(2, 1, 3), radius=0.5), math.pi * (0.75 + 1 / 6)),
    (make(Polygon, 2, vertices=L_SHAPE), 4.0),
    (make(Polygon, 2, vertices=L_SHAPE[::-1]), 4.0),
    (make(Polygon, 2, vertices=[(1e6 + x, 1e6 + y) for x, y in L_SHAPE]), 4.0),
]
IDS = [f"{type(shape).__name__}-{i}" for i, (shape, _) in enumerate(SHAPES)]


@pytest.mark.parametrize(("shape", "volume"), SHAPES, ids=IDS)
def test_volume_is_exact_and_containment_agrees_with_it(shape, volume):
    assert shape.volume == pytest.approx(volume, rel=1e-12)
    lower, upper = shape.bounds()
    points = lower + np.random.default_rng(1).random((200_000, len(lower))) * (upper - lower)
    share = np.mean(shape.contains(points))
    expected = volume / np.prod(upper - lower)
    # Five standard deviations of a binomial share.
    assert abs(share - expected) <= 5 * math.sqrt(max(expected * (1 - expected), 0.0) / len(points)) + 1e-12


@pytest.mark.parametrize(("shape", "volume"), SHAPES, ids=IDS)
def test_bounds_are_tight_and_hold_the_shape(shape, volume):
    lower, upper = shape.bounds()
    size = upper - lower
    points = lower - size / 2 + np.random.default_rng(2).random((200_000, len(lower))) * 2 * size
    inside = points[shape.contains(points)]
    assert np.all(inside >= lower) and np.all(inside <= upper)
    assert np.all(inside.min(axis=0) - lower < 0.1 * size) and np.all(upper - inside.max(axis=0) < 0.1 * size)


@pytest.mark.parametrize(("shape", "volume"), SHAPES, ids=IDS)
def test_the_signed_distance_is_that_of_the_nearest_point_on_the_other_side(shape, volume):
    """Of a cloud of points: nearer than the surface is none of them, and one is little farther."""
    lower, upper = shape.bounds()
    size = upper - lower
    cloud = lower - 0.2 * size + np.random.default_rng(5).random((200_000, len(lower))) * 1.4 * size
    inside = shape.contains(cloud)
    queries = cloud[:300]
    found = shape.signed_distance(queries)
    assert np.array_equal(found < 0, inside[:300])
    # Nearest points of 140,000 at random leave a gap of (log n / n)^(1/d) of the extent at most, about.
    gap = 3 * (math.log(140_000) / 140_000) ** (1 / len(lower)) * size.max()
    for own, other in ((True, False), (False, True)):
        mine = inside[:300] == own
        nearest = KDTree(cloud[inside == other]).query(queries[mine])[0]
        assert np.all(np.abs(found[mine]) <= nearest * (1 + 1e-9)) and np.all(nearest - np.abs(found[mine]) < gap)


@pytest.mark.parametrize(("shape", "volume"), SHAPES, ids=IDS)
def test_a_point_with_an_inset_is_that_far_from_the_outside(shape, volume):
    lower, upper = shape.bounds()
    rng = np.random.default_rng(3)
    points = lower + rng.random((2000, len(lower))) * (upper - lower)
    inset = 0.2
    deep = points[shape.contains(points, inset=inset)]
    assert 0 < len(deep) < np.sum(shape.contains(points))
    directions = rng.normal(size=(50, len(lower)))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for direction in directions:
        assert shape.contains(deep + 0.999 * inset * direction).all()
    assert not shape.contains(points, inset=10.0).any()


@given(
    radii=st.lists(st.floats(0.2, 2.0), min_size=3, max_size=12),
    turn=st.floats(0, 6.3),
    reverse=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_a_star_polygon_is_the_fan_of_its_triangles(radii, turn, reverse, seed):
    n = len(radii)
    angles = turn + 2 * np.pi * np.arange(n) / n
    rim = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    polygon = make(Polygon, 2, vertices=(rim[::-1] if reverse else rim).tolist())
    ahead = np.roll(rim, -1, axis=0)
    areas = (rim[:, 0] * ahead[:, 1] - rim[:, 1] * ahead[:, 0]) / 2
    assert polygon.volume == pytest.approx(areas.sum(), rel=1e-12)

    points = np.random.default_rng(seed).uniform(-2, 2, (500, 2))
    expected = np.zeros(500, dtype=bool)
    unsure = np.zeros(500, dtype=bool)
    for a, b in zip(rim, ahead, strict=True):
        # Barycentric coordinates s, t of x = s a + t b; the triangle is s, t >= 0, s + t <= 1.
        s, t = np.linalg.solve(np.stack([a, b], axis=1), points.T)
        expected |= (s >= 0) & (t >= 0) & (s + t <= 1)
        unsure |= (np.abs(s) < 1e-9) | (np.abs(t) < 1e-9) | (np.abs(s + t - 1) < 1e-9)
    assert np.array_equal(polygon.contains(points)[~unsure], expected[~unsure])


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=3, max_size=7))
def test_an_accepted_polygon_has_the_area_of_its_inside(vertices):
    """On a coarse lattice of vertices most outlines cross, touch or turn back; those must be refused."""
    try:
        polygon = make(Polygon, 2, vertices=vertices)
    except ValidationError:
        return
    lower, upper = polygon.bounds()
    n = 300
    axes = [lo + (np.arange(n) + 0.5) * (hi - lo) / n for lo, hi in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    box = float(np.prod(upper - lower))
    # An edge passes through at most 2 n of the n^2 lattice cells, each of area box / n^2.
    assert abs(polygon.contains(points).mean() * box - polygon.volume) <= len(vertices) * 2 * box / n


def test_polygons_of_many_corners():
    """Of 30,000, within R (1 - cos(pi / n)) of a circle; a comb and a spiral of as many; the first teeth that meet."""
    n, R = 30_000, 0.3
    angle = 2 * math.pi * np.arange(n) / n
    circle = make(Polygon, 2, vertices=(R * np.stack([np.cos(angle), np.sin(angle)], axis=1)).tolist())
    assert circle.volume == pytest.approx(n / 2 * R**2 * math.sin(2 * math.pi / n), rel=1e-12)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 2))
    away = np.linalg.norm(points, axis=1) - R
    assert np.abs(circle.signed_distance(points) - away).max() <= R * (1 - math.cos(math.pi / n)) + 1e-15
    assert np.array_equal(circle.contains(points, inset=0.05), away <= -0.05)
    along = np.arange(n) / n
    comb = [*np.stack([along, 0.1 + 0.8 * (np.arange(n) % 2)], axis=1).tolist(), [1.0, 0.0], [0.0, 0.0]]
    assert make(Polygon, 2, vertices=comb).volume == pytest.approx(0.5, rel=1e-3)
    comb[n // 2][0] += 2.5 / n
    with pytest.raises(ValidationError, match=f"edges after vertices {n // 2 - 1} and {n // 2 + 1} cross"):
        make(Polygon, 2, vertices=comb)
    arm = np.stack([np.cos(20 * angle / R), np.sin(20 * angle / R)], axis=1)
    spiral = [*(arm * (1 + angle)[:, None]).tolist(), *(arm * (1.02 + angle)[:, None])[::-1].tolist()]
    assert make(Polygon, 2, vertices=spiral).volume == pytest.approx(
        0.02 * 20 / R * 2 * math.pi * (1.01 + math.pi), 1e-2
    )


@given(st.integers(0, 2**32 - 1), st.integers(4, 130))
def test_distances_and_crossings_are_those_of_all_edges(seed, n):
    """One by one: distances to segments, and pairs of segments that solve a + s u = c + t v with s and t in [0, 1]."""
    rng = np.random.default_rng(seed)
    vertices, points = rng.random((n, 2)), rng.random((20, 2))
    u = np.roll(vertices, -1, axis=0) - vertices
    along = np.clip(np.einsum("pki,ki->pk", points[:, None] - vertices, u) / np.sum(u * u, axis=1), 0, 1)
    expected = np.linalg.norm(points[:, None] - vertices - along[..., None] * u, axis=2).min(axis=1)
    assert edge_distances(points, vertices) == pytest.approx(expected, rel=1e-12)
    # A radial outline is simple; with two corners exchanged it may not be.
    angle = 2 * math.pi * np.arange(n) / n
    outline = (0.5 + rng.random((n, 1))) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first, second = rng.choice(n, 2, replace=False)
    outline[[first, second]] = outline[[second, first]]
    u = np.roll(outline, -1, axis=0) - outline
    i, j = np.triu_indices(n, 2)
    i, j = i[(i > 0) | (j < n - 1)], j[(i > 0) | (j < n - 1)]
    s, t = np.linalg.solve(np.stack([u[i], -u[j]], axis=2), (outline[j] - outline[i])[..., None])[..., 0].T
    cross = bool(np.any((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)))
    try:
        make(Polygon, 2, vertices=outline.tolist())
    except ValidationError:
        assert cross
    else:
        assert not cross


@pytest.mark.parametrize(("vertices", "sentence"), [
    ([(0, 0), (1, 1), (1, 0), (0, 1)], "the edges after vertices 0 and 2 cross or touch"),
    ([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)], "the edges after vertices 0 and 2 cross or touch"),
    ([(0, 0), (1, 0), (1, 0), (0, 1)], "vertex 2 repeats the one before it"),
    ([(0, 0), (1, 0), (1, 1), (0, 0)], "the last vertex repeats the first"),
    ([(0, 0), (2, 0), (1, 0), (1, 1)], "the outline runs back on itself at vertex 1"),
    ([(0, 0), (1, 0), (2, 0)], "the outline runs back on itself"),
])  # fmt: skip
def test_a_polygon_must_be_simple(vertices, sentence):
    with pytest.raises(ValidationError, match=sentence):
        make(Polygon, 2, vertices=vertices)


def test_a_tilted_cylinder_is_an_upright_one_turned():
    upright = make(Cylinder, 3, base=(0, 0, 0), axis=(0, 0, 1), radius=0.5, height=2)
    tilted = make(Cylinder, 3, base=(1, 2, 3), axis=(1, 2, -2), radius=0.5, height=2)
    third = np.array([1, 2, -2]) / 3
    first = np.array([2, 1, 2]) / 3
    turn = np.stack([first, np.cross(third, first), third], axis=1)
    points = np.random.default_rng(4).uniform(-1, 3, (20_000, 3))
    assert np.array_equal(upright.contains(points), tilted.contains(points @ turn.T + (1, 2, 3)))


@pytest.mark.parametrize("axis", [(0, 0, 0), (0.0, 0.0, -0.0)])
def test_a_cylinder_needs_a_direction(axis):
    with pytest.raises(ValidationError, match="must have a direction"):
        make(Cylinder, 3, base=(0, 0, 0), axis=axis, radius=1, height=1)
