"""Bodies placed at random: inside their region, apart from everything, and what is said where they do not fit."""

import math
import pickle
import time

import numpy as np
import pytest
from good_sweep import BASE, LAWS, SWEEP, refusal, sweep_of
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import kstest

from mpmcli.check.geometry import distance_between
from mpmcli.dataset.draw import NoPlace, PlacementError, RoundedBox, Wanted, distances, draw, find_places, rounded_box
from mpmcli.scene.shapes import Ball, Box, Polygon

# Positions are of order 1 m: a few roundings.
ROUNDINGS = 1e-12

# Bodies as the scene has them: ("box", lower corner, upper corner) or ("ball", centre, radius).
Solid = tuple[str, list[float], list[float] | float]


def apart(first: Solid, second: Solid) -> float:
    """Return the distance of two bodies, m; 0 where they touch or overlap. One axis at a time, from the definition."""
    if first[0] == "ball" and second[0] == "ball":
        return max(0.0, math.dist(first[1], second[1]) - first[2] - second[2])
    if first[0] == "box" and second[0] == "box":
        gaps = [max(0.0, c - b, a - d) for a, b, c, d in zip(first[1], first[2], second[1], second[2], strict=True)]
        return math.hypot(*gaps)
    box, ball = (first, second) if first[0] == "box" else (second, first)
    nearest = [min(max(x, a), b) for x, a, b in zip(ball[1], box[1], box[2], strict=True)]
    return max(0.0, math.dist(nearest, ball[1]) - ball[2])


def corners(solid: Solid) -> tuple[list[float], list[float]]:
    if solid[0] == "box":
        return solid[1], solid[2]
    return [x - solid[2] for x in solid[1]], [x + solid[2] for x in solid[1]]


def assert_well_placed(solids, region, min_distance, others=()):
    """Hold the contract: inside the region, no overlap, the distance kept."""
    for i, one in enumerate(solids):
        lower, upper = corners(one)
        assert all(x >= r - ROUNDINGS for x, r in zip(lower, region[0], strict=True))
        assert all(x <= r + ROUNDINGS for x, r in zip(upper, region[1], strict=True))
        for other in [*solids[:i], *others]:
            distance = apart(one, other)
            assert distance > 0 and distance >= min_distance - ROUNDINGS


def solids_of(values) -> list[Solid]:
    return [
        ("ball", body["center"], body["radius"]) if "radius" in body else ("box", body["min"], body["max"])
        for body in values
    ]


@st.composite
def arrangements(strategy):
    """Return bodies to place, obstacles, region and min_distance, in 2D or 3D."""
    d = strategy(st.sampled_from([2, 3]))
    length = st.floats(0.01, 0.4)
    lower = [strategy(st.floats(-1, 1)) for _ in range(d)]
    upper = [x + strategy(st.floats(0.4, 1)) for x in lower]

    def extent():
        if strategy(st.booleans()):
            return np.zeros(d), strategy(length) / 2
        return np.array([strategy(length) / 2 for _ in range(d)]), 0.0

    bodies = [extent() for _ in range(strategy(st.integers(1, 6)))]
    obstacles = [
        RoundedBox(
            np.array([strategy(st.floats(x - 0.2, y + 0.2)) for x, y in zip(lower, upper, strict=True)]), *extent()
        )
        for _ in range(strategy(st.integers(0, 3)))
    ]
    return bodies, obstacles, lower, upper, strategy(st.sampled_from([0.0, 0.01, 0.1])), strategy(st.integers(0, 2**32))


def solid(center, half, radius) -> Solid:
    if radius:
        return ("ball", list(center), radius)
    return ("box", list(center - half), list(center + half))


def wanted_of(bodies, lower, upper, min_distance, seed):
    return [
        Wanted(
            half,
            radius,
            float(np.prod(half + radius)),
            np.array(lower),
            np.array(upper),
            min_distance,
            np.random.default_rng([seed, k]),
        )
        for k, (half, radius) in enumerate(bodies)
    ]


@given(arrangements())
def test_bodies_are_inside_and_apart(arrangement):
    bodies, obstacles, lower, upper, min_distance, seed = arrangement
    try:
        centers = find_places(wanted_of(bodies, lower, upper, min_distance, seed), obstacles)
    except NoPlace:
        assume(False)
    placed = [solid(center, half, radius) for center, (half, radius) in zip(centers, bodies, strict=True)]
    others = [solid(one.center, one.half, one.radius) for one in obstacles]
    assert_well_placed(placed, (lower, upper), min_distance, others)
    again = find_places(wanted_of(bodies, lower, upper, min_distance, seed), obstacles)
    assert all((a == b).all() for a, b in zip(centers, again, strict=True))


@given(arrangements())
def test_distances_are_those_of_the_shapes(arrangement):
    bodies, obstacles, lower, upper, _, seed = arrangement
    assume(obstacles)
    centers = np.random.default_rng(seed).uniform(lower, upper, (5, len(lower)))
    for half, radius in bodies:
        found = distances(centers, half, radius, obstacles)
        for center, row in zip(centers, found, strict=True):
            expected = [apart(solid(center, half, radius), solid(o.center, o.half, o.radius)) for o in obstacles]
            np.testing.assert_allclose(row, expected, atol=ROUNDINGS)


def test_distances_are_those_that_check_computes():
    box, ball = Box.model_construct(min=(0.0, 0.0), max=(0.2, 0.1)), Ball.model_construct(center=(0.5, 0.4), radius=0.1)
    far = Box.model_construct(min=(0.6, 0.7), max=(0.9, 0.8))
    for first, second in ((box, ball), (ball, far), (box, far)):
        one = rounded_box(first)
        found = distances(one.center[None], one.half, one.radius, [rounded_box(second)])
        assert found[0, 0] == pytest.approx(distance_between(first, second), abs=ROUNDINGS)


def test_other_shapes_are_their_bounding_boxes():
    found = rounded_box(Polygon.model_construct(vertices=((0.1, 0.2), (0.5, 0.2), (0.3, 0.6))))
    assert found.center == pytest.approx([0.3, 0.4]) and found.half == pytest.approx([0.2, 0.2]) and found.radius == 0


def test_one_body_is_uniform_in_its_region():
    n = 1000
    bodies = [(np.array([0.1, 0.05]), 0.0)]
    places = np.array([find_places(wanted_of(bodies, [0, 1], [1, 2], 0, seed), [])[0] for seed in range(n)])
    # D <= sqrt(ln(2 / 1e-6) / (2 n)) but for one case in a million (Massart 1990).
    most = math.sqrt(math.log(2e6) / (2 * n))
    assert kstest(places[:, 0], lambda x: (x - 0.1) / 0.8).statistic < most
    assert kstest(places[:, 1], lambda y: (y - 1.05) / 0.9).statistic < most


def test_the_larger_one_of_two_distances_is_kept():
    """The larger body comes first and asks for more, and there is something else in the way."""
    wall = RoundedBox(np.array([0.0, 0.5]), np.array([0.1, 0.5]), 0.0)
    nearest = []
    for seed in range(50):
        (large,) = wanted_of([(np.array([0.2, 0.2]), 0.0)], [0, 0], [1, 1], 0.15, seed)
        (small,) = wanted_of([(np.array([0.05, 0.05]), 0.0)], [0, 0], [1, 1], 0.0, seed + 100)
        first, second = find_places([large, small], [wall])
        one, two = solid(first, large.half, 0.0), solid(second, small.half, 0.0)
        assert apart(one, two) >= 0.15 - ROUNDINGS
        assert apart(one, ("box", [-0.1, 0.0], [0.1, 1.0])) >= 0.15 - ROUNDINGS
        nearest.append(apart(two, ("box", [-0.1, 0.0], [0.1, 1.0])))
    # The small one keeps no distance from what is no wish of the large one.
    assert 0 < min(nearest) < 0.1


def test_the_largest_body_is_placed_first():
    """In a strip of 1 m, 0.94 m leave 0.05 m free in a third of the places; 0.05 m leave 0.94 m in a fiftieth."""
    bodies = [(np.array([0.025, 0.05]), 0.0), (np.array([0.47, 0.05]), 0.0)]
    for seed in range(30):
        find_places(wanted_of(bodies, [0, 0], [1, 0.1], 0, seed), [])


def test_a_body_as_wide_as_its_region_fits_to_the_last_bit():
    """0.04 + 0.3 - 0.3 rounds to less than 0.04."""
    text = SWEEP.replace("integers = [1, 3]", "integers = [1, 1]").replace("min = [0.2, 0.2]", "min = [0.04, 0.2]")
    text = text.replace("max = [0.8, 0.8]", "max = [0.64, 0.8]")
    sweep = sweep_of(text.replace("uniform = [[0.15, 0.15], [0.3, 0.3]]", "uniform = [[0.6, 0.1], [0.6, 0.2]]"))
    for n in range(20):
        (body,) = draw(sweep, n).values["place.sand"]
        assert body["min"][0] >= 0.04 and body["max"][0] <= 0.64


def test_the_template_itself_is_in_nobodys_way():
    sweep = sweep_of(SWEEP)
    template: Solid = ("box", [0.1, 0.1], [0.3, 0.3])
    assert any(apart(one, template) == 0 for n in range(50) for one in solids_of(draw(sweep, n).values["place.sand"]))


@pytest.fixture
def in_an_empty_directory(tmp_path, monkeypatch):
    """Sweeps are loaded from the present directory."""
    monkeypatch.chdir(tmp_path)


pytestmark = pytest.mark.usefixtures("in_an_empty_directory")
STONE: Solid = ("ball", [0.7, 0.2], 0.1)


def test_the_bodies_of_a_sweep_are_well_placed():
    sweep = sweep_of(SWEEP)
    counts = []
    for n in range(300):
        solids = solids_of(draw(sweep, n).values["place.sand"])
        assert_well_placed(solids, ([0.2, 0.2], [0.8, 0.8]), 0.02, [STONE])
        counts.append(len(solids))
    assert set(counts) == {1, 2, 3}


def test_sizes_and_velocities_follow_their_distributions():
    sweep = sweep_of(SWEEP.replace("integers = [1, 3]", "integers = [1, 2]"))
    bodies = [body for n in range(600) for body in draw(sweep, n).values["place.sand"]]
    most = math.sqrt(math.log(2e6) / (2 * len(bodies)))
    widths = [body["max"][0] - body["min"][0] for body in bodies]
    assert kstest(widths, lambda x: (x - 0.15) / 0.15).statistic < most
    assert kstest([body["velocity"][1] for body in bodies], lambda v: (v + 2.5) / 5).statistic < most


BALLS = """\
base = "base.toml"
count = 100
[[place]]
body = "stone"
count = { integers = [1, 2] }
radius = { uniform = [0.03, 0.08] }
region = { min = [0.0, 0.0, 0.0], max = [1.0, 1.0, 0.4] }
min_distance = 0.05
[[place]]
body = "brick"
count = 3
region = { min = [0.0, 0.0, 0.0], max = [0.8, 1.0, 1.0] }
"""
BASE_3D = """\
domain = { size = [1.0, 1.0, 1.0], cells = [20, 20, 20] }
time = { end = 0.1, frames = 4 }
[[bodies]]
name = "brick"
material = "jelly"
shape = { box = { min = [0.1, 0.1, 0.1], max = [0.3, 0.2, 0.3] } }
velocity = [0.0, 0.0, -1.0]
[[bodies]]
name = "pillar"
material = "jelly"
shape = { box = { min = [0.4, 0.4, 0.0], max = [0.6, 0.6, 1.0] } }
[[bodies]]
name = "stone"
material = "jelly"
shape = { ball = { center = [0.8, 0.2, 0.5], radius = 0.1 } }
[[forces]]
name = "wind"
body = "brick"
acceleration = [1.0, 0.0, 0.0]
[[forces]]
acceleration = [0.0, 2.0, 0.0]
"""


def test_boxes_and_balls_together_in_3d():
    sweep = sweep_of(BALLS, BASE_3D)
    pillar: Solid = ("box", [0.4, 0.4, 0.0], [0.6, 0.6, 1.0])
    for n in range(100):
        one = draw(sweep, n)
        balls, bricks = (solids_of(one.values[f"place.{name}"]) for name in ("stone", "brick"))
        assert_well_placed(balls, ([0, 0, 0], [1, 1, 0.4]), 0.05, [pillar, *bricks])
        assert_well_placed(bricks, ([0, 0, 0], [0.8, 1, 1]), 0.0, [pillar])
        for _, low, high in bricks:
            assert np.subtract(high, low) == pytest.approx([0.2, 0.1, 0.2])
        names = [body["name"] for body in one.data["bodies"]]
        assert names == ["brick_1", "brick_2", "brick_3", "pillar", *(f"stone_{k + 1}" for k in range(len(balls)))]
        assert one.origins == (0, 0, 0, 1, *[2] * len(balls))


def test_what_a_template_says_holds_for_every_body_in_its_place():
    scene = draw(sweep_of(BALLS, BASE_3D), 0).scene(LAWS).scene
    assert [body.velocity for body in scene.bodies[:3]] == [(0.0, 0.0, -1.0)] * 3
    assert [force.body for force in scene.forces] == ["brick_1", "brick_2", "brick_3", None]
    assert [force.name for force in scene.forces] == ["wind", "wind", "wind", None]


def test_a_varied_body_is_kept_away_from_where_it_is():
    text = SWEEP.replace("[vary]", '[vary]\n"bodies.stone.shape.ball.center" = { uniform = [[0.3, 0.3], [0.7, 0.7]] }')
    sweep = sweep_of(text.replace("[0.3, 0.3]]", "[0.2, 0.2]]"))
    for n in range(100):
        values = draw(sweep, n).values
        stone: Solid = ("ball", values["bodies.stone.shape.ball.center"], 0.1)
        assert_well_placed(solids_of(values["place.sand"]), ([0.2, 0.2], [0.8, 0.8]), 0.02, [stone])


def test_a_second_body_changes_no_first_one_that_is_larger():
    sweep = sweep_of(SWEEP.replace("integers = [1, 3]", "grid = [1, 2]"))
    first = draw(sweep, 0, {"place.sand.count": 1}).values["place.sand"][0]
    both = [draw(sweep, 0, {"place.sand.count": 2}).values["place.sand"] for _ in range(2)]
    assert both[0] == both[1]
    assert np.subtract(both[0][0]["max"], both[0][0]["min"]) == pytest.approx(np.subtract(first["max"], first["min"]))
    assert both[0][0]["velocity"] == first["velocity"]


FULL = SWEEP.replace("{ integers = [1, 3] }", "4").replace(
    "{ uniform = [[0.15, 0.15], [0.3, 0.3]] }", "{ grid = [[0.1, 0.1], [0.29, 0.29]] }"
)


def test_bodies_without_a_place_are_one_sentence():
    sweep = sweep_of(FULL.replace("0.02", "0.05"))
    assert len(draw(sweep, 0).values["place.sand"]) == 4
    start = time.perf_counter()
    with pytest.raises(PlacementError) as refused:
        draw(sweep, 1)
    assert time.perf_counter() - start < 5
    said = str(refused.value)
    assert str(pickle.loads(pickle.dumps(refused.value))) == said
    # Two bodies of 0.29 m need 0.63 m along an axis; 4 x 0.29^2 / 0.6^2 = 93.4 percent.
    assert said.startswith("sweep.toml: trajectory 1: at most ")
    assert said.endswith(
        ' of 4 bodies found a place in 200 starts of 256 tries each; "sand" takes 93.4 percent of the area of its '
        "region; place fewer or smaller bodies, with a smaller min_distance, or in a larger region"
    )
    assert int(said.split("at most ")[1].split()[0]) == 1


def test_a_first_trajectory_without_a_place_is_refused():
    text = FULL.replace("[[0.1, 0.1], [0.29, 0.29]]", "[[0.29, 0.29]]").replace("0.02", "0.05")
    (line,) = refusal(text)
    assert line.startswith("sweep.toml:7: place: trajectory 0: at most 1 of 4 bodies found a place in ")


def test_sizes_are_drawn_anew_where_bodies_do_not_fit():
    """Three boxes of the sweep find no place in about 1 of 200 trajectories, while most sizes do."""
    sweep = sweep_of(SWEEP.replace("integers = [1, 3]", "integers = [4, 4]").replace("[0.15, 0.15]", "[0.1, 0.1]"))
    for n in range(100):
        assert len(draw(sweep, n).values["place.sand"]) == 4


def test_names_that_are_taken_are_refused():
    assert refusal(SWEEP, BASE.replace('"stone"', '"sand_1"')) == [
        'sweep.toml:8: place.body: makes bodies of names such as "sand_1", which the base scene has; rename one of them'
    ]
