"""Observed order of convergence, and the cost of reaching a given error."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Errors below this are round-off of double precision, and have no order.
ROUND_OFF = 1e-10
# Replaces a zero error in logarithms.
NOTHING = 1e-18


def observed_order(coarse: tuple[float, float], fine: tuple[float, float]) -> float | None:
    """Return log(e1 / e2) / log(n2 / n1) of two pairs (n, error); None for equal n or round-off."""
    (n1, e1), (n2, e2) = coarse, fine
    if n1 == n2 or not min(e1, e2) > ROUND_OFF:
        return None
    return math.log(e1 / e2) / math.log(n2 / n1)


@dataclass(frozen=True)
class Cost:
    """The cost of reaching a given error.

    Attributes:
        n: resolution, interpolated between those that were run.
        seconds, particle_steps: cost at that resolution.
        at_most: whether the error of the coarsest run is already smaller; the cost is then an upper bound.
    """

    n: float
    seconds: float
    particle_steps: float
    at_most: bool = False


@dataclass(frozen=True)
class Point:
    """One run of a setting: resolution, error and cost."""

    n: int
    error: float
    seconds: float
    particle_steps: float


def cost_to_reach(points: Sequence[Point], target: float) -> Cost | None:
    """Return the cost at which the error falls to `target`; None if it stays above.

    The logarithms of n, cost and error are interpolated linearly, since errors and costs are powers of n.

    Args:
        points: runs from coarse to fine.
    """
    for i, point in enumerate(points):
        if point.error > target:
            continue
        if i == 0:
            return Cost(point.n, point.seconds, point.particle_steps, at_most=point.error < target)
        before = points[i - 1]
        fall = math.log(before.error / max(point.error, NOTHING))
        share = math.log(before.error / target) / fall
        return Cost(
            _between(before.n, point.n, share),
            _between(before.seconds, point.seconds, share),
            _between(before.particle_steps, point.particle_steps, share),
        )
    return None


def _between(a: float, b: float, share: float) -> float:
    """Interpolate logarithmically, or linearly if a cost is zero."""
    return a * (b / a) ** share if min(a, b) > 0 else a + share * (b - a)
