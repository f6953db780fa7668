"""The short form of scripts/damage: damaged results are noticed, and never read as data."""

import pytest
from damage import EXPORTS, RESULTS, describe, outcomes, trials

SUBJECTS = len((*RESULTS, *EXPORTS))


@pytest.mark.parametrize(
    ("flips", "others"), [(3 * SUBJECTS, SUBJECTS), pytest.param(1000, 100, marks=pytest.mark.slow)]
)
def test_damage_is_noticed_and_never_read_as_data(flips: int, others: int) -> None:
    """Other seeds than those of the script."""
    chosen = trials(flips, first=10_000) + trials(others, ("cut", "removed"), first=10_000)
    found = list(outcomes(chosen))
    assert not list(describe(found))
    # Damage to what an export does not read leaves it as it was; damage to anything else refuses it.
    assert {one.exported for one in found} == {"refused", "equal", ""}
