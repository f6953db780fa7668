"""Files that are either whole or absent: temporary name, fsync, atomic rename, fsync of the directory."""

import errno
import os
import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex

from mpmcli.errors import DiskFullError, RunError

try:
    import resource
except ImportError:  # Windows
    resource = None

TEMPORARY_SUFFIX = ".tmp"
# Bytes left free in addition to the data to be written: file system metadata and other programs.
SPACE_MARGIN = 16 * 1024 * 1024
# Error codes of the system for a lack of space.
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def temporary_of(path: Path) -> Path:
    """Return the temporary path of a file."""
    return path.with_name(path.name + TEMPORARY_SUFFIX)


def sync_file(path: Path) -> None:
    """Force the content of a closed file to the disk."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_directory(directory: Path) -> None:
    """Force the names in a directory to the disk, where the system can (Windows cannot)."""
    try:
        descriptor = os.open(directory, os.O_RDONLY)
    except OSError:
        return
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def sealed(path: Path, size: int = 0, *, unique: bool = False) -> Iterator[Path]:
    """Yield a temporary path; on exit, move it to `path` durably. OSError: there is no space for `size` bytes.

    It must be `unique` where no lock keeps other processes from writing the same file.
    """
    file = Unsealed(path, unique=unique)
    with file.written(size) as temporary:
        yield temporary
    file.seal()


class Unsealed:
    """A file that is first written, then moved to its path in one durable step, possibly by another thread."""

    def __init__(self, path: Path, *, unique: bool = False) -> None:
        self.path = path
        self._temporary = temporary_of(path.with_name(f"{path.name}.{token_hex(4)}") if unique else path)

    @contextmanager
    def written(self, size: int = 0) -> Iterator[Path]:
        """Yield a temporary path to write and close; see `sealed`."""
        with self._removed_on_error():
            # A killed process may have left one; a symbolic link must not be followed.
            self._temporary.unlink(missing_ok=True)
            if size:
                ask_for(self._temporary, size)
            yield self._temporary

    def seal(self) -> None:
        """Move the file to its path; on failure, remove the temporary file."""
        with self._removed_on_error():
            sync_file(self._temporary)
            os.replace(self._temporary, self.path)
        sync_directory(self.path.parent)

    @contextmanager
    def _removed_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            # The user must see the original error, not a failed clean-up.
            with suppress(OSError):
                self._temporary.unlink(missing_ok=True)
            raise


def ask_for(path: Path, size: int) -> None:
    """Reserve and release `size` bytes; without space HDF5 crashes the interpreter at exit."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(path, "wb") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            # Some file systems cannot reserve space; then this check is void.
            if is_full(error):
                raise
        file.truncate(0)


def write_text(path: Path, text: str, *, unique: bool = False) -> None:
    """Replace a UTF-8 text file in one durable step; see `sealed`."""
    with sealed(path, unique=unique) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def writing(what: object, kept: str = "", *, to: Path | None = None, faults: tuple = ()) -> Iterator[None]:
    """Raise a RunError for an OSError, or one of `faults`, in what is written here; `kept` ends its sentence."""
    try:
        yield
    except (OSError, *faults) as error:
        where, reason = f" to {to}" if to else "", getattr(error, "strerror", None) or error
        raise RunError(f"{what} could not be written{where} ({reason}){kept and f'; {kept}'}.") from error


def number_of(path: Path) -> int:
    """Return the number in a file name such as frame_000007.vtkhdf."""
    return int(path.stem.split("_")[1])


def numbered_files(folder: Path, names: re.Pattern[str]) -> list[Path]:
    """Return the files of a folder with such names, in the order of their numbers; none if it does not exist."""
    paths = [path for path in folder.iterdir() if names.fullmatch(path.name)] if folder.is_dir() else []
    return sorted(paths, key=number_of)


def remove_numbered(folder: Path, names: re.Pattern[str], spared: Collection[Path] = ()) -> None:
    """Remove files with such names, also unfinished ones, but no `spared` resolved paths; and the folder, if empty."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if names.fullmatch(path.name.removesuffix(TEMPORARY_SUFFIX)) and path.resolve() not in spared:
            path.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def is_full(error: BaseException) -> bool:
    """Return whether an error reports a full disk, an exceeded quota, or the limit on the size of a file."""
    return isinstance(error, OSError) and error.errno in NO_SPACE


def largest_file() -> int | None:
    """Return the limit of this process on the size of a file (`ulimit -f`), bytes; None if there is none."""
    if resource is None:
        return None
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def require_free_space(
    directory: Path, size: int, purpose: str, kept: str, *, joined: int = 0, several: bool = False
) -> None:
    """Raise DiskFullError unless the disk has space for `size` bytes and a margin, and a file may be that large.

    `several` states that the data is split into files, so that the limit on the size of a file is not compared with
    `size`. `purpose` is the subject of the error message ("frame 7"), `kept` its end ("the 7 frames before it are
    kept"). `joined` is the size, bytes, of one further file that later combines this data with earlier data.
    """
    included = "a margin and the packing of all frames up to it" if joined else "a margin"
    free, largest = shutil.disk_usage(directory).free, largest_file()
    if free < size + joined + SPACE_MARGIN:
        raise DiskFullError(
            f"The disk of {directory} has {free / 1e6:.1f} MB left, but {purpose} needs "
            f"{(size + joined + SPACE_MARGIN) / 1e6:.1f} MB ({included} included): free some space or write to another "
            f"disk with -o; {kept}."
        )
    need = max(0 if several else size, joined)
    if largest is not None and largest < need:
        what = "the packing of all frames up to it needs" if joined > size else "that needs"
        raise DiskFullError(
            f"{purpose} cannot be written, since {what} a file of {need / 1e6:.3g} MB, and files may have "
            f"{largest / 1e6:.3g} MB here: raise that limit (ulimit -f); {kept}."
        )
