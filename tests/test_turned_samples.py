"""The turned lattice, and samples that are relaxed until nodes have the volume and the centre of full cells."""

import math
from itertools import product

import numpy as np
import pytest
import scenes
from scenes import ball, box, polygon

from mpmcli.errors import InputError
from mpmcli.scene import checks, estimate_particles, sample_bodies
from mpmcli.scene.sampling import turned_axes, turned_points

H = 0.02
# Cells of a box of water, which stands in the corner of a domain that is larger along x and upwards.
CELLS = {2: (14, 12), 3: (8, 7, 9)}


def scene_of(d, shape=None, shift=0.0, walls="separate", length=20, **body):
    low, high = np.full(d, shift * H), (np.array(CELLS[d]) + shift) * H
    domain = {"size": [length * H, *[14 * H] * (d - 1)], "spacing": H, "walls": walls}
    own = {"name": "b", "material": "water", "shape": shape or box(low, high)} | body
    return scenes.scene_of(own, domain=domain, contact={})


def deviations(scene, low, high, images):
    """Return what nodes from low to high, cells, lack of a cell's volume and moments, (nodes, 1 + d), from plain sums.

    `images` are what places, in cells, are mapped to behind walls or beyond periodic faces.
    """
    (particles,) = sample_bodies(scene)
    places = particles.position / H
    d = places.shape[1]
    places = np.concatenate([places, *(image(places.copy()) for image in images)])
    lack = np.zeros([b - a + 1 for a, b in zip(low, high, strict=True)] + [1 + d])
    for number in product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))):
        r = places[np.all(np.abs(places - number) < 1.5, axis=1)] - number
        w = np.prod(np.where(np.abs(r) < 0.5, 0.75 - r**2, 0.5 * (1.5 - np.abs(r)) ** 2), axis=1)
        sums = particles.volume / H**d * (w @ np.column_stack([np.ones(len(r)), r]))
        lack[tuple(np.subtract(number, low))] = np.eye(1 + d)[0] - sums
    return lack.reshape(-1, 1 + d)


def mirror(*axes):
    def image(places):
        places[:, list(axes)] *= -1
        return places

    return image


def shifted(cells):
    def image(places):
        places[:, 0] += cells
        return places

    return image


@pytest.mark.parametrize("d", [2, 3])
def test_coordinates_of_the_turned_lattice_have_products_that_are_norms(d):
    """A whole number over sqrt(5) or 7, and not 0 but for the point 0."""
    axes = turned_axes(d)
    assert axes @ axes.T == pytest.approx(np.eye(d), abs=1e-15)
    numbers = np.stack(np.meshgrid(*[np.arange(-12, 13)] * d, indexing="ij"), -1).reshape(-1, d)
    norms = np.prod(numbers @ axes.T, axis=1) * {2: math.sqrt(5), 3: 7}[d]
    if d == 2:
        i, j = numbers.T
        assert norms == pytest.approx(i * i + i * j - j * j, abs=1e-9)
    assert norms == pytest.approx(np.rint(norms), abs=1e-9)
    assert np.min(np.abs(np.rint(norms)[np.any(numbers != 0, axis=1)])) == 1


@pytest.mark.parametrize(("d", "least"), [(2, 2**0.5 / 5**0.25), (3, 3**0.5 / 7 ** (1 / 3))])
def test_turned_points_keep_apart_however_the_lattice_is_stretched(d, least):
    """0.946 (2D) and 0.905 (3D) of the spacing: the arithmetic mean of squares is no less than the geometric one."""
    numbers = np.stack(np.meshgrid(*[np.arange(-20, 21)] * d, indexing="ij"), -1).reshape(-1, d)
    points = numbers[np.any(numbers != 0, axis=1)] @ turned_axes(d).T
    found = []
    for rates in np.random.default_rng(0).uniform(-1, 1, (60, d)):
        stretches = np.exp(2 * (rates - rates.mean()))
        found.append(np.min(np.linalg.norm(points * stretches, axis=1)))
    assert least <= min(found) < 1.02 * least


@pytest.mark.parametrize("d", [2, 3])
def test_turned_points_are_all_those_in_the_box(d):
    half = np.array([7.3, 2.1, 4.0])[:d]
    numbers = np.stack(np.meshgrid(*[np.arange(-14, 14) + 0.5] * d, indexing="ij"), -1).reshape(-1, d)
    all_points = numbers @ turned_axes(d).T
    expected = all_points[np.all(np.abs(all_points) <= half, axis=1)]
    found = turned_points(half)
    assert len(found) == len(expected)
    assert np.sort(found, axis=0) == pytest.approx(np.sort(expected, axis=0))


@pytest.mark.parametrize("high", [[0.28, 0.24], [0.11, 0.11], [0.28, 0.001], [0.25, 0.26, 0.1], [0.3, 0.004, 0.002]])
def test_a_turned_box_has_the_count_of_a_lattice(high):
    """Thin ones too, whose particles lie all along them."""
    shape = box([0.0] * len(high), high)
    scene = scene_of(len(high), shape, sampling="turned")
    (turned,), (lattice,) = sample_bodies(scene), sample_bodies(scene_of(len(high), shape))
    assert turned.count == lattice.count == estimate_particles(scene)
    assert turned.volume == lattice.volume
    assert scene.bodies[0].shape.form.contains(turned.position).all()
    counts = np.histogram(turned.position[:, 0], bins=4, range=(0, high[0]))[0]
    assert counts.max() - counts.min() <= max(2, 0.1 * turned.count)


RING = {"ball": {"center": [0.14, 0.14], "radius": 0.13}, "subtract": [ball([0.14, 0.14], 0.05)]}
SHAPES = {
    "ball": (2, ball([0.14, 0.14], 0.13)),
    "ball on the floor": (3, ball([0.14, 0.14, 0.1], 0.1)),
    "ring": (2, RING),
    "polygon": (2, polygon([[0.0, 0.0], [0.3, 0.0], [0.05, 0.2]])),
}


@pytest.mark.parametrize("way", ["turned", "jittered", "poisson"])
@pytest.mark.parametrize("name", SHAPES)
def test_relaxed_particles_stay_in_their_shape_and_keep_their_mass(name, way):
    d, shape = SHAPES[name]
    (raw,), (moved,) = (sample_bodies(scene_of(d, shape, sampling=way, relaxed=relaxed)) for relaxed in (False, True))
    form = scene_of(d, shape).bodies[0].shape.form
    assert form.contains(moved.position).all() and moved.position.min() >= 0
    assert moved.count == raw.count
    assert moved.count * moved.mass == pytest.approx(1000 * form.volume, rel=1e-12)
    away = np.linalg.norm(moved.position - raw.position, axis=1)
    assert away.max() < H and len(np.unique(moved.position, axis=0)) == moved.count
    # A turned lattice fills the nodes inside of a shape as it is, to the tolerance of relaxing.
    assert away.max() > 0.01 * H or way == "turned"


@pytest.mark.parametrize("shift", [0.0, 0.3])
@pytest.mark.parametrize(("way", "part"), [("turned", 0.1), ("jittered", 0.12), ("poisson", 0.2)])
@pytest.mark.parametrize("d", [2, 3])
def test_relaxing_fills_full_nodes(d, way, part, shift):
    """Those on walls and at their edges, with mirror images, and those inside of a box that no wall touches.

    Within 1e-3 is good enough: so much do those inside of a turned lattice lack, which is left as it is.
    """
    low = [0 if shift == 0 else 2] * d
    # The highest node whose spline, 1.5 cells wide on either side, the box fills.
    high = [math.floor(cells + shift - 1.5) for cells in CELLS[d]]
    images = [mirror(*axes) for axes in _subsets(d)] if shift == 0 else []
    before, after = (
        np.sqrt(np.mean(deviations(scene_of(d, None, shift, sampling=way, relaxed=relaxed), low, high, images) ** 2, 0))
        for relaxed in (False, True)
    )
    assert np.all(after < np.maximum(part * before, 1e-3)), (before, after)


def _subsets(d):
    return [[a for a in range(d) if bits >> a & 1] for bits in range(1, 2**d)]


def test_relaxing_sees_through_periodic_faces():
    """What lies beyond one face is what lies before the other; the floor mirrors."""
    walls = {"x_min": "periodic", "x_max": "periodic"}
    images = [shifted(14), shifted(-14)]
    images = [*images, mirror(1), *(lambda places, s=s: s(mirror(1)(places)) for s in images)]
    before, after = (
        np.sqrt(
            np.mean(
                deviations(
                    scene_of(2, walls=walls, length=14, sampling="jittered", relaxed=relaxed), [0, 0], [13, 10], images
                )
                ** 2,
                axis=0,
            )
        )
        for relaxed in (False, True)
    )
    assert np.all(after < 0.1 * before), (before, after)


def test_a_face_that_is_periodic_or_open_is_a_surface_where_the_body_does_not_go_on_behind_it():
    """Nodes near it are not full, so that particles stay where no full node is near."""
    for walls in ({"x_min": "periodic", "x_max": "periodic"}, {"x_min": "open"}):
        (raw,), (moved,) = (
            sample_bodies(scene_of(2, walls=walls, sampling="turned", relaxed=relaxed)) for relaxed in (False, True)
        )
        still = np.all(raw.position == moved.position, axis=1)
        assert still[raw.position[:, 0] < 0.5 * H].all() and not still.all()


def test_a_lattice_in_cells_is_left_as_it_is():
    for d in (2, 3):
        (raw,), (moved,) = (sample_bodies(scene_of(d, relaxed=relaxed)) for relaxed in (False, True))
        assert np.array_equal(raw.position, moved.position)


def test_points_and_bodies_of_too_many_cells_are_not_relaxed(tmp_path, monkeypatch):
    np.save(tmp_path / "two.npy", np.array([[0.1, 0.1], [0.2, 0.1]]))
    points = {"points": {"file": str(tmp_path / "two.npy"), "spacing": 0.01}}
    with pytest.raises(InputError, match=r"relaxed.*moves particles, and points are particles as they are"):
        scene_of(2, points, relaxed=True)
    assert sample_bodies(scene_of(2, points, sampling="turned"))[0].count == 2
    monkeypatch.setattr(checks, "_MOST_RELAXED", 100)
    with pytest.raises(InputError, match=r'is for bodies of 100 cells at most, and "b" spans 195; leave it out'):
        scene_of(2, relaxed=True)
