"""Packages that only some commands need: the extras of an installation."""

from importlib import import_module
from types import ModuleType

from mpmcli.errors import InputError


def imported(package: str, extra: str, what: str) -> ModuleType:
    """Return a package of an extra; InputError, which says what needs it: it is not installed."""
    try:
        return import_module(package)
    except ImportError:
        raise InputError(f'{what} needs {package}, which pip install "mpmcli[{extra}]" installs.') from None
