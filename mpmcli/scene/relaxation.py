"""Relaxed samples: particles moved slightly until grid nodes have the volume and the centre of a full cell."""

from collections.abc import Iterator
from functools import reduce
from itertools import product

import numpy as np

from mpmcli.scene.domain import PASSED, PERIODIC, Domain
from mpmcli.scene.shapes import Form

# Descent steps in 2D and 3D, the fraction of a Newton step in each, and the fraction of the previous step that is added
# (momentum). Steps above 0.65 oscillate at the edges of walls in 3D.
_DESCENTS, _STEP, _MOMENTUM = {2: 24, 3: 13}, 0.5, 0.7
# Integrals over space of |grad w|^2 and |grad (w r)|^2, w the spline of a node and r the distance along one axis.
_CURVATURES = {2: (1.1, 0.3243), 3: (0.9075, 0.2206)}
# Tolerated deviation of a node; and the largest move of a particle along an axis per step, as a fraction of the edge of
# its square or cube.
_ENOUGH, _FARTHEST = 1e-3, 0.1
# Round-off in cells, and the reach of a spline less that.
_ROUND_OFF_CELLS = 1e-4
_SPLINE_REACH = 1.5 - _ROUND_OFF_CELLS
# Particles per batch, so that intermediate values stay in the cache.
_AT_ONCE = 2**16
# The spline w of the node before the nearest one, of that one and of the next, and w r, r the distance from the node:
# coefficients of the powers 0 to 3 of the distance t from the nearest one.
_SPLINE = np.array([[1 / 8, -1 / 2, 1 / 2, 0], [3 / 4, 0, -1, 0], [1 / 8, 1 / 2, 1 / 2, 0]]).T
_MOMENT = np.array([[1 / 8, -3 / 8, 0, 1 / 2], [0, 3 / 4, 0, -1], [-1 / 8, -3 / 8, 0, 1 / 2]]).T


def _products(d: int) -> np.ndarray:
    """Return the coefficients of the volumes and the moments of all nodes around one, (4^d, (1 + d) 3^d)."""
    kinds = [[_MOMENT if e == a else _SPLINE for a in range(d)] for e in (None, *range(d))]
    return np.concatenate([reduce(np.kron, kind) for kind in kinds], axis=1, dtype=np.float32)


_SPLINES = {d: _products(d) for d in (2, 3)}


def relaxed(position: np.ndarray, volume: float, form: Form, domain: Domain) -> np.ndarray:
    """Return particles of a form, (n, d), m, moved so that full nodes have the volume h^d and no first moment.

    A node is full if the form, with its images behind walls and beyond periodic faces, fills its quadratic spline. The
    method is gradient descent with momentum on the squared deficits of full nodes. Only particles within reach of a
    node with a deficit move, and none leaves the form.

    Args:
        position: (n, d) float64, m.
        volume: of a particle, m^3 (m^2 in 2D).
        form: what the particles fill.
        domain: its grid and its walls.
    """
    bounds = np.array(form.bounds())
    nodes = _Nodes(bounds, domain)
    d, share = len(nodes.counts), volume / domain.spacing ** len(nodes.counts)
    order = np.argsort(nodes.in_cells(position)[0], kind="stable")
    sums = nodes.sums(position[order], share)
    weights = nodes.weights(form, sums)
    lacking = np.any(np.abs(nodes.lack(sums)) > _ENOUGH, axis=0) & (weights > 0)
    for a in range(d):
        lacking = lacking | np.roll(lacking, 1, a) | np.roll(lacking, -1, a)
    order = order[lacking.reshape(-1)[nodes.in_cells(position[order])[0]]]
    if not len(order):
        return position
    found, moving = position.copy(), position[order]
    rest = sums - nodes.sums(moving, share)
    # A Newton step of a single node; nodes on walls respond twice as strongly for each wall, because of the images.
    weights = _STEP * weights / np.reshape([_CURVATURES[d][min(e, 1)] for e in range(1 + d)], (1 + d,) + (1,) * d)
    lower, upper = np.clip(bounds, domain.origin, domain.upper)
    most, steps = _FARTHEST * share ** (1 / d), np.zeros(moving.shape)
    for _ in range(_DESCENTS[d]):
        field = nodes.folded(weights * nodes.lack(rest + nodes.sums(moving, share)), back=True)
        for first in range(0, len(moving), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            steps[some] = np.clip(_MOMENTUM * steps[some] + nodes.gradient(moving[some], field), -most, most)
            new = np.clip(moving[some] + nodes.h * steps[some], lower, upper)
            outside = ~form.contains(new)
            new[outside], steps[some][outside] = moving[some][outside], 0.0
            moving[some] = new
    found[order] = moving
    return found


class _Nodes:
    """The nodes around a bounding box, as an array with one axis for each of space; lengths are in cells.

    A field on them is an array (1 + d, *counts): of volumes, and of first moments along each axis.
    """

    def __init__(self, bounds: np.ndarray, domain: Domain) -> None:
        """Place nodes around `bounds`, m, (2, d), and find the walls and periodic faces that act on them."""
        self.h, self.cells, self.origin = domain.spacing, np.array(domain.cells), np.array(domain.origin)
        lower, upper = (bounds - self.origin) / self.h
        self.first = np.floor(lower).astype(int) - 2
        self.counts = tuple((np.ceil(upper).astype(int) + 3 - self.first).tolist())
        self.strides = np.cumprod([1, *self.counts[:0:-1]])[::-1]
        faces = domain.walls.faces(len(self.cells))
        spans = (lower < _ROUND_OFF_CELLS) & (upper > self.cells - _ROUND_OFF_CELLS)
        self.periodic = spans & np.array([PERIODIC in pair for pair in faces])
        self.walls = np.array([[word not in PASSED for word in pair] for pair in faces])
        ends = np.array([np.full(len(spans), _ROUND_OFF_CELLS), self.cells - _ROUND_OFF_CELLS])
        self.reach = np.where(self.walls.T, ends, [[-np.inf], [np.inf]])
        self.folds = list(self._folds())

    def _folds(self) -> Iterator[tuple[int, list[int], list[int], np.ndarray]]:
        """Yield the axis, nodes in the domain, those beyond a face that are their images, and the signs of these."""
        d = len(self.counts)
        for a, (begin, end) in enumerate(zip(-self.first, self.cells - self.first, strict=True)):
            even, odd = np.ones((2, 1 + d, *(1,) * (d - 1)))
            odd[1 + a] = -1.0
            pairs = [([begin, begin + 1, end - 1], [end, end + 1, begin - 1], even)] if self.periodic[a] else []
            for wall, ahead, is_wall in zip((begin, end), (1, -1), self.walls[a], strict=True):
                if is_wall:
                    pairs.append(([wall, wall + ahead], [wall, wall - ahead], odd))
            for front, behind, sign in pairs:
                # A distant wall has nothing to fold.
                if min(front + behind) >= 0 and max(front + behind) < self.counts[a]:
                    yield a, front, behind, sign

    def folded(self, field: np.ndarray, *, back: bool = False) -> np.ndarray:
        """Add image nodes beyond faces to their nodes in the domain, in place; `back` is the transpose."""
        for a, front, behind, sign in reversed(self.folds) if back else self.folds:
            along = np.moveaxis(field, 1 + a, 0)
            onto, beyond = (behind, front) if back else (front, behind)
            along[onto] += sign * along[beyond]
        return field

    def weights(self, form: Form, sums: np.ndarray) -> np.ndarray:
        """Return 1 for full nodes, halved for each wall that they lie on, and 0 for others, (*counts)."""
        # Less than half of the volume means that the test points missed a hole smaller than their distance.
        some = np.flatnonzero(sums[0] > 0.5)
        places = np.stack(np.unravel_index(some, self.counts), axis=1) + self.first
        full = np.all((places >= 0) & (places <= self.cells - self.periodic), axis=1)
        for offset in product((-_SPLINE_REACH, 0.0, _SPLINE_REACH), repeat=len(self.counts)):
            # Nodes behind a wall have an image if the form reaches the wall.
            points = np.clip(places[full] + np.array(offset), *self.reach)
            points = np.where(self.periodic, points % self.cells, points)
            full[full] = form.contains(self.origin + self.h * points)
        on_walls = np.sum(((places == 0) & self.walls[:, 0]) | ((places == self.cells) & self.walls[:, 1]), axis=1)
        found = np.zeros(self.counts)
        found.reshape(-1)[some] = full * 0.5**on_walls
        return found

    def lack(self, sums: np.ndarray) -> np.ndarray:
        """Return the difference between the field of full cells and a field of sums."""
        found = -sums
        found[0] += 1.0
        return found

    def in_cells(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of the nodes next to places (n, d), m, (n,), and the distances from them, (d, n)."""
        places = (position - self.origin) / self.h - self.first
        nearest = np.rint(places)
        return nearest.astype(np.int64) @ self.strides, (places - nearest).T.astype(np.float32)

    def sums(self, position: np.ndarray, share: float) -> np.ndarray:
        """Return the volumes and the first moments of particles (n, d), m, each of them `share` of a cell: a field."""
        d = len(self.counts)
        found = np.zeros((1 + d, int(np.prod(self.counts))))
        for first in range(0, len(position), _AT_ONCE):
            index, distances = self.in_cells(position[first : first + _AT_ONCE])
            low = index.min()
            index -= low
            n, terms = index.max() + 1, [np.full(len(index), share, np.float32)]
            for t in distances:
                terms = [value for term in terms for value in (term, term * t, term * (t * t), term * (t * t * t))]
            powers = np.array([np.bincount(index, term, n) for term in terms], np.float32)
            for total, values in zip(self._around(found, low, n), _SPLINES[d].T @ powers, strict=True):
                total += values
        return self.folded(found.reshape(-1, *self.counts))

    def gradient(self, position: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return the gradient at particles (n, d), m, of the splines and moments of nodes times a field, (n, d)."""
        index, distances = self.in_cells(position)
        low = index.min()
        index -= low
        around = self._around(field.reshape(len(field), -1), low, index.max() + 1)
        powers = _SPLINES[len(distances)] @ np.array(around, np.float32)
        return np.stack(_polynomial(powers.reshape(*(4,) * len(distances), -1), index, distances)[1:], axis=1)

    def _around(self, field: np.ndarray, low: int, n: int) -> list[np.ndarray]:
        """Return the slices of a field, (1 + d, nodes), around n nodes from `low` on, in the order of _SPLINES."""
        offsets = [int(np.dot(offset, self.strides)) for offset in product((-1, 0, 1), repeat=len(self.counts))]
        return [values[low + offset : low + offset + n] for values in field for offset in offsets]


def _polynomial(powers: np.ndarray, index: np.ndarray, distances: np.ndarray) -> list[np.ndarray]:
    """Return polynomials, of coefficients (4, ..., nodes), at distances (d, n) from nodes (n,), and their slopes."""
    if not len(distances):
        return [powers[index]]
    t, (c0, c1, c2, c3) = distances[0], (_polynomial(part, index, distances[1:]) for part in powers)
    values = [((z * t + y) * t + x) * t + w for w, x, y, z in zip(c0, c1, c2, c3, strict=True)]
    return [values[0], (3 * c3[0] * t + 2 * c2[0]) * t + c1[0], *values[1:]]
