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
    place = [np.minimum((x[:, a] * (1 / spacing)).astype(np.intp), n - 1) for a, n in enumerate(cells)]
    low, high = [0] * len(cells), [n - 1 for n in cells]
    if math.prod(cells) > WHOLE:
        low, high = [int(own.min()) for own in place], [int(own.max()) for own in place]
    # One cell more on each side: a wall asks for nothing, the void is empty.
    shape = [last - first + 3 for first, last in zip(low, high, strict=True)]
    index = place[0] + (1 - low[0])
    for own, first, count in zip(place[1:], low[1:], shape[1:], strict=True):
        index *= count
        index += own + (1 - first)
    size = math.prod(shape)
    if flows.all():
        held = np.bincount(index, volume, size).reshape(shape)
        inside = held > 0
    else:
        held = np.bincount(index[flows], volume[flows], size).reshape(shape)
        inside = (held > 0) & (np.bincount(index[~flows], minlength=size).reshape(shape) == 0)
    for axis, count in enumerate(cells):
        planes = inside.swapaxes(0, axis)
        planes[0], planes[-1] = low[axis] == 0, high[axis] == count - 1
    for axis in range(len(cells)):
        planes = inside.swapaxes(0, axis)
        inside = (planes[:-2] & planes[1:-1] & planes[2:]).swapaxes(0, axis)
    count = int(np.count_nonzero(inside))
    if count < FEWEST:
        return 0.0
    within = held[(slice(1, -1),) * len(cells)]
    return float(count * spacing ** len(cells) / within[inside].sum() - 1)
