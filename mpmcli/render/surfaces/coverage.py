"""How much of the plane is covered by particles in 2D: their area, spread over a grid by a Gaussian."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.render.particle_grid import deposited, with_images

# Standard deviation of the Gaussian, in distances between particles.
SPREAD = 1.25
# Nodes of the grid to a distance, at least.
FINENESS = 3.0
# Reach of the Gaussian, in standard deviations.
REACH = 3.2
# Radius of the disk that has the area of a particle, in distances.
DISK = math.sqrt(1.0 / math.pi)
# Cover of its own place, below which a particle stands alone and is drawn as a disk, and above which it is not.
ALONE, TOGETHER = 0.34, 0.42


@dataclass(frozen=True)
class Grid:
    """Nodes over a rectangle, (rows, columns), the first at `corner`.

    Attributes:
        corner: of the lower left node, (2,), m.
        edge: between nodes, m.
        shape: numbers of rows, upwards, and columns.
    """

    corner: tuple[float, float]
    edge: float
    shape: tuple[int, int]


def grid_over(lower: Sequence[float], upper: Sequence[float], edge: float) -> Grid:
    """Return the grid of nodes in the middles of cells that cover a rectangle from its lower left corner."""
    columns, rows = (max(math.ceil((high - low) / edge - 1e-6), 1) for low, high in zip(lower, upper, strict=True))
    return Grid((lower[0] + 0.5 * edge, lower[1] + 0.5 * edge), edge, (rows, columns))


def cover_of(
    position: np.ndarray, distance: float, lower: Sequence[float], upper: Sequence[float], grid: Grid
) -> np.ndarray:
    """Return the share (rows, columns) of each node's surroundings that particles (n, 2) cover.

    It is 1 within a body, 1/2 on its straight edge, and does not fade at the walls of the domain, which are mirrors.
    A particle that stands alone is a disk of its own area, 1/2 on its rim.
    """
    images = with_images(position, REACH * SPREAD * distance, lower, upper)[0]
    cover = spread(images, np.full(len(images), distance**2), SPREAD * distance, grid)
    own = _at(cover, position, grid)
    loose = own < TOGETHER
    if loose.any():
        slope = np.clip((TOGETHER - own[loose]) / (TOGETHER - ALONE), 0.0, 1.0)
        _raise_disks(cover, position[loose], DISK * distance * np.sqrt(slope), SPREAD * distance, grid)
    return cover


def spread(position: np.ndarray, weights: np.ndarray, deviation: float, grid: Grid) -> np.ndarray:
    """Return the sum (rows, columns) of Gaussians of integral `weights` (n,) about particles (n, 2), by area."""
    margin = math.ceil(REACH * deviation / grid.edge) + 1
    shape = (grid.shape[0] + 2 * margin, grid.shape[1] + 2 * margin)
    place = (position - np.array(grid.corner)) / grid.edge + margin
    total = deposited(place, weights, shape)
    # Sharing out between two nodes has blurred already, by a sixth of a cell squared on average.
    width = math.sqrt(max((deviation / grid.edge) ** 2 - 1.0 / 6.0, 0.0))
    blurred = gaussian(total.astype(np.float32), width)
    return blurred[margin:-margin, margin:-margin] / np.float32(grid.edge**2)


def gaussian(values: np.ndarray, deviation: float) -> np.ndarray:
    """Return values (rows, columns) blurred by a Gaussian, cells; beyond the edges they are 0."""
    if deviation < 0.15:
        return values
    reach = max(math.ceil(REACH * deviation), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    for _ in range(2):
        padded = np.zeros((values.shape[0] + 2 * reach, values.shape[1]), dtype=np.float32)
        padded[reach : reach + values.shape[0]] = values
        total = kernel[reach] * values
        for k in range(1, reach + 1):
            pair = padded[reach - k : reach - k + values.shape[0]] + padded[reach + k : reach + k + values.shape[0]]
            pair *= kernel[reach + k]
            total += pair
        values = np.ascontiguousarray(total.T)
    return values


def _at(cover: np.ndarray, position: np.ndarray, grid: Grid) -> np.ndarray:
    place = np.rint((position - np.array(grid.corner)) / grid.edge).astype(int)
    column, row = np.clip(place[:, 0], 0, grid.shape[1] - 1), np.clip(place[:, 1], 0, grid.shape[0] - 1)
    return cover[row, column]


def _raise_disks(cover: np.ndarray, position: np.ndarray, radii: np.ndarray, deviation: float, grid: Grid) -> None:
    """Raise the cover to that of disks: 1/2 on the rim, and as steep there as on an edge."""
    slope = 1.0 / (deviation * math.sqrt(2.0 * math.pi))
    flat = cover.reshape(-1)
    for rows, nodes, away in disk_nodes(position, float(radii.max()) + grid.edge, grid):
        np.maximum.at(flat, nodes, (0.5 + slope * (radii[rows] - away)).astype(np.float32))


def disk_nodes(position: np.ndarray, reach: float, grid: Grid) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the nodes about particles (n, 2), in turn: rows, nodes and distances, m, (k,)."""
    place = (position - np.array(grid.corner)) / grid.edge
    base = np.rint(place).astype(np.int64)
    count = math.ceil(reach / grid.edge)
    for down in range(-count, count + 1):
        for right in range(-count, count + 1):
            column, row = base[:, 0] + right, base[:, 1] + down
            away = grid.edge * np.hypot(column - place[:, 0], row - place[:, 1])
            hit = (away <= reach) & (column >= 0) & (column < grid.shape[1]) & (row >= 0) & (row < grid.shape[0])
            rows = np.flatnonzero(hit)
            yield rows, row[rows] * grid.shape[1] + column[rows], away[rows]
