"""Points on a surface at a spacing: along the lines of a 2D surface, and apart from each other on one in 3D."""

import math
from itertools import pairwise

import numpy as np

from mpmcli.scene.surface import Surface

# Cosine of the angle from which on an edge is sharp.
SHARP = math.cos(math.radians(30.0))
# Least distance in spacings: as close as random disks lie on average, one to a square of the spacing.
APART = 0.78
# Candidates to a square of the spacing.
CANDIDATES = 24
SEED = 0


def surface_points(surface: Surface, spacing: float) -> np.ndarray:
    """Return points on a surface, (n, d), about one to a length (2D) or square (3D) of the spacing, m.

    Corners in 2D, and sharp edges in 3D, have points of their own. The same surface always gives the same.
    """
    if len(surface.cells) == 0:
        return np.empty((0, surface.points.shape[1]))
    if surface.points.shape[1] == 2:
        return np.concatenate([_along(chain, spacing) for chain in surface.chains()])
    return _apart(surface, spacing)


def _along(chain: np.ndarray, spacing: float) -> np.ndarray:
    """Return points at equal distances between the corners of a line (k, 2)."""
    chain = chain[[True, *(np.diff(chain, axis=0) != 0).any(axis=1)]]
    closed = len(chain) > 2 and np.array_equal(chain[0], chain[-1])
    if closed:
        # It begins at a corner, if there is one.
        turns = np.flatnonzero(_turns(np.concatenate([chain[-2:-1], chain])))
        chain = np.roll(chain[:-1], -int(turns[0]) if len(turns) else 0, axis=0)
        chain = np.concatenate([chain, chain[:1]])
    cuts = [0, *(1 + np.flatnonzero(_turns(chain))).tolist(), len(chain) - 1]
    found = [_even(chain[a : b + 1], spacing) for a, b in pairwise(cuts)]
    return np.concatenate(found if closed else [*found, chain[-1:]])


def _turns(chain: np.ndarray) -> np.ndarray:
    """Say of the points of a line (k, 2), but for its ends, whether it turns there, (k - 2,)."""
    along = np.diff(chain, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.sum(along[1:] * along[:-1], axis=1) < SHARP


def _even(chain: np.ndarray, spacing: float) -> np.ndarray:
    """Return points at equal distances on a line (k, d), the first one and not the last."""
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    count = max(round(gone[-1] / spacing), 1)
    places = gone[-1] * np.arange(count) / count
    return np.stack([np.interp(places, gone, axis) for axis in chain.T], axis=1)


def _apart(surface: Surface, spacing: float) -> np.ndarray:
    """Return random points on triangles that are apart from each other: on the sharp edges first.

    Of the candidates, in random order, each is taken that has none before it within the least distance.
    """
    from scipy.spatial import cKDTree

    random = np.random.default_rng(SEED)
    shares = surface.sizes / surface.sizes.sum()
    count = max(math.ceil(CANDIDATES * surface.sizes.sum() / spacing**2), 1)
    cells = surface.cells[np.searchsorted(np.cumsum(shares), random.random(count) * (1 - 1e-12))]
    u, v = random.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (surface.points[cells[:, k]] for k in range(3))
    points = np.concatenate([_edge_points(surface, spacing), a + u * (b - a) + v * (c - a)])
    pairs = cKDTree(points).query_pairs(APART * spacing, output_type="ndarray")
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    open_, taken = np.ones(len(points), bool), np.zeros(len(points), bool)
    while open_.any():
        # In each round those are taken that wait for no other.
        waits = np.zeros(len(points), bool)
        waits[second] = True
        new = open_ & ~waits
        taken |= new
        near = np.concatenate([second[new[first]], first[new[second]]])
        open_[new] = open_[near] = False
        kept = open_[first] & open_[second]
        first, second = first[kept], second[kept]
    return points[taken]


def _edge_points(surface: Surface, spacing: float) -> np.ndarray:
    """Return points on the sharp edges and rims of triangles, at most a spacing apart, (n, 3)."""
    edges = np.concatenate([surface.cells[:, [k, (k + 1) % 3]] for k in range(3)])
    cell = np.tile(np.arange(len(surface.cells)), 3)
    ordered = np.sort(edges, axis=1)
    order = np.lexsort((ordered[:, 1], ordered[:, 0]))
    ordered, cell = ordered[order], cell[order]
    same = (ordered[1:] == ordered[:-1]).all(axis=1)
    normals = surface.normals
    sharp = np.ones(len(ordered), bool)
    flat = same & (np.sum(normals[cell[1:]] * normals[cell[:-1]], axis=1) >= SHARP)
    sharp[1:][flat] = sharp[:-1][flat] = False
    found = [np.empty((0, 3))]
    for a, b in surface.points[np.unique(ordered[sharp], axis=0)]:
        count = max(round(float(np.linalg.norm(b - a)) / spacing), 1)
        found.append(a + np.arange(count + 1)[:, None] / count * (b - a))
    return np.concatenate(found)
