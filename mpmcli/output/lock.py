"""The lock of a directory: one writer at a time, named in a lock file.

The operating system holds the lock (filelock) and releases it however the process ends. What filelock lacks: the file
identifies the owner uniquely, also after it has ended; it is removed with the lock, so that a remaining file belongs to
a process that was killed; and a lock is inspected without being taken.
"""

import errno
import hashlib
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from mpmcli.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = "run.lock"
# Time for which a process that inspects the lock, or is being killed, may hold it, s.
PATIENCE = 0.5
PAUSE = 0.02
# Error codes of a file system without locks.
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
BOOT_ID, MACHINE_ID = Path("/proc/sys/kernel/random/boot_id"), Path("/etc/machine-id")
# Without boot identifiers, boots whose times differ by less count as the same, s.
SAME_BOOT = 60.0

Life = Literal["lives", "ended", "elsewhere"]


@dataclass(frozen=True)
class Owner:
    """A process, identified for other processes.

    `space` identifies the namespace of process numbers. `started` is in clock ticks since boot on Linux, independent of
    changes of the clock, else in seconds since 1970. `host` is a hash of the machine's name and identifier, as run.json
    is published with its data; `boot` identifies the boot.
    """

    pid: int
    started: float
    host: str
    boot: str
    space: str = ""

    @classmethod
    def here(cls) -> "Owner":
        """Return this process."""
        pid = os.getpid()
        return cls(pid, process_start(pid) or 0.0, _host(), _boot(), _space())

    @classmethod
    def read(cls, facts: Any) -> "Owner | None":
        """Return the owner from written fields, None if the fields are invalid."""
        try:
            words = {name: str(facts[name]) for name in ("host", "boot")}
            return cls(int(facts["pid"]), float(facts["started"]), space=str(facts.get("space", "")), **words)
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    @property
    def shares_kernel(self) -> bool:
        """Whether it runs or ran under the running kernel, whose file locks cover all processes."""
        with suppress(ValueError):
            return abs(float(self.boot) - float(_boot())) < SAME_BOOT
        return self.boot == _boot()

    @property
    def life(self) -> Life:
        """Whether the process lives; "elsewhere" if this process cannot tell."""
        if self.shares_kernel:
            if self.space != _space():
                return "elsewhere"
            start = process_start(self.pid)
            return "lives" if start is not None and abs(start - self.started) < 2 else "ended"
        return "ended" if self.host == _host() else "elsewhere"


def process_start(pid: int) -> float | None:
    """Return the start of a process, see `Owner.started`; None if there is no such process, or a zombie."""
    try:
        # The second field, the name, may contain any character.
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return None if fields[0] in "ZX" else float(fields[19])
    except FileNotFoundError:
        if Path("/proc/self/stat").exists():
            return None
    except (OSError, IndexError, ValueError):
        pass
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except psutil.Error:
        return None


def time_now() -> str:
    """Return the time, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@cache
def _host() -> str:
    identifier = ""
    with suppress(OSError):
        identifier = MACHINE_ID.read_text(encoding="utf-8").strip()
    return hashlib.sha256(f"mpmcli {socket.gethostname()} {identifier}".encode()).hexdigest()[:16]


@cache
def _boot() -> str:
    with suppress(OSError):
        return BOOT_ID.read_text(encoding="utf-8").strip()
    import psutil

    return f"{psutil.boot_time():.0f}"


@cache
def _space() -> str:
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""


def take_lock(directory: Path) -> ExitStack:
    """Take the lock of a directory, also from a process that has ended; InputError: another process may hold it.

    The first close of the returned stack removes the file and releases the lock.

    Only the holder of the system's lock writes and removes the file. On a file system without locks, two processes may
    take over the lock at the same moment.
    """
    path = Path(directory) / LOCK
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link, and mpmcli writes a file there: remove it.")
    with ExitStack() as held:
        try:
            locked = held.enter_context(_system_lock(path))
            _refuse_foreign(directory, _content(path), locks_work=locked)
            held.callback(_remove, path)
            facts = {"machine": socket.gethostname(), "since": time_now(), **asdict(Owner.here())}
            path.write_text(json.dumps(facts) + "\n", encoding="utf-8")
        except Timeout:
            raise InputError(_held(directory, _content(path))) from None
        except OSError as error:
            raise refused(directory, "locked", error) from error
        return held.pop_all()


@contextmanager
def _system_lock(path: Path) -> Iterator[bool]:
    """Hold the system's lock of a file; yield False if the file system has none. Timeout: another process holds it."""
    # The file is removed while it is locked, see `_remove`: waiting processes then try the next one of this name.
    lock = FileLock(path, timeout=PATIENCE, poll_interval=PAUSE, preserve_lock_file=True, fallback_to_soft=False)
    try:
        lock.acquire()
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        yield lock.is_locked
    finally:
        lock.release()


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink(missing_ok=True)


def refuse_locked(directory: Path) -> None:
    """Raise the InputError of `take_lock` for a directory that another process is writing; change nothing."""
    path = Path(directory) / LOCK
    until = time.monotonic() + PATIENCE
    while lock_is_held(directory):
        if time.monotonic() > until:
            raise InputError(_held(directory, _content(path)))
        time.sleep(PAUSE)
    if path.exists():
        _refuse_foreign(directory, _content(path), locks_work=fcntl is not None)


def lock_is_held(directory: Path) -> bool:
    """Return whether a process holds the lock of a directory; False also if the system cannot tell.

    A shared lock of the system tells without a file being made or written, which a FileLock cannot.
    """
    try:
        descriptor = os.open(Path(directory) / LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError as error:
        return error.errno in (errno.EWOULDBLOCK, errno.EACCES)
    finally:
        os.close(descriptor)


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _refuse_foreign(directory: Path, content: dict[str, Any], *, locks_work: bool) -> None:
    """Refuse a lock file whose owner may live although the system grants the lock."""
    owner = Owner.read(content)
    if owner is None or (locks_work and owner.shares_kernel) or owner.life == "ended":
        return
    if owner.life == "lives":
        if owner.pid != os.getpid():
            raise InputError(_held(directory, content))
        return
    raise InputError(
        f"{directory} was locked by {_named(content)}, and whether that process has ended cannot be determined: "
        f"if it has, remove {Path(directory) / LOCK}; or give another directory with -o."
    )


def refused(directory: Path, what: str, error: OSError) -> InputError:
    """Return the error for a directory that cannot be "made", "written" or "locked"."""
    return InputError(f"{directory} cannot be {what} ({error.strerror or error}): give another place with -o.")


def _held(directory: Path, content: dict[str, Any]) -> str:
    return (
        f"{directory} is being written by {_named(content)}: wait until that process has ended, end it, or give "
        "another directory with -o."
    )


def _named(content: dict[str, Any]) -> str:
    """Return the holder of a lock in words; control characters of the file are removed."""
    owner = Owner.read(content)
    if owner is None:
        return "another process"
    told = (str(content.get(name)) for name in ("machine", "since"))
    machine, since = ("".join(c if c.isprintable() else "?" for c in text)[:80] for text in told)
    return f"process {owner.pid} on {machine} since {since}"
