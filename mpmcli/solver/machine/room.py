"""Room for a scene in few sizes: those of arrays are a part of kernels, which are found again for other scenes."""

from collections.abc import Sequence
from dataclasses import replace

from mpmcli.boundaries.colliders import ColliderKind

# Entries, and colliders, up to which there is room for as many.
FEWEST, FEWEST_COLLIDERS = 1024, 4
# Cells along an axis are multiples of these in 2D and 3D where they are few, and of the third otherwise.
FEW_CELLS, FEW_TIMES, CELLS = 64, {2: 16, 3: 8}, 4
# Entries by which more are off from multiples of powers of two: arrays of such sizes, one after the other, begin in the
# same set of lines of a cache, and steps in 2D take a fifth longer.
SKEW = 336


def power_of_two(count: int) -> int:
    """Return the next power of two, at least 1."""
    return 1 << max(0, count - 1).bit_length()


def in_steps(count: int) -> int:
    """Return room for so many entries, in eighths of a power of two: none, or `FEWEST` at least."""
    if count > FEWEST:
        return _multiple(count - SKEW, power_of_two(count - SKEW) // 16) + SKEW
    return FEWEST if count else 0


def roomy_cells(cells: Sequence[int]) -> tuple[int, ...]:
    """Return the cells per axis for which a dense grid has nodes, in sixteenths of a power of two above 64."""
    few = FEW_TIMES[len(cells)]
    return tuple(_multiple(n, few if n <= FEW_CELLS else max(CELLS, power_of_two(n) // 32)) for n in cells)


def roomy_colliders(kind: ColliderKind) -> ColliderKind:
    count = max(FEWEST_COLLIDERS, power_of_two(kind.count)) if kind.count else 0
    sizes = {name: in_steps(getattr(kind, name)) for name in ("numbers", "samples", "points")}
    return replace(kind, count=count, **sizes)


def _multiple(count: int, step: int) -> int:
    return -(-count // max(1, step)) * max(1, step)
