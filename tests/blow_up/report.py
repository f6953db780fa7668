"""The study of stable steps as Markdown: its table, what holds of it, and what does not."""

import math
from collections.abc import Sequence
from statistics import median

from blow_up.trial import Measured

# Growth between the fifth and the last tenth of the long run that is none.
NO_GROWTH = 2.0
# What the median over the bulk scenes is expected to lie between.
EXPECTED_MEDIAN = (1.0, 1.4)
HEAD = [
    "scene",
    "",
    "particles",
    "bound",
    "predicted, s",
    "measured, s",
    "measured / predicted",
    "at 0.98",
    "at 1.02",
]


def grew(row: Measured) -> bool:
    """Say whether the long run at 0.98 of the predicted step blew up or grew slowly."""
    return row.below.blew_up or row.below.late > NO_GROWTH


def bulk_median(rows: Sequence[Measured]) -> float:
    """Return the median of measured over predicted step of the bulk scenes, nan where there are none."""
    found = [row.ratio for row in rows if row.scene.kind == "bulk"]
    return median(found) if found else math.nan


def flaws(rows: Sequence[Measured]) -> list[str]:
    """Return a sentence for every expectation that the study misses."""
    found = []
    for row in rows:
        name = f"{row.scene.position.shape[1]}D {row.scene.kind}, {row.scene.name}"
        if grew(row):
            found.append(f"{name}: it grows at 0.98 of the predicted step.")
        if row.scene.exact and not row.above.blew_up:
            found.append(f"{name}: it does not blow up at 1.02 of the predicted step.")
    middle, (low, high) = bulk_median(rows), EXPECTED_MEDIAN
    if middle < low or middle > high:
        found.append(f"The median over the bulk scenes is {middle:.3f}, which is not between {low:g} and {high:g}.")
    return found


def table_rows(rows: Sequence[Measured]) -> list[list[str]]:
    """Return the cells of the table, a row per scene, under HEAD."""
    cells = []
    for row in rows:
        never = math.isinf(row.ratio)
        cells.append(
            [
                row.scene.name,
                f"{row.scene.position.shape[1]}D {row.scene.kind}",
                str(row.particles),
                row.limit,
                f"{row.predicted:.3e}",
                "none" if never else f"{row.ratio * row.predicted:.3e}",
                "" if never else f"{row.ratio:.3f}",
                "grows" if grew(row) else f"{row.below.largest:.3g}",
                f"blows up in {row.above.steps}" if row.above.blew_up else "holds",
            ]
        )
    return cells


def summary(rows: Sequence[Measured]) -> list[str]:
    """Return the medians by kind, each with its range, as lines."""
    lines = []
    for kind in ("alone", "cluster", "bulk"):
        ratios = [row.ratio for row in rows if row.scene.kind == kind and not math.isinf(row.ratio)]
        if ratios:
            lines.append(
                f"* {kind}: median {median(ratios):.3f}, from {min(ratios):.3f} to {max(ratios):.3f}, "
                f"over {len(ratios)} scenes"
            )
    return lines
