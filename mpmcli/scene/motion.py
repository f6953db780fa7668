"""How a rigid thing moves: its offset and its angle as functions of time, and their rates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mpmcli.scene.expression import Name, Number, Tree, apply, evaluate
from mpmcli.scene.quadrature import integral_of, largest_of
from mpmcli.scene.rotation import rotation

TIME = Name("t")
# In which jumps are looked for one by one, so that a pair of them does not cancel.
PIECES = 8


@dataclass(frozen=True)
class Motion:
    """The motion of a rigid thing about a pivot that moves with it.

    A point that starts at X is at pivot + offset + R(angle) (X - pivot), R the rotation about a fixed axis.

    Attributes:
        pivot: at the start, before `offset`, (d,), m.
        axis: of rotation, a unit vector, (3,); z in 2D.
        offset: at time 0, (d,), m; angle: at time 0, rad.
        velocity: of the pivot, m/s, one tree of t per axis; spin: rate of the angle, rad/s.
    """

    pivot: tuple[float, ...]
    axis: tuple[float, ...]
    offset: tuple[float, ...]
    angle: float
    velocity: tuple[Tree, ...]
    spin: Tree

    @property
    def rates(self) -> tuple[Tree, ...]:
        """Velocity and spin, d + 1 trees."""
        return (*self.velocity, self.spin)

    @property
    def moves(self) -> bool:
        """Whether anything changes with time."""
        return any(tree != Number(0.0) for tree in self.rates)

    @property
    def turns(self) -> bool:
        """Whether the angle changes with time."""
        return self.spin != Number(0.0)

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """Return the offset, (d,), m, and the angle, rad, at a time, s."""
        gone = [integral_of(tree, 0.0, time) for tree in self.rates]
        return np.array(self.offset) + gone[:-1], self.angle + gone[-1]

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the pivot is, (d,), m, and the rotation, (d, d), at a time, s."""
        offset, angle = self.at(time)
        d = len(self.pivot)
        return np.array(self.pivot) + offset, rotation(self.axis, angle)[:d, :d]

    def placed(self, points: np.ndarray, time: float) -> np.ndarray:
        """Return where points (n, d) that start at these places are at a time, s; the start is that without offset."""
        place, turned = self.pose(time)
        return place + (points - np.array(self.pivot)) @ turned.T

    def taken_back(self, points: np.ndarray, time: float) -> np.ndarray:
        """Undo `placed`: where points (n, d) would have to start."""
        place, turned = self.pose(time)
        return np.array(self.pivot) + (points - place) @ turned

    def fastest(self, reach: float, end: float) -> float:
        """Return a bound on the speed of points within `reach` (m) of the pivot between 0 and `end` (s), m/s."""
        speeds = [largest_of(tree, 0.0, end) for tree in self.rates]
        turning = speeds[-1] * reach if speeds[-1] > 0 else 0.0
        return math.hypot(*speeds[:-1]) + turning


def between_keys(times: Sequence[float], values: Sequence[float]) -> Tree:
    """Return the slope of what goes linearly through values at times that rise, and stays before and after; a tree."""
    result: Tree = Number(0.0)
    for (t0, v0), (t1, v1) in reversed(list(pairwise(zip(times, values, strict=True)))):
        result = apply("if", apply("<", TIME, Number(t1)), Number((v1 - v0) / (t1 - t0)), result)
    if times[0] > 0 and len(times) > 1:
        result = apply("if", apply("<", TIME, Number(times[0])), Number(0.0), result)
    return result


def has_jump(tree: Tree, slope: Tree, end: float) -> bool:
    """Say whether a tree of t jumps between 0 and `end` (s): whether the integral of its slope misses it."""
    times = np.linspace(0.0, end, PIECES + 1)
    values = [float(evaluate(tree, {"t": time})) for time in times]
    scale = max(largest_of(tree, 0.0, end), 1e-12)
    return any(
        not abs(v1 - v0 - integral_of(slope, t0, t1)) <= 1e-6 * scale
        for (t0, t1), (v0, v1) in zip(pairwise(times.tolist()), pairwise(values), strict=True)
    )
