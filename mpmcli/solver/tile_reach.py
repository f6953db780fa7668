"""The tiles whose nodes the particles of a tile may write, images behind walls included."""

from collections.abc import Sequence

import numpy as np

from mpmcli.boundaries.walls import REACH
from mpmcli.scene import Scene
from mpmcli.solver.splines import PAD, SPLINES


def reach_along(cells: int, tile: int, beyond: tuple[int, int], *, repeats: bool) -> np.ndarray:
    """Return per tile of an axis those that its particles reach, (tiles, k) int32, padded with -1.

    Args:
        cells: of the domain; tile: edge of a tile, cells.
        beyond: nodes that the stencils of its particles reach before the tile, and behind it.
        repeats: whether the domain repeats along the axis.
    """
    tiles, last = -(-(cells + 1 + 2 * PAD) // tile), cells + PAD
    found = []
    for t in range(tiles):
        low, high = t * tile - beyond[0], (t + 1) * tile - 1 + beyond[1]
        ranges = [(low, high)]
        if repeats:
            # Of a node near a face there is an image as far inside of the other one.
            if low <= 2 * PAD:
                ranges.append((low + cells, min(high, 2 * PAD) + cells))
            if high >= last - PAD:
                ranges.append((max(low, last - PAD) - cells, high - cells))
        else:
            if low <= PAD + REACH:
                ranges.append((0, low))
            if high >= last - REACH:
                ranges.append((high, tiles * tile - 1))
        own = {k for first, after in ranges for k in range(max(first // tile, 0), min(after // tile, tiles - 1) + 1)}
        found.append(sorted(own))
    table = np.full((tiles, max(map(len, found))), -1, np.int32)
    for t, own in enumerate(found):
        table[t, : len(own)] = own
    return table


def first_nodes_of(position: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the first nodes of the stencils of points, (n, d) m, as integer coordinates, (n, d)."""
    scaled = (position - np.array(scene.domain.origin)) / scene.domain.spacing
    shift = SPLINES[scene.solver.kernel].nodes / 2 - 1
    return np.clip(np.floor(scaled - shift).astype(np.int64), 0, np.array(scene.domain.cells)) + PAD


def tiles_reached(first_nodes: np.ndarray, tile: int, reach: Sequence[np.ndarray]) -> np.ndarray:
    """Return the tiles that particles may write, sorted: their linear indices, last axis fastest.

    Args:
        first_nodes: of the stencils, (n, d) int.
        reach: per axis what `reach_along` returns.
    """
    shape = tuple(len(table) for table in reach)
    found = np.unique(np.ravel_multi_index(tuple((first_nodes // tile).T), shape))
    # Along one axis after the other, which keeps few of them twice.
    for axis, table in enumerate(reach):
        places = list(np.unravel_index(found, shape))
        along = table[places[axis]]
        wide = [np.broadcast_to(place[:, None], along.shape)[along >= 0] for place in places]
        wide[axis] = along[along >= 0]
        found = np.unique(np.ravel_multi_index(tuple(wide), shape))
    return found
