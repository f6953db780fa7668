"""A column of water that is let go, beside three measured ones (Martin and Moyce 1952): validation."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure
from mpmcli.validation.martin_moyce import LAST, N_SQUARED, best_shift, mean_error, measured

# a of the larger column, m.
WIDTH = 0.05715
GRAVITY, DENSITY = 9.81, 1000.0
# The front is where all but this share of the water is behind: what is left is a film thinner than a particle.
FILM = 0.001
# The height at the back is that of the highest water within this part of the width.
BACK = 1 / 8


class DamBreak(Case):
    """A column a wide and 2 a high at rest, its pressure hydrostatic, whose gate is gone at t = 0; no friction."""

    name = "dam_break"
    title = "Dam break against the columns of Martin and Moyce"
    group = "fluids"
    source = "Martin and Moyce 1952 (Phil. Trans. R. Soc. A 244:312), figure 3 and tables 2 and 6, n^2 = 2"
    resolution = "cells across the column"
    levels = {"coarse": (16,), "default": (16, 32, 64), "fine": (16, 32, 64, 96)}  # noqa: RUF012
    measures = (
        Measure(
            "shifted front error",
            "",
            "Mean of |Z - measured| / measured over T from 1 to 4, mean of the three series, best shift of time.",
            bound=lambda n: 0.02,
        ),
        Measure(
            "time shift",
            "T",
            "How much later than at t = 0 the gate lets go, as the three fronts would have it.",
            bound=lambda n: 0.3,
        ),
        Measure("front error", "", "The same as the first without a shift of time.", bound=lambda n: 0.15),
        Measure("series i", "", "That against series (i), a = 2.25 in, figure 3.", bound=lambda n: 0.15),
        Measure("series ii", "", "That against series (ii), a = 1.125 in, figure 3.", bound=lambda n: 0.15),
        Measure("series iii", "", "That against series (iii), a = 2.25 in, table 2.", bound=lambda n: 0.15),
        Measure(
            "height error",
            "",
            "Mean of |H - measured| / measured over T from 1 to 4 at the back, table 6, no shift of time.",
            bound=lambda n: 0.021,
        ),
    )
    note = (
        "Validation, not verification: the experiment has a gate, a floor with friction and an uncertain origin of "
        "time. So the front is judged with one shift of T for the three series, and the shift itself: a quarter leaves "
        "1 to 2 %, which no bend of the curve could. Without it the front leads by 12 to 14 %, as those of "
        "frictionless codes do by 5 to 15 %. Yet the height at the back agrees "
        "best without any, so that a late gate is not the whole of it. The front is that of 99.9 % of the water. The "
        "foremost particle is further ahead, and the more so the thinner a film the grid resolves: 13.7, 14.5 and "
        "14.8 % at 16, 32 and 64 cells; the front of 99 % is 5 % ahead. A floor that sticks is no friction at these "
        "resolutions, as the boundary layer of the experiment is a hundredth of a thick: the tongue rides over what "
        "sticks, and leads by 11 % at 16 cells and by 17 % at 32."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = WIDTH / n
        across, up = 13 * n // 2, 5 * n // 2
        return {
            "domain": {
                "size": [across * h, up * h],
                "cells": [across, up],
                "gravity": [0.0, -GRAVITY],
                "walls": "separate",
            },
            "time": {"end": LAST / math.sqrt(N_SQUARED * GRAVITY / WIDTH), "frames": 80},
            "output": {"fields": ["velocity"]},
            "bodies": [
                {
                    "name": "water",
                    "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": "auto"},
                    "shape": {"box": {"min": [0.0, 0.0], "max": [WIDTH, N_SQUARED * WIDTH]}},
                    "initial_pressure": "hydrostatic",
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, fronts, heights = [], [], []
        for frame, _ in frames:
            x, y = frame.position.astype(np.float64).T
            # Half the edge of a particle.
            reach = WIDTH * math.sqrt(N_SQUARED / len(x)) / 2
            times.append(frame.time)
            fronts.append((np.quantile(x, 1 - FILM) + reach) / WIDTH)
            heights.append((y[x < BACK * WIDTH].max() + reach) / (N_SQUARED * WIDTH))
        T = np.array(times) * math.sqrt(N_SQUARED * GRAVITY / WIDTH)
        front = np.array(fronts)
        curves = measured("front")
        errors = {f"series {series.name}": mean_error(series, T, front) for series in curves}
        shift, left = best_shift(curves, T, front)
        (height,) = measured("height")
        return {
            "shifted front error": left,
            "time shift": shift,
            "front error": float(np.mean(list(errors.values()))),
            **errors,
            "height error": mean_error(height, T, np.array(heights)),
        }


CASES = (DamBreak(),)
