"""The validation cases by name. Each module of this package defines its cases in a tuple CASES."""

import importlib
import pkgutil
from functools import lru_cache
from typing import get_args, get_type_hints

from mpmcli.validation.case import Case


@lru_cache
def all_cases() -> dict[str, Case]:
    """Return all cases by name, sorted by group, in the order of the report, then by name."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    groups = get_args(get_args(get_type_hints(Case)["group"])[0])
    found = sorted((case for module in modules for case in module.CASES), key=lambda c: (groups.index(c.group), c.name))
    return {case.name: case for case in found}
