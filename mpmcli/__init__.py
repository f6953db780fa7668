"""mpmcli: reproducible particle datasets with the Material Point Method."""

import os
from importlib import import_module

__version__ = "0.1.0"

# Taichi greets on standard output when it is imported, which belongs to JSON here.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
# And it aborts where batch systems leave HOME unset.
os.environ.setdefault("HOME", os.path.expanduser("~"))

__all__ = ["load_scene", "open", "run", "sweep"]


def __getattr__(name: str) -> object:
    """Return a function of `mpmcli.api`, which is imported when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("mpmcli.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
