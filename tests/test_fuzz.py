"""Damaged scenes and sweeps: a short form of scripts/fuzz, and that it finds what is planted."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import tomli_w
from conftest import ROOT
from fuzzing.from_schema import scene_of
from fuzzing.outcome import fault_of
from fuzzing.targets import TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st

FUZZ = ROOT / "scripts" / "fuzz"
PLANTS = """\
import ctypes, os, sys
sys.path.insert(0, {tests!r})
import click
from pathlib import Path
from fuzzing import campaign, outcome
from fuzzing.targets import Input

@click.command()
@click.argument("what")
def plant(what):
    if what == "error":
        raise KeyError(what)
    if what == "crash":
        ctypes.string_at(0)
    if what == "memory":
        bytearray(2**30 + 2**20)
    if what == "escape":
        print("\\x1b[31m")
    while what == "hang":
        pass

outcome.OWN["plant"] = plant
campaign.MOST_SECONDS = 0.2
plants = "fine", "error", "crash", "memory", "escape", "hang", "fine"
given = tuple(Input({{}}, (("plant", what),)) for what in plants)
run = campaign.Campaign("plants", 0, 0, len(given), Path("place"), Path("found"), given)
run.directory.mkdir()
run.run()
print(run.done, sorted(run.faults))
"""


def test_a_few_inputs_of_each_target(run_module: Callable, tmp_path: Path) -> None:
    done = run_module(FUZZ, "--count", 5, "--seed", 0, "--findings", tmp_path / "found")
    assert done.status == 0, done.stdout + done.stderr
    assert done.stdout.count(": 5 inputs") == len(TARGETS)


def test_every_forbidden_outcome_is_noticed(run_python: Callable, tmp_path: Path) -> None:
    done = run_python(PLANTS.format(tests=str(ROOT / "tests")))
    kinds = ["KeyError in ?", "MemoryError in ?", "control character", "crash SIGSEGV", "hang, killed"]
    assert done.stdout.strip() == f"7 {kinds}"


@settings(derandomize=True, max_examples=40)
@given(st.randoms(use_true_random=False))
def test_scenes_that_follow_the_schema(rng: Random) -> None:
    with suppress(TypeError, ValueError), TemporaryDirectory() as place:
        # What TOML cannot hold is no scene.
        text = tomli_w.dumps(scene_of(rng)).encode()
        scene = Path(place) / "scene.toml"
        scene.write_bytes(text)
        fault = fault_of(["check", scene])
        assert fault is None, fault.detail
