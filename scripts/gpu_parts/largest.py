"""The largest runs, one contestant after another, each with the device to itself."""

from collections.abc import Sequence

from gpu_parts import bench
from gpu_parts.bench import Size, compare
from gpu_parts.parts import Setup, Task

# Blocks are long enough for some steps of 1e8 particles.
SECONDS = 2.0
TINY, SMALL = Size(3, 600, 16, 8e-4, ()), Size(3, 100_000, 64, 2e-4, ())
FULL = Size(3, 100_000_000, 512, 2e-5, ())


def tasks(setup: Setup) -> Sequence[Task]:
    """Return a task for each contestant."""
    size = setup.sized(TINY, SMALL, FULL)
    seconds = setup.sized(0.1, 0.5, SECONDS)
    alone = [Size(size.dimension, size.particles, size.cells, size.step, (who,)) for who in ("ours", "solid", "peer")]
    return [Task(f"{one.key} {one.who[0]}", lambda left, s=one: compare(s, setup.arch, seconds)) for one in alone]


def section(rows: dict[str, dict]) -> str:
    """Return the table of all contestants of a size."""
    together: dict[str, dict] = {}
    for key, row in rows.items():
        if "skipped" not in row:
            size = key.rpartition(" ")[0]
            joined = together.setdefault(size, {"cells": row["cells"], "contestants": {}})
            joined["contestants"] |= row["contestants"]
    return bench.section(together)
