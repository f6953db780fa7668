"""What the tables of the benchmark have in common: the machine, and how a record is written as text.

A record is what a benchmark has found, as a dictionary for JSON.
"""

import importlib.metadata
import os
import platform
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from mpmcli import __version__
from mpmcli.bench.side import BenchOptions
from mpmcli.plain_text import counted, text_table

# All tables are of single precision.
PRECISION = "f32"
# Why a contestant is not sound.
REASON = "(a particle left the box or is not a number)"


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


def head(options: BenchOptions, **settings: object) -> dict:
    """Return how a record begins: machine and settings, of which not all tables have `threads` and `arch`."""
    known = {"machine": describe_machine(), "precision": PRECISION, "block_s": options.seconds, **settings}
    return {name: known[name] for name in ("machine", "threads", "precision", "arch", "block_s") if name in known}


def page(heading: str, tables: Iterable[str], notes: Iterable[str], warnings: Iterable[str] = ()) -> str:
    """Return a table of the benchmark as text: its heading, its rows, what the columns mean, and what to beware of."""
    below = "\n".join([*notes, *(f"Beware: {warning}" for warning in warnings)])
    return "\n\n".join(filter(None, [heading, *tables, below]))


def heading(record: dict, threads: Sequence[int]) -> str:
    """Return the line above a table: machine, numbers of threads and precision."""
    *others, last = threads
    numbers = ", ".join(map(str, others)) + " and " * bool(others) + counted(last, "thread")
    machine = record["machine"]
    return f"{machine['processor']}, {record.get('arch', 'cpu')}, {numbers}, {PRECISION}, taichi {machine['taichi']}"


def rows_text(rows: Iterable[dict], columns: Sequence[tuple[str, Callable[[dict], str]]], left: set[int]) -> str:
    """Write a line for each row of a record; a column is its head and what it says of a row."""
    lines = [tuple(cell(row) for _, cell in columns) for row in rows]
    return text_table(tuple(head for head, _ in columns), lines, left)


def number(value: float | None, form: str) -> str:
    """Write a number, nothing where it was not measured."""
    return "" if value is None else format(value, form)


def span(values: Sequence[float]) -> tuple[float, float]:
    """Return the smallest and the largest of some values."""
    return min(values), max(values)


def ratios_of(figures: dict, *others: dict) -> list[float]:
    """Return the cost of each block over the mean of those of the others in the same round."""
    rounds = zip(*(one["ns_per_particle_step_blocks"] for one in (figures, *others)), strict=True)
    return [cost / statistics.fmean(beside) for cost, *beside in rounds]


def picked(figures: dict, names: str) -> dict:
    """Return the figures of these names, which have spaces between them."""
    return {name: figures[name] for name in names.split()}
