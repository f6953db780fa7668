"""What cases measure in frames: fields, the fit of a damped oscillation, a mean over residual oscillations."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene
from mpmcli.solver.transfer.kept_motion import OWN_STEP
from mpmcli.validation.case import Frames

# Initial frequencies of the fit, over the guess.
STARTS = np.linspace(0.5, 2.0, 61)
# Relative tolerances of the fit.
TIGHT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}


def field(frame: Frame, name: str) -> np.ndarray:
    """Return a field of a frame in double precision."""
    return frame.fields[name].astype(np.float64)


def damped_step(scene: Scene, step: float) -> float:
    """Return the step, s, whose damping a lone body has at steps of `step`: its own where that is longer."""
    return step * max(1.0, OWN_STEP / scene.time.safety)


def in_middle(frame: Frame, scene: Scene, number: int, width: float) -> np.ndarray:
    """Return which particles began in the middle of a body, a box or square of that width, m."""
    low, high = (np.array(bound) for bound in scene.bodies[number].shape.form.bounds())
    off = np.abs(field(frame, "initial_position") - (low + high) / 2).max(axis=1)
    return (frame.body == number) & (off < width / 2)


@dataclass(frozen=True)
class Oscillation:
    """offset + e^(-decay t) (a cos(frequency t) + b sin(frequency t)), frequency in rad/s, decay in 1/s."""

    frequency: float
    decay: float
    amplitude: float
    offset: float

    def energy_loss(self) -> float:
        """Return the part of the energy that is lost in a period."""
        return -math.expm1(-2 * self.decay * 2 * math.pi / self.frequency)


NOT_FOUND = Oscillation(math.nan, math.nan, math.nan, math.nan)


def fit_oscillation(times: np.ndarray, signal: np.ndarray, frequency: float) -> Oscillation:
    """Fit a damped oscillation to several periods of a signal, (n,), by least squares.

    The initial frequency, 0.5 to 2 times the guess in rad/s, is that of the best undamped fit. All is NaN if the fit
    fails.
    """
    from scipy.optimize import least_squares

    if not np.isfinite(signal).all():
        return NOT_FOUND

    def residual(x: np.ndarray) -> np.ndarray:
        w, decay, a, b, offset = x
        return np.exp(-decay * times) * (a * np.cos(w * times) + b * np.sin(w * times)) + offset - signal

    _, w, parts = min((_undamped(times, signal, w) for w in STARTS * frequency), key=lambda start: start[0])
    a, b, offset = parts
    try:
        found = least_squares(residual, (w, 0.0, a, b, offset), "3-point", x_scale="jac", **TIGHT)
    # The exponential overflows.
    except ValueError:
        return NOT_FOUND
    w, decay, a, b, offset = map(float, found.x)
    sound = found.success and 0.1 < w / frequency < 10
    return Oscillation(w, decay, math.hypot(a, b), offset) if sound else NOT_FOUND


def _undamped(times: np.ndarray, signal: np.ndarray, frequency: float) -> tuple[float, float, np.ndarray]:
    """Return residual norm, frequency and coefficients of the best undamped oscillation of that frequency."""
    basis = np.stack([np.cos(frequency * times), np.sin(frequency * times), np.ones_like(times)], axis=1)
    parts, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    return float(np.linalg.norm(signal - basis @ parts)), frequency, parts


def window_weights(count: int) -> np.ndarray:
    """Return Hann's weights, (count,), of the frames of a window, first and last included; they sum to 1.

    An oscillation with m periods in the window is reduced by sin(pi m) / (pi m (1 - m^2)): 0 for integers m > 1
    and less than 0.02 for m > 2.4. The factor of an unweighted mean is sin(pi m) / (pi m).
    """
    weights = np.sin(np.pi * np.arange(count) / (count - 1)) ** 2
    return weights / weights.sum()


def after_ramp(frames: Frames, ramp: int, window: int) -> Iterator[tuple[float, Frame]]:
    """Yield the frames that follow the `ramp` first ones, `window` and one in number, each with its weight."""
    weights = window_weights(window + 1)
    for frame, _ in frames:
        if frame.index >= ramp:
            yield weights[frame.index - ramp], frame
