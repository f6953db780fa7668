"""Distance between two forms of any kind, by search."""

import math
from itertools import product

import numpy as np

from mpmcli.scene.shapes import Form

# Points per axis that are tried at first, times that the cells around the best are halved, and how many of them are.
TRIED, HALVINGS, KEPT = 16, 7, 500


def distance_by_search(first: Form, second: Form) -> float:
    """Return the distance of two forms that do not overlap, m, to 1e-3 of the extent of the smaller one.

    It is the smallest sum of the distances of a point from both. The nearest points of both forms are that far apart,
    so that their middle is within half of it of both bounding boxes. Cells in which no sum can be smaller than the best
    one, which changes by twice the way at most, are left.
    """
    bounds = [form.bounds() for form in (first, second)]
    small = min(bounds, key=lambda pair: float(np.ptp(pair, axis=0).max()))
    d = len(small[0])
    corners = np.array(list(product((0, 1), repeat=d)))

    def total(points: np.ndarray) -> np.ndarray:
        return np.maximum(first.signed_distance(points), 0.0) + np.maximum(second.signed_distance(points), 0.0)

    best = float(total(small[0] + (corners + 0.5) / 2 * np.ptp(small, axis=0)).min())
    lower = np.max([low for low, _ in bounds], axis=0) - best / 2
    upper = np.min([high for _, high in bounds], axis=0) + best / 2
    size = np.maximum(upper - lower, 0.0) / TRIED
    steps = np.stack(np.meshgrid(*[np.arange(TRIED)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    centers = lower + (steps + 0.5) * size
    for _ in range(HALVINGS):
        found = total(centers)
        best = min(best, float(found.min()))
        promising = found - np.linalg.norm(size) < best
        order = np.argsort(found[promising], kind="stable")[:KEPT]
        size = size / 2
        centers = (centers[promising][order][:, None] + (corners - 0.5) * size).reshape(-1, d)
        if not len(centers) or math.isclose(best, 0.0, abs_tol=1e-12):
            break
    return best
