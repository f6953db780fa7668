"""How thick a body is, seen from the camera."""

import math

import numpy as np

from mpmcli.render.view import View

# Edge of the pixels in which particles are counted, in distances between particles, and the least, in pixels.
COARSENESS, FINEST = 1.4, 3.0


def thickness_at(view: View, position: np.ndarray, distance: float, points: np.ndarray) -> np.ndarray:
    """Return the length (v,) of body that a ray through each of the points (v, 3) meets, m.

    Particles (n, 3) are counted on coarse pixels: their volume by the area that a pixel shows at their depth.
    """
    seen, wanted = view.pixels(position), view.pixels(points)
    near = max(float(seen[:, 2].mean()), 1e-12)
    scale = view.pixels_per_metre * (1.0 if view.parallel else view.distance / near)
    edge = max(FINEST, COARSENESS * distance * scale)
    shape = (math.ceil(view.size[1] / edge) + 2, math.ceil(view.size[0] / edge) + 2)
    area = (edge / view.pixels_per_metre) ** 2
    if not view.parallel:
        area = area * (seen[:, 2] / view.distance) ** 2
    x, y = ((seen[:, k] / edge + 0.5) for k in (0, 1))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    weights = np.broadcast_to(distance**3 / area, x.shape)
    total = np.zeros(shape)
    for right in (0, 1):
        for down in (0, 1):
            column, row = left + right, top + down
            share = (x - left if right else 1.0 - x + left) * (y - top if down else 1.0 - y + top) * weights
            inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            flat = row[inside] * shape[1] + column[inside]
            total += np.bincount(flat, share[inside], total.size).reshape(shape)
    for axis in (0, 1):
        padded = np.pad(total, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
        ends = [padded.take(range(k, k + total.shape[axis]), axis=axis) for k in range(3)]
        total = 0.25 * ends[0] + 0.5 * ends[1] + 0.25 * ends[2]
    column = np.clip(wanted[:, 0] / edge + 0.5, 0.0, shape[1] - 1.001)
    row = np.clip(wanted[:, 1] / edge + 0.5, 0.0, shape[0] - 1.001)
    j, i = column.astype(int), row.astype(int)
    u, v = column - j, row - i
    upper = (1.0 - u) * total[i, j] + u * total[i, j + 1]
    lower = (1.0 - u) * total[i + 1, j] + u * total[i + 1, j + 1]
    return (1.0 - v) * upper + v * lower
