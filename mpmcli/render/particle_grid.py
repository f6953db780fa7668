"""Particles on regular grids: their mirror images behind walls, their shares of nodes, and the blur of a grid."""

from collections.abc import Sequence

import numpy as np


def with_images(
    position: np.ndarray, reach: float, lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return particles with their mirror images behind the walls that are closer than `reach`.

    Args:
        position: (n, d).
        lower, upper: corners of the domain, (d,) or more.

    Returns:
        (m, d) particles and images, and (m,) the row of the particle that each of them belongs to.
    """
    source = np.arange(len(position))
    for axis in range(position.shape[1]):
        images, sources = [position], [source]
        for wall, inwards in ((lower[axis], 1.0), (upper[axis], -1.0)):
            near = inwards * (position[:, axis] - wall) < reach
            image = position[near].copy()
            image[:, axis] = 2.0 * wall - image[:, axis]
            images.append(image)
            sources.append(source[near])
        position, source = np.concatenate(images), np.concatenate(sources)
    return position, source


def deposited(place: np.ndarray, amounts: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the sum of what particles bring to each node, (rows, columns): each is shared among four, by area.

    Args:
        place: (n, 2), columns and rows from the first node, in cells; what falls outside is dropped.
        amounts: (n,).
    """
    base = np.floor(place).astype(np.int64)
    part = place - base
    total = np.zeros(shape[0] * shape[1])
    for right in (0, 1):
        for down in (0, 1):
            column, row = base[:, 0] + right, base[:, 1] + down
            share = (part[:, 0] if right else 1.0 - part[:, 0]) * (part[:, 1] if down else 1.0 - part[:, 1]) * amounts
            inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            total += np.bincount(row[inside] * shape[1] + column[inside], share[inside], len(total))
    return total.reshape(shape)


def sampled(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return values between the pixels of an image (r, c, k), linear in between; the outermost go on outside."""
    rows, columns = image.shape[:2]
    row, column = np.clip(row - 0.5, 0, rows - 1.001), np.clip(column - 0.5, 0, columns - 1.001)
    j, i = row.astype(np.int32), column.astype(np.int32)
    v, u = (row - j)[..., None], (column - i)[..., None]
    flat, home = image.reshape(rows * columns, -1), j * columns + i
    upper = flat[home] * (1 - u) + flat[home + 1] * u
    lower = flat[home + columns] * (1 - u) + flat[home + columns + 1] * u
    return upper * (1 - v) + lower * v


def blurred_along(values: np.ndarray, axis: int) -> np.ndarray:
    """Return values blurred along an axis with weights 1/4, 1/2, 1/4; what would leave at an end is kept there."""
    values = np.moveaxis(values, axis, 0)
    result = 0.5 * values
    result[1:] += 0.25 * values[:-1]
    result[:-1] += 0.25 * values[1:]
    result[0] += 0.25 * values[0]
    result[-1] += 0.25 * values[-1]
    return np.moveaxis(result, 0, axis)
