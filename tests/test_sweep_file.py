"""Sweep files: what is read, what is filled in, what makes their key, and what is said of each fault."""

from pathlib import Path

import pytest
from good_sweep import BARE, BASE, LAWS, SWEEP, refusal, sweep_of, varied

from mpmcli.dataset.sweep import Choice, Grid, Normal, Uniform
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.errors import InputError


@pytest.fixture(autouse=True)
def empty_directory(tmp_path, monkeypatch):
    """Sweeps are loaded from the present directory, and named as they lie there."""
    monkeypatch.chdir(tmp_path)


def test_a_good_sweep_is_complete():
    sweep = sweep_of(SWEEP)
    assert (sweep.count, sweep.seed, sweep.method, sweep.accept) == (1000, 7, "random", "stable")
    assert (sweep.path, sweep.base) == (Path("sweep.toml"), Path("base.toml"))
    assert (sweep.text, sweep.base_text) == (SWEEP, BASE)
    assert sweep.base_data["domain"]["cells"] == [32, 32]
    assert sweep.vary == {
        "bodies.sand.material.friction_angle": Uniform(((25.0, 40.0),), False),
        "domain.gravity.1": Choice((-9.81, -3.7)),
    }
    assert sweep.placements[0].region.max == (0.8, 0.8)
    assert sweep.placements[0].min_distance == 0.02
    assert list(sweep.distributions) == [*sweep.vary, "place.sand.count", "place.sand.size", "place.sand.velocity"]


def test_the_defaults():
    sweep = sweep_of('base = "base.toml"\ncount = 3\n')
    assert (sweep.seed, sweep.method, sweep.accept, sweep.vary, sweep.placements) == (0, "random", "stable", {}, ())
    assert sweep.split.model_dump() == {"train": 0.8, "valid": 0.1, "test": 0.1}


def test_the_caller_may_give_the_count():
    assert sweep_of(SWEEP, count=5).count == 5
    assert sweep_of('base = "base.toml"\n', count=5).count == 5


def test_the_base_scene_lies_beside_the_sweep_or_in_the_working_directory():
    Path("sweeps").mkdir()
    Path("sweeps/sweep.toml").write_text(SWEEP, encoding="utf-8")
    Path("base.toml").write_text(BASE, encoding="utf-8")
    assert load_sweep("sweeps/sweep.toml", laws=LAWS).base == Path("base.toml")
    Path("sweeps/base.toml").write_text(BASE, encoding="utf-8")
    assert load_sweep("sweeps/sweep.toml", laws=LAWS).base == Path("sweeps/base.toml")


def test_kinds_of_values():
    sweep = sweep_of(
        varied(
            '"time.end" = 0.2',
            '"bodies.stone.velocity" = { grid = [[0.0, 0.0], [1.0, 0.0]] }',
            '"domain.gravity.1" = { normal = [-9, 1] }',
            '"domain.gravity.0" = { normal = [0, 1], within = [-1, 0.5] }',
        )
    )
    assert list(sweep.vary.values()) == [
        Choice((0.2,)),
        Grid(([0.0, 0.0], [1.0, 0.0])),
        Normal(((-9.0, 1.0, -12.0, -6.0),), False),
        Normal(((0.0, 1.0, -1.0, 0.5),), False),
    ]


def test_the_key_is_of_the_content_alone(tmp_path, monkeypatch):
    key = sweep_of(SWEEP).key
    assert len(key) == 64 and int(key, 16)
    shuffled = SWEEP.replace('base = "base.toml"\ncount = 1000\n', 'count   = 1_000 # many\nbase = "./base.toml"\n')
    assert shuffled != SWEEP
    assert sweep_of(shuffled).key == key
    assert sweep_of(SWEEP.replace("[place]", "[[place]]")).key == key
    assert sweep_of(SWEEP + "\n# the end\n", "# a scene\n" + BASE).key == key
    assert sweep_of(SWEEP.replace("seed = 7", 'seed = 7\nmethod = "random"\naccept = "stable"')).key == key
    assert sweep_of(SWEEP.replace("count = 1000", "count = 9"), count=1000).key == key
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert sweep_of(SWEEP).key == key


@pytest.mark.parametrize(("old", "new"), [
    ("count = 1000", "count = 1001"), ("seed = 7", "seed = 8"), ("seed = 7", 'seed = 7\nmethod = "sobol"'),
    ("seed = 7", 'seed = 7\naccept = "suspect"'), ("[25, 40]", "[25, 41]"), ("[1, 3]", "[1, 2]"), ("0.02", "0.03"),
    ("train = 0.8\nvalid = 0.1", "train = 0.7\nvalid = 0.2"),
])  # fmt: skip
def test_the_key_changes_with_the_content(old, new):
    assert old in SWEEP
    assert sweep_of(SWEEP.replace(old, new)).key != sweep_of(SWEEP).key


def test_the_key_changes_with_the_base_scene_and_with_the_order_of_grids():
    assert sweep_of(SWEEP, BASE.replace("end = 0.1", "end = 0.2")).key != sweep_of(SWEEP).key
    grids = '"time.end" = { grid = [0.1, 0.2] }', '"time.frames" = { grid = [1, 2] }'
    assert sweep_of(varied(*grids)).key != sweep_of(varied(*reversed(grids))).key


@pytest.mark.parametrize(("old", "new", "sentence"), [
    ("count = 1000", "cuont = 1000", 'sweep.toml:2: cuont: unknown key; did you mean "count"?'),
    ("count = 1000", "count = 0", "sweep.toml:2: count: must be at least 1; found 0"),
    ("seed = 7", "seed = -1", "sweep.toml:3: seed: must be at least 0; found -1"),
    ("seed = 7", 'method = "sobl"',
     'sweep.toml:3: method: must be "random", "sobol" or "latin"; found "sobl"; did you mean "sobol"?'),
    ("seed = 7", 'accept = "all"', 'sweep.toml:3: accept: must be "stable" or "suspect"; found "all"'),
    ('"base.toml"', '"bse.toml"', "sweep.toml:1: base: there is no such file: neither bse.toml nor "),
    ('base = "base.toml"', "", 'sweep.toml: base: missing key: the base scene, such as base = "scene.toml"'),
    ('"base.toml"', "3", "sweep.toml:1: base: must be text in quotes; found 3"),
    ("train = 0.8", "train = 0.7",
     "sweep.toml:14: split: must make 1 together, as train = 0.8, valid = 0.1, test = 0.1 do; found 0.9"),
    ("valid = 0.1", "vaild = 0.1", 'sweep.toml:16: split.vaild: unknown key; did you mean "valid"?'),
])  # fmt: skip
def test_a_faulty_table_is_named(old, new, sentence):
    assert old in SWEEP
    assert any(line.startswith(sentence) for line in refusal(SWEEP.replace(old, new)))


def test_all_faults_come_at_once_in_the_order_of_the_file():
    text = (
        SWEEP.replace("count = 1000", "count = 0")
        .replace("uniform = [25, 40]", "unifrm = [25, 40]")
        .replace("max = [0.8, 0.8]", "max = [0.8]")
        .replace("min_distance", "distance")
    )
    assert refusal(text) == [
        "sweep.toml:2: count: must be at least 1; found 0",
        'sweep.toml:5: vary.bodies.sand.material.friction_angle.unifrm: unknown key; did you mean "uniform"?',
        "sweep.toml:12: place.region.max: needs two numbers in this 2D scene (as many as domain.size); found 1",
        'sweep.toml:13: place.distance: unknown key; did you mean "min_distance"?',
    ]


@pytest.mark.parametrize(("value", "sentence"), [
    ("{ unifrm = [1, 2] }", '.unifrm: unknown key; did you mean "uniform"?'),
    ("{ gaussian = [1, 2] }",
     ".gaussian: unknown key; the distributions are uniform, loguniform, normal, integers, choice and grid"),
    ("{}", ": must be a distribution, uniform, loguniform, normal, integers, choice or grid, or a value; found an "
     "empty table"),
    ("{ a = { b = 1 } }",
     ': must be a distribution or a value; a key with dots stands in quotes, "domain.gravity"'),
    ("{ uniform = [1, 2], grid = [1] }", ': is one distribution, and "uniform" and "grid" are 2; keep one of them'),
    ("{ uniform = [1, 2], within = [1, 2] }", ".within: unknown key; uniform takes no other key"),
    ("{ normal = [1, 2], wihtin = [1, 2] }", '.wihtin: unknown key; did you mean "within"?'),
    ("{ uniform = [2, 1] }", ".uniform: must be [lower, upper]; found 2 above 1"),
    ("{ uniform = [1, nan] }",
     ".uniform: must be two numbers, or two lists of numbers of the same length; found [1, nan]"),
    ("{ uniform = [1, 2, 3] }",
     ".uniform: must be two numbers, or two lists of numbers of the same length; found [1, 2, 3]"),
    ("{ uniform = [[1, 2], 3] }",
     ".uniform: must be two numbers, or two lists of numbers of the same length; found [[1, 2], 3]"),
    ("{ uniform = [[1, 2], [3]] }",
     ".uniform: must be two numbers, or two lists of numbers of the same length; found [[1, 2], [3]]"),
    ('{ uniform = ["a", true] }',
     '.uniform: must be two numbers, or two lists of numbers of the same length; found ["a", true]'),
    ("{ loguniform = [0, 1] }", ".loguniform: needs bounds greater than 0; found 0"),
    ("{ integers = [1, 2.5] }", ".integers: needs whole numbers; found [1, 2.5]"),
    ("{ choice = [] }", ".choice: must be a list with at least one value; found []"),
    ("{ grid = 3 }", ".grid: must be a list with at least one value; found 3"),
    ("{ normal = [1, 0] }", ".normal: is [mean, standard deviation], and a deviation is greater than 0; found [0]"),
    ("{ normal = [1, 2], within = [3, 2] }", ".within: must be [min, max] around values that occur; found [3, 2]"),
    ("{ normal = [0, 1], within = [50, 60] }",
     ".within: must be [min, max] around values that occur; found [50, 60]"),
    ("{ normal = [0, 1], within = [[1], [2]] }",
     ".within: must be two bounds of the same kind as mean and standard deviation"),
])  # fmt: skip
def test_a_faulty_distribution_is_named(value, sentence):
    assert refusal(varied(f'"time.end" = {value}')) == [f"sweep.toml:6: vary.time.end{sentence}"]


@pytest.mark.parametrize(("line", "sentence"), [
    ('"time.ned" = 0.5', 'time.ned: unknown key; did you mean "end"?'),
    ('"bodies.sand.material.fricton_angle" = { uniform = [20, 30] }',
     'bodies.sand.material.fricton_angle: unknown key; did you mean "friction_angle"?'),
    ('"bodies.snad.velocity" = [1, 0]',
     'bodies.snad.velocity: no entry of bodies has the name "snad"; did you mean "sand"?'),
    ('"bodies.5.velocity" = [1, 0]',
     "bodies.5.velocity: bodies has 2 entries, counted from 0; there is no bodies[5]"),
    ('"time..end" = 1',
     'time..end: "time..end" is not a key; a key is a path such as time.end or bodies[0].velocity'),
    ('"bodies.sand.name" = "a"',
     "bodies.sand.name: vary what a body, a collider or a force holds, such as bodies.NAME.velocity, "
     "and not its name"),
    ('"bodies.sand" = 3', "bodies.sand: vary what a body, a collider or a force holds, such as bodies.NAME.velocity, "
     "and not its name"),
])  # fmt: skip
def test_a_key_that_is_not_in_the_base_scene_is_one_sentence(line, sentence):
    assert refusal(varied(line)) == [f"sweep.toml:6: vary.{sentence}"]


@pytest.mark.parametrize(("line", "sentence"), [
    # Both ends are tried, whatever trajectory 0 draws.
    ('"bodies.sand.material.friction_angle" = { uniform = [-1, 40] }', "must be greater than 0; found -1.0"),
    ('"bodies.sand.material.friction_angle" = { uniform = [20, 95] }', "must be less than 90; found 95.0"),
    ('"time.frames" = { integers = [0, 1000] }', "must be at least 1; found 0"),
    ('"time.frames" = { grid = [9, 8, 7, 6, -5] }', "must be at least 1; found -5"),
    ('"time.end" = { normal = [1, 0.5] }', "must be greater than 0; found -0.5"),
    ('"bodies.stone.velocity" = { uniform = [[0, 0, 0], [1, 1, 1]] }',
     "needs two numbers in this 2D scene (as many as domain.size); found 3"),
    ('"bodies.stone.shape.ball.center.0" = { choice = [0.7, 0.8, 0.95] }',
     'with 0.95: bodies[1].shape: body "stone" leaves the domain through x_max by 0.05 m (it reaches x = 1.05, '
     "the face is at 1); move it or enlarge the domain"),
])  # fmt: skip
def test_values_that_make_no_scene_are_found_before_anything_runs(line, sentence):
    key = line.split('"')[1]
    assert refusal(varied(line)) == [f"sweep.toml:6: vary.{key}: {sentence}"]


def test_a_fault_that_several_bodies_and_values_have_is_said_once():
    two = SWEEP.replace("integers = [1, 3]", "grid = [2]")
    # The bodies of the placement come before the stone and move its index.
    assert refusal(two.replace("uniform = [25, 40]", "choice = [95.0]")) == [
        "sweep.toml:5: vary.bodies.sand.material.friction_angle: must be less than 90; found 95.0"
    ]
    velocities = "{ grid = [[0.0, 0.0], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]] }"
    assert refusal(two.replace("[vary]", f'[vary]\n"bodies.stone.velocity" = {velocities}')) == [
        "sweep.toml:5: vary.bodies.stone.velocity: needs two numbers in this 2D scene (as many as domain.size); found 3"
    ]


def test_two_keys_for_one_value_are_refused():
    lines = '"domain.gravity" = [0.0, -1.0]', '"domain.gravity.1" = -2.0'
    assert refusal(varied(*lines)) == [
        "sweep.toml:7: vary.domain.gravity.1: sets what vary.domain.gravity sets as well; leave one of them out"
    ]
    text = SWEEP.replace("[vary]", '[vary]\n"bodies.0.shape.box.max.0" = 0.25')
    assert refusal(text) == [
        'sweep.toml:5: vary.bodies.0.shape.box.max.0: sets what the placement of "sand" sets as well; leave one of '
        "them out"
    ]


@pytest.mark.parametrize(("old", "new", "sentence"), [
    ('body = "sand"', 'body = "snad"',
     '8: place.body: no body of the base scene has the name "snad"; did you mean "sand"?'),
    ('body = "sand"', 'body = "water"',
     '8: place.body: no body of the base scene has the name "water"; the bodies are "sand" and "stone"'),
    ('body = "sand"', 'body = "stone"', '10: place.size: "stone" is a ball, which has no size; give radius'),
    ("size = ", "radius = 0.1 #", '10: place.radius: "sand" is a box, which has no radius; give size'),
    ("size = ", "size = [0.1] #", "10: place.size: must be two numbers greater than 0; found [0.1]"),
    ("[[0.15, 0.15]", "[[-0.15, 0.15]", "10: place.size: must be two numbers greater than 0; found [-0.15, 0.15]"),
    ("[0.3, 0.3]]", "[0.7, 0.3]]", "10: place.size: must fit into the region, 0.6 x 0.6 m; found 0.7 x 0.3 m"),
    ("integers = [1, 3]", "integers = [0, 3]",
     "9: place.count: must be whole numbers from 1 to 1000, such as { integers = [1, 3] }; found 0"),
    ("integers = [1, 3]", "uniform = [1, 3]",
     "9: place.count: must be whole numbers from 1 to 1000, such as { integers = [1, 3] }; found 1.0"),
    ("min = [0.2, 0.2]", "min = [-0.2, 0.2]",
     "12: place.region: must lie in the domain; found x = -0.2 to 0.8 of 0 to 1 m"),
    ("min = [0.2, 0.2]", "min = [0.9, 0.2]",
     "12: place.region.max: must be above min along x, so that the region holds bodies"),
    ("min_distance = 0.02", "min_distance = -1", "13: place.min_distance: must be at least 0; found -1"),
    ("[-2.5, -2.5], [2.5, 2.5]", "[-2.5], [2.5]",
     "11: place.velocity: needs two numbers in this 2D scene (as many as domain.size); found 1"),
])  # fmt: skip
def test_a_faulty_placement_is_named(old, new, sentence):
    assert old in SWEEP
    assert f"sweep.toml:{sentence}" in refusal(SWEEP.replace(old, new))


def test_placements_of_a_list_have_their_index():
    two = SWEEP.replace("[place]", "[[place]]").replace(
        "[split]", '[[place]]\nbody = "sand"\ncount = 1\nregion = { min = [0, 0], max = [1, 1] }\n[split]'
    )
    assert refusal(two) == ['sweep.toml:15: place[1].body: "sand" is placed already; a template is for one placement']


def test_a_template_is_a_box_or_a_ball():
    base = BASE.replace(
        "box = { min = [0.1, 0.1], max = [0.3, 0.3] }", "polygon = { vertices = [[0.1, 0.1], [0.3, 0.1], [0.2, 0.3]] }"
    )
    assert 'sweep.toml:8: place.body: must be a box or a ball; "sand" is a polygon' in refusal(SWEEP, base)


def test_elastic_bodies_that_would_not_separate_are_refused():
    """With a grid of their own state at rest, unless the scene says that they stick; a single one may have it."""
    two = BASE.replace('{ preset = "sand", friction_angle = 30.0 }', '"jelly"').replace('sampling = "jittered"\n', "")
    total = '[solver]\nsolids = "total"\n'
    said = (
        'elastic bodies would not separate: "sand" and "stone" meet a quarter of a cell early, and slide '
        'on each other without friction; set contact.default = "stick" if this will do, or leave solids out'
    )
    for contact in ("", '[contact]\ndefault = "separate"\n'):
        assert refusal(BARE, two + total + contact) == [f"sweep.toml: trajectory 0: solver.solids: {said}"]
    assert sweep_of(BARE, two + total + '[contact]\ndefault = "stick"\n').count == 1000
    of_one = two[: two.index('[[bodies]]\nname = "stone"')] + total
    assert sweep_of(BARE, of_one).count == 1000
    either = varied('"solver.solids" = { choice = ["updated", "total"] }')
    assert refusal(either, two) == [f"sweep.toml:6: vary.solver.solids: {said}"]


def test_frames_without_particles_that_have_left_are_refused():
    base = BASE.replace("[time]", 'walls = { x_max = "open" }\n[time]') + "[output]\ndrop_retired = true\n"
    assert refusal(BARE, base) == [
        "sweep.toml: trajectory 0: output.drop_retired: a trajectory of a dataset has the same particles in all "
        "frames; leave it out"
    ]


def test_a_faulty_base_scene_speaks_for_itself():
    assert refusal(SWEEP, BASE.replace("end = 0.1", "end = -0.1")) == [
        "base.toml:6: time.end: must be greater than 0; found -0.1"
    ]
    assert refusal(SWEEP, "a = ") == [
        "base.toml:1: not valid TOML: this is not a TOML value; text needs quotes, numbers and lists none"
    ]


def test_a_file_that_cannot_be_read():
    with pytest.raises(InputError) as refused:
        load_sweep("none.toml", laws=LAWS)
    assert str(refused.value) == "none.toml: there is no such file; give the path of a sweep in TOML"
    assert refusal("count = = 3")[0].startswith("sweep.toml:1:9: not valid TOML: ")
    assert refusal(BARE.replace("count = 1000\n", "")) == ["sweep.toml: count: missing key: number of trajectories"]
