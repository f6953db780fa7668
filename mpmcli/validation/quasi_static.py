"""Statics with a solver of motion: a load that comes on smoothly, and the mean of what still swings after it."""

import numpy as np


def smooth_ramp(duration: float) -> str:
    """Return the text of an expression of t that rises from 0 to 1 within `duration`, s, and stays there.

    s^4 (35 - 84 s + 70 s^2 - 20 s^3), s = t / duration: three derivatives vanish at both ends, so that a mode of
    frequency w is left swinging with 1680 / (w duration)^4 of its static part at most (integrals by parts of the slope
    140 s^3 (1 - s)^3, whose third derivative is 840 at both ends).
    """
    s = f"clamp(t / {duration!r}, 0, 1)"
    return f"({s} ** 4 * (35 - 84 * {s} + 70 * {s} ** 2 - 20 * {s} ** 3))"


def window_weights(count: int) -> np.ndarray:
    """Return Hann's weights, (count,), of the frames of a window, first and last included; they sum to 1.

    Of a swing of which the window holds m periods they leave sin(pi m) / (pi m (1 - m^2)): nothing where m is whole and
    2 or more, and less than 0.02 beyond m = 2.4. Plain means leave sin(pi m) / (pi m).
    """
    weights = np.sin(np.pi * np.arange(count) / (count - 1)) ** 2
    return weights / weights.sum()
