"""The machine of a benchmark, and the page around its tables."""

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from pathlib import Path

from mpmcli import __version__


def describe_machine() -> dict:
    """Return the processor, the system and the versions."""
    return {
        "processor": _processor_name(),
        "logical_processors": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "taichi": importlib.metadata.version("taichi"),
        "mpmcli": __version__,
    }


def _processor_name() -> str:
    described = Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def page(machine: dict, what: str, table: str, notes: Sequence[str]) -> str:
    """Return a table with a line about the machine above it, and notes below."""
    top = f"{machine['processor']}, {what}, f32, Taichi {machine['taichi']}."
    return "\n\n".join(filter(None, [top, table, "\n".join(notes)]))
