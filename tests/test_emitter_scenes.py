"""Emitters, open faces and impulses in a scene: mouths against closed forms, and a sentence for each bad one."""

import math

import numpy as np
import pytest
from good_scene import GOOD, load, refusal
from scenes import ball, block, body, box, scene_of
from scipy.spatial import cKDTree

from mpmcli.errors import InputError
from mpmcli.scene import Scene, estimate_particles, sample_bodies, scene_to_toml
from mpmcli.scene.sheets import fastest_inflow, mouth_of, sheets_of

# For integrals of rates.
TIMES = np.linspace(0.0, 1.0, 20_001)
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4}
JET = block("jet", WATER, [0.1, 0.2], [0.3, 0.5])
GOOD_JET = """\
[[emitters]]
name = "jet"
material = { law = "fluid", density = 1000.0, bulk_modulus = "auto" }
shape = { box = { min = [2.0, 1.5], max = [2.2, 1.6] } }
velocity = [0.0, -2.0]
"""
GOOD_PUSH = """\
[[impulses]]
start = 0.5
center = [3.0, 1.0]
radius = 0.3
strength = 2.0
"""


def jet_scene(d: int = 2, **more: object) -> Scene:
    size = [1.0, 1.0, 1.0][:d]
    box = {"min": [0.6, 0.0, 0.0][:d], "max": [0.7, 0.1, 0.1][:d]}
    return scene_of(
        body("pool", WATER, {"box": box}),
        domain={"size": size, "spacing": 0.05},
        frames=2,
        emitters=[{**JET, "velocity": [2.0, 0.0, 0.0][:d], **more}],
    )


@pytest.mark.parametrize(("shape", "velocity", "area"), [
    (box([0.1, 0.2], [0.3, 0.5]), [2.0, 0.0], 0.3),
    (box([0.1, 0.2], [0.3, 0.5]), [0.0, -1.0], 0.2),
    # Through the centre at 45 degrees, from one long side to the other.
    (box([0.1, 0.2], [0.3, 0.5]), [1.0, 1.0], 0.2 * math.sqrt(2)),
    (ball([0.4, 0.4], 0.13), [1.0, 3.0], 0.26),
    (box([0.1, 0.2, 0.3], [0.3, 0.5, 0.7]), [0.0, 0.0, 3.0], 0.06),
    (ball([0.4, 0.4, 0.4], 0.2), [1.0, 1.0, 1.0], math.pi * 0.04),
    ({"cylinder": {"base": [0.4, 0.2, 0.4], "axis": [0, 1, 0], "radius": 0.2, "height": 0.1}}, [0.0, -1.0, 0.0],
     math.pi * 0.04),
])  # fmt: skip
def test_the_mouth_is_the_section_and_the_flow_its_area_times_the_speed(shape, velocity, area):
    """The area to 2e-3, of which the flow is a multiple, whatever the sampling; all enter two cells before it."""
    for sampling in ("lattice", "turned", "jittered"):
        scene = jet_scene(len(velocity), shape=shape, velocity=velocity, sampling=sampling)
        emitter = scene.emitters[0]
        mouth, sheets = mouth_of(emitter, scene.domain.spacing), sheets_of(emitter, scene)
        assert mouth.area == pytest.approx(area, rel=2e-3)
        flow = sheets.size * sheets.volume / sheets.period
        assert flow == pytest.approx(area * np.linalg.norm(velocity), rel=2e-3)
        places = sheets.places(emitter)
        assert sheets.lead == 2 * scene.domain.spacing
        ahead = (places - mouth.centre) @ mouth.direction + sheets.lead
        thickness = sheets.period * np.linalg.norm(velocity)
        if sampling == "lattice":
            assert ahead == pytest.approx(0.0, abs=1e-12)
        elif sampling == "turned":
            assert (ahead > 0).all() and (ahead < thickness).all()
            assert emitter.shape.form.contains(places + (sheets.lead - ahead)[:, None] * mouth.direction).all()
        assert len(places) == sheets.particles
        assert sheets.count == math.ceil((1.0 + sheets.early) / sheets.period - 1e-9)
        # Each particle fills about as much as one of a body.
        assert sheets.volume == pytest.approx(scene.domain.spacing**scene.dimension / 2**scene.dimension, rel=0.15)


@pytest.mark.parametrize(
    ("centre", "velocity", "cells"),
    [
        ([0.3, 0.5], [0.0, -1.0], 2.0),
        # The ceiling at 1 m, a lid from 0.7 m on, and the pool of water up to 0.1 m.
        ([0.3, 0.965], [0.0, -1.0], 0.5),
        ([0.3, 0.655], [0.0, -1.0], 0.75),
        ([0.65, 0.165], [0.0, 1.0], 1.25),
    ],
    ids=["free", "wall", "collider", "body"],
)
def test_a_nozzle_begins_at_what_is_before_the_mouth(centre, velocity, cells):
    """Two cells before the mouth, or at a face, a collider, or a body, to a quarter of a cell."""
    shape = box([x - 0.02 for x in centre], [x + 0.02 for x in centre])
    lid = {"name": "lid", "shape": box([0.1, 0.7], [0.5, 0.9])}
    asked = jet_scene(shape=shape, velocity=velocity).model_dump(exclude_none=True, exclude={"domain": {"cells"}})
    asked = scene_of(**asked | {"colliders": [lid]})
    sheets = sheets_of(asked.emitters[0], asked)
    assert sheets.lead / 0.05 == pytest.approx(cells)
    assert sheets.due[0] == pytest.approx(-sheets.lead) and sheets.early == pytest.approx(sheets.lead)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("sampling", ["turned", "lattice"])
def test_a_stream_of_the_turned_sequence_has_no_rows_that_part(d, sampling):
    """Shortest distance in those of the lattice: of the stream as it enters, and stretched threefold along the flow.

    A lattice is as close as its rows come across, 3^(-1/(d - 1)) of its distance.
    """
    box = {"box": {"min": [0.2] * d, "max": [0.6] * d}}
    scene = jet_scene(d, shape=box, velocity=[0.0] * (d - 1) + [-1.0], sampling=sampling)
    sheets = sheets_of(scene.emitters[0], scene)
    number = np.arange(sheets.particles) // sheets.size
    stream = sheets.places(scene.emitters[0])
    stream[:, -1] += number * sheets.period
    for stretch in (1.0, 3.0):
        stream[:, -1] *= stretch
        stream[:, :-1] *= stretch ** (-1 / (d - 1))
        apart = cKDTree(stream).query(stream, k=2)[0][:, 1].min() / (scene.domain.spacing / 2)
        assert apart > 0.9 if sampling == "turned" else apart == pytest.approx(stretch ** (-1 / (d - 1)), rel=0.01)


def test_all_particles_are_sampled_and_counted():
    scene = jet_scene(start=0.25, end=0.75)
    pool, jet = sample_bodies(scene)
    assert jet.waits and not pool.waits and (jet.velocity == [2.0, 0.0]).all()
    assert len(jet.position) == sheets_of(scene.emitters[0], scene).particles == 40 * 12
    assert estimate_particles(scene) == len(pool.position) + len(jet.position)
    # What has come out is all that flows through the mouth in this time.
    assert jet.volume * len(jet.position) == pytest.approx(0.3 * 2.0 * 0.5, rel=1e-6)


@pytest.mark.parametrize(("sampling", "particles"), [("lattice", [96, 120]), ("turned", [100, 116])])
def test_a_total_is_kept_to_a_particle_and_of_a_lattice_as_far_as_whole_sheets_allow(sampling, particles):
    for key, value, count in zip(("particles", "volume"), (100, 0.0725), particles, strict=True):
        scene = jet_scene(**{key: value, "sampling": sampling})
        sheets = sheets_of(scene.emitters[0], scene)
        assert sheets.particles == len(sheets.places(scene.emitters[0])) == count


def test_the_effective_scene_has_them_all():
    text = GOOD.replace("[time]", 'walls = { x_max = "open" }\n[time]') + GOOD_JET + GOOD_PUSH
    loaded = load(text)
    again = load(scene_to_toml(loaded.scene)).scene
    assert again == loaded.scene and again.particle_count_varies
    assert any(" and jet: bulk_modulus" in note for note in loaded.notes)


BAD = [
    ("velocity = [0.0, -2.0]", "velocity = [0, 0]",
     "emitters[0].velocity: must not be zero, as nothing would flow; give the velocity of the material in m/s"),
    ("velocity = [0.0, -2.0]", "velocity = [0.0, -2.0]\nstart = 2.0",
     "emitters[0].start: must be before the end of the scene, 1.5 s; found 2"),
    ("velocity = [0.0, -2.0]", "velocity = [0.0, -2.0]\nstart = 1.0\nend = 0.5",
     "emitters[0].end: must be after start, 1 s; found 0.5"),
    ("velocity = [0.0, -2.0]", "velocity = [0.0, -2.0]\nparticles = 100000",
     'emitters[0].particles: takes 25 s to flow out of "jet", which has 1.5 s until time.end; 6000 particles at most '
     "come out by then"),
    ("velocity = [0.0, -2.0]", "velocity = [0.0, -2.0]\nvolume = 1.0\nend = 1.0",
     'emitters[0].volume: takes 2.5 s to flow out of "jet", which has 1 s until end; 0.4 m^2 at most come out by then'),
    ("velocity = [0.0, -2.0]", "velocity = [0.0, -2.0]\nvolume = 0.1\nparticles = 10",
     "emitters[0].volume: particles is given as well; leave one of them out"),
    ("[2.0, 1.5], max = [2.2, 1.6]", "[2.0, 1.5], max = [2e9, 1.6]",
     'emitters[0].shape: the mouth of "jet" could hold 2e+11 particles at once, and 1e+07 is the most; '
     "make it narrower, or the grid coarser"),
    ("[2.0, 1.5], max = [2.2, 1.6]", "[3.9, 1.5], max = [4.5, 1.6]",
     'emitters[0].shape: the mouth of "jet" extends beyond the domain along x by 0.495 m; move it or enlarge the '
     "domain"),
    ("[2.0, 1.5], max = [2.2, 1.6]", "[0.5, 0.1], max = [0.9, 0.3]",
     'emitters[0].shape: the mouth of "jet" lies in body "column", for example at [0.505, 0.2]; move one of them'),
    ("[[emitters]]",
     '[[colliders]]\nname = "post"\nshape = { box = { min = [2.05, 1.0], max = [2.15, 1.9] } }\n[[emitters]]',
     'emitters[0].shape: the mouth of "jet" lies in collider "post", for example at [2.055, 1.55]; move one of them'),
    ('name = "jet"', 'name = "column"',
     'emitters[0].name: "column" is the name of bodies[0] already; every emitter needs its own'),
    ("radius = 0.3", "radius = 0.3\ndirection = [0, 0]",
     "impulses[0].direction: must not be zero; leave it out for a push away from the centre"),
    ("start = 0.5", "start = 0.5\nend = 0.4", "impulses[0].end: must be after start, 0.5 s; found 0.4"),
    ("start = 0.5", 'start = 0.5\nbody = "colum"',
     'impulses[0].body: no body has the name "colum"; did you mean "column"?'),
    ("[time]", 'walls = { y_max = "open" }\nfriction = { y_max = 0.5 }\n[time]',
     'domain.friction.y_max: is for a wall that can slip, and domain.walls has "open" for y_max; leave it out, or give '
     '"slip" or "separate" there'),
]  # fmt: skip


@pytest.mark.parametrize(("good", "bad", "line"), BAD, ids=[line.split(":", 1)[0] for *_, line in BAD])
def test_each_bad_one_has_its_sentence(good, bad, line):
    text = GOOD + GOOD_JET + GOOD_PUSH
    assert good in text
    found = refusal(text.replace(good, bad))
    assert [one.split(": ", 1)[1] for one in found] == [line]


def test_solids_on_grids_of_their_own_know_neither():
    tables = jet_scene().model_dump(exclude_none=True, exclude={"domain": {"cells"}})
    with pytest.raises(InputError, match='solids = "total" supports no emitters'):
        scene_of(**tables | {"solver": {"solids": "total"}})


RATES = {
    "pulses": ("0.02 * (1 + sin(10*t))", lambda t: 0.02 * (t + (1 - np.cos(10 * t)) / 10)),
    "ramp": ("0.08 * t", lambda t: 0.04 * t**2),
    "valve": ("0.03 if 0.2 < t and t < 0.7 else 0", lambda t: 0.03 * np.clip(t - 0.2, 0.0, 0.5)),
    "number": (0.025, lambda t: 0.025 * t),
}


@pytest.mark.parametrize("name", RATES)
@pytest.mark.parametrize("dimension", [2, 3])
def test_sheets_of_a_rate_that_varies(dimension: int, name: str) -> None:
    """The volume that is due by any time is the integral of the rate, to a sheet; each sheet enters at rate / area."""
    rate, volume = RATES[name]
    d, low, high = dimension, [0.2] * dimension, [0.4] * dimension
    asked = jet_scene(d, velocity=[0.0] * (d - 1) + [-3.0], rate=rate, shape=box(low, high))
    sheets = sheets_of(asked.emitters[0], asked)
    own = sheets.size * sheets.volume
    entered = own * np.arange(1, sheets.count)
    # In a nozzle before the mouth, which pulses have not.
    assert (sheets.lead > 0) == (name == "number")
    assert entered == pytest.approx(volume(sheets.due[1:] + sheets.early), abs=own / 100)
    assert sheets.particles * sheets.volume == pytest.approx(volume(1.0 + sheets.early), abs=own)
    middle = np.interp(own * (np.arange(sheets.count) + 0.5), volume(TIMES), TIMES)
    expected = np.gradient(volume(TIMES), TIMES) / sheets.mouth.area
    assert sheets.speeds[:-1] == pytest.approx(np.interp(middle, TIMES, expected)[:-1], rel=0.02, abs=1e-3)
    assert fastest_inflow(asked.emitters[0], 1.0) == pytest.approx(expected.max(), rel=1e-3)
    if name == "number":
        speed = 0.025 / sheets.mouth.area
        same = jet_scene(d, velocity=[0.0] * (d - 1) + [-speed], shape=box(low, high))
        assert sheets_of(same.emitters[0], same).due == pytest.approx(sheets.due)


@pytest.mark.parametrize("rate", ["t - 0.5", "0", "-1 if t > 0.9 else 1"])
def test_a_rate_that_is_negative_or_nothing_is_refused(rate: str) -> None:
    (said,) = refusal(GOOD + GOOD_JET + f'rate = "{rate}"\n')
    assert "emitters[0].rate: must not be negative, and positive at some time: " in said
