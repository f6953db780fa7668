"""Standing gravity waves in a tank: how fast they swing, for small and for not so small amplitudes."""

import math


def standing_wave_frequency(gravity: float, wave_number: float, depth: float, amplitude: float = 0.0) -> float:
    """Return the frequency, rad/s, of a standing wave of water, to the third order in its steepness.

    w^2 = g k tanh(k d) for small waves; w / sqrt(g k) = w0 + (a k)^2/2 w2, with w0^2 = tanh(k d) and
    w2 = (9 w0^-7 - 12 w0^-3 - 3 w0 - 2 w0^5)/32 (Tadjbakhsh and Keller 1960, JFM 8:442).

    Args:
        gravity: m/s^2; wave_number: 1/m; depth, amplitude: m.
    """
    w = math.sqrt(math.tanh(wave_number * depth))
    curvature = (9 * w**-7 - 12 * w**-3 - 3 * w - 2 * w**5) / 32
    return math.sqrt(gravity * wave_number) * (w + (amplitude * wave_number) ** 2 / 2 * curvature)
