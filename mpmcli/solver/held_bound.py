"""The bound on the step as it is held: it falls at once, and rises late (docs/theory.md, 6.8)."""

import math
from typing import NamedTuple

# A bound falls at once, and rises only to the smallest of the last HOLD to 2 HOLD steps, and only where that is RISE
# times what it was: a step that follows the oscillation of a particle, always smaller in the same phase of it, drives
# that oscillation. Lone particles of the neo-Hookean law let go at strains of 5 to 40 % gained up to 27 times their
# energy in 10,000 steps where the bound rose by a thousandth per step, and up to 4 times here.
HOLD, RISE = 128, 1.05


class HeldBound(NamedTuple):
    """The smallest bound of the last HOLD to 2 HOLD steps.

    Attributes:
        value: that bound, s; low, low_before: the smallest of this series of HOLD steps, and of the one before it, s.
        steps: number of steps in this series.
    """

    value: float = math.inf
    low: float = math.inf
    low_before: float = math.inf
    steps: float = 0.0

    def after(self, bound: float) -> "HeldBound":
        """Return it after a step whose bound was `bound`, s."""
        low, steps = min(self.low, bound), self.steps + 1
        if steps >= HOLD:
            lowest = min(self.low_before, low)
            value = lowest if lowest > RISE * self.value else min(self.value, bound)
            return HeldBound(value, math.inf, low, 0.0)
        return HeldBound(min(self.value, bound), low, self.low_before, steps)
