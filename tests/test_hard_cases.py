"""The hard cases of the catalogue: each is run, and each criterion that is missed is missed as it is said here."""

import pytest
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


@pytest.mark.parametrize("case", rows(slow=False))
def test_a_hard_case(case: HardCase) -> None:
    outcome = carry_out(case)
    assert outcome.passed, f"{outcome.figure}; {outcome.detail}"


@pytest.mark.slow
@pytest.mark.parametrize("case", rows(slow=True))
def test_a_slow_hard_case(case: HardCase) -> None:
    outcome = carry_out(case)
    assert outcome.passed, f"{outcome.figure}; {outcome.detail}"
