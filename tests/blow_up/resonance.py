"""Oscillations of finite size: a lone fluid particle is driven by its own steps, below the bound for small ones."""

from collections.abc import Sequence

import numpy as np

from blow_up.scenes import alone, liquid
from blow_up.trial import Trial
from mpmcli.solver.machine.backend import Backend

# Steps over the bound at rest that are tried, and steps of one trial.
RATIOS = np.round(np.arange(0.4, 1.1, 0.01), 2)
STEPS = 3000
# The recursion has left for good beyond these.
SMALLEST, LARGEST = 1e-6, 50.0


def measured_blow_ups(volume_ratio: float, backend: Backend, ratios: Sequence[float] = RATIOS) -> np.ndarray:
    """Say for each step, (k,) over the bound at rest, whether a lone 2D fluid particle let go at J blows up."""
    stretches = (volume_ratio**0.5,) * 2
    trial = Trial(alone(f"fluid let go at J {volume_ratio}", liquid(), 2, stretches=stretches), backend)
    # The bound goes with J^(-1/2).
    at_rest = trial.predicted * volume_ratio**0.5
    return np.array([trial.run(ratio * at_rest, STEPS).blew_up for ratio in ratios])


def recursion_blow_ups(volume_ratio: float, ratios: Sequence[float] = RATIOS, steps: int = STEPS) -> np.ndarray:
    """Say the same from the recursion that a lone particle of p = K (1/J - 1) obeys.

    With w = dt tr C / 2 and r the step over the bound at rest, w' = w - 2 r^2 (J - 1) and J' = J (1 + w')^2. It keeps
    the area dw dJ / J, and so small oscillations stay small up to r = 1; but a period of three steps, at
    r = sqrt(3)/2 = 0.866, and one of four, at sqrt(1/2) = 0.707, throw out those of finite size (resonances of the
    leapfrog method: Mandziuk and Schlick 1995; Skeel, Zhang and Schlick 1997).
    """
    r = np.asarray(ratios, float)
    J, w, lost = np.full_like(r, volume_ratio), np.zeros_like(r), np.zeros(len(r), bool)
    for _ in range(steps):
        w = w - 2 * r * r * (J - 1)
        J = J * (1 + w) ** 2
        lost |= ~((J > SMALLEST) & (J < LARGEST))
        J[lost], w[lost] = 1.0, 0.0
    return lost


def windows(blown: np.ndarray, ratios: Sequence[float] = RATIOS) -> list[tuple[float, float]]:
    """Return the first and the last ratio of each unbroken row of blow-ups."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], blown, [False]]).astype(int)))
    return [(float(ratios[a]), float(ratios[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
