"""Points of a sample chosen so that a shape has its density: their number times the volume of a cell is its volume.

The points of a lattice that lie in a shape are too many or too few by those of a row, unless its faces lie midway
between rows. All particles of a body have the same mass, so that its density inside would be wrong by as much.
"""

from collections.abc import Callable, Iterable
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

# Points, one in each cell that may lie in a form, (n, d), m, and the middles of these cells; some at a time.
Sample = Iterable[tuple[np.ndarray, np.ndarray]]


def fitted(form: Solid, sample: Callable[[], Sample], cell: np.ndarray) -> np.ndarray:
    """Return the points of a sample that fill a form, (k, d), m, with k |cell| its volume.

    If those inside are too many or too few, the cells with the largest share inside the form are chosen, and of equal
    cells that cannot all be chosen some, spread evenly, each with its images in the middle planes of the form, so that
    its centre of mass stays. A chosen point outside moves to the nearest counted place of its cell inside. A remaining
    error above `CLOSE` stretches the sample about its middle.

    Args:
        form: the form.
        sample: returns the sample, the same at each call.
        cell: the edges of a cell, a row each, (d, d), m.
    """
    inside = np.concatenate([points[form.contains(points)] for points, _ in sample()])
    wanted = form.volume / abs(np.linalg.det(cell))
    if abs(len(inside) - wanted) <= CLOSE * wanted:
        return inside
    d = len(cell)
    fine = ((np.array(list(product(range(FINE[d]), repeat=d))) + 0.5) / FINE[d] - 0.5) @ cell
    # The middle and the corners of a cell.
    probes = np.vstack([np.zeros(d), np.array(list(product((-0.5, 0.5), repeat=d))) @ cell])
    points, middles, shares = _filled(form, sample, probes, fine)
    if shares.sum() < THIN * wanted:
        points, middles, shares = _filled(form, sample, None, fine)
    if not len(points):
        return inside
    middle = np.mean(form.bounds(), axis=0)
    away = np.round(np.abs(middles - middle) / np.ptp(form.bounds(), axis=0), 6)
    chosen = _chosen(shares, np.unique(away, axis=0, return_inverse=True)[1].reshape(-1), wanted)
    found = points[chosen]
    for k in np.flatnonzero(~form.contains(found)):
        places = middles[chosen[k]] + fine
        places = places[form.contains(places)]
        found[k] = places[np.argmin(np.sum((places - found[k]) ** 2, axis=1))]
    if abs(len(found) - wanted) <= CLOSE * wanted:
        return found
    stretched = middle + (wanted / len(found)) ** (1 / d) * (found - middle)
    return np.where(form.contains(stretched)[:, None], stretched, found)


def _filled(
    form: Solid, sample: Callable[[], Sample], probes: np.ndarray | None, fine: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and middles of the cells that a form meets, and their shares in it, (n,).

    A share is that of the `fine` places; with `probes` it is all or nothing if these are alike.
    """
    found = []
    for all_points, all_middles in sample():
        for first in range(0, len(all_middles), _CELLS_AT_ONCE):
            rows = slice(first, first + _CELLS_AT_ONCE)
            points, middles = all_points[rows], all_middles[rows]
            shares, cut = np.zeros(len(middles)), np.arange(len(middles))
            if probes is not None:
                within = _contains(form, middles, probes)
                shares, cut = within.all(axis=1).astype(float), np.flatnonzero(within.any(axis=1) & ~within.all(axis=1))
            shares[cut] = _contains(form, middles[cut], fine).mean(axis=1)
            met = np.flatnonzero(shares)
            found.append((points[met], middles[met], shares[met]))
    points, middles, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return points, middles, shares


def _contains(form: Solid, middles: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return whether each place of each cell lies in a form, (n, k)."""
    places = (middles[:, None] + offsets).reshape(-1, middles.shape[1])
    return form.contains(places).reshape(len(middles), len(offsets))


def _chosen(shares: np.ndarray, images: np.ndarray, wanted: float) -> np.ndarray:
    """Return the indices, ascending, of about `wanted` cells with the largest shares.

    Cells with the same number in `images` and the same share stay together.
    """
    order = np.lexsort((images, images * _GOLDEN % 1.0, -shares))
    falls, changes = np.diff(shares[order]) != 0, np.diff(images[order]) != 0
    for splits in (falls, falls | changes):
        ends = np.append(np.flatnonzero(splits) + 1, len(order))
        count = int(ends[np.argmin(np.abs(ends - wanted))])
        if abs(count - wanted) <= CLOSE * wanted:
            break
    return np.sort(order[:count])
