"""Numbers that expressions in kernels read of a run: means over the kick of what depends on time alone, and constants.

A `Solver` compiles the constants of its scene. In a batch they are numbers of each run, so that runs share kernels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from mpmcli.scene.expression import INITIAL, POSITION, Apply, Name, Number, Tree, names_in
from mpmcli.scene.quadrature import Mean, telling_times

# Whole exponents up to this one are products: a power of a negative number is undefined on some devices.
LARGEST_PRODUCT = 64


@dataclass(frozen=True)
class Place:
    """A leaf of a tree for kernels: a number that they read.

    Attributes:
        index: among those of the run.
    """

    index: int


class Entries:
    """What the numbers of a run are: constants, and trees of t, whose means count.

    Attributes:
        found: in the order of their places.
        constant: whether constants are numbers of the run, not of the kernel.
    """

    def __init__(self, origin: Sequence[float] = (), *, constant: bool = False) -> None:
        """Begin without any; coordinates of expressions are relative to `origin`, (d,), m, which may be left out."""
        self.found: list[float | Tree] = []
        self.constant = constant
        self._origin = tuple(origin)

    @property
    def timed(self) -> tuple[bool, ...]:
        """Whether each of them depends on time."""
        return tuple(not isinstance(entry, float) for entry in self.found)

    def number(self, value: float) -> "Tree | Place":
        """Return the leaf for a constant."""
        if not self.constant:
            return Number(value)
        self.found.append(float(value))
        return Place(len(self.found) - 1)

    def placed(self, tree: Tree) -> "Tree | Place":
        """Return a tree for `node_of`: what depends on time alone is a place, and constants are as they have to be."""
        names = names_in(tree)
        if names == {"t"}:
            if tree not in self.found:
                self.found.append(tree)
            return Place(self.found.index(tree))
        if isinstance(tree, Number):
            return self.number(tree.value)
        if isinstance(tree, Name):
            return self._coordinate(tree)
        function, arguments = tree.function, tree.arguments
        if whole_power(tree) is not None:
            return Apply(function, (self.placed(arguments[0]), arguments[1]))
        # A condition of time may hold for a part of the kick.
        if function == "if" and "t" in names_in(arguments[0]):
            function = "blend"
        return Apply(function, tuple(self.placed(argument) for argument in arguments))

    def _coordinate(self, name: Name) -> Tree:
        names = INITIAL if name.name in INITIAL else POSITION
        origin = self._origin[names.index(name.name)] if self._origin else 0.0
        return Apply("+", (name, self.number(origin))) if self.constant or origin != 0 else name


def whole_power(tree: Apply) -> int | None:
    """Return the exponent of a power that is a product, None of anything else."""
    if tree.function in ("**", "pow") and isinstance(tree.arguments[1], Number):
        exponent = tree.arguments[1].value
        if exponent == int(exponent) and abs(exponent) <= LARGEST_PRODUCT:
            return int(exponent)
    return None


@ti.data_oriented
class DeviceValues:
    """The numbers of some runs on the device.

    Attributes:
        field: (runs, k).
    """

    def __init__(self, runs: int, width: int) -> None:
        self.field = ti.field(float, shape=(runs, max(1, width)))

    @ti.kernel
    def write(self, run: int, values: ti.types.ndarray(ti.f64, 1)):
        """Set the numbers of a run."""
        for k in range(values.shape[0]):
            self.field[run, k] = ti.cast(values[k], float)


class RunValues:
    """The numbers of one run, as the host sets them.

    Attributes:
        timed: whether any of them depends on time.
    """

    def __init__(self, values: DeviceValues, run: int, entries: Sequence[float | Tree], end: float) -> None:
        """Set them as of time 0, of a run of `end` seconds."""
        self._values, self._run = values, run
        self._constants = np.array([entry if isinstance(entry, float) else 0.0 for entry in entries])
        self.means = {k: Mean(entry, end) for k, entry in enumerate(entries) if not isinstance(entry, float)}
        self._trees = [entry for entry in entries if not isinstance(entry, float)]
        self.timed = bool(self.means)
        if len(entries):
            self.write(0.0, 0.0)

    def write(self, start: float, end: float) -> None:
        """Set what depends on time to its means between two times, s; to its values where they are the same."""
        numbers = self._constants.copy()
        for k, mean in self.means.items():
            numbers[k] = mean(start, end)
        self._values.write(self._run, numbers)

    def telling_times(self, start: float, end: float) -> list[float]:
        """Return the times between two (s) at which any of the values is smallest or largest."""
        return [time for tree in self._trees for time in telling_times(tree, start, end)]
