"""The turned lattice: a square or cubic one whose points keep apart, however much it is stretched along the axes."""

import math

import numpy as np


def turned_axes(d: int) -> np.ndarray:
    """Return the rotation R, (d, d), of the turned lattice R Z^d.

    The product of the coordinates of any of its points but 0 is at least 1 / sqrt(5) (2D) or 1 / 7 (3D).
    """
    if d == 2:
        angle = math.atan(2.0) / 2
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    a, b, c = (2 / math.sqrt(7) * math.sin(k * math.pi / 7) for k in (1, 2, 3))
    return np.array([[-a, -b, -c], [-c, -a, b], [-b, c, -a]])


def turned_points(half: np.ndarray, offset: float = 0.5) -> np.ndarray:
    """Return the points of R (Z^d + offset) that are no farther than `half`, (d,), from 0 along each axis, (n, d)."""
    axes = turned_axes(len(half))
    reach = np.ceil(np.abs(axes.T) @ half).astype(int) + 1
    # Lines along the last axis of the lattice: the numbers of the first and the last point of each in the box.
    starts = np.meshgrid(*[np.arange(-r, r) + offset for r in reach[:-1]], indexing="ij")
    lines = np.stack(starts, axis=-1).reshape(-1, len(half) - 1) @ axes[:, :-1].T
    middle, span = -lines / axes[:, -1], half / np.abs(axes[:, -1])
    first = np.ceil(np.max(middle - span, axis=1) - offset)
    last = np.floor(np.min(middle + span, axis=1) - offset)
    counts = np.maximum(0, last - first + 1).astype(int)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    along = np.repeat(first, counts) + number + offset
    return np.repeat(lines, counts, axis=0) + along[:, None] * axes[:, -1]


def turned_box(lower: np.ndarray, upper: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return as many points of a turned lattice in a box, (n, d), m, as a lattice of `counts` points per axis has.

    The lattice is stretched as that one is, and then a little more, such that the box holds just these.
    """
    half, n = counts / 2, math.prod(counts.tolist())
    # About a point the lattice has odd numbers of points, about the middle of a cell even ones.
    points = turned_points(half + 1, offset=0.0 if n % 2 else 0.5)
    reach = np.max(np.abs(points) / half, axis=1)
    chosen = np.argsort(reach, kind="stable")[: n + 1]
    # The faces lie midway between the last point inside and the first one outside.
    points = points[np.sort(chosen[:n])] / (counts * reach[chosen[n - 1 :]].mean())
    return np.clip((lower + upper) / 2 + points * (upper - lower), lower, upper)
