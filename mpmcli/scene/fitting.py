"""Points of a sample chosen so that a shape has its density: their number times the volume of a cell is its volume.

The points of a lattice that lie in a shape are too many or too few by those of a row, unless its faces lie midway
between rows. All particles of a body have the same mass, so that its density inside would be wrong by as much.
"""

from itertools import product

import numpy as np

from mpmcli.scene.primitives import Solid

# Largest relative error of the number of points for which they are left as they are.
CLOSE = 0.002
# Points per axis at which the share of a cell inside the shape is counted.
FINE = {2: 6, 3: 4}
# Smallest share of its volume that the corners of cells find in a form that is not thin.
THIN = 0.9
_CELLS_AT_ONCE = 2**14
_GOLDEN = (5**0.5 - 1) / 2


def fitted(form: Solid, points: np.ndarray, middles: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Return the points of a sample that fill a form, (k, d), m, with k |cell| its volume.

    If those inside are too many or too few, the cells with the largest share inside the form are chosen, and of equal
    cells that cannot all be chosen some, spread evenly and in opposite pairs. A chosen point outside moves to the
    nearest counted place of its cell inside. A remaining error above `CLOSE` stretches the sample about its middle.

    Args:
        form: the form.
        points: a point in each cell that may lie in the form, (n, d), m.
        middles: the middles of these cells, (n, d), m.
        cell: the edges of a cell, a row each, (d, d), m.
    """
    inside = form.contains(points)
    wanted = form.volume / abs(np.linalg.det(cell))
    if abs(inside.sum() - wanted) <= CLOSE * wanted:
        return points[inside]
    d = len(cell)
    fine = (np.array(list(product(range(FINE[d]), repeat=d))) + 0.5) / FINE[d] - 0.5
    shares = _shares(form, middles, cell, fine @ cell)
    if shares.sum() < THIN * wanted:
        shares = _shares(form, middles, None, fine @ cell)
    chosen = _chosen(shares, wanted)
    if not len(chosen):
        return points[inside]
    found = points[chosen].copy()
    for k in np.flatnonzero(~inside[chosen]):
        places = middles[chosen[k]] + fine @ cell
        places = places[form.contains(places)]
        found[k] = places[np.argmin(np.sum((places - found[k]) ** 2, axis=1))]
    if abs(len(found) - wanted) <= CLOSE * wanted:
        return found
    middle = np.mean(form.bounds(), axis=0)
    stretched = middle + (wanted / len(found)) ** (1 / d) * (found - middle)
    return np.where(form.contains(stretched)[:, None], stretched, found)


def _shares(form: Solid, middles: np.ndarray, cell: np.ndarray | None, fine: np.ndarray) -> np.ndarray:
    """Return the share of each cell inside a form, (n,), by counting `fine` points.

    With the edges of the cells it is all or nothing if the corners and the middle of a cell are alike.
    """
    d = middles.shape[1]
    corners = np.zeros((1, d))
    if cell is not None:
        corners = np.vstack([corners, np.array(list(product((-0.5, 0.5), repeat=d))) @ cell])
    shares = np.empty(len(middles))
    for first in range(0, len(middles), _CELLS_AT_ONCE):
        some = middles[first : first + _CELLS_AT_ONCE]
        probes = form.contains((some[:, None] + np.vstack([corners, np.zeros(d)])).reshape(-1, d)).reshape(
            len(some), -1
        )
        own = probes.all(axis=1).astype(float)
        cut = np.flatnonzero(probes.any(axis=1) & ~probes.all(axis=1) if cell is not None else np.ones(len(some)))
        own[cut] = form.contains((some[cut, None] + fine).reshape(-1, d)).reshape(len(cut), -1).mean(axis=1)
        shares[first : first + len(some)] = own
    return shares


def _chosen(shares: np.ndarray, wanted: float) -> np.ndarray:
    """Return the numbers, ascending, of the cells with the largest shares, `wanted` of them up to a half or `CLOSE`."""
    n = len(shares)
    # Opposite cells of a lattice have the numbers k and n - 1 - k.
    pairs = np.minimum(np.arange(n), n - 1 - np.arange(n))
    order = np.lexsort((pairs * _GOLDEN % 1.0, -shares))
    order = order[shares[order] > 0.0]
    falls = np.flatnonzero(np.diff(shares[order])) + 1
    ends = np.append(falls, len(order))
    whole = ends[np.argmin(np.abs(ends - wanted))] if len(order) else 0
    count = whole if abs(whole - wanted) <= CLOSE * wanted else max(1, round(wanted))
    return np.sort(order[:count])
