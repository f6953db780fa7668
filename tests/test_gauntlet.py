"""The ordinary scenes of tests/gauntlet: they load, check finds no error, and the page shows each of them."""

import re
import tomllib

import pytest
from command import ROOT

from mpmcli.check.finding import passes
from mpmcli.check.scene_check import check_scene
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import load_scene
from mpmcli.scene.expression_reader import parse

FOLDER = ROOT / "tests" / "gauntlet"
KNOWN = FOLDER / "known.toml"
SCENES = sorted(path.stem for path in FOLDER.glob("*.toml") if path != KNOWN)
PAGE = (ROOT / "docs" / "gauntlet.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_loads_and_check_finds_no_error(name: str) -> None:
    assert passes(check_scene(load_scene(FOLDER / f"{name}.toml", laws=parameter_models())).findings)


def test_a_known_answer_is_of_a_scene_and_a_thing_in_it() -> None:
    for answer in tomllib.loads(KNOWN.read_text(encoding="utf-8"))["answer"]:
        scene = load_scene(FOLDER / f"{answer['scene']}.toml", laws=parameter_models()).scene
        things = {one.name for one in (*scene.sources, *scene.colliders)}
        observed = scene.error_bars.observe if scene.error_bars else {}
        assert answer["observable"].partition(".")[0] in things | observed.keys()
        assert isinstance(parse(answer["value"], ()), float)
        assert max([answer["at"]] if isinstance(answer["at"], float) else answer["at"]) <= scene.time.end


def test_the_page_has_a_row_and_a_small_picture_of_each_scene() -> None:
    assert sorted(re.findall(r"^\| \[`(\w+)`\]", PAGE, re.MULTILINE)) == SCENES
    for name in SCENES:
        assert f"(pictures/gauntlet/{name}.webp)" in PAGE
        assert (ROOT / "docs" / "pictures" / "gauntlet" / f"{name}.webp").stat().st_size <= 15_000
