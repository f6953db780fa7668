"""Particles of bodies: how many, where, and with exactly the mass of the shape."""

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball, box, polygon
from scipy.spatial import KDTree

from mpmcli.errors import InputError
from mpmcli.scene import estimate_particles, sample_bodies, sampling
from mpmcli.scene.sampling import disk_radius

FLUID = {"law": "fluid", "density": 800.0, "bulk_modulus": 1e5}


def scene_of(*bodies, size=(4.0, 4.0), spacing=0.1, **domain):
    named = [{"name": f"b{i}", "material": FLUID, **body} for i, body in enumerate(bodies)]
    return scenes.scene_of(*named, size=list(size), spacing=spacing, contact={}, **domain)


BOX = box([0.0, 0.0], [1.0, 0.5])
DISC = ball([2.5, 2.5], 1.0)


def test_a_box_on_the_grid_has_particles_at_a_quarter_and_three_quarters_of_each_cell():
    (particles,) = sample_bodies(scene_of({"shape": BOX}))
    assert particles.count == 10 * 5 * 4
    in_cell = np.sort(np.unique(np.round(np.mod(particles.position / 0.1, 1.0), 9)))
    assert np.allclose(in_cell, [0.25, 0.75])
    assert particles.volume == pytest.approx(0.1**2 / 4, rel=1e-12)


@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_a_lattice_has_its_number_of_particles_per_cell(count):
    scene = scene_of({"shape": BOX, "particles_per_cell": count})
    (particles,) = sample_bodies(scene)
    cells, number = np.unique(np.floor(particles.position / 0.1).astype(int), axis=0, return_counts=True)
    assert len(cells) == 50 and np.all(number == count)
    assert estimate_particles(scene) == particles.count


def test_in_3d_27_particles_per_cell():
    box = {"box": {"min": [0, 0, 0], "max": [0.4, 0.2, 0.2]}}
    scene = scene_of({"shape": box, "particles_per_cell": 27}, size=(1, 1, 1))
    assert sample_bodies(scene)[0].count == estimate_particles(scene) == 16 * 27


@given(
    lower=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    extent=st.tuples(st.floats(1e-4, 2), st.floats(1e-4, 2)),
    jittered=st.booleans(),
)
def test_a_box_of_any_size_is_filled_evenly(lower, extent, jittered):
    upper = [lo + e for lo, e in zip(lower, extent, strict=True)]
    body = {"shape": box(lower, upper), "sampling": "jittered" if jittered else "lattice"}
    scene = scene_of(body)
    (particles,) = sample_bodies(scene)
    assert particles.count == estimate_particles(scene)
    form = scene.bodies[0].shape.form
    assert form.contains(particles.position).all()
    assert particles.count * particles.mass == pytest.approx(800 * form.volume, rel=1e-12)
    # A lattice point stands for a cell within a factor of two of h/2 along each axis, thin boxes apart.
    if not jittered and min(extent) > 0.05:
        assert 0.5 < particles.volume / (0.1**2 / 4) < 2.0


SHAPES = {
    "disc": ((4, 4), DISC),
    "polygon": ((4, 4), polygon([[0.5, 0.5], [3, 1], [2, 3]])),
    "ball": ((2, 2, 2), ball([1, 1, 1], 0.7)),
    "cylinder": ((2, 2, 2), {"cylinder": {"base": [0.5, 0.5, 0.5], "axis": [1, 1, 1], "radius": 0.4, "height": 1}}),
}


@pytest.mark.parametrize(
    ("way", "name"),
    [*((way, name) for way in ("lattice", "jittered") for name in SHAPES), ("poisson", "disc"), ("poisson", "polygon")],
)
def test_mass_and_count_are_exact_and_the_estimate_close(name, way):
    size, shape = SHAPES[name]
    scene = scene_of({"shape": shape, "sampling": way}, size=size)
    (particles,) = sample_bodies(scene)
    form = scene.bodies[0].shape.form
    assert form.contains(particles.position).all()
    assert particles.count * particles.volume == pytest.approx(form.volume, rel=1e-12)
    assert particles.count * particles.mass == pytest.approx(800 * form.volume, rel=1e-12)
    assert abs(particles.count - estimate_particles(scene)) < 0.05 * particles.count
    assert sum(sampling.count_sources(scene)) == particles.count


def test_a_disc_on_a_lattice_is_symmetric():
    position = sample_bodies(scene_of({"shape": DISC}))[0].position - 2.5
    assert np.allclose(position.mean(axis=0), 0, atol=1e-12)
    quarters = {tuple(q) for q in np.round(np.abs(position), 9)}
    assert len(quarters) * 4 == len(position)


@pytest.mark.parametrize("count", [3, 5, 7])
def test_jittered_takes_any_number_per_cell(count):
    scene = scene_of({"shape": box([0, 0], [3.0, 3.0]), "sampling": "jittered", "particles_per_cell": count})
    (particles,) = sample_bodies(scene)
    assert particles.count == pytest.approx(900 * count, rel=0.02)
    assert np.unique(particles.position, axis=0).shape == particles.position.shape


def test_jitter_is_told_by_the_seed_and_the_body_alone(monkeypatch):
    def positions(seed, other=BOX):
        bodies = ({"shape": other}, {"shape": DISC, "sampling": "jittered", "seed": seed})
        return sample_bodies(scene_of(*bodies))[1].position

    first = positions(7)
    assert np.array_equal(first, positions(7))
    assert np.array_equal(first, positions(7, other=box([0, 0], [0.3, 0.3])))
    assert not np.array_equal(first, positions(8))
    monkeypatch.setattr(sampling, "_POINTS_AT_ONCE", 37)
    assert np.array_equal(first, positions(7))


def test_two_bodies_of_one_seed_differ():
    boxes = [{"box": {"min": [x, 0], "max": [x + 1, 1]}} for x in (0, 2)]
    a, b = sample_bodies(scene_of(*({"shape": box, "sampling": "jittered"} for box in boxes)))
    assert not np.allclose(a.position + np.array([2, 0]), b.position)


def test_velocity_is_linear_in_the_offset_from_the_centre():
    gradient = [[-1.0, 0.5], [0.0, 2.0]]
    body = {"shape": DISC, "velocity": [3.0, -1.0], "velocity_gradient": gradient}
    (particles,) = sample_bodies(scene_of(body))
    expected = (3.0, -1.0) + (particles.position - 2.5) @ np.array(gradient).T
    assert np.allclose(particles.velocity, expected, rtol=0, atol=1e-14)
    assert particles.affine.shape == (particles.count, 2, 2)
    assert np.array_equal(particles.affine[-1], gradient)
    assert np.array_equal(sample_bodies(scene_of({"shape": DISC}))[0].affine[0], np.zeros((2, 2)))


def test_an_enormous_scene_is_estimated_without_being_made():
    box = {"box": {"min": [0, 0, 0], "max": [1, 1, 1]}}
    scene = scene_of({"shape": box}, size=(1, 1, 1), spacing=1 / 5000)
    assert estimate_particles(scene) == 10**12
    ball = {"ball": {"center": [0.5, 0.5, 0.5], "radius": 0.5}}
    assert estimate_particles(scene_of({"shape": ball}, size=(1, 1, 1), spacing=1 / 5000)) == pytest.approx(
        np.pi / 6 * 1e12, rel=1e-6
    )


def test_a_body_too_thin_for_its_lattice_is_named(monkeypatch):
    monkeypatch.setattr("mpmcli.scene.checks._MOST_SEARCHED", 0)
    sliver = polygon([[0, 1], [1, 1.1], [0, 1.00001]])
    scene = scene_of({"shape": sliver})
    with pytest.raises(InputError, match='body "b0" is too thin to hold a particle'):
        sample_bodies(scene)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("per_cell", [3, 8])
def test_a_poisson_disk_sample_is_as_dense_as_asked_and_keeps_its_radius(d, per_cell):
    """Counts within 3 % of the volume, in the middle and along the faces alike; no two closer than the radius.

    Wherever a ball of the radius finds no point, there is room: hardly anywhere after the last round.
    """
    edge, h = (2.0, 0.05) if d == 2 else (0.5, 0.05)
    box = {"box": {"min": [0.0] * d, "max": [edge] * d}}
    scene = scene_of({"shape": box, "sampling": "poisson", "particles_per_cell": per_cell}, size=(edge,) * d, spacing=h)
    (particles,) = sample_bodies(scene)
    expected = (edge / h) ** d * per_cell
    assert particles.count == pytest.approx(expected, rel=0.03)
    assert estimate_particles(scene) == pytest.approx(expected, rel=1e-6)
    radius = disk_radius(h / per_cell ** (1 / d), d)
    tree = KDTree(particles.position)
    assert tree.query(particles.position, k=2)[0][:, 1].min() >= radius
    places = np.random.default_rng(0).uniform(0.1, edge - 0.1, (20_000, d))
    assert np.mean(tree.query(places)[0] > radius) < 0.01
    # A layer of h along every face holds its share: five standard deviations of less than half a Poisson process.
    layer = np.mean(((particles.position < h) | (particles.position > edge - h)).any(axis=1))
    share = 1 - (1 - 2 * h / edge) ** d
    assert abs(layer - share) < 2.5 * np.sqrt(share / particles.count)


def test_a_poisson_disk_sample_is_told_by_the_seed_and_the_body_alone():
    """As a jittered lattice is; other seeds and other bodies differ."""

    def positions(seed, other=BOX):
        bodies = ({"shape": other}, {"shape": DISC, "sampling": "poisson", "seed": seed})
        return sample_bodies(scene_of(*bodies))[1].position

    first = positions(7)
    assert np.array_equal(first, positions(7))
    assert np.array_equal(first, positions(7, other=box([0, 0], [0.3, 0.3])))
    assert first.shape != positions(8).shape or not np.array_equal(first, positions(8))
    boxes = [{"shape": box([x, 0], [x + 1, 1]), "sampling": "poisson"} for x in (0, 2)]
    a, b = sample_bodies(scene_of(*boxes))
    assert a.position.shape != b.position.shape or not np.allclose(a.position + np.array([2, 0]), b.position)


def test_bodies_of_mud_are_turned_and_relaxed_by_default() -> None:
    """They flow far and are not shifted; what the scene says itself counts, and points are as they are."""
    mud = {"material": {"law": "viscoplastic", "density": 1500.0, "yield_stress": 100.0, "consistency": 1.0}}

    def sampled(**more: object) -> tuple[str, bool]:
        (body,) = scene_of({"shape": BOX, **more}).bodies
        return body.sampling, body.relaxed

    assert sampled(**mud) == sampled(**mud, sampling="turned") == ("turned", True)
    assert sampled(**mud, relaxed=False) == ("turned", False)
    assert sampled(**mud, sampling="lattice") == sampled() == ("lattice", False)
    assert sampled(sampling="turned") == ("turned", False)
