"""Decides whether a setting should replace the default one: it must be faster and no less accurate."""

from collections.abc import Sequence

from mpmcli.validation.comparison import Compared
from mpmcli.validation.verdict import SINGLE

# A setting replaces the default one if the mean ratio of times at equal error is below FASTER and no ratio of errors
# at equal resolution exceeds WORSE.
FASTER, WORSE = 0.9, 2.0


def takes_its_place(entry: Compared) -> bool:
    """Return whether a setting should replace the default one."""
    if entry.error is None or entry.to_equal is None or entry.failed:
        return False
    return entry.to_equal.mean < FASTER and entry.error.high <= WORSE


def reason(entry: Compared) -> str:
    """Return one sentence with the ratios for or against a setting."""
    if entry.error is None or entry.to_equal is None:
        return f"**{entry.label}**: no case tells."
    worst = max(entry.error.of_case, key=entry.error.of_case.__getitem__)
    found = f"**{entry.label}**: {entry.to_equal.mean:.2g} of the time"
    bad = f"{entry.error.high:.2g} times as far off in its worst case, {worst}"
    if entry.failed:
        return f"{found}, but {entry.failed} of {entry.runs} runs failed."
    if entry.setting == SINGLE:
        return f"{found}, and {bad}: scenes take it, as nothing is lost. Here it would blur the orders of small errors."
    if takes_its_place(entry):
        return f"{found}, and {bad}: it should be the default."
    return f"{found}, but {bad}." if entry.to_equal.mean < FASTER else f"{found}; {bad}."


def outcome(compared: Sequence[Compared]) -> str:
    """Return the rule of replacement and the settings that satisfy it, as text of the report."""
    better = [entry.label for entry in compared if entry.setting != SINGLE and takes_its_place(entry)]
    rule = (
        f"A setting would take the place of the default one if it came to an equal error in less than {FASTER:g} of "
        f"the time, in the mean over the cases, and were at most {WORSE:g} times as far off at equal n in any of them."
    )
    return f"{rule} {'These do: ' + ', '.join(better) + '.' if better else 'None does.'}"
