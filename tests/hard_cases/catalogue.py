"""All hard cases, in the order of the catalogue."""

import re

from hard_cases import contact, failure, impact, lone, plastic, precision, resting, tension, waves
from hard_cases.case import HardCase

MODULES = (contact, failure, impact, lone, plastic, precision, resting, tension, waves)


def hard_cases() -> dict[str, HardCase]:
    """Return every hard case by its name."""
    found = {case.name: case for module in MODULES for case in module.CASES}
    return dict(sorted(found.items(), key=lambda item: (int(re.findall(r"\d+", item[0])[0]), item[0])))
