"""Errors of about 5 % planted on purpose, of which validation at the level `coarse` must catch nine in ten."""

import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT
from small_plants import SMALL_PLANTS, SmallPlant

from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runner import carry_out_all
from mpmcli.validation.runs import Run
from mpmcli.validation.verdict import judge

FEWEST = 40
CASES = all_cases()


def first_run(package: Path, name: str) -> str:
    """Run a case at its coarsest resolution with the package in a directory; return what is off, "" if nothing is.

    The level `coarse` has that run, so that what fails here fails there.
    """
    run = Run(name, min(CASES[name].levels["coarse"]), Setting())
    # -P: without it the package in the present directory would be taken.
    process = ["env", f"PYTHONPATH={package}", sys.executable, "-P", "-m", "mpmcli.validation.runner"]
    ((_, result),) = carry_out_all([run], 1, command=lambda run: [*process, run.case, str(run.n), "{}"])
    # A run may become unstable or give no number; any other failure would be a plant that does not even compile.
    assert result.status in ("finished", "unstable") or "came to its end" in result.message, result.message
    return "; ".join(judge(CASES[name], {run: result}).reasons)


@pytest.fixture(scope="module")
def unplanted() -> Callable[[str], str]:
    """Return `first_run` of this package as it is, once for each case."""
    return cache(lambda case: first_run(ROOT, case))


@pytest.mark.parametrize("plant", SMALL_PLANTS, ids=str)
def test_a_small_plant_finds_its_place(plant: SmallPlant) -> None:
    """Where the source has changed, nothing would be planted, and nothing caught; nor by a case that is gone."""
    text = (ROOT / "mpmcli" / plant.file).read_text(encoding="utf-8")
    assert text.count(plant.right) == plant.count
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
