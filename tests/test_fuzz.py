"""Damaged input of every kind: a short form of scripts/fuzz, what it has found, and that it finds what is planted."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import pytest
import tomli_w
from conftest import ROOT
from fuzzing.corpus import corpus
from fuzzing.file_mutation import hdf5_mutant, sqlite_mutant
from fuzzing.from_schema import scene_of
from fuzzing.outcome import fault_of
from fuzzing.seeds import datasets, results
from fuzzing.targets import TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st

FUZZ = ROOT / "scripts" / "fuzz"
PLANTS = """\
import ctypes, os, sys
sys.path.insert(0, {tests!r})
import click
from pathlib import Path
from fuzzing import campaign, readers
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

readers.OWN["plant"] = plant
campaign.MOST_SECONDS = 0.2
plants = "fine", "error", "crash", "memory", "escape", "hang", "fine"
given = tuple(Input({{}}, (("plant", what),)) for what in plants)
run = campaign.Campaign("plants", 0, 0, len(given), Path("place"), Path("found"), given)
run.directory.mkdir()
run.run()
print(run.done, sorted(run.faults))
"""


def test_what_was_found_stays_mended(run_module: Callable, tmp_path: Path) -> None:
    done = run_module(FUZZ, "--corpus", "--findings", tmp_path / "found")
    assert done.status == 0, done.stdout + done.stderr
    assert f"{len(corpus())} inputs" in done.stdout and len(corpus()) >= 50


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
        fault = fault_of(["check", scene, "--no-probe"])
        assert fault is None, fault.detail


@pytest.mark.parametrize(
    ("seed", "mutant"),
    [
        (lambda: results("packed")[0]["result/particles.vtkhdf"], hdf5_mutant),
        (lambda: datasets()[0]["data/manifest.sqlite"], sqlite_mutant),
    ],
)
def test_mutants_of_containers_are_containers(seed: Callable, mutant: Callable) -> None:
    data = seed()
    found = [mutant(data, Random(k)) for k in range(10)]
    assert all(one[:8] == data[:8] for one in found) and len(set(found)) > 5


def test_guided_inputs_reach_new_lines(run_module: Callable, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="the guided form of the fuzzer needs the package atheris")
    done = run_module(FUZZ, "--guided", "--count", 200, "--findings", tmp_path / "found", "checkpoint")
    assert done.status == 0, done.stdout + done.stderr
    assert "DONE   cov: " in done.stderr and not list((tmp_path / "found").iterdir())
