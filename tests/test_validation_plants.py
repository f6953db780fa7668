"""Errors planted on purpose, each of which a validation case must catch at its coarse level.

Of those of about 5 % (SMALL_PLANTS), nine in ten must be caught, at the coarsest resolution.
"""

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
from small_plants import PLANTS, SMALL_PLANTS, Plant

from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import CaseRun, RunResult
from mpmcli.validation.verdict import judge

CASES = all_cases()
# Prints the result of a case at its coarsest resolution.
FIRST_RUN = """
import dataclasses, json, sys
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import carry_out
case = all_cases()[sys.argv[1]]
print(json.dumps(dataclasses.asdict(carry_out(case, min(case.levels["coarse"]), Setting()))))
"""


def run(package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the package in a directory."""
    # -P: without it the package in the present directory would be taken.
    process, variables = [sys.executable, "-P", *arguments], {**os.environ, "PYTHONPATH": str(package)}
    return subprocess.run(process, capture_output=True, text=True, timeout=600, cwd=package, env=variables)


def check_end(status: str, message: str) -> None:
    """A run may become unstable or give no number; any other failure would be a plant that does not even compile."""
    assert status in ("finished", "unstable") or "came to its end" in message, message


@cache
def level(package: Path, name: str) -> str:
    """Validate a case at its coarse level with the package in a directory; return what is off, "" if nothing is."""
    done = run(package, "-m", "mpmcli", "validate", name, "--levels", "coarse", "--workers", "1", "--json")
    assert done.returncode in (0, 1), done.stderr
    (verdict,) = json.loads(done.stdout)["cases"]
    for each in verdict["runs"]:
        check_end(each["status"], each["message"])
    assert (verdict["verdict"] == "pass") == (done.returncode == 0)
    return "; ".join(verdict["reasons"])


@cache
def first_run(package: Path, name: str) -> str:
    """Return the same of its coarsest resolution alone, which the level has: what fails here fails there."""
    done = run(package, "-c", FIRST_RUN, name)
    assert done.returncode == 0, done.stderr
    result = RunResult(**json.loads(done.stdout.splitlines()[-1]))
    check_end(result.status, result.message)
    n = min(CASES[name].levels["coarse"])
    return "; ".join(judge(CASES[name], {CaseRun(name, n, Setting()): result}).reasons)


@pytest.mark.parametrize("plant", (*PLANTS, *SMALL_PLANTS), ids=str)
def test_a_plant_finds_its_place(plant: Plant) -> None:
    """Where the source has changed, nothing would be planted, and nothing caught; nor by a case that is gone."""
    text = (ROOT / "mpmcli" / plant.file).read_text(encoding="utf-8")
    assert text.count(plant.right) == 1
    assert plant.wrong != plant.right
    assert plant.cases and set(plant.cases) <= set(CASES)


@pytest.mark.parametrize(("plants", "fewest", "missed"), [(PLANTS, 10, 0.0), (SMALL_PLANTS, 40, 0.1)])
def test_nine_in_ten_small_plants_are_caught_and_all_others(
    plants: tuple[Plant, ...], fewest: int, missed: float
) -> None:
    names = [str(plant) for plant in plants]
    assert len(set(names)) == len(names) >= fewest
    assert sum(plant.missed != "" for plant in plants) <= missed * len(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "look"),
    [*((plant, level) for plant in PLANTS), *((plant, first_run) for plant in SMALL_PLANTS)],
    ids=lambda one: str(one) if isinstance(one, Plant) else one.__name__,
)
def test_a_planted_error_is_caught(
    plant: Plant, look: Callable[[Path, str], str], tmp_path: Path, record_property: Callable
) -> None:
    """One of its cases, which passes as the package is, fails with the error in it."""
    shutil.copytree(ROOT / "mpmcli", tmp_path / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    file = tmp_path / "mpmcli" / plant.file
    file.write_text(file.read_text(encoding="utf-8").replace(plant.right, plant.wrong), encoding="utf-8")
    caught = False
    for name in plant.cases:
        assert look(ROOT, name) == "", name
        said = look(tmp_path, name)
        record_property(name, said)
        caught = caught or said != ""
    assert caught == (plant.missed == ""), f"{', '.join(plant.cases)}: {'caught' if caught else 'not caught'}"
