"""Particles that others hide from the camera."""

import numpy as np


def hidden(pixels: np.ndarray, cell: float, gap: float, reach: int = 1, cover: int = 0) -> np.ndarray:
    """Return which particles are invisible, because others in front cover them and their surroundings.

    Args:
        pixels: (n, 3), pixels from the left and from the top, and the distance, m.
        cell: side of the squares over which particles are compared, pixels.
        gap: how far the others are in front at least, m.
        reach: how many squares on each side of its own a particle may be seen in.
        cover: how many squares on each side of its own a particle covers whole.

    Returns:
        (n,) bool. Each of the squares within reach is covered by a particle that is nearer than this one by `gap`.
    """
    if len(pixels) == 0:
        return np.zeros(0, dtype=bool)
    low = np.floor(pixels[:, :2].min(axis=0) / cell).astype(np.int64)
    column, row = (np.floor(pixels[:, :2] / cell).astype(np.int64) - low + reach).T
    nearest = np.full((row.max() + reach + 1, column.max() + reach + 1), np.inf)
    np.minimum.at(nearest, (row, column), pixels[:, 2])
    for spread, rounds in ((np.minimum, cover), (np.maximum, reach)):
        for axis in (0, 1) * rounds:
            nearest = spread(nearest, spread(np.roll(nearest, 1, axis), np.roll(nearest, -1, axis)))
    return pixels[:, 2] > nearest[row, column] + gap
