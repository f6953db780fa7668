"""The volume that liquids and grains fill on the grid, against that of their particles: an entry of the ledger."""

import math
from collections.abc import Sequence

import numpy as np

# Fewest cells inside the material that say anything: the edge of what is inside is sharp to a particle or so.
FEWEST = 64
# Cells that are looked at at once. Of a larger domain only those that particles occupy are.
WHOLE = 2**16


def volume_errors(
    x: np.ndarray,
    volume: np.ndarray,
    flows: np.ndarray,
    spacing: float,
    cells: Sequence[int],
    periodic: Sequence[bool],
) -> np.ndarray:
    """Return the volume of the cells inside the material over that of the particles in them, less 1, at T times, (T,).

    A cell is inside where it and all of its neighbours, corners included, hold particles of materials that flow and of
    no others; beyond a wall there is nothing to ask for, beyond a periodic face is the other one. With fewer than
    FEWEST such cells the result is 0.

    Args:
        x: (T, n, d), m, from the corner of the domain.
        volume: of each particle as it is, (T, n), m^d.
        flows: whether the material of each particle flows, (n,) bool.
        spacing: m; cells: of the domain per axis; periodic: whether it repeats along them.
    """
    result = np.zeros(len(x))
    if flows.any():
        at_once = max(1, WHOLE // math.prod(cells))
        for first in range(0, len(x), at_once):
            own = slice(first, first + at_once)
            result[own] = _errors(x[own], volume[own], flows, spacing, cells, periodic)
    return result


def _errors(
    x: np.ndarray,
    volume: np.ndarray,
    flows: np.ndarray,
    spacing: float,
    cells: Sequence[int],
    periodic: Sequence[bool],
) -> np.ndarray:
    place = [np.minimum((x[:, :, a] * (1 / spacing)).astype(np.intp), n - 1) for a, n in enumerate(cells)]
    low, high = [0] * len(cells), [n - 1 for n in cells]
    if math.prod(cells) > WHOLE:
        low, high = [int(own.min()) for own in place], [int(own.max()) for own in place]
    # One cell more on each side: a wall asks for nothing, the void is empty.
    shape = [len(x)] + [last - first + 3 for first, last in zip(low, high, strict=True)]
    index = np.arange(len(x))[:, None]
    for own, first, count in zip(place, low, shape[1:], strict=True):
        index = index * count
        index = index + (own + (1 - first))
    size = math.prod(shape)
    if flows.all():
        held = np.bincount(index.ravel(), volume.ravel(), size).reshape(shape)
        inside = held > 0
    else:
        held = np.bincount(index[:, flows].ravel(), volume[:, flows].ravel(), size).reshape(shape)
        inside = (held > 0) & (np.bincount(index[:, ~flows].ravel(), minlength=size).reshape(shape) == 0)
    for axis, count in enumerate(cells):
        planes = inside.swapaxes(0, 1 + axis)
        whole = low[axis] == 0, high[axis] == count - 1
        planes[0], planes[-1] = whole
        if periodic[axis]:
            # Cells that are not looked at are empty.
            planes[0], planes[-1] = (planes[-2], planes[1]) if all(whole) else (False, False)
    for axis in range(len(cells)):
        planes = inside.swapaxes(0, 1 + axis)
        inside = (planes[:-2] & planes[1:-1] & planes[2:]).swapaxes(0, 1 + axis)
    inside = inside.reshape(len(x), -1)
    within = held[(slice(None), *(slice(1, -1),) * len(cells))].reshape(len(x), -1)
    counts = np.count_nonzero(inside, axis=1)
    enough = counts >= FEWEST
    # In one order, whatever the number of times.
    filled = np.where(inside, within, 0.0).sum(axis=1)
    return np.where(enough, counts * spacing ** len(cells) / np.where(enough, filled, 1.0) - 1, 0.0)
