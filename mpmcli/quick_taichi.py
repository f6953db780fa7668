"""Imports Taichi, and spares what it does for each function that it decorates, which is a third of all imports.

For each it asks `inspect` for the line of source that is running, and that goes through all modules that are loaded.
"""

import inspect
import sys

_module_of = inspect.getmodule
try:
    # Where files are at their places, their lines are found without it.
    inspect.getmodule = lambda *_: None
    import taichi as ti
    from taichi.lang import kernel_impl
finally:
    inspect.getmodule = _module_of


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Return whether a function is decorated in the body of a class, which runs in a frame called by the given one."""
    frame = sys._getframe(level_of_class_stackframe - 1)
    return not frame.f_code.co_flags & inspect.CO_OPTIMIZED and "__qualname__" in frame.f_locals


kernel_impl._inside_class = _inside_class

__all__ = ["ti"]
