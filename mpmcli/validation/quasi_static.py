"""Static solutions from a dynamic solver: a smooth load ramp, and a mean over residual oscillations."""

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

    An oscillation with m periods in the window is reduced by sin(pi m) / (pi m (1 - m^2)): 0 for integers m > 1
    and less than 0.02 for m > 2.4. The factor of an unweighted mean is sin(pi m) / (pi m).
    """
    weights = np.sin(np.pi * np.arange(count) / (count - 1)) ** 2
    return weights / weights.sum()
