"""The unit that a parameter's description names."""

import re

# After a comma: kg/m^3, Pa s, degrees, ...; then the sentence ends or goes on after a mark.
_SYMBOL = r"(?:kg|Pa|mol|degrees|rad|[mskJNKW1])(?:\^(?:-?\d+|n))?"
_UNIT = re.compile(rf", ({_SYMBOL}(?:[ /]{_SYMBOL})*)(?=[.,;:)]|$)")


def unit_of(description: str | None) -> str:
    """Return the unit in a description such as "Viscosity, Pa s; water 1e-3.", or "" where it names none."""
    found = _UNIT.search(description or "")
    return found[1] if found else ""
