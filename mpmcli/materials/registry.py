"""Finds the laws: every module of this package that defines `LAW`."""

import importlib
import pkgutil
from functools import cache

import mpmcli.materials as room
from mpmcli.materials.law import Law
from mpmcli.scene.material import MaterialParameters


@cache
def laws() -> dict[str, type[Law]]:
    """Return every law by the name that scenes use for it."""
    modules = (importlib.import_module(f"{room.__name__}.{m.name}") for m in pkgutil.iter_modules(room.__path__))
    found = (module.LAW for module in modules if hasattr(module, "LAW"))
    return {law.name: law for law in found}


def parameter_models() -> tuple[type[MaterialParameters], ...]:
    """Return the parameter models of all laws, in the order of their names."""
    return tuple(laws()[name].parameters for name in sorted(laws()))
