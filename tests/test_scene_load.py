"""Bad scenes, each with its sentence: file, line, key path, what is wrong, what would be right."""

import random
import tomllib
from pathlib import Path
from typing import get_args

import pytest

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import LoadedScene, ParticleField, load_scene, parse_scene, scene_to_toml
from mpmcli.scene.sentences import listed, quoted

LAW_NAMES = quoted(sorted(str(model.model_fields["law"].default) for model in parameter_models()))
FIELD_NAMES = quoted(
    list(dict.fromkeys([*get_args(ParticleField), *(v.name for model in parameter_models() for v in model.internal)]))
)

GOOD = """\
title = "Dam break"
[domain]
size = [4.0, 2.0]
spacing = 0.02
gravity = [0.0, -9.81]
[time]
end = 1.5
frames = 150
[[bodies]]
name = "column"
material = { law = "fluid", density = 1000.0, bulk_modulus = "auto" }
shape = { box = { min = [0.0, 0.0], max = [1.0, 1.0] } }
[[bodies]]
name = "drop"
shape.ball = { center = [3.0, 1.0], radius = 0.5 }
[bodies.material]
law = "neo_hookean"
density = 1100
youngs_modulus = 1e5
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Return `load(text, *overrides)`, which loads a file scene.toml that holds the text."""
    monkeypatch.chdir(tmp_path)

    def load(text: str, *overrides: str) -> LoadedScene:
        Path("scene.toml").write_text(text, encoding="utf-8")
        return load_scene("scene.toml", overrides, laws=parameter_models())

    return load


@pytest.fixture
def refusal(load):
    """Return `refusal(text, *overrides)`: the lines with which the scene is refused."""

    def refusal(text: str, *overrides: str) -> list[str]:
        with pytest.raises(InputError) as refused:
            load(text, *overrides)
        return str(refused.value).splitlines()

    return refusal


def test_a_good_scene_is_complete(load):
    scene = load(GOOD).scene
    assert scene.dimension == 2
    assert scene.domain.origin == (0.0, 0.0)
    assert scene.domain.cells == (200, 100)
    assert scene.domain.walls.faces(2) == (("separate", "separate"), ("separate", "separate"))
    assert scene.time.step == "auto" and scene.time.safety == 0.8
    assert [body.particles_per_cell for body in scene.bodies] == [4, 4]
    assert scene.bodies[1].velocity == (0.0, 0.0)
    assert scene.bodies[1].material.density == 1100.0
    assert scene.output.fields == ("velocity", "density", "pressure")
    assert scene.solver.precision == "f32"


def test_auto_is_resolved_and_said(load):
    loaded = load(GOOD)
    # v^2 = 2 g H with H = 1.5 m, the top of the drop, which is denser than the column; K = density v^2 / 1 %.
    assert loaded.scene.bodies[0].material.bulk_modulus == pytest.approx(1100 * 2 * 9.81 * 1.5 / 0.01)
    assert len(loaded.notes) == 1 and loaded.notes[0].startswith("column: bulk_modulus = ")
    assert loaded.source == "scene.toml"


def test_three_numbers_make_a_3d_scene(load):
    scene = load(
        """
        domain = { size = [1, 1, 2], cells = [10, 10, 20], walls = { default = "slip", z_min = "stick" } }
        time = { end = 1, frames = 1 }
        [[bodies]]
        name = "b"
        material = { law = "fluid", density = 1 }
        shape = { cylinder = { base = [0.5, 0.5, 0], axis = [0, 0, 1], radius = 0.2, height = 1 } }
        """
    ).scene
    assert scene.dimension == 3
    assert scene.domain.spacing == 0.1
    assert scene.domain.walls.faces(3) == (("slip", "slip"), ("slip", "slip"), ("stick", "slip"))
    assert scene.bodies[0].particles_per_cell == 8


# What is replaced in GOOD, by what, and the one line that answers.
REPLACED = [
    (
        "density = 1000.0",
        "densty = 1000.0",
        '11: bodies[0].material.densty: unknown key; did you mean "density"?',
    ),
    (
        "end = 1.5",
        "end = 1.5\nduration = 3",
        "8: time.duration: unknown key; the keys here are end, frames, safety and step",
    ),
    ("end = 1.5", "end = 1.5\nspacing = 3", "8: time.spacing: unknown key here; it belongs to [domain]"),
    ("[time]", "[tme]", '6: tme: unknown key; did you mean "time"?'),
    ("end = 1.5\n", "", "6: time.end: missing key: Simulated time, s; the scene starts at 0"),
    ("end = 1.5", 'end = "1.5"', '7: time.end: must be a number; found "1.5"'),
    ("end = 1.5", "end = true", "7: time.end: must be a number; found true"),
    ("end = 1.5", "end = inf", "7: time.end: must be a finite number; found inf"),
    ("end = 1.5", "end = 1979-05-27", "7: time.end: must be a number; found 1979-05-27"),
    ("end = 1.5", "end = 0", "7: time.end: must be greater than 0; found 0"),
    ("end = 1.5", "end = 1\nsafety = 1.5", "8: time.safety: must be at most 1; found 1.5"),
    ("end = 1.5", "end = 1\nstep = 0", '8: time.step: must be greater than 0 or "auto"; found 0'),
    (
        "end = 1.5",
        'end = 1\nstep = "atuo"',
        '8: time.step: must be a number or "auto"; found "atuo"; did you mean "auto"?',
    ),
    ("end = 1.5", "end = 1\nsafety = 0", "8: time.safety: must be greater than 0; found 0"),
    (
        "end = 1.5",
        "end = 1e16",
        "7: time.end: is beyond what can be computed with, 1e+15 at most; found 1e+16",
    ),
    (
        "end = 1.5",
        "end = 1e-16",
        "7: time.end: is below what can be computed with, 1e-15 at least; found 1e-16",
    ),
    ("frames = 150", "frames = 0", "8: time.frames: must be at least 1; found 0"),
    ("frames = 150", "frames = 1.5", "8: time.frames: must be a whole number; found 1.5"),
    (
        "density = 1000.0",
        "density = -1000.0",
        "11: bodies[0].material.density: must be greater than 0; found -1000.0",
    ),
    (
        "density = 1000.0",
        'density = "1000"',
        '11: bodies[0].material.density: must be a number; found "1000"',
    ),
    (
        "youngs_modulus = 1e5\n",
        "",
        "16: bodies[1].material.youngs_modulus: missing key: Young's modulus E, Pa; or its knob springiness, 0 to 1",
    ),
    (
        'bulk_modulus = "auto"',
        "bulk_modulus = -1",
        '11: bodies[0].material.bulk_modulus: must be greater than 0 or "auto"; found -1',
    ),
    (
        '"neo_hookean"',
        '"neo_hokean"',
        '17: bodies[1].material.law: unknown law "neo_hokean"; did you mean "neo_hookean"? '
        f"The laws are {listed(LAW_NAMES, 'and')}",
    ),
    (
        'law = "neo_hookean"\n',
        "",
        f"16: bodies[1].material.law: missing key: the constitutive law, {listed(LAW_NAMES)}; or a preset, "
        '"water", "honey", "lava", "mud", "jelly", "rubber", "snow", "sand", "clay" or "metal"',
    ),
    ("size = [4.0, 2.0]", "size = [4.0]", "3: domain.size: needs two numbers (2D) or three (3D); found 1"),
    ("size = [4.0, 2.0]", "size = 4.0", "3: domain.size: must be a list in brackets; found 4.0"),
    ("size = [4.0, 2.0]", 'size = [4.0, "2"]', '3: domain.size[1]: must be a number; found "2"'),
    (
        "gravity = [0.0, -9.81]",
        "gravity = [0.0, 0.0, -9.81]",
        "5: domain.gravity: needs two numbers in this 2D scene (as many as domain.size); found 3",
    ),
    (
        "center = [3.0, 1.0]",
        "center = [3.0, 1.0, 0.0]",
        "15: bodies[1].shape.ball.center: needs two numbers in this 2D scene (as many as domain.size); found 3",
    ),
    (
        "spacing = 0.02",
        "spacing = 0.03",
        "3: domain.size: must be a whole number of cells of spacing 0.03 m: 4 m is 133.333 cells along x, "
        "3.99 or 4.02 m would fit; 2 m is 66.6667 cells along y, 1.98 or 2.01 m would fit",
    ),
    (
        "spacing = 0.02\n",
        "",
        '2: domain: missing key "spacing" (m), or "cells" (a number per axis) in its place',
    ),
    (
        "spacing = 0.02",
        "spacing = 0.02\ncells = [200, 100]",
        '5: domain.cells: "spacing" is given as well; leave one of them out',
    ),
    (
        "spacing = 0.02",
        "cells = [200, 90]",
        "4: domain.cells: must make square cells; found 0.02 m along x, 0.0222222 m along y; "
        "nearest to the size is [200, 100]",
    ),
    ("spacing = 0.02", "cells = [200]", "4: domain.cells: needs two numbers, as domain.size has; found 1"),
    (
        "spacing = 0.02",
        "spacing = 1e-12",
        "4: domain.spacing: makes more than 2147483647 cells along an axis; make it coarser",
    ),
    (
        "[time]",
        'walls = "slippery"\n[time]',
        '6: domain.walls: must be "slip", "stick" or "separate", or a table with one of them per face; '
        'found "slippery"',
    ),
    (
        "[time]",
        '[domain.walls]\nx_min = "stik"\n[time]',
        '7: domain.walls.x_min: must be "slip", "stick" or "separate"; found "stik"; did you mean "stick"?',
    ),
    (
        "[time]",
        '[domain.walls]\nz_min = "stick"\n[time]',
        "7: domain.walls.z_min: is a face of a 3D scene and this one is 2D; leave it out",
    ),
    ("ball = {", "bal = {", '15: bodies[1].shape.bal: unknown key; did you mean "ball"?'),
    (
        "[bodies.material]",
        "shape.box = { min = [3, 1], max = [4, 2] }\n[bodies.material]",
        "15: bodies[1].shape: needs exactly one of box, ball, cylinder, polygon; found box and ball",
    ),
    (
        "shape.ball = { center = [3.0, 1.0], radius = 0.5 }",
        "shape = {}",
        "15: bodies[1].shape: needs exactly one of box, ball, cylinder, polygon; found none",
    ),
    (
        "shape.ball = {",
        "shape.cylinder = {",
        "15: bodies[1].shape.cylinder: is a shape of 3D scenes and this one is 2D; use box, ball or polygon",
    ),
    (
        "max = [1.0, 1.0]",
        "max = [1.0, 0.0]",
        "12: bodies[0].shape.box.max: must be above min along y, so that the box holds matter",
    ),
    (
        "ball = { center = [3.0, 1.0], radius = 0.5 }",
        "polygon.vertices = [\n  [2, 1], [3, 2],\n  [3, 1],\n  [2, 2]]",
        "15: bodies[1].shape.polygon.vertices: the edges after vertices 0 and 2 cross or touch: "
        "list the vertices in order round the outline",
    ),
    (
        "ball = { center = [3.0, 1.0], radius = 0.5 }",
        'polygon.vertices = [\n  [2, 1], [3, 1],\n  [3, "2"],\n  [2, 2]]',
        '17: bodies[1].shape.polygon.vertices[2][1]: must be a number; found "2"',
    ),
    (
        "max = [1.0, 1.0]",
        "max = [1.0, 2.05]",
        '12: bodies[0].shape: body "column" leaves the domain through y_max by 0.05 m '
        "(it reaches y = 2.05, the face is at 2); move it or enlarge the domain",
    ),
    (
        "center = [3.0, 1.0]",
        "center = [1.2, 1.0]",
        '15: bodies[1].shape: body "drop" overlaps body "column", for example at [0.702459, 0.9525]; '
        "bodies may touch but not overlap",
    ),
    (
        '"drop"',
        '"column"',
        '14: bodies[1].name: "column" is the name of bodies[0] already; every body needs its own',
    ),
    (
        '"drop"',
        '"a.b"',
        '14: bodies[1].name: must begin with a letter and hold only letters, digits, spaces, - and _; found "a.b"',
    ),
    (
        'name = "drop"',
        'name = "drop"\nparticles_per_cell = 5',
        "15: bodies[1].particles_per_cell: must be a square number for a lattice in 2D, for example 4 or 9; "
        'found 5. With sampling = "jittered" any number will do',
    ),
    (
        'name = "drop"',
        'name = "drop"\nvelocity_gradient = [[1, 2]]',
        "15: bodies[1].velocity_gradient: needs two numbers in this 2D scene (as many as domain.size); found 1",
    ),
    (
        'name = "drop"',
        'name = "drop"\nvelocity = []',
        "15: bodies[1].velocity: needs two numbers in this 2D scene (as many as domain.size); found 0",
    ),
    (
        "[time]",
        '[output]\nfields = ["pressur"]\n[time]',
        f'7: output.fields[0]: must be {listed(FIELD_NAMES)}; found "pressur"; did you mean "pressure"?',
    ),
    (
        "[time]",
        '[output]\nfields = ["mass", "mass"]\n[time]',
        '7: output.fields: lists "mass" more than once; once is enough',
    ),
    (
        "[time]",
        '[output]\nfields = [\n  "mass",\n  "plastic_strain"]\n[time]',
        '9: output.fields[1]: no body of this 2D scene stores "plastic_strain"; it can store velocity, density, '
        "pressure, volume_ratio, deformation_gradient, affine, stress, mass and initial_position",
    ),
    ("[time]", "[output]\ncompress = 1\n[time]", "7: output.compress: must be true or false; found 1"),
    (
        "spacing = 0.02",
        "spacing =",
        "4:10: not valid TOML: this is no TOML value; text needs quotes, numbers and lists none",
    ),
    (
        "box = { min",
        "box = {\nmin",
        "12:18: not valid TOML: expected a key; a table in { } stands on one line",
    ),
    ("spacing = 0.02", "spacing 0.02", "4:9: not valid TOML: expected key = value"),
]


@pytest.mark.parametrize(("good", "bad", "line"), REPLACED, ids=[line.split(":", 2)[-1][:50] for *_, line in REPLACED])
def test_each_bad_scene_has_its_sentence(refusal, good, bad, line):
    assert good in GOOD
    assert refusal(GOOD.replace(good, bad)) == [f"scene.toml:{line}"]


def test_all_errors_come_at_once_in_the_order_of_the_file(refusal):
    text = (
        GOOD.replace("size = [4.0, 2.0]", "size = [4.0]")
        .replace("end = 1.5", 'end = "long"')
        .replace("frames = 150", "frames = 0")
        .replace("density = 1000.0", "densty = -1000.0")
        .replace("radius = 0.5", "radius = -0.5")
    )
    assert refusal(text) == [
        "scene.toml:3: domain.size: needs two numbers (2D) or three (3D); found 1",
        'scene.toml:7: time.end: must be a number; found "long"',
        "scene.toml:8: time.frames: must be at least 1; found 0",
        'scene.toml:11: bodies[0].material.densty: unknown key; did you mean "density"?',
        "scene.toml:11: bodies[0].material.densty: must be greater than 0; found -1000.0",
        "scene.toml:15: bodies[1].shape.ball.radius: must be greater than 0; found -0.5",
    ]


def test_a_misspelled_key_does_not_hide_what_only_the_whole_scene_shows(refusal):
    lines = refusal(GOOD.replace("gravity", "gravty").replace("radius = 0.5", "radius = 1.25"))
    assert lines[0] == 'scene.toml:5: domain.gravty: unknown key; did you mean "gravity"?'
    assert lines[1].startswith('scene.toml:15: bodies[1].shape: body "drop" leaves the domain through x_max by 0.25 m')
    assert " and y_min by 0.25 m" in lines[1] and " and y_max by 0.25 m" in lines[1]
    assert len(lines) == 2


def test_missing_tables_and_no_bodies(refusal):
    assert refusal("") == [
        "scene.toml: domain: missing key: The box that the scene lives in, and its grid",
        "scene.toml: time: missing key: How long, how many frames, which steps",
        "scene.toml: bodies: missing key: The bodies, at least one",
    ]
    head = GOOD[: GOOD.index("[[bodies]]")]
    assert refusal("bodies = []\n" + head) == ["scene.toml:1: bodies: needs at least 1 entry; found 0"]


def test_a_sliver_without_particles_is_refused(refusal):
    # Thinner than a hair, and passing between the points of the lattice.
    sliver = "polygon.vertices = [[2.5, 1.0], [3.5, 1.02], [2.5, 1.00001]]\n"
    (line,) = refusal(GOOD.replace("ball = { center = [3.0, 1.0], radius = 0.5 }\n", sliver))
    assert line == (
        'scene.toml:15: bodies[1].shape: body "drop" is too thin to hold a particle: its particles would be '
        "0.01 m apart; make it thicker, or the grid finer"
    )


def test_windows_files_are_read(load, tmp_path):
    (tmp_path / "windows.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    windows = load_scene(tmp_path / "windows.toml", laws=parameter_models()).scene
    assert windows == load(GOOD).scene


def test_files_that_are_no_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("directory").mkdir()
    Path("result").mkdir()
    Path("result/scene.toml").write_text(GOOD)
    Path("binary").write_bytes(b"title = \xff")
    for path, sentence in {
        "nope.toml": "nope.toml: there is no such file; give the path of a scene in TOML",
        "directory": "directory: this is a directory; give the path of a scene in TOML",
        "result": "result: this is a directory; did you mean result/scene.toml?",
        "binary": "binary: this is no text in UTF-8 (byte 8 is 0xff); give a scene in TOML",
    }.items():
        with pytest.raises(InputError) as refused:
            load_scene(path, laws=parameter_models())
        assert str(refused.value) == sentence
        assert refused.value.exit_code == 2


def test_toml_that_python_cannot_hold(refusal):
    for text in ("a = " + "9" * 5000, "a = " + "[" * 5000):
        (line,) = refusal(text)
        assert line == "scene.toml: not valid TOML: a number is too long or lists are too deep"
    assert refusal("a = [1") == ["scene.toml:1: not valid TOML: a list is not closed with ]"]


def test_a_scene_without_a_file_has_no_lines():
    with pytest.raises(InputError) as refused:
        parse_scene({"time": {"end": 1, "frames": 2}, "bodies": [3]}, laws=parameter_models(), source="case")
    assert str(refused.value).splitlines() == [
        "case: domain: missing key: The box that the scene lives in, and its grid",
        "case: bodies[0]: must be a table; found 3",
    ]


def test_whatever_is_damaged_the_answer_is_sentences_or_a_scene():
    """Deletions, misspellings and odd values anywhere: only InputError, and every line has its place."""
    odd = [
        0,
        -1,
        1e308,
        10**400,
        float("nan"),
        "x",
        "auto",
        "",
        True,
        [],
        [1],
        [1, 2, 3],
        {},
        {"a": 1},
        [[1, 2]],
        [{}],
    ]
    rng = random.Random(1)
    refused = 0
    presets = GOOD + '[[bodies]]\nname = "mud"\nmaterial = "mud"\nshape.ball = { center = [2, 0.3], radius = 0.1 }\n'
    presets += '[[bodies]]\nname = "honey"\nshape.ball = { center = [2, 0.6], radius = 0.1 }\n'
    presets += 'material = { preset = "honey", density = 1400, thickness = 0.5, stiffness = 1 }\n'
    for _ in range(1000):
        data = tomllib.loads(presets)
        for _ in range(rng.randint(1, 3)):
            table, key = rng.choice(list(places(data)))
            damage = rng.random()
            if damage < 0.2:
                del table[key]
            elif damage < 0.4 and isinstance(table, dict):
                table[f"{key}s"] = table.pop(key)
            else:
                table[key] = rng.choice(odd)
        try:
            scene_to_toml(parse_scene(data, laws=parameter_models()).scene)
        except InputError as error:
            refused += 1
            assert all(line.startswith("<scene>: ") for line in str(error).splitlines())
    assert refused > 800


def places(data):
    """Yield every (table or list, key or index) of parsed TOML."""
    for key in data if isinstance(data, dict) else range(len(data)):
        yield data, key
        if isinstance(data[key], dict | list):
            yield from places(data[key])
