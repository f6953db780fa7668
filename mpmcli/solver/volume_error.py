"""The volume that liquids and grains fill on the grid, against that of their particles: an entry of the ledger."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.solver.frame_arrays import parts_of

# Fewest cells inside the material that say anything: the edge of what is inside is sharp to a particle or so.
FEWEST = 64
# Cells that are looked at at once. Of a larger domain only those that particles occupy are.
WHOLE = 2**16


class FilledCells:
    """The cells that particles fill at T times; particles are added a part after another.

    A cell is inside where it and all of its neighbours, corners included, hold particles of materials that flow and of
    no others; beyond a wall there is nothing to ask for, beyond a periodic face is the other one.
    """

    def __init__(
        self,
        x: np.ndarray,
        spacing: float,
        cells: Sequence[int],
        periodic: Sequence[bool],
    ) -> None:
        """Choose the cells to look at.

        Args:
            x: places of all particles that may be added, (T, n, d), m, from the corner of the domain.
            spacing: m; cells: of the domain per axis; periodic: whether it repeats along them.
        """
        self._spacing, self._cells, self._periodic = spacing, tuple(cells), periodic
        self._low, self._high = [0] * len(cells), [n - 1 for n in cells]
        if math.prod(cells) > WHOLE:
            lower, upper = _bounds(x)
            for a in range(len(cells)):
                self._low[a], self._high[a] = (max(0, int(self._cell(bound[a], a))) for bound in (lower, upper))
        # One cell more on each side: a wall asks for nothing, the void is empty.
        self._shape = [len(x)] + [last - first + 3 for first, last in zip(self._low, self._high, strict=True)]
        self._held = np.zeros(math.prod(self._shape))
        self._others: np.ndarray | None = None

    def _cell(self, x: np.ndarray, a: int) -> np.ndarray:
        return np.minimum((x * (1 / self._spacing)).astype(np.intp), self._cells[a] - 1)

    def add(self, x: np.ndarray, volume: np.ndarray, flows: np.ndarray) -> None:
        """Add particles. The sums depend on their order, and not on how many are added at once.

        Args:
            x: (T, k, d), m; volume: of each particle as it is, (T, k), m^d.
            flows: whether the material of each particle flows, (k,) bool.
        """
        index = np.arange(len(x))[:, None]
        for a, (first, count) in enumerate(zip(self._low, self._shape[1:], strict=True)):
            index = index * count
            index = index + (self._cell(x[:, :, a], a) + (1 - first))
        if not flows.all():
            if self._others is None:
                self._others = np.zeros(len(self._held), bool)
            self._others[index[:, ~flows].ravel()] = True
            index, volume = index[:, flows], volume[:, flows]
        np.add.at(self._held, index.ravel(), volume.ravel())

    def errors(self) -> np.ndarray:
        """Return the volume of the cells inside over that of the particles in them, less 1, (T,).

        With fewer than FEWEST such cells it is 0.
        """
        held = self._held.reshape(self._shape)
        inside = held > 0
        if self._others is not None:
            inside &= ~self._others.reshape(self._shape)
        for axis, count in enumerate(self._cells):
            planes = inside.swapaxes(0, 1 + axis)
            whole = self._low[axis] == 0, self._high[axis] == count - 1
            planes[0], planes[-1] = whole
            if self._periodic[axis]:
                # Cells that are not looked at are empty.
                planes[0], planes[-1] = (planes[-2], planes[1]) if all(whole) else (False, False)
        for axis in range(len(self._cells)):
            planes = inside.swapaxes(0, 1 + axis)
            inside = (planes[:-2] & planes[1:-1] & planes[2:]).swapaxes(0, 1 + axis)
        inside = inside.reshape(len(held), -1)
        within = held[(slice(None), *(slice(1, -1),) * len(self._cells))].reshape(len(held), -1)
        counts = np.count_nonzero(inside, axis=1)
        enough = counts >= FEWEST
        # In one order, whatever the number of times.
        filled = np.where(inside, within, 0.0).sum(axis=1)
        return np.where(enough, counts * self._spacing ** len(self._cells) / np.where(enough, filled, 1.0) - 1, 0.0)


def _bounds(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinate along each axis, (d,), of places (T, n, d)."""
    found = [[(x[:, rows, a].min(), x[:, rows, a].max()) for a in range(x.shape[2])] for rows in parts_of(x.shape[1])]
    bounds = np.array(found, x.dtype)
    return bounds[:, :, 0].min(axis=0), bounds[:, :, 1].max(axis=0)


def times_at_once(cells: Sequence[int]) -> int:
    """Return how many times one `FilledCells` may look at: only one where it depends on the particles which cells."""
    return max(1, WHOLE // math.prod(cells))
