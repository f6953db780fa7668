"""Loading scenes: what is filled in, which files are none, and that all faults are told at once."""

import random
import tomllib
from pathlib import Path

import pytest
from good_scene import GOOD, load, refusal

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import load_scene, parse_scene, scene_to_toml


@pytest.fixture(autouse=True)
def empty_directory(tmp_path, monkeypatch):
    """Scenes are loaded from the present directory, and named as they lie there."""
    monkeypatch.chdir(tmp_path)


def test_a_good_scene_is_complete():
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


def test_auto_is_resolved_and_said():
    loaded = load(GOOD)
    # v^2 = 2 g H with H = 1.5 m, the top of the drop, which is denser than the column; K = density v^2 / 1 %.
    assert loaded.scene.bodies[0].material.bulk_modulus == pytest.approx(1100 * 2 * 9.81 * 1.5 / 0.01)
    assert len(loaded.notes) == 1 and loaded.notes[0].startswith("column: bulk_modulus = ")
    assert loaded.source == "scene.toml"


def test_three_numbers_make_a_3d_scene():
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


def test_all_errors_come_at_once_in_the_order_of_the_file():
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
        "scene.toml:15: bodies[1].shape.ball.radius: must be greater than 0; found -0.5",
    ]


def test_a_misspelled_key_does_not_hide_what_only_the_whole_scene_shows():
    lines = refusal(GOOD.replace("gravity", "gravty").replace("radius = 0.5", "radius = 1.25"))
    assert lines[0] == 'scene.toml:5: domain.gravty: unknown key; did you mean "gravity"?'
    assert lines[1].startswith('scene.toml:15: bodies[1].shape: body "drop" leaves the domain through x_max by 0.25 m')
    assert " and y_min by 0.25 m" in lines[1] and " and y_max by 0.25 m" in lines[1]
    assert len(lines) == 2


def test_missing_tables_and_no_bodies():
    assert refusal("") == [
        "scene.toml: domain: missing key: the box of the scene, and its grid",
        "scene.toml: time: missing key: simulated time, frames and time step",
    ]
    head = GOOD[: GOOD.index("[[bodies]]")]
    none = "bodies: needs at least one entry, or emitters or rigid bodies (colliders with a density)"
    assert refusal("bodies = []\n" + head) == [f"scene.toml:1: {none}"] and refusal(head) == [f"scene.toml: {none}"]


def test_a_sliver_without_particles_is_refused():
    # Thinner than a hair, and passing between the points of the lattice.
    sliver = "polygon.vertices = [[2.5, 1.0], [3.5, 1.02], [2.5, 1.00001]]\n"
    (line,) = refusal(GOOD.replace("ball = { center = [3.0, 1.0], radius = 0.5 }\n", sliver))
    assert line == (
        'scene.toml:15: bodies[1].shape: body "drop" is too thin to hold a particle: its particles would be '
        "0.01 m apart; make it thicker, or the grid finer"
    )


def test_windows_files_are_read():
    Path("windows.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    windows = load_scene("windows.toml", laws=parameter_models()).scene
    assert windows == load(GOOD).scene


def test_files_that_are_no_scene():
    Path("directory").mkdir()
    Path("result").mkdir()
    Path("result/scene.toml").write_text(GOOD)
    Path("binary").write_bytes(b"title = \xff")
    for path, sentence in {
        "nope.toml": "nope.toml: there is no such file; give the path of a scene in TOML",
        "directory": "directory: this is a directory; give the path of a scene in TOML",
        "result": "result: this is a directory; did you mean result/scene.toml?",
        "binary": "binary: this is not text in UTF-8 (byte 8 is 0xff); give a scene in TOML",
    }.items():
        with pytest.raises(InputError) as refused:
            load_scene(path, laws=parameter_models())
        assert str(refused.value) == sentence
        assert refused.value.exit_code == 2


def test_toml_that_python_cannot_hold():
    for text in ("a = " + "9" * 5000, "a = " + "[" * 5000):
        (line,) = refusal(text)
        assert line == "scene.toml: not valid TOML: a number is too long or lists are too deep"
    assert refusal("a = [1") == ["scene.toml:1: not valid TOML: a list is not closed with ]"]


def test_a_scene_without_a_file_has_no_lines():
    with pytest.raises(InputError) as refused:
        parse_scene({"time": {"end": 1, "frames": 2}, "bodies": [3]}, laws=parameter_models(), source="case")
    assert str(refused.value).splitlines() == [
        "case: domain: missing key: the box of the scene, and its grid",
        "case: bodies[0]: must be a table; found 3",
    ]


def test_whatever_is_damaged_the_answer_is_sentences_or_a_scene():
    """Deletions, misspellings and odd values anywhere: only InputError, and every line has its place."""
    odd = [0, -1, 1e308, 10**400, float("nan"), "x", "auto", "", True, [], [1], [1, 2, 3], {}, {"a": 1}, [[1, 2]], [{}]]
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


def test_the_copy_of_a_scene_finds_the_files_of_the_original(tmp_path: Path) -> None:
    """A result has a copy of its scene; what that names is relative to the scene that was run."""
    first, second = (tmp_path / name / "scene.toml" for name in ("here", "there"))
    text = 'domain = { size = [1, 1], spacing = 0.1 }\ntime = { end = 1, frames = 1 }\n[[bodies]]\nname = "a"\n'
    text += 'material = "water"\nshape = { points = { file = "a.csv", spacing = 0.05 } }\n'
    for path in (first, second):
        path.parent.mkdir()
        path.write_text(text)
    (tmp_path / "here" / "a.csv").write_text("x,y\n0.5,0.5\n")
    with pytest.raises(InputError, match="no such file"):
        load_scene(second, laws=parameter_models())
    loaded = load_scene(second, laws=parameter_models(), original=first)
    assert loaded.source == str(first) and loaded.scene == load_scene(first, laws=parameter_models()).scene
