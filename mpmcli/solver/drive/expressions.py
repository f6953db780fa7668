"""Numbers of a run for expressions in kernels: constants, and means over the kick of values that depend only on time.

Means are differences of integrals in tables. The host fills the table of a run with the next windows
(`scene.quadrature.Mean`); the kernel stops before a kick that would end beyond them. Constants are not part of kernels,
so that runs share kernels.

A kernel has each node of a tree once, as a variable (`Evaluation`). Conditions are integers, 0 or 1, or for a
condition on time the fraction of the kick for which it holds. Both branches of `a if c else b` are evaluated. KERNELS
has the names of `scene.functions`; its functions agree with NumPy to rounding.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from taichi.lang import ops

from mpmcli.boundaries.doubles import double_field
from mpmcli.quick_taichi import ti
from mpmcli.scene.expression import INITIAL, POSITION, VELOCITY, Apply, Name, Number, Tree, names_in
from mpmcli.scene.quadrature import BOUND, COEFFICIENTS, COLUMNS, HALF, LOW, MIDDLE, WINDOWS, Mean, telling_times

# Integer powers up to this exponent are computed as products, because powers of negative numbers are undefined on some
# devices.
LARGEST_PRODUCT = 64


@dataclass(frozen=True)
class Place:
    """The index of a number of the run."""

    index: int


@dataclass(frozen=True)
class Formula:
    """A tree for kernels, each node once: numbers of the run, coordinates, and functions of the steps at some indices.

    An exponent that is whole is a part of its step: ("**", (index of the base,), exponent).
    """

    steps: tuple[Place | Name | tuple, ...]


class Entries:
    """The numbers of a run, in order in `found`: constants, and trees of t, which are averaged."""

    def __init__(self, origin: Sequence[float]) -> None:
        """Start without numbers; `origin`, (d,), m, is added to the coordinates in expressions."""
        self.found: list[float | Tree] = []
        self._origin = tuple(origin)

    @property
    def timed(self) -> tuple[bool, ...]:
        return tuple(not isinstance(entry, float) for entry in self.found)

    def number(self, value: float) -> Place:
        self.found.append(float(value))
        return Place(len(self.found) - 1)

    def placed(self, tree: Tree) -> Formula | Place:
        """Return a tree for `node_of`, with places for constants and for subtrees that depend only on time."""
        steps: list[Place | Name | tuple] = []
        self._add(tree, steps, {})
        return steps[0] if isinstance(steps[0], Place) and len(steps) == 1 else Formula(tuple(steps))

    def _add(self, tree: Tree, steps: list[Place | Name | tuple], known: dict[int, int]) -> int:
        """Append the steps of a tree, unless they are known by its identity; return the index of the last."""

        def put(step: Place | Name | tuple) -> int:
            steps.append(step)
            return len(steps) - 1

        if id(tree) in known:
            return known[id(tree)]
        names = names_in(tree)
        if names == {"t"}:
            if tree not in self.found:
                self.found.append(tree)
            index = put(Place(self.found.index(tree)))
        elif isinstance(tree, Number):
            index = put(self.number(tree.value))
        elif isinstance(tree, Name):
            index = put(tree)
            if tree.name not in VELOCITY:
                axes = INITIAL if tree.name in INITIAL else POSITION
                index = put(("+", (index, put(self.number(self._origin[axes.index(tree.name)])))))
        elif (exponent := whole_power(tree)) is not None:
            index = put(("**", (self._add(tree.arguments[0], steps, known),), exponent))
        else:
            inner = tuple(self._add(argument, steps, known) for argument in tree.arguments)
            if tree.function in ("min", "max"):
                index = reduce(lambda a, b: put((tree.function, (a, b))), inner)
            else:
                # A condition on time may hold for a part of the kick.
                blends = tree.function == "if" and "t" in names_in(tree.arguments[0])
                index = put(("blend" if blends else tree.function, inner))
        known[id(tree)] = index
        return index


def whole_power(tree: Apply) -> int | None:
    """Return the exponent of a power that is computed as a product, None for other trees."""
    if tree.function in ("**", "pow") and isinstance(tree.arguments[1], Number):
        exponent = tree.arguments[1].value
        if exponent == int(exponent) and abs(exponent) <= LARGEST_PRODUCT:
            return int(exponent)
    return None


@ti.data_oriented
class DeviceValues:
    """The numbers of some runs on the device, in `field`, (runs, k)."""

    def __init__(self, runs: int, width: int) -> None:
        self.field = ti.field(float, shape=(runs, max(1, width)))
        self.real = np.float64 if self.field.dtype == ti.f64 else np.float32

    @ti.kernel
    def write(self, run: int, values: ti.types.ndarray(ndim=1)):
        for k in range(values.shape[0]):
            self.field[run, k] = values[k]


class RunValues:
    """The numbers of one run, set by the host.

    Attributes:
        entries: constants and trees of the numbers.
        means: `Mean` of each number that depends on time, by index.
        timed: whether any number depends on time.
    """

    def __init__(
        self, values: DeviceValues, run: int, entries: Sequence[float | Tree], pause: float, end: float
    ) -> None:
        """Set the numbers at time 0 for a run of `end` seconds with frames every `pause` seconds."""
        self._values, self._run, self.entries = values, run, tuple(entries)
        self._constants = np.array([entry if isinstance(entry, float) else 0.0 for entry in entries])
        self.means = {k: Mean(entry, pause, end) for k, entry in enumerate(entries) if not isinstance(entry, float)}
        self._trees = [entry for entry in entries if not isinstance(entry, float)]
        self.timed = bool(self.means)
        if len(entries):
            self.write(0.0, 0.0)

    def write(self, start: float, end: float) -> None:
        numbers = self._constants.copy()
        for k, mean in self.means.items():
            numbers[k] = mean(start, end)
        self._values.write(self._run, numbers.astype(self._values.real))

    def telling_times(self, start: float, end: float) -> list[float]:
        """Return the times between `start` and `end`, s, of extrema of any value."""
        return [time for tree in self._trees for time in telling_times(tree, start, end)]


# Rows per number of a run, and windows filled at a time.
ROOM, AHEAD = 4096, 8


@ti.data_oriented
class TimeTables:
    """Tables of the time-dependent numbers of some runs.

    Attributes:
        rows: (runs * numbers, ROOM) rows of the tables.
        used: (runs * numbers) int, number of rows in use.
    """

    def __init__(self, runs: int, numbers: int) -> None:
        self._numbers = numbers
        self.rows = double_field(runs * numbers, ROOM, entries=(COLUMNS,))
        self.used = ti.field(int, shape=runs * numbers)

    def fill(self, run: int, means: Sequence[Mean], since: float, *, coarse: bool) -> float:
        """Fill the tables of a run with windows from `since`, s, on; return the time up to which means are available.

        `coarse` is whether to store more windows than a step spans, with fewer rows for each.
        """
        ahead = 2 * WINDOWS if coarse else AHEAD
        horizon = math.inf
        for i, mean in enumerate(means):
            first = k = mean.window_at(since)
            rows: list[np.ndarray] = []
            count, before = 0, 0.0
            while k < first + ahead:
                own = subsampled(mean.rows(k), ROOM // (ahead if coarse else 2))
                count += len(own)
                if count > ROOM:
                    break
                rows.append(own.copy())
                rows[-1][:, -1] += before
                before += _integral(own[-1])
                k += 1
            self._write(run * self._numbers + i, np.concatenate(rows))
            horizon = min(horizon, mean.start_of(k))
        return horizon

    @ti.kernel
    def _write(self, table: int, rows: ti.types.ndarray(ti.f64, 2)):
        self.used[table] = rows.shape[0]
        for q in range(rows.shape[0]):
            for k in ti.static(range(COLUMNS)):
                self.rows[table, q][k] = rows[q, k]

    @ti.func
    def part(self, table: int, time: ti.f64):
        low = 0
        high = self.used[table] - 1
        while low < high:
            middle = (low + high + 1) // 2
            if self.rows[table, middle][LOW] <= time:
                low = middle
            else:
                high = middle - 1
        return low

    @ti.func
    def integral(self, table: int, time: ti.f64):
        """Return the integral from the start of the table to a time, s."""
        q = self.part(table, time)
        place = (time - self.rows[table, q][MIDDLE]) / self.rows[table, q][HALF]
        result = self.rows[table, q][COEFFICIENTS]
        for k in ti.static(range(COEFFICIENTS + 1, COLUMNS)):
            result = result * place + self.rows[table, q][k]
        return result

    @ti.func
    def mean(self, table: int, start: ti.f64, end: ti.f64):
        return (self.integral(table, end) - self.integral(table, start)) / (end - start)

    @ti.func
    def largest(self, table: int, start: ti.f64, end: ti.f64):
        """Return a bound on |value| between two times, s; times beyond the table are ignored."""
        q = self.part(table, start)
        result = self.rows[table, q][BOUND]
        for k in range(q + 1, self.part(table, end) + 1):
            result = ti.max(result, self.rows[table, k][BOUND])
        return result


def _integral(row: np.ndarray) -> float:
    """Return the integral from the start of the window to the end of a row."""
    return float(row[COEFFICIENTS:].sum())


def subsampled(rows: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` rows for a window: neighbouring rows are merged, with a linear integral in each."""
    if len(rows) <= most:
        return rows
    first = np.arange(0, len(rows), -(-len(rows) // most))
    end = rows[-1, MIDDLE] + rows[-1, HALF]
    low = rows[first, LOW]
    high = np.append(low[1:], end)
    # The integral at the start of each row, by its polynomial at -1.
    signs = (-1.0) ** np.arange(COLUMNS - COEFFICIENTS)[::-1]
    before = rows[first, COEFFICIENTS:] @ signs
    after = np.append(before[1:], _integral(rows[-1]))
    joined = np.zeros((len(first), COLUMNS))
    joined[:, LOW], joined[:, MIDDLE], joined[:, HALF] = low, 0.5 * (low + high), 0.5 * (high - low)
    joined[:, BOUND] = np.maximum.reduceat(rows[:, BOUND], first)
    joined[:, -2], joined[:, -1] = 0.5 * (after - before), 0.5 * (after + before)
    return joined


@ti.func
def _modulo(a, b):
    return a - b * ti.floor(a / b)


@ti.func
def _power(a, b):
    size = ti.pow(ti.abs(a), b)
    odd = b - 2.0 * ti.floor(0.5 * b) == 1.0
    whole = ti.select(odd, -size, size)
    # The square root of a negative number is NaN.
    negative = ti.select(ti.floor(b) == b, whole, ti.sqrt(a))
    return ti.select(a < 0.0, negative, size)


def _holds(compare: Callable) -> Callable:
    @ti.func
    def holds(a, b):
        return ti.select(compare(a, b), 1, 0)

    return holds


@ti.func
def _not(a):
    return 1 - a


@ti.func
def _choose(condition, a, b):
    return ti.select(condition != 0, a, b)


@ti.func
def _blend(share, a, b):
    """Return a, b, or their weighted mean if a condition holds for a fraction `share` of the kick."""
    # An unused branch may be infinite.
    return ti.select(share >= 1, a, ti.select(share <= 0, b, share * a + (1 - share) * b))


# By atan2, because asin and acos of some devices are accurate only to 1e-4.
@ti.func
def _asin(a):
    return ti.atan2(a, ti.sqrt((1.0 - a) * (1.0 + a)))


@ti.func
def _acos(a):
    return ti.atan2(ti.sqrt((1.0 - a) * (1.0 + a)), a)


@ti.func
def _atan(a):
    return ti.atan2(a, ti.cast(1.0, float))


@ti.func
def _sinh(a):
    grown = ti.exp(ti.abs(a))
    size = 0.5 * (grown - 1.0 / grown)
    if ti.abs(a) < 0.1:
        # The first terms of the series, because the difference above cancels.
        square = a * a
        size = ti.abs(a) * (1.0 + square / 6.0 * (1.0 + square / 20.0 * (1.0 + square / 42.0 * (1.0 + square / 72.0))))
    return ti.select(a < 0.0, -size, size)


@ti.func
def _cosh(a):
    grown = ti.exp(ti.abs(a))
    return 0.5 * (grown + 1.0 / grown)


@ti.func
def _log10(a):
    return ti.log(a) / ti.cast(2.302585092994046, float)


@ti.func
def _sign(a):
    return ti.select(a > 0.0, ti.cast(1.0, float), ti.select(a < 0.0, ti.cast(-1.0, float), ti.cast(0.0, float)))


@ti.func
def _step(a):
    return ti.select(a >= 0.0, ti.cast(1.0, float), ti.cast(0.0, float))


@ti.func
def _clamp(a, low, high):
    return ti.min(ti.max(a, low), high)


@ti.func
def _hypot(a, b):
    return ti.sqrt(a * a + b * b)


KERNELS: dict[str, Callable] = {
    "+": ops.add,
    "-": ops.sub,
    "*": ops.mul,
    "/": ops.truediv,
    "%": _modulo,
    "**": _power,
    "negative": ops.neg,
    "<": _holds(ops.cmp_lt),
    "<=": _holds(ops.cmp_le),
    ">": _holds(ops.cmp_gt),
    ">=": _holds(ops.cmp_ge),
    "==": _holds(ops.cmp_eq),
    "!=": _holds(ops.cmp_ne),
    "and": ops.mul,
    "or": ops.max,
    "not": _not,
    "if": _choose,
    # A condition on time.
    "blend": _blend,
    "clamp": _clamp,
    "hypot": _hypot,
    "pow": _power,
    "step": _step,
    "sign": _sign,
    "log10": _log10,
    "sinh": _sinh,
    "cosh": _cosh,
    "asin": _asin,
    "acos": _acos,
    "atan": _atan,
}
KERNELS |= {
    name: getattr(ti, name)
    for name in ("sin", "cos", "tan", "atan2", "tanh", "exp", "log", "sqrt", "abs", "floor", "ceil", "min", "max")
}


# Index of the velocity behind the initial position.
MOVES = 3


@ti.data_oriented
class Coordinate:
    """A coordinate of the position, of the initial position, or of the velocity."""

    def __init__(self, axis: int, *, initial: bool) -> None:
        self.axis, self.initial = axis, initial

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        if ti.static(self.initial):
            return X[self.axis]
        else:
            return x[self.axis]


@ti.data_oriented
class Reading:
    """A number of the run; for a condition on time, the fraction of the kick for which it holds."""

    def __init__(self, values: DeviceValues, index: int) -> None:
        self.values, self.index = values, index

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        return self.values.field[run, self.index]


@ti.data_oriented
class Power:
    """An integer power, by repeated squaring."""

    def __init__(self, exponent: int) -> None:
        self.inverse = exponent < 0
        self.bits = tuple(bit == "1" for bit in bin(abs(exponent))[2:])

    @ti.func
    def of(self, base):
        result = ti.cast(1.0, float)
        for bit in ti.static(self.bits):
            result *= result
            if ti.static(bit):
                result *= base
        if ti.static(self.inverse):
            result = 1.0 / result
        return result


@ti.data_oriented
class Evaluation:
    """The steps of a formula: leaves, and functions with the indices of the steps that they are applied to."""

    def __init__(self, steps: Sequence[tuple[object, tuple[int, ...]]]) -> None:
        self.steps = tuple(steps)

    @ti.func
    def evaluate(self, x: ti.template(), X: ti.template(), run: int):
        found = ti.static([])
        for step, arguments in ti.static(self.steps):
            # A variable for each step, which later steps read.
            if ti.static(len(arguments) == 0):
                value = step.evaluate(x, X, run)
                ti.static(found.append(value))
            else:
                value = step(*[found[k] for k in ti.static(arguments)])
                ti.static(found.append(value))
        return found[-1]


def node_of(formula: Formula | Place, values: DeviceValues) -> Reading | Evaluation:
    """Return the node that evaluates a result of `Entries.placed` at x and X, (d,), m, with the numbers of a run.

    For a formula of the velocity, X has it from entry MOVES on, m/s.
    """
    if isinstance(formula, Place):
        return Reading(values, formula.index)
    steps: list[tuple[object, tuple[int, ...]]] = []
    for step in formula.steps:
        match step:
            case Place():
                steps.append((Reading(values, step.index), ()))
            case Name():
                axes = next(axes for axes in (VELOCITY, INITIAL, POSITION) if step.name in axes)
                axis = axes.index(step.name) + (MOVES if axes is VELOCITY else 0)
                steps.append((Coordinate(axis, initial=axes is not POSITION), ()))
            case (_, arguments, exponent):
                steps.append((Power(exponent).of, arguments))
            case (function, arguments):
                steps.append((KERNELS[function], arguments))
    return Evaluation(steps)
