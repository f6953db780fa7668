"""The output directory: made, refused, or cleared of an earlier result, and of nothing else."""

import tempfile
from pathlib import Path

from mpmcli.errors import InputError
from mpmcli.output.checkpoints import remove_checkpoints
from mpmcli.output.collider_files import COLLIDER_FILES, MOVING_FRAME
from mpmcli.output.durable import TEMPORARY_SUFFIX, sync_directory
from mpmcli.output.run_record import RECORD, read_record
from mpmcli.output.segments import PACKED, remove_segments, sealed_segments
from mpmcli.output.series import SERIES, SERIES_FRAME, SERIES_HEADER, SERIES_LEDGER

SCENE = "scene.toml"
NAMES = (PACKED, SCENE, SERIES, SERIES_HEADER, SERIES_LEDGER, RECORD, *COLLIDER_FILES)


def prepare_directory(directory: Path, overwrite: bool) -> Path:
    """Make sure that `directory` exists, is writable and holds no earlier result.

    With `overwrite` the files that mpmcli writes are removed: the packed file, segments, series,
    checkpoints, scene.toml and run.json. Anything else in the directory stays.

    Returns:
        The directory.

    Raises:
        InputError: something is in the way, or the directory cannot be written. Nothing was made
            or removed then.
    """
    directory = Path(directory)
    check_directory(directory, overwrite)
    if directory.is_dir():
        _remove_result(directory)
    else:
        _make(directory)
    return directory


def check_directory(directory: Path, overwrite: bool, *, resume: bool = False) -> None:
    """Refuse a directory that holds something, unless a run is resumed there, or cannot be written.

    Nothing is made or removed. Cheap, so that a long preparation need not come first; `prepare_directory` has the last
    word.

    Raises:
        InputError: as `prepare_directory`.
    """
    directory = Path(directory)
    try:
        directory.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{directory} cannot be made ({reason}): give another place with -o.") from error
    if directory.is_dir():
        _refuse_unwritable(directory)
        if not (overwrite or resume) and any(directory.iterdir()):
            raise InputError(
                f"{directory} exists and is not empty: give another directory with -o, or --overwrite to "
                "replace the result in it, or --resume to go on with it."
            )
    elif directory.exists() or directory.is_symlink():
        raise InputError(f"{directory} is a file, not a directory: give another place with -o.")


def _make(directory: Path) -> None:
    # Every missing parent is made too, and taken away again if the whole does not succeed.
    missing = [directory]
    for parent in directory.parents:
        if parent.exists():
            break
        missing.append(parent)
    made: list[Path] = []
    try:
        for path in reversed(missing):
            path.mkdir()
            made.append(path)
            sync_directory(path.parent)
        _refuse_unwritable(directory)
    except (OSError, InputError) as error:
        for path in reversed(made):
            path.rmdir()
        if isinstance(error, InputError):
            raise
        reason = error.strerror or error
        raise InputError(f"{directory} cannot be made ({reason}): give another place with -o.") from error


def _refuse_unwritable(directory: Path) -> None:
    try:
        # Permission bits do not tell of read-only disks, so a nameless file is tried.
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{directory} cannot be written ({reason}): give another place with -o.") from error


def _remove_result(directory: Path) -> None:
    ours = [path for path in directory.iterdir() if _is_ours(path.name.removesuffix(TEMPORARY_SUFFIX))]
    for path in ours:
        if path.is_dir():
            raise InputError(f"{path} is a directory where mpmcli writes a file: give another place with -o.")
    if (directory / SCENE).exists() and not _holds_result(directory):
        # With `-o .` it may well be the scene that is about to be run.
        raise InputError(f"{directory / SCENE} was not written by mpmcli: give another directory with -o.")
    try:
        remove_segments(directory)
        remove_checkpoints(directory)
        # The record is removed last: while it exists, the remaining files are known to be mpmcli's.
        for path in sorted(ours, key=lambda path: path.name == RECORD):
            path.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"The earlier result in {directory} cannot be removed ({reason}).") from error


def _is_ours(name: str) -> bool:
    frame = SERIES_FRAME.fullmatch(name) or MOVING_FRAME.fullmatch(name)
    return name in NAMES or frame is not None


def _holds_result(directory: Path) -> bool:
    if (directory / PACKED).exists() or (directory / SERIES_HEADER).exists() or sealed_segments(directory):
        return True
    return read_record(directory) is not None
