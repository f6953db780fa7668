"""Finds the laws: every module of this package that defines `LAW`, and every plugin given by --plugin."""

import importlib
import pkgutil
import sys
import traceback
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

import mpmcli.materials as room
from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.scene.material import MaterialParameters

# Laws of plugins and their files, by the name that scenes use.
_plugins: dict[str, tuple[type[Law], Path]] = {}


def laws() -> dict[str, type[Law]]:
    """Return all laws by the name that scenes use, plugins last."""
    return _own_laws() | {name: law for name, (law, _) in _plugins.items()}


def parameter_models() -> tuple[type[MaterialParameters], ...]:
    """Return the parameter models of all laws, in the order of their names."""
    known = laws()
    return tuple(known[name].parameters for name in sorted(known))


def load_plugins(paths: Sequence[Path]) -> tuple[type[MaterialParameters], ...]:
    """Replace all loaded plugins by the given ones, and return the parameter models of all laws.

    Each is a Python file that is run and defines `LAW`. InputError: there is no such file, it fails, its LAW is
    incomplete, or the name of the law is taken.
    """
    _plugins.clear()
    for path in paths:
        _load_plugin(path)
    return parameter_models()


def _load_plugin(path: Path) -> None:
    """Register the LAW of a file. Raises InputError if there is none, or it is incomplete or named as another."""
    module = _run(path)
    law = getattr(module, "LAW", None)
    if law is None:
        raise InputError(f"{path}: the file defines no LAW; end it with LAW = YourLaw")
    if sentence := _incomplete(law):
        raise InputError(f"{path}: {sentence}")
    if law.name in _own_laws():
        raise InputError(f'{path}: "{law.name}" is the name of a law of mpmcli; give LAW another name')
    if law.name in _plugins:
        raise InputError(
            f'{path}: "{law.name}" is the name of the law in {_plugins[law.name][1]}; give LAW another name'
        )
    _plugins[law.name] = (law, path)


def plugin_file(name: str) -> Path | None:
    """Return the file that a law was loaded from, None for a law of mpmcli."""
    return _plugins[name][1] if name in _plugins else None


@cache
def _own_laws() -> dict[str, type[Law]]:
    modules = (importlib.import_module(f"{room.__name__}.{m.name}") for m in pkgutil.iter_modules(room.__path__))
    found = (module.LAW for module in modules if hasattr(module, "LAW"))
    return {law.name: law for law in found}


def _run(path: Path) -> ModuleType:
    """Execute a file and return it as a module, without writing a cache file."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; give a Python file that defines LAW") from None
    except (OSError, UnicodeDecodeError) as error:
        said = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise InputError(f"{path}: the file cannot be read: {said}") from None
    # The full path: Taichi reads the source of kernels from it later, possibly from another working directory.
    file = str(path.resolve())
    module = ModuleType(f"mpmcli_plugin_{len(_plugins)}_{path.stem}")
    module.__file__ = file
    # Python looks up the module of a class here.
    sys.modules[module.__name__] = module
    try:
        exec(compile(text, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        text = error.msg if isinstance(error, SyntaxError) else str(error)
        said = next(iter(text.strip().splitlines()), "no more is known")
        raise InputError(f"{_place(path, file, error)}: {type(error).__name__}: {said}") from error
    return module


def _place(path: Path, file: str, error: BaseException) -> str:
    """Return the path with the line of the file that raised the error."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    if isinstance(error, SyntaxError) and error.filename == file:
        lines.append(error.lineno)
    return f"{path}:{lines[-1]}" if lines else str(path)


def _incomplete(law: object) -> str | None:
    """Return a sentence about what a law lacks, or None."""
    if not (isinstance(law, type) and issubclass(law, Law)):
        return f"LAW must be a subclass of mpmcli.materials.law.Law; found {law!r}"
    missing = [name for name in ("name", "parameters", "deformation") if not hasattr(law, name)]
    missing += [f"{name}()" for name in sorted(law.__abstractmethods__)]
    missing += [f"{name}()" for name in ("respond", "energy") if getattr(law, name) is getattr(Law, name)]
    if missing:
        return f"{law.__name__} does not define {', '.join(missing)}"
    if not (isinstance(law.parameters, type) and issubclass(law.parameters, MaterialParameters)):
        return f"{law.__name__}.parameters must be a subclass of MaterialParameters; found {law.parameters!r}"
    said = law.parameters.model_fields["law"].default
    if said != law.name:
        return f'{law.__name__}.name is "{law.name}", and law in its parameters is {said!r}; both must be the same word'
    return None
