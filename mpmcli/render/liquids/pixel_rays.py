"""The lines of sight of the pixels of a view."""

import numpy as np

from mpmcli.render.view import View


def rays(view: View, left: int, top: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays of pixels start and how they go, two (rows, columns, 3) float32, in the scene's axes.

    The point at a distance of z along the view is start + z * direction; pixels are counted from `left` and `top`.
    """
    across, up = plane(view, left, top, rows, columns)
    right, rise, back = view.axes
    offset = across[..., None] * right + up[..., None] * rise
    start = np.array(view.position)
    if view.parallel:
        return start + offset, np.broadcast_to(-back, offset.shape)
    return np.broadcast_to(start, offset.shape), offset - back


def plane(view: View, left: int, top: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how far pixels lie to the right and up, (1, columns) and (rows, 1): m, or m at a distance of 1 m."""
    width, height = view.size
    unit = 1 / view.pixels_per_metre if view.parallel else 1 / (view.pixels_per_metre * view.distance)
    across = (np.arange(left, left + columns) + 0.5 - 0.5 * width) * unit
    up = (0.5 * height - np.arange(top, top + rows) - 0.5) * unit
    return across[None, :], up[:, None]
