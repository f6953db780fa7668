"""What trajectories draw: distributions, independence of keys and of the count, grids, sequences, splits, seeds."""

import copy
import hashlib
import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from good_sweep import BARE, LAWS, SWEEP, sweep_of, varied
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest, qmc, truncnorm

from mpmcli.dataset.draw import draw
from mpmcli.dataset.sweep import Integers, LogUniform, Normal, Uniform, read_distribution

N = 1000
LARGEST_U = 1 - 2.0**-53


@pytest.fixture(autouse=True)
def empty_directory(tmp_path, monkeypatch):
    """Sweeps are loaded from the present directory."""
    monkeypatch.chdir(tmp_path)


def drawn(sweep, key, numbers=range(N)):
    return [draw(sweep, n).values[key] for n in numbers]


def furthest(n):
    """Largest distance of an empirical distribution of n draws from the true one, but for one case in a million.

    P(D > e) <= 2 exp(-2 n e^2) (Dvoretzky, Kiefer, Wolfowitz; Massart 1990).
    """
    return math.sqrt(math.log(2 / 1e-6) / (2 * n))


def normal_share(mean, deviation, low, high):
    """Return the cumulative distribution of a normal one between two bounds."""

    def phi(x):
        return 0.5 * (1 + np.array([math.erf((one - mean) / (deviation * math.sqrt(2))) for one in np.atleast_1d(x)]))

    return lambda x: (phi(x) - phi(low)) / (phi(high) - phi(low))


@pytest.mark.parametrize("method", ["random", "sobol", "latin"])
@pytest.mark.parametrize(("text", "share"), [
    ("uniform = [0.5, 2]", lambda x: (x - 0.5) / 1.5),
    ("loguniform = [0.01, 10]", lambda x: np.log(x / 0.01) / math.log(1000)),
    ("normal = [2, 0.5]", normal_share(2, 0.5, 0.5, 3.5)),
    ("normal = [1, 0.5], within = [0.9, 3]", normal_share(1, 0.5, 0.9, 3)),
    ("normal = [1, 0.5], within = [2, 4]", normal_share(1, 0.5, 2, 4)),
])  # fmt: skip
def test_draws_follow_their_distribution(text, share, method):
    sweep = sweep_of(varied(f'"time.end" = {{ {text} }}', head=f'{BARE}method = "{method}"'))
    values = np.array(drawn(sweep, "time.end"))
    assert kstest(values, share).statistic < furthest(N)
    low, high = sweep.vary["time.end"].extremes()
    assert low <= values.min() and values.max() <= high


@pytest.mark.parametrize(
    ("text", "values"), [("integers = [2, 6]", [2, 3, 4, 5, 6]), ("choice = [1, 4, 16]", [1, 4, 16])]
)
def test_every_value_is_as_likely(text, values):
    found = drawn(sweep_of(varied(f'"time.frames" = {{ {text} }}')), "time.frames")
    assert set(found) == set(values) and all(type(one) is int for one in found)
    p = 1 / len(values)
    for value in values:
        # Six standard deviations of a binomial.
        assert abs(found.count(value) - N * p) < 6 * math.sqrt(N * p * (1 - p))


def test_components_of_a_vector_are_independent():
    sweep = sweep_of(varied('"bodies.stone.velocity" = { uniform = [[-1, 10], [1, 30]] }'))
    x, y = np.array(drawn(sweep, "bodies.stone.velocity")).T
    assert kstest(x, lambda v: (v + 1) / 2).statistic < furthest(N)
    assert kstest(y, lambda v: (v - 10) / 20).statistic < furthest(N)
    assert abs(np.corrcoef(x, y)[0, 1]) < 5 / math.sqrt(N)
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 5 / math.sqrt(N)


def test_quantiles_of_the_far_tails_are_those_of_scipy():
    u = np.linspace(0, 0.999, 50)
    for low, high in ((-12, -10), (10, 12), (8, 30), (-2, 30), (-0.5, 7), (-9, 3)):
        found = [Normal(((1.0, 2.0, 1.0 + 2 * low, 1.0 + 2 * high),), False).value([one]) for one in u]
        np.testing.assert_allclose(found, 1 + 2 * truncnorm.ppf(u, low, high), rtol=1e-9, atol=1e-9)


numbers = st.floats(-1e6, 1e6)
positive = st.floats(1e-6, 1e6)
unit = st.one_of(st.floats(0, LARGEST_U), st.sampled_from([0.0, LARGEST_U]))


@given(numbers, numbers, unit)
def test_uniform_stays_within_its_bounds(a, b, u):
    low, high = sorted((a, b))
    assert low <= Uniform(((low, high),), False).value([u]) <= high


@given(positive, positive, unit)
def test_loguniform_stays_within_its_bounds(a, b, u):
    low, high = sorted((a, b))
    assert low <= LogUniform(((low, high),), False).value([u]) <= high


@given(st.integers(-(10**15), 10**15), st.integers(0, 10**15), unit)
def test_integers_stay_within_their_bounds(low, span, u):
    value = Integers(((low, low + span),), False).value([u])
    assert low <= value <= low + span and type(value) is int


@given(numbers, positive, st.floats(-30, 30), st.floats(1e-3, 30), unit)
def test_normal_stays_within_its_bounds(mean, deviation, a, width, u):
    low, high = mean + a * deviation, mean + min(a + width, 35.0) * deviation
    if low < high:
        assert low <= Normal(((mean, deviation, low, high),), False).value([u]) <= high


def test_the_ends_of_a_distribution_are_its_quantiles_of_0_and_1():
    for table in ({"uniform": [1, 2]}, {"loguniform": [1, 2]}, {"normal": [5, 1]}, {"integers": [1, 4]}):
        distribution = read_distribution(table)
        low, high = distribution.extremes()
        assert distribution.value([0.0]) == pytest.approx(low)
        assert distribution.value([LARGEST_U]) == pytest.approx(high, rel=1e-6)


def test_a_draw_depends_on_seed_number_and_key_alone():
    """The documented numbers: Philox seeded by seed, number, and 128 bits of the SHA-256 of the key."""
    sweep = sweep_of(SWEEP)
    key = "bodies.sand.material.friction_angle"
    words = np.frombuffer(hashlib.sha256(key.encode()).digest()[:16], "<u4").tolist()
    for n in (0, 1, 999):
        u = np.random.Generator(np.random.Philox(np.random.SeedSequence(7, spawn_key=(n, *words)))).random()
        assert draw(sweep, n).values[key] == 25.0 + u * 15.0


@pytest.mark.parametrize("method", ["random", "sobol", "latin"])
def test_other_keys_change_nothing(method):
    few = ['"time.end" = { uniform = [1, 2] }', '"time.frames" = { integers = [1, 99] }']
    more = ['"domain.gravity.0" = { choice = [0.0, 1.0] }', *few, '"time.safety" = { grid = [0.5, 0.6] }']
    if method == "random":
        more += ['"domain.gravity.1" = { uniform = [-10, -1] }']
    head = f'{BARE}method = "{method}"'
    first, second = sweep_of(varied(*few, head=head)), sweep_of(varied(*more, head=head))
    for key in first.vary:
        assert drawn(first, key, range(50)) == drawn(second, key, range(50))


@pytest.mark.parametrize("method", ["random", "sobol"])
def test_the_count_changes_nothing(method):
    text = SWEEP.replace("seed = 7", f'seed = 7\nmethod = "{method}"')
    few, many = sweep_of(text, count=20), sweep_of(text, count=10**9)
    for n in range(20):
        first, second = draw(few, n), draw(many, n)
        assert (first.values, first.data, first.split) == (second.values, second.data, second.split)


def test_the_seed_changes_everything():
    first, second = draw(sweep_of(SWEEP), 0), draw(sweep_of(SWEEP.replace("seed = 7", "seed = 8")), 0)
    key = "bodies.sand.material.friction_angle"
    assert first.values[key] != second.values[key]
    assert first.values["place.sand"][0]["min"] != second.values["place.sand"][0]["min"]
    assert first.data["bodies"][0]["seed"] != second.data["bodies"][0]["seed"]


def shared_points(method, count):
    """Return the points of the unit cube of a sweep with three continuous components, (count, 3)."""
    lines = ['"time.end" = { uniform = [1, 2] }', '"time.frames" = { choice = [1, 2] }']
    lines += ['"domain.gravity" = { uniform = [[0, 0], [1, 1]] }']
    sweep = sweep_of(varied(*lines, head=f'{BARE}method = "{method}"'), count=count)
    values = [draw(sweep, n).values for n in range(count)]
    return np.array([[v["time.end"] - 1, *v["domain.gravity"]] for v in values])


def test_sobol_points_are_those_of_scipy():
    expected = qmc.Sobol(3, scramble=True, rng=7).random(64)
    np.testing.assert_allclose(shared_points("sobol", 64), expected, rtol=0, atol=1e-15)


def test_sobol_points_are_spread_more_evenly_than_random_ones():
    discrepancies = {method: qmc.discrepancy(shared_points(method, 256)) for method in ("random", "sobol")}
    assert discrepancies["sobol"] < 0.1 * discrepancies["random"]


def test_a_latin_hypercube_has_one_point_in_every_row():
    points = shared_points("latin", 50)
    for component in points.T:
        assert sorted(np.floor(50 * component).astype(int)) == list(range(50))


def test_grids_run_through_their_combinations_last_key_fastest():
    lines = ['"time.frames" = { grid = [1, 2] }', '"time.safety" = { grid = [0.5, 0.6, 0.7] }', '"time.end" = 0.3']
    sweep = sweep_of(varied(*lines))
    found = [tuple(draw(sweep, n).values.values()) for n in range(8)]
    once = [(a, b, 0.3) for a in (1, 2) for b in (0.5, 0.6, 0.7)]
    assert found == once + once[:2]


def test_grids_of_placements_come_last():
    text = SWEEP.replace("integers = [1, 3]", "grid = [1, 2]").replace("uniform = [25, 40]", "grid = [30, 35]")
    sweep = sweep_of(text)
    found = [draw(sweep, n).values for n in range(4)]
    assert [len(v["place.sand"]) for v in found] == [1, 2, 1, 2]
    assert [v["bodies.sand.material.friction_angle"] for v in found] == [30, 30, 35, 35]


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
def test_the_split_has_its_fractions_of_every_first_trajectories(seed):
    sweep = sweep_of(f'base = "base.toml"\ncount = 10000\nseed = {seed}\n[split]\ntrain = 0.7\nvalid = 0.2\ntest = 0.1')
    names = [sweep.split_of(n) for n in range(10_000)]
    for name, share in (("train", 0.7), ("valid", 0.2), ("test", 0.1)):
        off = np.abs(np.cumsum([one == name for one in names]) - share * np.arange(1, 10_001))
        # Among ten the order is random: of the first three none may be for training.
        assert off.max() < 3 * 0.7 + 1e-9
    assert draw(sweep, 17).split == names[17]


@pytest.mark.parametrize("length", [10, 13, 21, 34, 55])
def test_every_value_of_a_grid_falls_into_every_split(length):
    """Trajectory n has value n modulo the length of the grid: a tenth of those of each are in test."""
    sweep = sweep_of('base = "base.toml"\ncount = 10\nseed = 3')
    shares = [np.mean([sweep.split_of(n) == "test" for n in range(k, 200 * length, length)]) for k in range(length)]
    # Three standard deviations, and a little for many values.
    assert max(abs(share - 0.1) for share in shares) < 4 * (0.1 * 0.9 / 200) ** 0.5


def test_a_split_of_one_part_has_no_other():
    head = 'base = "base.toml"\ncount = 100\n[split]\n'
    whole = sweep_of(f"{head}valid = 1")
    assert {whole.split_of(n) for n in range(100)} == {"valid"}
    halves = sweep_of(f"{head}train = 0.5\ntest = 0.5")
    assert {halves.split_of(n) for n in range(100)} == {"train", "test"}


def test_seeds_split_differently():
    sweeps = [sweep_of(SWEEP.replace("seed = 7", f"seed = {seed}")) for seed in (1, 2)]
    assert [sweeps[0].split_of(n) for n in range(50)] != [sweeps[1].split_of(n) for n in range(50)]


def test_every_trajectory_has_its_own_jitter_and_each_body_its_own():
    sweep = sweep_of(SWEEP)
    seeds = [body["seed"] for n in range(50) for body in draw(sweep, n).data["bodies"] if "seed" in body]
    assert len(set(seeds)) == len(seeds) == sum(len(draw(sweep, n).values["place.sand"]) for n in range(50))
    assert all("seed" not in body for n in range(5) for body in draw(sweep, n).data["bodies"][-1:])
    fixed = sweep_of(SWEEP.replace("[vary]", '[vary]\n"bodies.sand.seed" = 5'))
    assert {body["seed"] for n in range(5) for body in draw(fixed, n).data["bodies"] if "seed" in body} == {5}


def test_a_draw_makes_a_scene_and_leaves_the_sweep_alone():
    sweep = sweep_of(SWEEP)
    before = copy.deepcopy(sweep.base_data)
    one = draw(sweep, 3)
    scene = one.scene(LAWS).scene
    assert sweep.base_data == before
    assert scene.domain.gravity[1] == one.values["domain.gravity.1"]
    placed = one.values["place.sand"]
    assert [body.name for body in scene.bodies] == [*(body["name"] for body in placed), "stone"]
    for body, values in zip(scene.bodies, placed, strict=False):
        assert body.shape.form.min == tuple(values["min"]) and body.velocity == tuple(values["velocity"])
        assert body.material.friction_angle == one.values["bodies.sand.material.friction_angle"]
    one.data["domain"]["gravity"][0] = 99
    one.values["place.sand"][0]["velocity"][0] = 99
    assert draw(sweep, 3).data["domain"]["gravity"][0] == 0.0
    assert draw(sweep, 3).data["bodies"][0]["velocity"][0] != 99


def test_a_scene_of_rigid_bodies_alone_is_drawn():
    base = """\
domain = { size = [1.0, 1.0], cells = [32, 32] }
time = { end = 0.1, frames = 4 }
[[colliders]]
name = "ball"
density = 500.0
shape = { ball = { center = [0.5, 0.5], radius = 0.1 } }
"""
    vary = 'base = "base.toml"\ncount = 9\n[vary]\n"colliders.ball.density" = { uniform = [100, 200] }\n'
    (ball,) = draw(sweep_of(vary, base=base), 3).scene(LAWS).scene.colliders
    assert 100.0 <= ball.density <= 200.0


def test_choices_are_not_shared_between_draws():
    sweep = sweep_of(varied('"bodies.stone.velocity" = { choice = [[1.0, 0.0]] }'))
    one = draw(sweep, 0)
    one.data["bodies"][1]["velocity"][0] = 99
    assert one.values["bodies.stone.velocity"] == draw(sweep, 0).data["bodies"][1]["velocity"] == [1.0, 0.0]
    one.values["bodies.stone.velocity"][0] = 99
    assert draw(sweep, 0).values["bodies.stone.velocity"] == [1.0, 0.0]


def test_values_survive_json_and_toml():
    sweep = sweep_of(SWEEP)
    for n in range(20):
        one = draw(sweep, n)
        assert json.loads(json.dumps(one.values)) == one.values
        assert tomllib.loads(tomli_w.dumps(one.data)) == one.data


def test_there_are_as_many_trajectories_as_the_sweep_says():
    sweep = sweep_of(SWEEP, count=5)
    draw(sweep, 4)
    for number in (5, -1):
        with pytest.raises(ValueError, match=f"there is no trajectory {number}"):
            draw(sweep, number)


def test_every_process_draws_the_same(run_python):
    expected, methods = [], ["random", "sobol", "latin"]
    for method in methods:
        sweep = sweep_of(SWEEP.replace("seed = 7", f'seed = 7\nmethod = "{method}"'))
        Path("sweep.toml").rename(f"{method}.toml")
        expected.append([sweep.key, *(draw(sweep, n).data for n in (5, 3))])
    code = (
        "import json\n"
        "from mpmcli.dataset.draw import draw\n"
        "from mpmcli.dataset.sweep_file import load_sweep\n"
        "from mpmcli.materials.registry import parameter_models\n"
        f"sweeps = [load_sweep(f'{{method}}.toml', laws=parameter_models()) for method in {methods}]\n"
        "print(json.dumps([[sweep.key, *(draw(sweep, n).data for n in (5, 3))] for sweep in sweeps]))\n"
    )
    said = run_python(code, environment={"PYTHONHASHSEED": "12345"}).stdout.splitlines()[-1]
    assert json.loads(said) == expected


def test_scipy_is_loaded_only_where_a_sequence_is_drawn(run_python):
    sweep_of(SWEEP)
    code = (
        "import sys\n"
        "from mpmcli.dataset.sweep_file import load_sweep\n"
        "from mpmcli.materials.registry import parameter_models\n"
        "load_sweep('sweep.toml', laws=parameter_models())\n"
        "print('scipy.stats' in sys.modules)\n"
    )
    assert run_python(code).stdout.splitlines()[-1] == "False"


def test_one_entry_of_a_velocity_that_the_base_scene_lacks_is_drawn_and_the_others_are_zero():
    sweep = sweep_of(varied('"bodies.stone.velocity.0" = { uniform = [1, 2] }'))
    velocity = draw(sweep, 3).scene(LAWS).scene.bodies[1].velocity
    assert velocity == (draw(sweep, 3).values["bodies.stone.velocity.0"], 0.0) and 1 <= velocity[0] <= 2
