"""The volume that liquids and grains fill on the grid, against that of their particles: an entry of the ledger."""

import math
from collections.abc import Sequence

import numpy as np

# Fewest cells inside the material that say anything: the edge of what is inside is sharp to a particle or so.
FEWEST = 64
# Cells of a domain above which only those that particles occupy are looked at.
WHOLE = 2**16


def volume_error(x: np.ndarray, volume: np.ndarray, flows: np.ndarray, spacing: float, cells: Sequence[int]) -> float:
    """Return the volume of the cells inside the material over that of the particles in them, less 1.

    A cell is inside where it and all of its neighbours, corners included, hold particles of materials that flow and of
    no others; beyond a wall there is nothing to ask for. With fewer than FEWEST such cells the result is 0.

    Args:
        x: (n, d), m, from the corner of the domain.
        volume: of each particle as it is, (n,), m^d.
        flows: whether the material of each particle flows, (n,) bool.
        spacing: m; cells: of the domain per axis.
    """
    if not flows.any():
        return 0.0
    some = not flows.all()
    counts = np.array(cells, np.int32)
    place = np.minimum((x * (1 / spacing)).astype(np.int32), counts - 1)
    low, high = np.zeros_like(counts), counts - 1
    if math.prod(cells) > WHOLE:
        low, high = place.min(0), place.max(0)
    # One cell more on each side: a wall asks for nothing, the void is empty.
    shape = (high - low + 3).tolist()
    strides = [math.prod(shape[a + 1 :]) for a in range(len(shape))]
    index = (place - low + 1) @ np.array(strides)
    held = np.bincount(index[flows] if some else index, volume[flows] if some else volume, math.prod(shape)).reshape(
        shape
    )
    inside = held > 0
    if some:
        inside &= np.bincount(index[~flows], minlength=held.size).reshape(shape) == 0
    before = ((), (slice(None),), (slice(None), slice(None)))
    for axis, count in enumerate(cells):
        inside[(*before[axis], 0)], inside[(*before[axis], -1)] = low[axis] == 0, high[axis] == count - 1
    for own in before[: len(cells)]:
        inside = inside[(*own, slice(-2))] & inside[(*own, slice(1, -1))] & inside[(*own, slice(2, None))]
    count = int(inside.sum())
    if count < FEWEST:
        return 0.0
    within = held[(slice(1, -1),) * len(cells)]
    return float(count * spacing ** len(cells) / within[inside].sum() - 1)
