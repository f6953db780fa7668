"""How an error falls with resolution and with cost: observed order, and the cost of a given error."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Below this, what is left of an error is round-off of double precision, and has no order.
ROUND_OFF = 1e-10
# Stands for an error of nothing where a logarithm is taken.
NOTHING = 1e-18


def observed_order(coarse: tuple[float, float], fine: tuple[float, float]) -> float | None:
    """Return log(e1 / e2) / log(n2 / n1) of two (n, error); None where round-off rules, or n is the same."""
    (n1, e1), (n2, e2) = coarse, fine
    if n1 == n2 or not min(e1, e2) > ROUND_OFF:
        return None
    return math.log(e1 / e2) / math.log(n2 / n1)


@dataclass(frozen=True)
class Cost:
    """What it costs to reach some error.

    Attributes:
        n: the resolution that it takes, between those that were run.
        seconds, particle_steps: the cost there.
        at_most: whether the coarsest run is better than asked for already, so that less might do.
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
    """Return the cost at which an error falls to `target`, None where it never does.

    Between two runs logarithms are interpolated linearly: errors and costs are powers of the resolution.

    Args:
        points: from coarse to fine.
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
    """Interpolate logarithms; a cost too small to be timed has none."""
    return a * (b / a) ** share if min(a, b) > 0 else a + share * (b - a)
