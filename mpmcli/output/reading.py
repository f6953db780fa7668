"""Opening files of HDF5: what readers raise on a damaged or foreign file becomes one sentence."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
from pydantic import ValidationError

from mpmcli.errors import InputError

# Of h5py, numpy, JSON, TOML and pydantic, where content contradicts itself. InputError: a reader said what is wrong.
DAMAGE = (InputError, OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, MemoryError)


class DamageError(InputError):
    """A file that was written by mpmcli, and has changed since."""


def first_line(error: Exception) -> str:
    """Return the first line of what an exception says, without a period at its end, or its type."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return (str(error).splitlines() or [type(error).__name__])[0].strip("'\"").rstrip(".")


def open_hdf5(path: Path, wanted: str) -> h5py.File:
    """Open a sealed file for reading, without a lock; InputError: it is no HDF5 file; `wanted` is what to give."""
    try:
        try:
            return h5py.File(path, "r", locking=False)
        except OSError:
            # This process has the file open with locking; HDF5 requires one setting for all handles.
            return h5py.File(path, "r")
    except OSError as error:
        reason = "is not an HDF5 file, or a damaged one" if path.exists() else "does not exist"
        if path.suffix == ".toml" and path.exists():
            reason = "is a scene, not a result of `mpmcli simulate`"
        raise InputError(f"{path} {reason}; give {wanted}.") from error


@contextmanager
def opened(path: Path, wanted: str) -> Iterator[h5py.File]:
    """Open a file as `open_hdf5` does; what reading it raises becomes a DamageError."""
    with open_hdf5(path, wanted) as file:
        try:
            yield file
        except InputError:
            raise
        except DAMAGE as error:
            what = first_line(error)
            raise DamageError(f"{path} is damaged: what it should hold cannot be read ({what}).") from error


def require_format(path: Path, found: object, ours: int) -> None:
    """Refuse with an InputError a file of another format than `ours`."""
    if found != ours:
        raise InputError(
            f"{path} has format {found}, and this version of mpmcli reads format {ours}: use the version that wrote it."
        )
