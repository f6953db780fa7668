"""Large deflection of clamped beams under a load of fixed direction: Reissner's beam, and the elastica as its limit."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

STEPS, BISECTIONS = 200, 60


@dataclass(frozen=True)
class Beam:
    """A beam of length 1 and bending stiffness EI = 1, straight along x and clamped at 0, with a load along y.

    Attributes:
        load: total load, P L^2 / EI.
        spread: fraction of the length, at the free end, over which the load is uniformly distributed.
        axial: EA L^2 / EI; infinite for the elastica.
        shear: k G A L^2 / EI; infinite for the elastica.
    """

    load: float
    spread: float = 0.0
    axial: float = math.inf
    shear: float = math.inf

    def bent(self) -> "BentLine":
        """Return the centre line in equilibrium, by shooting for the moment at the clamp with zero tip moment.

        theta' = M, M' = -x' f, (x, y)' = (1 + N/EA) (cos, sin) theta + V/kGA (-sin, cos) theta with N = f sin theta,
        V = f cos theta, and f the part of the load that acts beyond s (Reissner 1972).
        """
        bend = 1 - self.spread
        s = np.linspace(0.0, bend, STEPS + 1)
        if self.spread:
            s = np.concatenate([s, np.linspace(bend, 1.0, STEPS + 1)[1:]])
        # Upper bound for an elastica, for which M^2 / 2 + load sin theta is constant along the beam.
        low, high = 0.0, 1.2 * math.sqrt(2 * self.load)
        for _ in range(BISECTIONS):
            moment = (low + high) / 2
            low, high = (moment, high) if self._shoot(s, moment)[-1, 3] < 0 else (low, moment)
        states = self._shoot(s, high)
        return BentLine(s, states, np.array([self._slope(*pair) for pair in zip(s, states, strict=True)]))

    def _slope(self, s: float, state: np.ndarray) -> np.ndarray:
        """Return d(x, y, theta, M)/ds."""
        _, _, theta, moment = state
        f = self.load * min((1 - s) / self.spread if self.spread else 1.0, 1.0)
        c, d = math.cos(theta), math.sin(theta)
        along, across = 1 + f * d / self.axial, f * c / self.shear
        x = along * c - across * d
        return np.array([x, along * d + across * c, moment, -x * f])

    def _shoot(self, s: np.ndarray, moment: float) -> np.ndarray:
        """Return (x, y, theta, M) at places s, (n, 4), by the classical Runge-Kutta method from the clamp."""
        states = np.empty((len(s), 4))
        states[0] = state = np.array([0.0, 0.0, 0.0, moment])
        for k, (a, b) in enumerate(pairwise(s)):
            h, m = b - a, (a + b) / 2
            first = self._slope(a, state)
            second = self._slope(m, state + h / 2 * first)
            third = self._slope(m, state + h / 2 * second)
            fourth = self._slope(b, state + h * third)
            states[k + 1] = state = state + h / 6 * (first + 2 * second + 2 * third + fourth)
        return states


@dataclass(frozen=True)
class BentLine:
    """The centre line of a bent beam: at places s, (n,), its states (x, y, theta, M), (n, 4), and their slopes."""

    s: np.ndarray
    states: np.ndarray
    slopes: np.ndarray

    @property
    def tip(self) -> np.ndarray:
        """(x, y) of the tip."""
        return self.states[-1, :2]

    @property
    def tip_angle(self) -> float:
        """The angle of the tip, rad."""
        return float(self.states[-1, 2])

    def at(self, place: float) -> np.ndarray:
        """Return (x, y) at a place from 0 to 1, by cubic Hermite interpolation."""
        k = int(np.clip(np.searchsorted(self.s, place) - 1, 0, len(self.s) - 2))
        h = self.s[k + 1] - self.s[k]
        r = (place - self.s[k]) / h
        left, right = self.states[k, :2], self.states[k + 1, :2]
        rise, fall = h * self.slopes[k, :2], h * self.slopes[k + 1, :2]
        bend = (1 + 2 * r) * (1 - r) ** 2 * left + r * (1 - r) ** 2 * rise
        return bend + r * r * (3 - 2 * r) * right + r * r * (r - 1) * fall
