"""`--set KEY=VALUE`: which value it replaces, and what is said where it cannot."""

import pytest
from scenes import block

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene
from mpmcli.scene.toml_file import apply_overrides

DATA = {
    "title": "t",
    "time": {"end": 1.0, "frames": 2},
    "domain": {"size": [1, 1], "spacing": 0.1},
    "bodies": [block("column", {"law": "fluid", "density": 1000}, [0, 0], [0.5, 0.5])],
}


@pytest.mark.parametrize(("override", "path", "value"), [
    ("time.end=0.5", ("time", "end"), 0.5),
    (" time.end = 0.5 ", ("time", "end"), 0.5),
    ("title=a new title", ("title",), "a new title"),
    ('title="x = y"', ("title",), "x = y"),
    ("solver.precision=f64", ("solver", "precision"), "f64"),
    ("bodies.0.velocity=[1, 0]", ("bodies", 0, "velocity"), [1, 0]),
    ("bodies[0].velocity=[1, 0]", ("bodies", 0, "velocity"), [1, 0]),
    ("bodies.column.velocity=[1, 0]", ("bodies", 0, "velocity"), [1, 0]),
    ("bodies.column.velocity.1=-2.0", ("bodies", 0, "velocity"), [0, -2]),
    ("domain.gravity[1]=-9.81", ("domain", "gravity"), [0, -9.81]),
    ("bodies.column.shape.box.max[1]=0.25", ("bodies", 0, "shape", "box", "max", 1), 0.25),
    ("domain.walls={default = 'slip'}", ("domain", "walls"), {"default": "slip"}),
    ("output.compress=true", ("output", "compress"), True),
])  # fmt: skip
def test_an_override_sets_one_value(override, path, value):
    data, placed = apply_overrides(DATA, [override])
    at = data
    for part in path:
        at = at[part]
    assert at == value
    (place,) = placed
    assert place[: len(path)] == path and placed[place] == f"--set {override}"
    assert DATA["time"]["end"] == 1.0 and "velocity" not in DATA["bodies"][0]


def test_later_overrides_see_earlier_ones():
    data, _ = apply_overrides(
        DATA, ["bodies.column.name=water", "bodies.water.velocity=[1,1]", "time.end=3", "time.end=4"]
    )
    assert data["bodies"][0]["name"] == "water" and data["bodies"][0]["velocity"] == [1, 1]
    assert data["time"]["end"] == 4


@pytest.mark.parametrize(("override", "sentence"), [
    ("time.end", "an override is KEY=VALUE, for example time.end=0.5; the = is missing"),
    ("=3", '"" is not a key; a key is a path such as time.end or bodies[0].velocity'),
    (".".join("a" * 61) + "=3", f'"{"a." * 20}..." has 61 parts, and no value of a scene lies so deep'),
    ("time..end=3", '"time..end" is not a key; a key is a path such as time.end or bodies[0].velocity'),
    ("time.end=", "nothing is not a TOML value; write a number, a list or a word, or text in quotes"),
    ("time.end=[1", "[1 is not a TOML value; write a number, a list or a word, or text in quotes"),
    ("time.end=1\ntitle=2", "1\ntitle=2 is not a TOML value; write a number, a list or a word, or text in quotes"),
    ("bodies.colum.velocity=1", 'no entry of bodies has the name "colum"; did you mean "column"?'),
    ("bodies.x.velocity=1", 'no entry of bodies has the name "x"; the names are column'),
    ("bodies.1.velocity=1", "bodies has 1 entry, counted from 0; there is no bodies[1]"),
    ("bodies.0.velocity.2=1", "bodies[0].velocity has 2 entries, counted from 0; there is no bodies[0].velocity[2]"),
    ("domain.size.x=1", 'domain.size is a list: give an index, domain.size[0], for "x"'),
    ("title.a=1", 'title is "t" and holds no a; replace it as a whole, title={a = ...}'),
])  # fmt: skip
def test_an_override_that_fits_nowhere(override, sentence):
    with pytest.raises(InputError) as refused:
        apply_overrides(DATA, [override])
    assert str(refused.value) == f"--set {override}: {sentence}"


def test_all_bad_overrides_are_named():
    with pytest.raises(InputError) as refused:
        apply_overrides(DATA, ["time.end", "time.frames=3", "bodies.9.name=a"])
    assert [line.split(":")[0] for line in str(refused.value).splitlines()] == [
        "--set time.end",
        "--set bodies.9.name=a",
    ]


def test_validation_names_the_override_as_the_place():
    with pytest.raises(InputError) as refused:
        parse_scene(DATA, laws=parameter_models(), overrides=["time.ned=0.5", "bodies.column.velocity=[1]"])
    assert str(refused.value).splitlines() == [
        '--set time.ned=0.5: time.ned: unknown key; did you mean "end"?',
        "--set bodies.column.velocity=[1]: bodies[0].velocity: needs two numbers in this 2D scene "
        "(as many as domain.size); found 1",
    ]
    assert parse_scene(DATA, laws=parameter_models(), overrides=["time.end=0.5"]).scene.time.end == 0.5
