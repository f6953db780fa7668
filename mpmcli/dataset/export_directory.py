"""The directory of an export: it appears as a whole or not at all, and replaces nothing but an earlier export."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mpmcli.dataset.facts import EXPORTED_BY, FORMAT_KEY
from mpmcli.errors import InputError
from mpmcli.output import check_directory
from mpmcli.output.durable import TEMPORARY_SUFFIX, sync_directory, sync_file
from mpmcli.output.sums_file import SUMS, path_digest, sums_faults, sums_text
from mpmcli.output.verify import Verification

METADATA = "metadata.json"
_OURS = re.compile(r"metadata\.json|checksums\.sha256|(train|valid|test)\.(h5|npz)|\d{6,}\.(npz|vtkhdf)")


def check_export_directory(directory: Path, overwrite: bool) -> None:
    """Refuse a directory that holds anything, or, with `overwrite`, anything but an earlier export.

    Raises:
        InputError: so, or it cannot be written.
    """
    check_directory(directory, overwrite)
    if directory.resolve() == Path.cwd():
        raise InputError(f"{directory} is the present directory, which an export would replace: give another with -o.")
    if not directory.is_dir():
        return
    names = [path.name for path in directory.iterdir()]
    foreign = sorted(name for name in names if not _OURS.fullmatch(name))
    if names and (foreign or not _is_export(directory)):
        what = f"it holds {foreign[0]}" if foreign else f"it has no {METADATA} of mpmcli export"
        raise InputError(f"{directory} is not an earlier export, as {what}: give another directory with -o.")


@contextmanager
def new_directory(directory: Path, overwrite: bool) -> Iterator[Path]:
    """Give an empty directory to write to; on leaving, put it at `directory`; if the block raises, leave nothing.

    Raises:
        InputError: as `check_export_directory`, or no directory can be made beside it.
    """
    check_export_directory(directory, overwrite)
    target = directory.resolve()
    missing = [parent for parent in target.parents if not parent.exists()]
    temporary, former = (
        target.with_name(f"{target.name}.{os.getpid()}{end}") for end in (TEMPORARY_SUFFIX, f".old{TEMPORARY_SUFFIX}")
    )
    try:
        try:
            temporary.mkdir(parents=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{directory} cannot be made ({reason}): give another place with -o.") from error
        yield temporary
        for path in temporary.iterdir():
            sync_file(path)
        if target.exists():
            # Something may have been put into it meanwhile.
            check_export_directory(directory, overwrite)
            os.rename(target, former)
        try:
            os.rename(temporary, target)
        except OSError:
            if former.exists():
                os.rename(former, target)
            raise
        sync_directory(target.parent)
        shutil.rmtree(former, ignore_errors=True)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        for parent in missing:
            with suppress(OSError):
                parent.rmdir()
        raise


def is_export(path: Path) -> bool:
    """Return whether a directory holds an export, whole or not."""
    return path.is_dir() and (_is_export(path) or ((path / SUMS).exists() and (path / METADATA).exists()))


def seal_export(directory: Path) -> None:
    """Write the checksums of all files of an export that is complete."""
    sums = {path.name: [path_digest(path)] for path in directory.iterdir()}
    (directory / SUMS).write_text(sums_text(sums), encoding="ascii", newline="\n")


def verify_export(directory: Path) -> Verification:
    """Compare the files of an export with its checksums."""
    found = Verification(directory)
    if not (directory / SUMS).exists() and _is_export(directory) and not _of_this_format(directory):
        found.files = sum(1 for path in directory.iterdir() if _OURS.fullmatch(path.name))
        found.unchecked.append(str(directory))
        return found
    found.files, found.faults = sums_faults(directory)
    return found


def _of_this_format(directory: Path) -> bool:
    return FORMAT_KEY in json.loads((directory / METADATA).read_text(encoding="utf-8"))


def _is_export(directory: Path) -> bool:
    try:
        return EXPORTED_BY in json.loads((directory / METADATA).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False
