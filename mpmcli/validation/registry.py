"""All validation cases by name."""

import importlib
import pkgutil
from functools import lru_cache
from typing import get_args, get_type_hints

from mpmcli.validation import cases
from mpmcli.validation.case import Case


@lru_cache
def all_cases() -> dict[str, Case]:
    """Return every case by its name, chapter by chapter as in the report."""
    modules = [
        importlib.import_module(f"{cases.__name__}.{found.name}") for found in pkgutil.iter_modules(cases.__path__)
    ]
    groups = get_args(get_args(get_type_hints(Case)["group"])[0])
    found = sorted((case for module in modules for case in module.CASES), key=lambda c: (groups.index(c.group), c.name))
    return {case.name: case for case in found}
