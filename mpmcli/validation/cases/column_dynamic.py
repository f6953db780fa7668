"""A column with gravity switched on at t = 0: it oscillates between zero and twice its settlement (d'Alembert)."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, elastic, field, fit_oscillation, problem, shaft

HEIGHT, YOUNG, DENSITY, GRAVITY = 1.0, 1e6, 1000.0, 1.0
WAVE_SPEED = math.sqrt(YOUNG / DENSITY)
PERIOD = 4 * HEIGHT / WAVE_SPEED
WEIGHT = DENSITY * GRAVITY * HEIGHT
# Largest settlement of the top, twice the static one, m.
PEAK = WEIGHT * HEIGHT / YOUNG
PERIODS, FRAMES_PER_PERIOD = 3, 48
# Quadrature error at any spacing: at strains of 1e-3 particles are no longer evenly spaced.
FLOOR = 4e-5


def exact_stress(Y: np.ndarray, time: float) -> np.ndarray:
    """Return sigma_yy at height Y, m, Pa, for small strain.

    The difference from the state of rest, S = -density g (height - |Y|), propagates as two waves, even about the base
    and odd about the top: sigma = S(Y) - (S(Y - ct) + S(Y + ct)) / 2.
    """

    def at_rest(y: np.ndarray) -> np.ndarray:
        around = np.abs((y + 2 * HEIGHT) % (4 * HEIGHT) - 2 * HEIGHT)
        return -WEIGHT * (1 - around / HEIGHT)

    reach = WAVE_SPEED * time
    return at_rest(Y) - (at_rest(Y - reach) + at_rest(Y + reach)) / 2


def extreme(times: np.ndarray, values: np.ndarray) -> float:
    """Return the peak of the parabola through the largest sample and its neighbours."""
    k = int(np.clip(values.argmax(), 1, len(values) - 2))
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(middle - (right - left) ** 2 / (8 * bend)) if bend else float(middle)


class ColumnDynamic(Case):
    """u_tt = c^2 u_yy - g from rest: the stress at the base is a triangle wave between 0 and 2 density g height."""

    text = case_text("column_dynamic")
    name, title, group = "column_dynamic", "Column with gravity switched on", "solids"
    levels = {"coarse": (16, 32), "default": (16, 32, 64, 128), "fine": (16, 32, 64, 128, 256)}  # noqa: RUF012
    measures = (
        text.measure("base stress error", lambda n: 1.25 * 0.32 / n, order=0.9, expected=1.0),
        text.measure("peak error", lambda n: 1.5 * (0.052 / n**2 + FLOOR), rounding=3e-4),
        text.measure("period error", lambda n: 1.3 * 0.105 * (math.pi / 2 / n) ** 2 + 1.5 * FLOOR),
    )

    def tables(self, n: int) -> Tables:
        domain, shape = shaft(n, HEIGHT, -GRAVITY)
        column = body("column", elastic("fixed_corotated", DENSITY, YOUNG, 0.0), shape)
        time = PERIODS * PERIOD, PERIODS * FRAMES_PER_PERIOD
        return problem(domain, time, "stress initial_position", [column])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of the stress at the base over time, of the first peak of the top and of the period."""
        times, tops, modes, errors = [], [], [], []
        for frame, _ in frames:
            start = field(frame, "initial_position")[:, 1]
            sunk = start - frame.position[:, 1]
            low = start < scene.domain.spacing
            stress = field(frame, "stress").reshape(-1, 3, 3)[low, 1, 1]
            times.append(frame.time)
            tops.append(float(sunk[start == start.max()].mean()))
            modes.append(float(sunk @ np.sin(np.pi * start / (2 * HEIGHT))))
            errors.append(abs(float((stress - exact_stress(start[low], frame.time)).mean())) / WEIGHT)
        wave = fit_oscillation(np.array(times), np.array(modes), 2 * math.pi / PERIOD)
        first = slice(0, FRAMES_PER_PERIOD + 1)
        return {
            "base stress error": float(np.mean(errors)),
            "peak error": extreme(np.array(times[first]), np.array(tops[first])) / PEAK - 1,
            "period error": 2 * math.pi / wave.frequency / PERIOD - 1,
        }
