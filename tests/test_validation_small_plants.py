"""Errors of about 5 % planted on purpose, of which validation at the level `coarse` must catch nine in ten."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT
from small_plants import SMALL_PLANTS, SmallPlant

from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import CaseRun, RunResult
from mpmcli.validation.verdict import judge

FEWEST = 40
# Prints the result of a case at its coarsest resolution.
FIRST_RUN = """
import dataclasses, json, sys
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import carry_out
case = all_cases()[sys.argv[1]]
print(json.dumps(dataclasses.asdict(carry_out(case, min(case.levels["coarse"]), Setting()))))
"""
CASES = all_cases()


def first_run(package: Path, name: str) -> str:
    """Run a case at its coarsest resolution with the package in a directory; return what is off, "" if nothing is.

    The level `coarse` has that run, so that what fails here fails there.
    """
    # -P: without it the package in the present directory would be taken.
    process = [sys.executable, "-P", "-c", FIRST_RUN, name]
    done = subprocess.run(process, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(package)})
    assert done.returncode == 0, done.stderr
    result = RunResult(**json.loads(done.stdout.splitlines()[-1]))
    # A run may become unstable or give no number; any other failure would be a plant that does not even compile.
    assert result.status in ("finished", "unstable") or "came to its end" in result.message, result.message
    n = min(CASES[name].levels["coarse"])
    return "; ".join(judge(CASES[name], {CaseRun(name, n, Setting()): result}).reasons)


@pytest.fixture(scope="module")
def unplanted() -> Callable[[str], str]:
    """Return `first_run` of this package as it is, once for each case."""
    return cache(lambda case: first_run(ROOT, case))


@pytest.mark.parametrize("plant", SMALL_PLANTS, ids=str)
def test_a_small_plant_finds_its_place(plant: SmallPlant) -> None:
    """Where the source has changed, nothing would be planted, and nothing caught; nor by a case that is gone."""
    text = (ROOT / "mpmcli" / plant.file).read_text(encoding="utf-8")
    assert text.count(plant.right) == 1
    assert plant.wrong != plant.right
    assert plant.cases and set(plant.cases) <= set(CASES)


def test_nine_in_ten_small_plants_are_caught() -> None:
    names = [str(plant) for plant in SMALL_PLANTS]
    assert len(set(names)) == len(names) >= FEWEST
    assert sum(plant.missed != "" for plant in SMALL_PLANTS) <= 0.1 * len(names)


@pytest.mark.slow
@pytest.mark.parametrize("plant", SMALL_PLANTS, ids=str)
def test_a_small_planted_error_is_caught(
    plant: SmallPlant, tmp_path: Path, unplanted: Callable[[str], str], record_property: Callable
) -> None:
    """One of its cases, which passes as the package is, fails with the error in it."""
    shutil.copytree(ROOT / "mpmcli", tmp_path / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    file = tmp_path / "mpmcli" / plant.file
    file.write_text(file.read_text(encoding="utf-8").replace(plant.right, plant.wrong), encoding="utf-8")
    caught = False
    for name in plant.cases:
        assert unplanted(name) == "", name
        said = first_run(tmp_path, name)
        record_property(name, said)
        caught = caught or said != ""
    assert caught == (plant.missed == ""), f"{', '.join(plant.cases)}: {'caught' if caught else 'not caught'}"
