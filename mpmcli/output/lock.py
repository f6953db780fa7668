"""The lock of a directory that is being written: one writer at a time, and a file that names it.

The system holds the lock (flock), and releases it however the process ends; the content of the file tells who has it.
The file is removed with the lock, so that one that stays behind is of a process that was killed.
"""

import errno
import json
import os
import socket
import time
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError
from mpmcli.output.owner import Owner, time_now

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = "run.lock"
# Time for which a lock may be held by a process that looks at it, or that is just being killed, s.
PATIENCE = 0.5
PAUSE = 0.02
# What a file system answers that has no locks.
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


class DirectoryLock:
    """A lock that is held; made by `take_lock`."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    def release(self) -> None:
        """Remove the file and give the lock free; a second call does nothing."""
        if self._descriptor < 0:
            return
        try:
            self.path.unlink(missing_ok=True)
        except OSError:
            pass
        finally:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> "DirectoryLock":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def take_lock(directory: Path) -> DirectoryLock:
    """Take the lock of a directory, which exists, also from a process that has ended.

    Between the look and the taking nothing can come: the system gives a lock to one process, and only its holder
    reads, writes and removes the file. Where a file system has no locks, the file alone tells of the owner, and two
    processes may take it over at the same moment.

    Raises:
        InputError: another process has it, or one of another machine may have it.
    """
    path = Path(directory) / LOCK
    until = time.monotonic() + PATIENCE
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)
        except OSError as error:
            raise _cannot(directory, error) from error
        try:
            got = _lock(descriptor, exclusive=True)
            content = _content(path)
            if got is False:
                if time.monotonic() < until:
                    os.close(descriptor)
                    descriptor = -1
                    time.sleep(PAUSE)
                    continue
                raise InputError(_held(directory, content))
            if not _is_at(descriptor, path):
                # Its holder has removed it between the two calls.
                os.close(descriptor)
                descriptor = -1
                continue
            _refuse_foreign(directory, content, locks_work=got is True)
            try:
                _write(descriptor)
            except OSError:
                # The disk is full.
                path.unlink(missing_ok=True)
                raise
        except BaseException as error:
            if descriptor >= 0:
                os.close(descriptor)
            if isinstance(error, OSError):
                raise _cannot(directory, error) from error
            raise
        return DirectoryLock(path, descriptor)


def refuse_locked(directory: Path) -> None:
    """Refuse a directory that another process is writing; nothing is taken or changed.

    Raises:
        InputError: as `take_lock`.
    """
    path = Path(directory) / LOCK
    until = time.monotonic() + PATIENCE
    while lock_is_held(directory):
        if time.monotonic() > until:
            raise InputError(_held(directory, _content(path)))
        time.sleep(PAUSE)
    if path.exists():
        _refuse_foreign(directory, _content(path), locks_work=fcntl is not None)


def lock_is_held(directory: Path) -> bool:
    """Return whether a process has the lock of a directory; False also where the system cannot tell."""
    try:
        descriptor = os.open(Path(directory) / LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        return _lock(descriptor, exclusive=False) is False
    finally:
        os.close(descriptor)


def _lock(descriptor: int, *, exclusive: bool) -> bool | None:
    """Return whether the system gave the lock; None where it has no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        if error.errno in NO_LOCKS:
            return None
        raise
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Return whether the open file is the one of this name."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _write(descriptor: int) -> None:
    facts = {"machine": socket.gethostname(), "since": time_now(), **Owner.here().as_dict()}
    os.ftruncate(descriptor, 0)
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, (json.dumps(facts) + "\n").encode())


def _refuse_foreign(directory: Path, content: dict[str, Any], *, locks_work: bool) -> None:
    """Refuse a file whose owner may live although the system gives the lock.

    Raises:
        InputError: it may.
    """
    owner = Owner.read(content)
    if owner is None or (locks_work and owner.shares_kernel) or owner.life == "ended":
        return
    if owner.life == "lives":
        if owner.pid != os.getpid():
            raise InputError(_held(directory, content))
        return
    raise InputError(
        f"{directory} was locked by {_named(content)}, and whether that process has ended cannot be seen from here: "
        f"if it has, remove {Path(directory) / LOCK}; or give another directory with -o."
    )


def _cannot(directory: Path, error: OSError) -> InputError:
    return InputError(f"{directory} cannot be locked ({error.strerror or error}): give another place with -o.")


def _held(directory: Path, content: dict[str, Any]) -> str:
    return (
        f"{directory} is being written by {_named(content)}: wait until that process has ended, end it, or give "
        "another directory with -o."
    )


def _named(content: dict[str, Any]) -> str:
    """Return who holds a lock, in words; what a file says is printed without control characters."""
    owner = Owner.read(content)
    if owner is None:
        return "another process"
    machine, since = (_printable(content.get(name)) for name in ("machine", "since"))
    return f"process {owner.pid} on {machine} since {since}"


def _printable(value: object) -> str:
    return "".join(c if c.isprintable() else "?" for c in str(value))[:80]
