"""Integrals and extremes of functions of time alone; they miss no pulse, however short.

An interval of time is halved until the bounds of interval arithmetic agree with samples: a pulse between two samples
shows in the bounds.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.scene.expression import Apply, Name, Number, Tree, bounds_of, evaluate, kind_of

# Nodes and weights of the Gauss-Legendre rule on (-1, 1).
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
# A part is resolved if its bounds are at most this many times as wide as the range of its samples (an expression in
# which time occurs once has 1, and samples miss a tenth of it), or if the undecided rest is this fraction of the whole:
# of an integral, and of a search.
RATIO, OPEN, SEEN = 16.0, 1e-13, 1e-7
# Also required: the rule of its halves differs from its own by at most this fraction of the whole.
AGREEMENT = 1e-13
# Number of initial parts, and position at which a part is split: off centre, because with a jump in the middle the rule
# agrees with that of even halves by chance.
FIRST, CUT = np.array([0.0, 0.23, 0.48, 0.77, 1.0]), 0.46
# Largest number of halvings, which finds the edge of a pulse to rounding; largest number of parts, beyond which samples
# are used as they are: the slope of the largest of 64 lines takes as many for an integral to 1e-6.
DEPTH, MOST_PARTS = 60, 2**13
# Largest number of windows that a step spans, number of windows kept, and their usual width, s: narrower if frames are
# closer than a quarter of that, wider if a step, at most as long as a frame, could span more than WINDOWS.
WINDOWS, KEPT, LONG = 128, 8, 2.0**-4


@dataclass(frozen=True)
class Parts:
    """A subdivision of an interval of time: ends of the parts, (n,), s, and values at the nodes of each, (n, NODES)."""

    low: np.ndarray
    high: np.ndarray
    values: np.ndarray

    def times(self) -> np.ndarray:
        return 0.5 * (self.low + self.high)[:, None] + 0.5 * (self.high - self.low)[:, None] * NODES


@np.errstate(all="ignore")
def parts_of(tree: Tree, start: float, end: float, *, precise: bool = True) -> Parts:
    """Subdivide `start` to `end` (s) so that a tree of t is resolved in every part; a truth value is 1 or 0.

    If `precise`, the parts suit an integral; otherwise they only locate every feature.
    """
    edges = np.unique([*(start + (end - start) * FIRST), *(time for time in _switches(tree) if start < time < end)])
    low, high = edges[:-1], edges[1:]
    done: list[tuple[np.ndarray, ...]] = []
    count, whole = 0, 0.0
    for depth in range(DEPTH):
        middle = low + CUT * (high - low)
        # Integrals of each part, and of its halves.
        values, first, second = _values(tree, (low, low, middle), (high, middle, high))
        # Without its ends, where the value of a neighbouring part may begin.
        inner = np.nextafter(low, high), np.nextafter(high, low)
        least, most = (np.broadcast_to(side, low.shape) for side in bounds_of(tree, {"t": inner}))
        width = np.where(np.isfinite(most - least), most - least, np.inf)
        if depth == 0:
            sizes = np.abs(np.concatenate([values.ravel(), least, most]))
            whole = float(np.max(sizes, initial=1e-300, where=np.isfinite(sizes))) * (end - start)
        fine = (width <= RATIO * np.ptp(values, axis=1)) | (width * (high - low) <= (OPEN if precise else SEEN) * whole)
        if precise:
            halves = _rule(first, low, middle) + _rule(second, middle, high)
            fine &= np.abs(halves - _rule(values, low, high)) <= AGREEMENT * whole
        fine |= ~np.isfinite(values).all(axis=1)
        if depth == DEPTH - 1 or count + 2 * len(low) > MOST_PARTS:
            fine = np.ones_like(fine)
        done.append((low[fine], high[fine], values[fine]))
        count += int(fine.sum())
        low, middle, high = low[~fine], middle[~fine], high[~fine]
        if not len(low):
            break
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    order = np.argsort(np.concatenate([entry[0] for entry in done]), kind="stable")
    return Parts(*(np.concatenate(column)[order] for column in zip(*done, strict=True)))


def _switches(tree: Tree) -> set[float]:
    """Return the times with which a tree compares t itself, s."""
    nodes = tree.order if isinstance(tree, Apply) else ()
    pairs = [node.arguments for node in nodes if isinstance(node, Apply) and kind_of(node) == "truth"]
    return {a.value for pair in pairs if Name("t") in pair for a in pair if isinstance(a, Number)}


# The integral from -1 of each node's Lagrange polynomial, as coefficients of powers, (NODES, NODES + 1).
_POWERS = np.linalg.inv(np.vander(NODES, increasing=True)).T
ANTIDERIVATIVES = np.concatenate([np.zeros((len(NODES), 1)), _POWERS / np.arange(1, len(NODES) + 1)], axis=1)
ANTIDERIVATIVES[:, 0] = -(ANTIDERIVATIVES * (-1.0) ** np.arange(len(NODES) + 1)).sum(axis=1)


# Columns of the rows of a window: start, middle and half length of a part, s; a bound on |value| in it; coefficients of
# the integral from the start of the window in powers of the position in the part, -1 to 1, the highest first.
LOW, MIDDLE, HALF, BOUND, COEFFICIENTS = range(5)
COLUMNS = COEFFICIENTS + len(NODES) + 1


class _Window:
    """The integral of a tree of t from one time on, by the polynomials of its parts: `rows`, (n, COLUMNS)."""

    def __init__(self, tree: Tree, start: float, end: float) -> None:
        """Compute the polynomials of the integral from `start` to `end`, and a bound on the value in each part."""
        parts = parts_of(tree, start, end)
        half = 0.5 * (parts.high - parts.low)
        coefficients = parts.values @ ANTIDERIVATIVES * half[:, None]
        coefficients[:, 0] += np.concatenate([[0.0], np.cumsum(_rule(parts.values, parts.low, parts.high))[:-1]])
        within = np.nextafter(parts.low, parts.high), np.nextafter(parts.high, parts.low)
        low, high = (np.broadcast_to(side, half.shape) for side in bounds_of(tree, {"t": within}))
        bound = np.maximum(np.abs(low), np.abs(high))
        sampled = np.abs(np.where(np.isfinite(parts.values), parts.values, 0.0)).max(axis=1)
        bound = np.where(np.isfinite(bound), bound, sampled)
        self.rows = np.column_stack([parts.low, parts.low + half, half, bound, coefficients[:, ::-1]])
        self._low, self._middle, self._half = self.rows[:, [LOW, MIDDLE, HALF]].T.tolist()
        self._coefficients = self.rows[:, COEFFICIENTS:].tolist()

    def __call__(self, time: float) -> float:
        k = max(0, bisect_right(self._low, time) - 1)
        place = (time - self._middle[k]) / self._half[k]
        result = 0.0
        for coefficient in self._coefficients[k]:
            result = result * place + coefficient
        return result


class Mean:
    """Means of a tree of t over intervals of a run.

    The run is divided into windows, each of which is subdivided once, so that a mean costs some microseconds. It does
    not depend on earlier calls, nor on the end of the run: the width of windows follows from the time between frames,
    which an extended run keeps up to rounding, and is a power of two.
    """

    def __init__(self, tree: Tree, pause: float, end: float) -> None:
        """Prepare for a run of `end` seconds, with frames every `pause` seconds."""
        self._tree, self._end = tree, end
        power = 2.0 ** math.floor(math.log2(pause * (1 + 1e-9)))
        self._width = min(4 * power, max(LONG, 2 * power / WINDOWS))
        self._kept: dict[int, _Window] = {}

    def __call__(self, start: float, end: float) -> float:
        """Return the mean between two times, s; the value where they are the same."""
        if not end > start:
            return float(evaluate(self._tree, {"t": start}))
        first, last = self.window_at(start), self.window_at(end)
        total = 0.0
        for k in range(first, last + 1):
            window = self._window(k)
            low, high = max(start, self.start_of(k)), min(end, self.start_of(k + 1))
            if high > low:
                total += window(high) - window(low)
        return total / (end - start)

    def window_at(self, time: float) -> int:
        """Return the window in which a time, s, lies."""
        return math.floor(time / self._width)

    def start_of(self, k: int) -> float:
        """Return the time at which a window begins, s."""
        return k * self._width

    def rows(self, k: int) -> np.ndarray:
        """Return the rows of a window, (n, COLUMNS)."""
        return self._window(k).rows

    def _window(self, k: int) -> _Window:
        if k not in self._kept:
            if len(self._kept) >= KEPT:
                self._kept.clear()
            start, end = self.start_of(k), self.start_of(k + 1)
            window = _Window(self._tree, start, end)
            if start < self._end < end and not np.isfinite(window.rows).all():
                # Values may not exist after the end, for example the root of the remaining time.
                window = _Window(self._tree, start, self._end)
            self._kept[k] = window
        return self._kept[k]


def integral_of(tree: Tree, start: float, end: float) -> float:
    """Return the integral of a tree of t between two times, s."""
    if not end > start:
        return 0.0
    parts = parts_of(tree, start, end)
    return float(_rule(parts.values, parts.low, parts.high).sum())


def largest_of(tree: Tree, start: float, end: float) -> float:
    """Return a bound on |value| of a tree of t between two times, s; the largest sample if bounds are unknown."""
    low, high = bounds_of(tree, {"t": (np.float64(start), np.float64(max(start, end)))})
    largest = float(max(-low, high))
    if math.isfinite(largest):
        return largest
    found = [abs(float(evaluate(tree, {"t": time}))) for time in (start, *telling_times(tree, start, end))]
    return max((value for value in found if math.isfinite(value)), default=0.0)


def telling_times(tree: Tree, start: float, end: float) -> list[float]:
    """Return the times between `start` and `end`, s, at which a tree of t is smallest and largest."""
    if not end > start:
        return [start]
    parts = parts_of(tree, start, end, precise=False)
    times = parts.times()
    values = np.where(np.isfinite(parts.values), parts.values, np.nan)
    if np.isnan(values).all():
        return [start]
    return sorted({float(times.flat[np.nanargmin(values)]), float(times.flat[np.nanargmax(values)])})


def _values(tree: Tree, low: Sequence[np.ndarray], high: Sequence[np.ndarray]) -> np.ndarray:
    """Return the values at the nodes of each part of each series, (series, n, NODES); a condition is 1 or 0."""
    a, b = np.stack(low), np.stack(high)
    times = 0.5 * (a + b)[..., None] + 0.5 * (b - a)[..., None] * NODES
    return np.broadcast_to(evaluate(tree, {"t": times}), times.shape).astype(np.float64)


def _rule(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return 0.5 * (high - low) * (values @ WEIGHTS)
