"""Which process writes a directory, told apart from every other one, also after it has ended."""

import hashlib
import os
import socket
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

BOOT_ID, MACHINE_ID = Path("/proc/sys/kernel/random/boot_id"), Path("/etc/machine-id")
# Where boot identifiers are missing, boots count as the same whose times differ by less, s.
SAME_BOOT = 60.0

Life = Literal["lives", "ended", "elsewhere"]


@dataclass(frozen=True)
class Owner:
    """A process, as others can recognise it.

    Attributes:
        pid: its number; `space` tells namespaces of such numbers apart, as containers have them; "" where unknown.
        started: when the process began: clock ticks since boot on Linux, which no change of the clock moves, and
            seconds since 1970 elsewhere.
        host: a hash of name and identifier of the machine. It tells machines apart without naming them, since
            run.json is published with its data.
        boot: identifier of the boot: the same process number after another boot is another process.
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
        """Return the owner that `as_dict` has told, None where these are not such facts."""
        try:
            words = {name: str(facts[name]) for name in ("host", "boot")}
            return cls(int(facts["pid"]), float(facts["started"]), space=str(facts.get("space", "")), **words)
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON can hold it."""
        return asdict(self)

    @property
    def shares_kernel(self) -> bool:
        """Whether it runs or ran under the running kernel, in which locks of files tell of all processes."""
        return _same_boot(self.boot, _boot())

    @property
    def life(self) -> Life:
        """Whether the process lives; "elsewhere" where that cannot be seen from here."""
        if self.shares_kernel:
            if self.space != _space():
                return "elsewhere"
            start = process_start(self.pid)
            return "lives" if start is not None and abs(start - self.started) < 2 else "ended"
        return "ended" if self.host == _host() else "elsewhere"


def process_start(pid: int) -> float | None:
    """Return when a process began, see `Owner.started`; None where there is no such process, or only its remains."""
    try:
        # The second field, the name, may hold anything.
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


def _same_boot(one: str, other: str) -> bool:
    with suppress(ValueError):
        return abs(float(one) - float(other)) < SAME_BOOT
    return one == other


@cache
def _space() -> str:
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""
