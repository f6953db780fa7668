"""Fits a damped oscillation to a signal: its frequency and its decay."""

import math
from dataclasses import dataclass

import numpy as np

STEPS = 50
LARGEST_EXPONENT = 200.0
# Frequencies that a fit may start from, over the guess.
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
    """Fit a damped oscillation by least squares, with Gauss and Newton's method.

    It starts from the frequency near a guess, 0.5 to 2 times as high, whose undamped oscillation fits best.

    Args:
        times, signal: (n,), some periods of it, s and any unit.
        frequency: the guess, rad/s.

    Returns:
        The oscillation: all NaN where none is found.
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
        # Derivatives by w and by the decay join the linear ones: one step of Gauss and Newton.
        slopes = np.stack([times * (b * cosine - a * sine), -times * model], axis=1)
        change, *_ = np.linalg.lstsq(np.hstack([basis, slopes]), signal - basis @ [a, b, offset], rcond=None)
        w, decay = w + change[3], decay + change[4]
        # Further off than any oscillation that could have been meant, or an exponential that overflows.
        if not (0.1 * frequency < w < 10 * frequency and abs(decay) < LARGEST_EXPONENT / np.ptp(times)):
            return NOT_FOUND
        if (abs(change[3]) <= 1e-14 * abs(w) and abs(change[4]) <= 1e-14 * abs(w)) or scale == 0:
            break
    return Oscillation(float(w), float(decay), math.hypot(a, b), float(offset))


def _misfit(times: np.ndarray, signal: np.ndarray, frequency: float) -> float:
    """Return what an undamped oscillation of that frequency leaves of a signal."""
    basis = np.stack([np.cos(frequency * times), np.sin(frequency * times), np.ones_like(times)], axis=1)
    found, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    return float(np.linalg.norm(signal - basis @ found))
