"""The output directory: creates, refuses or clears it, and closes it after a crash."""

import json
import re
import tempfile
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from mpmcli.errors import InputError
from mpmcli.output.checkpoints import CHECKPOINT_NAME, CHECKPOINTS
from mpmcli.output.collider_files import MOVING, RESTING
from mpmcli.output.durable import TEMPORARY_SUFFIX, remove_numbered, sync_directory, temporary_of, write_text
from mpmcli.output.layout import DAMAGED, PACKED, SEGMENTS, remove_segments, sealed_segments
from mpmcli.output.lock import LOCK, refuse_locked, refused, take_lock, time_now
from mpmcli.output.run_record import RECORD, read_record
from mpmcli.output.series import is_series_file

SCENE = "scene.toml"
NAMES = (PACKED, DAMAGED, SCENE, RECORD, RESTING, MOVING)
# The directory of error bars beside a result, and the files in it.
ERROR_BARS, BAR_FILE = "error_bars", re.compile(r"error_bars\.json|report\.md|(bands|cost)\.svg|[0-9a-f]{16}\.npz")


@dataclass
class TakenDirectory:
    """A directory locked by this process until `release`; `made` lists the directories created, outermost first.

    `spared` resolved paths are never removed; `replaces`: whether it holds an earlier result, which `clear` removes.
    """

    path: Path
    lock: ExitStack
    made: tuple[Path, ...]
    spared: frozenset[Path] = frozenset()
    replaces: bool = False

    def __enter__(self) -> "TakenDirectory":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not has_frames(self.path):
            self.undo()
        self.release()

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        self.lock.close()

    def clear(self, first: Path | None = None) -> None:
        """Remove an earlier result, but not the `first` file of a new one; InputError: it cannot be removed."""
        spared = {*self.spared, first and first.resolve()}
        ours = [path for path in _result_files(self.path) if path.resolve() not in spared]
        try:
            remove_segments(self.path, spared)
            remove_numbered(self.path / CHECKPOINTS, CHECKPOINT_NAME)
            remove_numbered(self.path / ERROR_BARS, BAR_FILE)
            # The record is removed last: while it exists, the remaining files are known to be mpmcli's.
            for path in sorted(ours, key=lambda path: path.name == RECORD):
                path.unlink(missing_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"The earlier result in {self.path} cannot be removed ({reason}).") from error
        self.replaces = False

    def undo(self) -> None:
        """Remove the files of a run that computed nothing, and the directories made for it; an earlier result stays."""
        if not self.replaces:
            with suppress(OSError, InputError):
                self.clear()
        with suppress(OSError):
            (self.path / SEGMENTS).rmdir()
        self.release()
        _unmake(self.made)


def take_directory(
    directory: Path, overwrite: bool, *, resume: bool = False, inputs: Collection[Path] = ()
) -> TakenDirectory:
    """Ensure that `directory` exists, is writable, and is not being written; lock it.

    With `overwrite` it may hold an earlier result, which `clear` removes, except for resolved paths in `inputs`; with
    `resume` all stays. InputError, and nothing changed: other files or an input of the run are in the way, another
    process writes it, or it cannot be written.
    """
    directory = Path(directory)
    check_directory(directory, overwrite, resume=resume)
    made = [] if directory.is_dir() else _make(directory)
    lock = None
    try:
        lock = take_lock(directory)
        # Another run may have started and ended meanwhile.
        check_directory(directory, overwrite, resume=resume, locked=True)
        for path in [] if resume else _result_files(directory):
            if path.resolve() in inputs and path.name != SCENE:
                raise InputError(f"{path} is read by the scene, and the result would replace it: give another -o.")
    except BaseException:
        if lock is not None:
            lock.close()
        _unmake(made)
        raise
    replaces = overwrite and any(path.name != LOCK for path in directory.iterdir())
    return TakenDirectory(directory, lock, tuple(made), frozenset(inputs), replaces)


def check_directory(directory: Path, overwrite: bool, *, resume: bool = False, locked: bool = False) -> None:
    """Raise the errors of `take_directory` and change nothing; `locked`: this process holds its lock."""
    directory = Path(directory)
    try:
        directory.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise refused(directory, "made", error) from error
    if directory.is_dir():
        _refuse_unwritable(directory)
        if not locked:
            refuse_locked(directory)
        if not (overwrite or resume) and any(path.name != LOCK for path in directory.iterdir()):
            raise InputError(
                f"{directory} exists and is not empty: give another directory with -o, or --overwrite to "
                "replace the result in it, or --resume to go on with it."
            )
    elif directory.exists() or directory.is_symlink():
        raise InputError(f"{directory} is a file, not a directory: give another place with -o.")


def _make(directory: Path) -> list[Path]:
    """Make a directory; return all that were made, outermost first."""
    # Missing parents are made too, and removed again on failure.
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
        _unmake(made)
        if isinstance(error, InputError):
            raise
        raise refused(directory, "made", error) from error
    return made


def _unmake(made: Sequence[Path]) -> None:
    for path in reversed(made):
        with suppress(OSError):
            path.rmdir()


def _refuse_unwritable(directory: Path) -> None:
    try:
        # Permission bits do not show read-only disks, so an unnamed file is tried.
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise refused(directory, "written", error) from error


def _result_files(directory: Path) -> list[Path]:
    """Return the files of a result but its segments and checkpoints; InputError: they cannot be replaced."""
    names = {path: path.name.removesuffix(TEMPORARY_SUFFIX) for path in directory.iterdir()}
    ours = [path for path, name in names.items() if name in NAMES or is_series_file(name)]
    for path in ours:
        if path.is_dir():
            raise InputError(f"{path} is a directory where mpmcli writes a file: give another place with -o.")
    if (directory / SCENE).exists() and not (has_frames(directory) or read_record(directory) is not None):
        # With `-o .` it may be the scene that is about to run.
        raise InputError(f"{directory / SCENE} was not written by mpmcli: give another directory with -o.")
    return ours


def has_frames(directory: Path) -> bool:
    """Return whether a directory contains a frame of a run."""
    return (directory / PACKED).exists() or bool(sealed_segments(directory))


def close_abandoned(directory: Path, made: Sequence[Path], inputs: Collection[Path], pid: int, signal: str) -> None:
    """Close the result of a process `pid` that was killed by a signal: set "interrupted" in run.json.

    Without a frame, the files of the run but its `inputs` are removed, with the directories `made` for it, outermost
    first. A result of another process is not changed.
    """
    if not directory.is_dir():
        return
    taken = TakenDirectory(directory, take_lock(directory), tuple(made), frozenset(inputs))
    try:
        record = read_record(directory)
        process = (record or {}).get("process")
        ours = isinstance(process, dict) and process.get("pid") == pid and record["status"] == "running"
        if not has_frames(directory) and (ours or (record is None and made)):
            taken.undo()
        elif ours:
            with suppress(OSError):
                temporary_of(directory / PACKED).unlink(missing_ok=True)
            message = (
                f"the run was interrupted ({signal}) and ended by force; its frames are kept, and --resume goes on"
            )
            failure = {"message": message, "signal": signal}
            closed = {**record, "status": "interrupted", "ended": time_now(), "failure": failure}
            write_text(directory / RECORD, json.dumps(closed, indent=2, ensure_ascii=False) + "\n")
    finally:
        taken.release()
