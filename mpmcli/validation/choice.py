"""Says what a report speaks for: the default setting, or another one that is faster and no worse."""

from collections.abc import Sequence

from mpmcli.validation.comparison import Compared
from mpmcli.validation.verdict import SINGLE

# A setting would take the place of the default one if it came to equal errors in this part of its time, in the mean
# over the cases, and were so many times as far off at equal resolution at most, in any case.
FASTER, WORSE = 0.9, 2.0


def takes_its_place(entry: Compared) -> bool:
    """Return whether a setting is so much better than the default one that it should take its place."""
    if entry.error is None or entry.to_equal is None or entry.failed:
        return False
    return entry.to_equal.mean < FASTER and entry.error.high <= WORSE


def reason(entry: Compared) -> str:
    """Return one sentence with the numbers that speak for a setting or against it."""
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
    """Return what follows for the default setting, in a sentence."""
    better = [entry.label for entry in compared if entry.setting != SINGLE and takes_its_place(entry)]
    rule = (
        f"A setting would take the place of the default one if it came to an equal error in less than {FASTER:g} of "
        f"the time, in the mean over the cases, and were at most {WORSE:g} times as far off at equal n in any of them."
    )
    return f"{rule} {'These do: ' + ', '.join(better) + '.' if better else 'None does.'}"
