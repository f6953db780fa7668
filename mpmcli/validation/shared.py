"""Shared parts of the cases: tables of scenes in SI units, reference data, and measurements on frames."""

import math
import tomllib
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene
from mpmcli.solver.transfer.kept_motion import OWN_STEP
from mpmcli.validation.case import Frames, Tables

# Initial frequencies of the fit relative to the guess.
STARTS = np.linspace(0.5, 2.0, 61)
# Relative tolerances of the fit.
TIGHT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}


def problem(domain: Tables, time: tuple[float, int], fields: str, bodies: Sequence[Tables], **more: Any) -> Tables:
    """Return the tables of a scene: `time` is the end, s, and the number of frames, `fields` names between spaces.

    Bodies stick, unless `more` has a "contact". The tables are copies, because cases share tables of materials and a
    caller may modify the scene.
    """
    end, frames = time
    parts = {"domain": domain, "time": {"end": end, "frames": frames}, "output": {"fields": fields.split()}}
    parts["contact"] = {"default": "stick"}
    return deepcopy({**parts, "bodies": [*bodies], **more})


def body(name: str, material: Tables, shape: Tables, **more: Any) -> Tables:
    """Return the table of a body."""
    return {"name": name, "material": material, "shape": shape, **more}


def box(low: Sequence[float], high: Sequence[float]) -> Tables:
    """Return the shape of a box between two corners."""
    return {"box": {"min": [*low], "max": [*high]}}


def ball(center: Sequence[float], radius: float) -> Tables:
    """Return the shape of a disc or a ball."""
    return {"ball": {"center": [*center], "radius": radius}}


def fluid(density: float, bulk_modulus: float | str, law: str = "fluid", **more: Any) -> Tables:
    """Return the table of a fluid, or of another law with a bulk modulus."""
    return {"law": law, "density": density, "bulk_modulus": bulk_modulus, **more}


def elastic(law: str, density: float, youngs_modulus: float, poissons_ratio: float, **more: float) -> Tables:
    """Return the table of a material with elastic moduli and further parameters."""
    moduli = {"youngs_modulus": youngs_modulus, "poissons_ratio": poissons_ratio}
    return {"law": law, "density": density, **moduli, **more}


def lame_moduli(youngs_modulus: float, poissons_ratio: float) -> tuple[float, float]:
    """Return mu and lambda. Independent of the solver's code, so that an error there does not cancel."""
    E, nu = youngs_modulus, poissons_ratio
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def shaft(n: int, height: float, gravity: float | str, across: int = 5, room: int = 3) -> tuple[Tables, Tables]:
    """Return the domain of a shaft between slip walls and the shape of a column of n cells that fills its width.

    The grid has at least five cells per axis; a column that fills them stays one-dimensional. Gravity is along y, and
    `room` cells above the column are empty.
    """
    h = height / n
    size, cells = [across * h, height + room * h], [across, n + room]
    domain = {"size": size, "cells": cells, "gravity": [0.0, gravity], "walls": "slip"}
    return domain, box([0.0, 0.0], [across * h, height])


def free_blocks(n: int, edge: float, count: int, gaps: Sequence[int]) -> tuple[Tables, list[Tables]]:
    """Return the domain and the shapes of blocks of n cells along an edge, one above the other along the last axis.

    `gaps` are the numbers of empty cells beside the blocks along each axis, and between them along the last one.
    """
    h, (*beside, between) = edge / n, gaps
    cells = [n + 2 * gap for gap in beside] + [count * (n + between) + between]
    lows = [[gap * h for gap in beside] + [(between + k * (n + between)) * h] for k in range(count)]
    domain = {"size": [number * h for number in cells], "cells": cells, "walls": "separate"}
    return domain, [box(low, [x + edge for x in low]) for low in lows]


def smooth_ramp(duration: float) -> str:
    """Return the text of an expression of t that rises from 0 to 1 within `duration`, s, and stays there.

    With x = t / duration it is x^4 (35 - 84 x + 70 x^2 - 20 x^3), whose first three derivatives vanish at both ends. A
    mode of angular frequency w then oscillates with at most 2000 / (w duration)^4 of its static displacement, and about
    1680 / (w duration)^4 if w duration is large: integrate the slope 140 x^3 (1 - x)^3, whose third derivative at the
    ends is 840 and -840, by parts.
    """
    s = f"clamp(t / {duration!r}, 0, 1)"
    return f"({s} ** 4 * (35 - 84 * {s} + 70 * {s} ** 2 - 20 * {s} ** 3))"


def reference_data(name: str) -> dict[str, Any]:
    """Return the contents of a file of `data/`, which states its sources."""
    return tomllib.loads(files("mpmcli.validation").joinpath(f"data/{name}.toml").read_text(encoding="utf-8"))


def field(frame: Frame, name: str) -> np.ndarray:
    """Return a field of a frame in double precision."""
    return frame.fields[name].astype(np.float64)


def damped_step(scene: Scene, step: float) -> float:
    """Return the step, s, that sets the damping of a single body: `step`, or the body's own step if longer."""
    return step * max(1.0, OWN_STEP / scene.time.safety)


def in_middle(frame: Frame, scene: Scene, number: int, width: float) -> np.ndarray:
    """Return a mask of the particles of a body that start in its middle, a square or cube of `width`, m."""
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
        """Return the fraction of the energy that is lost per period."""
        return -math.expm1(-2 * self.decay * 2 * math.pi / self.frequency)


NOT_FOUND = Oscillation(math.nan, math.nan, math.nan, math.nan)


def fit_oscillation(times: np.ndarray, signal: np.ndarray, frequency: float) -> Oscillation:
    """Fit a damped oscillation to several periods of a signal, (n,), by least squares.

    The initial frequency is that of the best undamped fit, 0.5 to 2 times the guess `frequency`, rad/s. All values are
    NaN if the fit fails.
    """
    from scipy.optimize import least_squares

    if not np.isfinite(signal).all():
        return NOT_FOUND

    def residual(x: np.ndarray) -> np.ndarray:
        w, decay, a, b, offset = x
        return np.exp(-decay * times) * (a * np.cos(w * times) + b * np.sin(w * times)) + offset - signal

    def undamped(w: float) -> tuple[float, float, np.ndarray]:
        """Return residual norm, frequency and coefficients of the best undamped oscillation of that frequency."""
        basis = np.stack([np.cos(w * times), np.sin(w * times), np.ones_like(times)], axis=1)
        parts, *_ = np.linalg.lstsq(basis, signal, rcond=None)
        return float(np.linalg.norm(signal - basis @ parts)), w, parts

    _, w, (a, b, offset) = min(map(undamped, STARTS * frequency), key=lambda start: start[0])
    try:
        found = least_squares(residual, (w, 0.0, a, b, offset), "3-point", x_scale="jac", **TIGHT)
    # The exponential overflows.
    except ValueError:
        return NOT_FOUND
    w, decay, a, b, offset = map(float, found.x)
    sound = found.success and 0.1 < w / frequency < 10
    return Oscillation(w, decay, math.hypot(a, b), offset) if sound else NOT_FOUND


def window_weights(count: int) -> np.ndarray:
    """Return the Hann weights, (count,), of the frames of a window, including first and last; they sum to 1.

    An oscillation with m periods in the window is reduced by sin(pi m) / (pi m (1 - m^2)): 0 for integers m > 1
    and less than 0.02 for m > 2.4. The factor of an unweighted mean is sin(pi m) / (pi m).
    """
    weights = np.sin(np.pi * np.arange(count) / (count - 1)) ** 2
    return weights / weights.sum()


def after_ramp(frames: Frames, ramp: int, window: int) -> Iterator[tuple[float, Frame]]:
    """Yield the `window` + 1 frames from frame `ramp` on, each with its Hann weight."""
    weights = window_weights(window + 1)
    for frame, _ in frames:
        if frame.index >= ramp:
            yield weights[frame.index - ramp], frame
