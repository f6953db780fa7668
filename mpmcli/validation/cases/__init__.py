"""The validation cases by name."""

import importlib
import pkgutil
from collections.abc import Iterable
from functools import lru_cache
from types import ModuleType
from typing import get_args, get_type_hints

from mpmcli.validation.case import Case


@lru_cache
def all_cases() -> dict[str, Case]:
    """Return all cases by name, sorted by group, in the order of the report, then by name."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    groups = get_args(get_args(get_type_hints(Case)["group"])[0])
    found = sorted(
        (case for module in modules for case in _cases_of(module)), key=lambda c: (groups.index(c.group), c.name)
    )
    return {case.name: case for case in found}


def _cases_of(module: ModuleType) -> Iterable[Case]:
    """Return the cases of a module: its tuple CASES, or else an instance of each case class that has a name."""
    classes = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    named = [one for one in classes if issubclass(one, Case) and hasattr(one, "name")]
    return getattr(module, "CASES", None) or [one() for one in named]
