"""Fits a damped oscillation to a signal: its frequency and its decay."""

import math
from dataclasses import dataclass

import numpy as np

STEPS = 50


@dataclass(frozen=True)
class Oscillation:
    """offset + e^(-decay t) (a cos(frequency t) + b sin(frequency t)), frequency in rad/s, decay in 1/s."""

    frequency: float
    decay: float
    amplitude: float
    offset: float


def fit_oscillation(times: np.ndarray, signal: np.ndarray, frequency: float) -> Oscillation:
    """Fit a damped oscillation by least squares: Gauss and Newton's method from a first guess of the frequency, rad/s.

    Args:
        times, signal: (n,), some periods of it, s and any unit.
    """
    w, decay = frequency, 0.0
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
        if (abs(change[3]) <= 1e-14 * abs(w) and abs(change[4]) <= 1e-14 * abs(w)) or scale == 0:
            break
    return Oscillation(float(w), float(decay), math.hypot(a, b), float(offset))
