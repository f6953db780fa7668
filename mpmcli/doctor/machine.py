"""Examines disk, memory and processor."""

import os
import shutil
import tempfile
from pathlib import Path

from mpmcli.doctor.probe_result import ProbeResult
from mpmcli.plain_text import size_text

# Bytes. Below this a run of the size of the demo may not fit.
LITTLE_DISK = LITTLE_MEMORY = 1e9
# Bytes. Below this nothing useful can be written.
NO_DISK = 1e7
CGROUP = Path("/sys/fs/cgroup")


def current_directory() -> ProbeResult:
    """Examine the current directory, the default place of results."""
    place = Path.cwd()
    elsewhere = "go to a directory of your own, or name one by -o"
    try:
        _write(place)
    except OSError as error:
        return ProbeResult("broken", f"{place} cannot be written ({error.strerror})", elsewhere)
    free = shutil.disk_usage(place).free
    detail = f"{place}, writable, {size_text(free)} free"
    if free < NO_DISK:
        return ProbeResult("broken", detail, "free some space, or name another disk by -o")
    if free < LITTLE_DISK:
        return ProbeResult("information", detail, "free some space, or name another disk by -o")
    return ProbeResult("ok", detail)


def kernel_cache() -> ProbeResult:
    """Examine the cache of compiled kernels, which is optional."""
    place = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi"
    try:
        place.mkdir(parents=True, exist_ok=True)
        _write(place)
    except OSError as error:
        return ProbeResult(
            "information",
            f"{place} cannot be written ({error.strerror}), so every run compiles its kernels anew",
            "make it writable, or let XDG_CACHE_HOME name a directory that is",
        )
    free = shutil.disk_usage(place).free
    detail = f"{place}, writable, {size_text(free)} free"
    return ProbeResult("ok", detail) if free >= NO_DISK else ProbeResult("information", detail, "free some space")


def memory() -> ProbeResult:
    """Examine the memory available to a run."""
    import psutil

    whole = psutil.virtual_memory()
    free, detail = whole.available, f"{size_text(whole.total)}, {size_text(whole.available)} free"
    limit = memory_limit()
    if limit is not None and limit < whole.total:
        free = min(free, limit)
        detail += f", the container may take {size_text(limit)}"
    if free < LITTLE_MEMORY:
        return ProbeResult("information", detail, "end other programs, or simulate fewer particles")
    return ProbeResult("ok", detail)


def cores() -> ProbeResult:
    """Examine the number of cores available to a run."""
    there = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else there
    detail = f"{usable} of {there} usable"
    limit = processor_limit()
    if limit is not None and limit < usable:
        return ProbeResult(
            "information",
            f"{detail}, the container may take the time of {limit:.3g}",
            f"simulate with --threads {max(1, int(limit))}",
        )
    return ProbeResult("ok", detail)


def memory_limit(root: Path = CGROUP) -> int | None:
    """Return the memory limit of the container, bytes, from Linux control groups v2 or v1; None without a limit."""
    words = _words(root / "memory.max") or _words(root / "memory" / "memory.limit_in_bytes")
    return int(words[0]) if words and words[0].isdigit() else None


def processor_limit(root: Path = CGROUP) -> float | None:
    """Return the processor limit of the container, in cores; None without a limit."""
    words = _words(root / "cpu.max") or [
        word for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us") for word in _words(root / "cpu" / name)
    ]
    if len(words) != 2 or not all(word.isdigit() for word in words) or not int(words[1]):
        return None  # "max" or -1
    return int(words[0]) / int(words[1])


def _write(place: Path) -> None:
    with tempfile.TemporaryFile(dir=place):
        pass


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
