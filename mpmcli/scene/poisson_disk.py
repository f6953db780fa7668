"""Poisson-disk samples: points at random, no two of which are closer than a radius, without room for another one."""

from itertools import product

import numpy as np

# Points per radius^d of a sample, as measured, in 2D and 3D. Without end it would be 0.6965 and 0.7334.
DENSITY = {2: 0.680, 3: 0.652}
# Cells per radius along an axis, rounds in which some of those with room offer a point, and points per radius^d that
# are offered in each.
_FINE, _ROUNDS, _OFFERED = {2: 6, 3: 4}, 14, 1.0
# Radii by which the box is enlarged: points at an edge lie more closely, as nothing competes with them beyond it.
_MARGIN = 3
_POINTS_AT_ONCE = 2_000


def disk_radius(spacing: float, d: int) -> float:
    """Return the radius at which a sample has as many points as a lattice of this spacing, m."""
    return DENSITY[d] ** (1 / d) * spacing


def poisson_disk(lower: np.ndarray, upper: np.ndarray, radius: float, generator: np.random.Generator) -> np.ndarray:
    """Return points in a box with corners (d,), at least `radius` apart, and nearly everywhere within it of each other.

    Dart throwing in cells that have room, after Ebeida et al. (2012): in each round some cells offer a point, those too
    close to a point that is there or to one offered before it are refused, and cells that a point covers are dropped.
    The same generator always gives the same points.

    Returns:
        (n, d), m; about DENSITY[d] points per radius^d.
    """
    from scipy.spatial import KDTree

    d = len(lower)
    width = radius / _FINE[d]
    # Beyond the margin there are cells that points cover, and that offer none.
    pad = _FINE[d] + 1
    start = lower - _MARGIN * radius - pad * width
    counts = np.ceil((upper + _MARGIN * radius - start) / width).astype(int) + pad
    free = np.zeros(counts, dtype=bool)
    free[(slice(pad, -pad),) * d] = True
    free = free.reshape(-1)
    share = _OFFERED / _FINE[d] ** d
    many = int(np.prod(counts - 2 * pad) * share) + 1
    found = np.empty((0, d))
    for _ in range(_ROUNDS):
        room = np.flatnonzero(free)
        if not len(room):
            break
        chosen = generator.choice(room, min(many, len(room)), replace=False)
        offered = np.stack(np.unravel_index(chosen, counts), axis=1) + generator.random((len(chosen), d))
        offered = start + width * offered
        if len(found):
            offered = offered[np.isinf(KDTree(found).query(offered, distance_upper_bound=radius, workers=-1)[0])]
        new = offered[_first_come(KDTree(offered).query_pairs(radius, output_type="ndarray"), len(offered))]
        found = np.concatenate([found, new])
        for first in range(0, len(new), _POINTS_AT_ONCE):
            free[_covered((new[first : first + _POINTS_AT_ONCE] - start) / width, counts)] = False
    return found[np.all((found >= lower) & (found <= upper), axis=1)]


def _covered(places: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the numbers of the cells whose corners are all within a radius of a place, (n, d), in cells."""
    d = places.shape[1]
    fine = _FINE[d]
    offsets = np.array(list(product(range(-fine, fine + 1), repeat=d)))
    offsets = offsets[np.sum(np.maximum(np.abs(offsets) - 0.5, 0.0) ** 2, axis=1) <= fine**2]
    cells = np.floor(places).astype(np.int64)
    inside = np.zeros((len(places), len(offsets)))
    for k in range(d):
        # The farthest corner of a cell is half a cell beyond its centre along each axis.
        inside += (np.abs(offsets[:, k] + (cells[:, k] + 0.5 - places[:, k])[:, None]) + 0.5) ** 2
    strides = np.cumprod([1, *counts[:0:-1]])[::-1]
    return ((cells @ strides)[:, None] + offsets @ strides)[inside <= fine**2]


def _first_come(pairs: np.ndarray, n: int) -> np.ndarray:
    """Return which of n points stay, (n,) bool, if each in turn is refused for one that stays before it.

    Args:
        pairs: numbers of points that are too close to each other, (k, 2), the smaller one first.
        n: number of points.
    """
    stays, undecided = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    while len(pairs):
        waits = np.zeros(n, dtype=bool)
        waits[pairs[:, 1]] = True
        stays |= undecided & ~waits
        undecided &= waits
        undecided[pairs[stays[pairs[:, 0]], 1]] = False
        pairs = pairs[undecided[pairs[:, 1]] & (undecided[pairs[:, 0]])]
    return stays | undecided
