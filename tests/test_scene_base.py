"""Scenes that begin with another one."""

from pathlib import Path

import pytest

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, load_scene, scene_to_toml

BASE = """\
title = "two"
domain = { size = [4.0, 2.0], spacing = 0.01, gravity = [0.0, -9.81] }
time = { end = 1.5, frames = 150 }
[[bodies]]
name = "column"
material = "water"
shape = { box = { min = [0.0, 0.0], max = [1.0, 1.0] } }
[[bodies]]
name = "drop"
material = { preset = "jelly", density = 500.0 }
shape = { ball = { center = [3.0, 1.0], radius = 0.5 } }
[[forces]]
acceleration = [1.0, 0.0]
"""


@pytest.fixture
def scene(tmp_path: Path):
    (tmp_path / "base.toml").write_text(BASE, encoding="utf-8")

    def made(text: str, name: str = "scene.toml") -> Scene:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
        return load_scene(tmp_path / name, laws=parameter_models()).scene

    return made


def same(one: Scene, other: Scene) -> bool:
    return scene_to_toml(one) == scene_to_toml(other)


def test_without_changes_it_is_the_base(scene) -> None:
    assert same(scene('base = "base.toml"\n'), scene(BASE))


def test_tables_are_merged_and_entries_by_their_names(scene) -> None:
    changed = scene(
        'base = "base.toml"\ntitle = "changed"\n[domain]\ncells = [200, 100]\n[time]\nend = 3.0\n'
        '[[bodies]]\nname = "drop"\nvelocity = [0.0, -2.0]\nmaterial = { density = 800.0 }\n'
        '[[bodies]]\nname = "stone"\nmaterial = "sand"\nshape = { ball = { center = [2.0, 1.5], radius = 0.2 } }\n'
        "[[forces]]\nacceleration = [0.0, 1.0]\n"
    )
    whole = (
        BASE.replace('"two"', '"changed"')
        .replace("spacing = 0.01", "cells = [200, 100]")
        .replace("end = 1.5", "end = 3.0")
    )
    whole = whole.replace("density = 500.0 }", "density = 800.0 }\nvelocity = [0.0, -2.0]")
    whole += '[[forces]]\nacceleration = [0.0, 1.0]\n[[bodies]]\nname = "stone"\nmaterial = "sand"\n'
    whole += "shape = { ball = { center = [2.0, 1.5], radius = 0.2 } }\n"
    assert same(changed, scene(whole))


def test_shapes_and_materials_of_another_kind_replace_those_of_the_base(scene) -> None:
    changed = scene(
        'base = "base.toml"\n[[bodies]]\nname = "drop"\nmaterial = { preset = "rubber" }\n'
        "shape = { box = { min = [2.5, 0.5], max = [3.0, 1.0] } }\n"
    )
    assert changed.bodies[1].material.density == scene(BASE.replace('"water"', '"rubber"')).bodies[0].material.density
    assert changed.bodies[1].shape.ball is None


def test_what_has_a_name_is_removed_and_bases_have_bases(scene) -> None:
    scene('base = "../base.toml"\nremove = ["column"]\n', "inner/one.toml")
    two = scene('base = "inner/one.toml"\n[time]\nframes = 3\n')
    assert [body.name for body in two.bodies] == ["drop"] and two.time.frames == 3


def test_files_are_found_where_the_base_is(scene, tmp_path: Path) -> None:
    points = BASE.replace("ball = { center = [3.0, 1.0], radius = 0.5 }", 'points = { file = "p.csv", spacing = 0.01 }')
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "p.csv").write_text("x,y\n3.0,1.0\n3.01,1.0\n", encoding="utf-8")
    scene(points, "inner/base.toml")
    assert len(scene('base = "inner/base.toml"\n').bodies[1].shape.form.position) == 2


@pytest.mark.parametrize(("text", "said"), [
    ('remove = ["drop"]\n', "base: missing key: the scene whose names `remove` leaves out"),
    ("base = 3\n", "base: must be the path of a scene in quotes; found 3"),
    ('base = "a\\u0000b"\n', "base: must be the path of a scene in quotes; found 'a\\x00b'"),
    ('base = "nowhere.toml"\n', "there is no such file"),
    ('base = "scene.toml"\n', "base: scene.toml has this scene as its base in turn"),
    ('base = "base.toml"\nremove = ["dorp"]\n', 'remove: nothing has the name "dorp"; did you mean "drop"?'),
    ('base = "base.toml"\nremove = "drop"\n', "remove: must be a list of names in quotes; found 'drop'"),
    ('base = "base.toml"\n[time]\nend = -1\n', "time.end: must be greater than 0; found -1"),
])  # fmt: skip
def test_each_bad_one_has_its_sentence(scene, text: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        scene(text)
    assert said in str(error.value) and len(str(error.value).splitlines()) == 1
