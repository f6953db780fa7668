"""Least-squares fit of a damped oscillation to a signal."""

import math
from dataclasses import dataclass

import numpy as np

STEPS = 50
LARGEST_EXPONENT = 200.0
# Initial frequencies of the fit, over the guess.
STARTS = np.linspace(0.5, 2.0, 61)


@dataclass(frozen=True)
class Oscillation:
    """offset + e^(-decay t) (a cos(frequency t) + b sin(frequency t)), frequency in rad/s, decay in 1/s."""

    frequency: float
    decay: float
    amplitude: float
    offset: float


NOT_FOUND = Oscillation(math.nan, math.nan, math.nan, math.nan)


def fit_oscillation(times: np.ndarray, signal: np.ndarray, frequency: float) -> Oscillation:
    """Fit a damped oscillation by least squares with the Gauss-Newton method.

    The initial frequency, 0.5 to 2 times the guess, is that of the best undamped fit.

    Args:
        times: (n,), s; several periods.
        signal: (n,), any unit.
        frequency: the guess, rad/s.

    Returns:
        The oscillation; all NaN if the fit fails.
    """
    if not np.isfinite(signal).all():
        return NOT_FOUND
    w, decay = min(STARTS * frequency, key=lambda start: _misfit(times, signal, start)), 0.0
    scale = np.abs(signal).max()
    basis = np.empty((len(times), 3))
    for _ in range(STEPS):
        envelope = np.exp(-decay * times)
        cosine, sine = envelope * np.cos(w * times), envelope * np.sin(w * times)
        basis[:] = np.stack([cosine, sine, np.ones_like(times)], axis=1)
        (a, b, offset), *_ = np.linalg.lstsq(basis, signal, rcond=None)
        model = a * cosine + b * sine
        # Gauss-Newton step: derivatives with respect to w and the decay extend the linear basis.
        slopes = np.stack([times * (b * cosine - a * sine), -times * model], axis=1)
        change, *_ = np.linalg.lstsq(np.hstack([basis, slopes]), signal - basis @ [a, b, offset], rcond=None)
        w, decay = w + change[3], decay + change[4]
        # The fit has diverged, or the exponential would overflow.
        if not (0.1 * frequency < w < 10 * frequency and abs(decay) < LARGEST_EXPONENT / np.ptp(times)):
            return NOT_FOUND
        if (abs(change[3]) <= 1e-14 * abs(w) and abs(change[4]) <= 1e-14 * abs(w)) or scale == 0:
            break
    return Oscillation(float(w), float(decay), math.hypot(a, b), float(offset))


def _misfit(times: np.ndarray, signal: np.ndarray, frequency: float) -> float:
    """Return the residual norm of the best undamped oscillation of that frequency."""
    basis = np.stack([np.cos(frequency * times), np.sin(frequency * times), np.ones_like(times)], axis=1)
    found, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    return float(np.linalg.norm(signal - basis @ found))
