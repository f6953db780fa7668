"""The hard cases of the catalogue: each is run, and each criterion that is missed is missed as it is said here."""

from collections.abc import Callable

import pytest
from conftest import ROOT
from hard_cases.case import HardCase, carry_out
from hard_cases.catalogue import hard_cases

CASES = hard_cases()
# What is missed, with the figure; a case that begins to pass must leave this list.
MISSED: dict[str, str] = {}


def rows(*, slow: bool) -> list:
    """Return the cases as parameters, those that are missed marked as such."""
    return [
        pytest.param(
            case, id=name, marks=[pytest.mark.xfail(strict=True, reason=MISSED[name])] if name in MISSED else []
        )
        for name, case in CASES.items()
        if case.slow == slow
    ]


def test_every_case_of_the_catalogue_is_there() -> None:
    assert {name.rstrip("ab") for name in CASES} == {f"H{n}" for n in range(1, 25)}
    assert set(MISSED) <= set(CASES)


def test_the_page_has_a_row_for_every_case() -> None:
    """docs/hard-cases.md is of a full run, and says of each case what is said here: passed or missed."""
    lines = (ROOT / "docs" / "hard-cases.md").read_text(encoding="utf-8").splitlines()
    outcomes = {line.split()[1]: line for line in lines if line.startswith("| H")}
    assert list(outcomes) == list(CASES)
    for name, line in outcomes.items():
        assert ("**missed**" if name in MISSED else "| passed |") in line


@pytest.mark.parametrize("case", rows(slow=False))
def test_a_hard_case(case: HardCase) -> None:
    outcome = carry_out(case)
    assert outcome.passed, f"{outcome.figure}; {outcome.detail}"


@pytest.mark.slow
@pytest.mark.parametrize("case", rows(slow=True))
def test_a_slow_hard_case(case: HardCase) -> None:
    outcome = carry_out(case)
    assert outcome.passed, f"{outcome.figure}; {outcome.detail}"


@pytest.mark.slow
def test_the_script_says_what_came(run_python: Callable) -> None:
    """A case that is asked for is run, and its outcome and figure are on stderr."""
    said = run_python([ROOT / "scripts" / "hard_cases", "--quick", "H7", "H1"], cwd=ROOT).stderr
    assert [line.split()[:2] for line in said.splitlines() if line.startswith("H")] == [
        ["H1", "passed"],
        ["H7", "passed"],
    ]
    assert "2 of 2 passed" in said


def test_write_needs_all_cases(run_python: Callable) -> None:
    done = run_python([ROOT / "scripts" / "hard_cases", "--write", "H7"], cwd=ROOT, check=False)
    assert done.status == 2 and "--write needs all cases" in done.stderr
