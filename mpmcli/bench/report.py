"""The machine of a benchmark, and its tables, in Markdown with aligned columns."""

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from pathlib import Path

from mpmcli import __version__


def describe_machine() -> dict:
    """Return processor, system and versions."""
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


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return a table whose first `left` columns are aligned to the left, and all others to the right."""
    widths = [max(3, *(len(row[k]) for row in [head, *rows])) for k in range(len(head))]
    rule = ["-" * width if k < left else "-" * (width - 1) + ":" for k, width in enumerate(widths)]
    lines = [
        [
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in [head, *rows]
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], rule, *lines[1:]])
