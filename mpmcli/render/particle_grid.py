"""Particles on regular grids: mirror images behind walls, shares of nodes, blurs, and the cover of a plane."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, map_coordinates

STRAY = 4.0  # distance outside the domain up to which a particle is drawn, in radii
SPREAD = 1.25  # standard deviation of the Gaussian of a particle's area, in distances between particles
FINENESS = 3.0  # smallest number of grid nodes per distance between particles
CUTOFF = 3.2  # distance at which the Gaussian is cut off, in standard deviations
DISK = math.sqrt(1.0 / math.pi)  # radius of the disk that has the area of a particle, in distances
# Cover at its position, below which a particle is isolated and drawn as a disk, and above which it is not.
ALONE, TOGETHER = 0.34, 0.42


def with_images(
    position: np.ndarray, reach: float, lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return particles (n, d) with their images behind walls closer than `reach`, and the row of each's source."""
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


def drawable(position: np.ndarray, lower: Sequence[float], upper: Sequence[float], distance: float) -> np.ndarray:
    """Return which of the particles (n, d) are finite, and in the domain or close to it: (n,) bool."""
    d = position.shape[1]
    stray = 0.5 * STRAY * distance
    # A comparison with a NaN is false, as intended.
    return ((position >= np.array(lower[:d]) - stray) & (position <= np.array(upper[:d]) + stray)).all(axis=1)


def deposited(place: np.ndarray, amounts: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the sum (rows, columns) of the amounts (n,) of particles, each shared by area among four nodes.

    Places (n, 2) are columns and rows from the first node, in cells; amounts outside are dropped.
    """
    base = np.floor(place).astype(np.int64)
    part = place - base
    total = np.zeros(shape[0] * shape[1])
    for right, down in np.ndindex(2, 2):
        column, row = base[:, 0] + right, base[:, 1] + down
        share = (part[:, 0] if right else 1.0 - part[:, 0]) * (part[:, 1] if down else 1.0 - part[:, 1]) * amounts
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        total += np.bincount(row[inside] * shape[1] + column[inside], share[inside], len(total))
    return total.reshape(shape)


def sampled(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return values between the pixels of an image (r, c, k) by linear interpolation, constant beyond its edges."""
    place = np.stack([row, column]) - 0.5
    channels = (map_coordinates(image[..., k], place, order=1, mode="nearest") for k in range(image.shape[2]))
    return np.stack(list(channels), axis=-1)


def blurred_along(values: np.ndarray, axis: int) -> np.ndarray:
    """Return values blurred along an axis with weights 1/4, 1/2, 1/4; the ends keep the part that would leave."""
    return convolve1d(values, (0.25, 0.5, 0.25), axis)


@dataclass(frozen=True)
class Grid:
    """Nodes over a rectangle."""

    corner: tuple[float, float]  # of the lower left node, m
    edge: float  # between nodes, m
    shape: tuple[int, int]  # numbers of rows, upwards, and columns


def cover_of(
    position: np.ndarray, distance: float, lower: Sequence[float], upper: Sequence[float], grid: Grid
) -> np.ndarray:
    """Return the fraction (rows, columns) of each node's surroundings that particles (n, 2) cover.

    It is 1 within a body, 1/2 on its straight edge, and does not fade at the walls of the domain, which are mirrors. An
    isolated particle is a disk of its own area, with 1/2 on its rim.
    """
    images = with_images(position, CUTOFF * SPREAD * distance, lower, upper)[0]
    deviation = SPREAD * distance
    cover = spread(images, np.full(len(images), distance**2), deviation, grid)
    nearest = np.rint((position - np.array(grid.corner)) / grid.edge).astype(int)
    column, row = np.clip(nearest[:, 0], 0, grid.shape[1] - 1), np.clip(nearest[:, 1], 0, grid.shape[0] - 1)
    share = cover[row, column]
    loose = share < TOGETHER
    if loose.any():
        alone = np.clip((TOGETHER - share[loose]) / (TOGETHER - ALONE), 0.0, 1.0)
        radii = DISK * distance * np.sqrt(alone)
        # The slope on the rim of a disk equals that on an edge.
        slope = 1.0 / (deviation * math.sqrt(2.0 * math.pi))
        flat = cover.reshape(-1)
        for rows, nodes, away in disk_nodes(position[loose], float(radii.max()) + grid.edge, grid):
            np.maximum.at(flat, nodes, (0.5 + slope * (radii[rows] - away)).astype(np.float32))
    return cover


def spread(position: np.ndarray, weights: np.ndarray, deviation: float, grid: Grid) -> np.ndarray:
    """Return the sum (rows, columns) of Gaussians of integral `weights` (n,) about particles (n, 2), by area."""
    margin = math.ceil(CUTOFF * deviation / grid.edge) + 1
    shape = (grid.shape[0] + 2 * margin, grid.shape[1] + 2 * margin)
    place = (position - np.array(grid.corner)) / grid.edge + margin
    total = deposited(place, weights, shape)
    # The distribution between two nodes has already blurred, with a mean variance of a sixth of a cell squared.
    width = math.sqrt(max((deviation / grid.edge) ** 2 - 1.0 / 6.0, 0.0))
    return soft(total.astype(np.float32), width)[margin:-margin, margin:-margin] / np.float32(grid.edge**2)


def soft(values: np.ndarray, deviation: float) -> np.ndarray:
    """Return values (rows, columns) blurred by a Gaussian of a deviation in cells, if it is wide enough to matter."""
    return values if deviation < 0.15 else gaussian_filter(values, deviation, mode="constant", truncate=CUTOFF)


def disk_nodes(position: np.ndarray, reach: float, grid: Grid) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the nodes around particles (n, 2), in batches: rows, nodes and distances, m, (k,)."""
    place = (position - np.array(grid.corner)) / grid.edge
    base = np.rint(place).astype(np.int64)
    count = math.ceil(reach / grid.edge)
    for down, right in np.ndindex(2 * count + 1, 2 * count + 1):
        column, row = base[:, 0] + right - count, base[:, 1] + down - count
        away = grid.edge * np.hypot(column - place[:, 0], row - place[:, 1])
        hit = (away <= reach) & (column >= 0) & (column < grid.shape[1]) & (row >= 0) & (row < grid.shape[0])
        rows = np.flatnonzero(hit)
        yield rows, row[rows] * grid.shape[1] + column[rows], away[rows]
