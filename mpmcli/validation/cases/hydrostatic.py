"""A column of water in a shaft: at rest under its own pressure, and let go without any."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.measuring import field
from mpmcli.validation.tables import Tables, body, fluid, problem, shaft

HEIGHT, DENSITY, GRAVITY = 1.0, 1000.0, 9.81
WEIGHT = DENSITY * GRAVITY * HEIGHT
FRAMES_PER_PERIOD = 40
# Terms of the series of a triangle; the first one left out has 1e-6 of the first.
TERMS = 500


def column(n: int, modulus: float, time: tuple[float, int], **start: str) -> Tables:
    """Return the tables of a column of n cells in a shaft with slip walls."""
    domain, shape = shaft(n, HEIGHT, -GRAVITY, across=8, room=4)
    fields = "velocity pressure volume_ratio initial_position"
    return problem(domain, time, fields, [body("water", fluid(DENSITY, modulus), shape, **start)])


class Hydrostatic(Case):
    """p = density g (H - Y) from the start, and nothing moves."""

    text = case_text("hydrostatic")
    name, title, group = "hydrostatic", "Hydrostatic column", "fluids"
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("pressure error", lambda n: 6e-4 * (32 / n) ** 1.5, order=1.4, expected=1.5),
        text.measure("resting speed (sqrt(g H))", lambda n: 6.5e-6 * (32 / n) ** 1.3),
        text.measure("row spread (density g H)", 1e-12),
    )

    def tables(self, n: int) -> Tables:
        return column(n, 100 * 2 * WEIGHT, (2.0, 40), initial_pressure="hydrostatic")

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        errors, speeds, spreads = [], [], []
        for frame, row in frames:
            Y = field(frame, "initial_position")[:, 1]
            pressure = field(frame, "pressure")
            exact = WEIGHT * (1 - Y / HEIGHT)
            errors.append(np.linalg.norm(pressure * frame.fields["volume_ratio"] - exact) / np.linalg.norm(exact))
            speeds.append(row.speed_max)
            spreads.append(np.std(pressure - row_means(Y, pressure)))
        return {
            "pressure error": float(max(errors)),
            "resting speed": max(speeds) / math.sqrt(GRAVITY * HEIGHT),
            "row spread": float(max(spreads)) / WEIGHT,
        }


def row_means(Y: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return, for each particle, (n,), the mean of the values of all that began at its height."""
    _, rows = np.unique(np.round(Y, 6), return_inverse=True)
    return (np.bincount(rows, values) / np.bincount(rows))[rows]


class HydrostaticDrop(Case):
    """Gravity switched on at t = 0: the base feels a triangle between 0 and 2 density g H, of period 4 H/c."""

    text = case_text("hydrostatic_drop")
    name, title, group = "hydrostatic_drop", "Column of water let go", "fluids"
    varies = ("precision", "transfer")
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    # Stiff, so that the column is nearly linear: its weight at rest compresses it by 0.1 % at the base. Sound runs as
    # much faster as it is compressed, by half of that along each characteristic, whenever that starts.
    modulus = 1000 * WEIGHT
    period = 4 * HEIGHT / math.sqrt(modulus / DENSITY) * (1 - WEIGHT / modulus / 2)
    periods = 3
    measures = (
        text.measure("pressure error", lambda n: 0.02 * 16 / n, order=0.9, expected=1.0),
        text.measure("period error", lambda n: 1.5e-4 + 2.3e-3 * (16 / n) ** 2),
        text.measure("peak error", lambda n: 0.04 * (16 / n) ** (2 / 3), expected=2 / 3),
    )

    def tables(self, n: int) -> Tables:
        return column(n, self.modulus, (self.periods * self.period, FRAMES_PER_PERIOD * self.periods))

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        times, base, exact_base, errors = [], [], [], []
        odd = 2 * np.arange(TERMS) + 1
        share = None
        for frame, _ in frames:
            if share is None:
                Y, row = np.unique(np.round(frame.fields["initial_position"][:, 1], 6), return_inverse=True)
                share = 8 / (np.pi * odd) ** 2 * np.cos(odd * np.pi * Y[:, None] / (2 * HEIGHT))
            exact = 1 - Y / HEIGHT - share @ np.cos(2 * np.pi * odd * frame.time / self.period)
            pressure = field(frame, "pressure") / WEIGHT
            errors.append(np.abs(pressure - exact[row]).mean())
            times.append(frame.time)
            base.append(pressure[row == 0].mean())
            exact_base.append(exact[0])
        # The phase of the first harmonic, period by period: the others of a triangle are orthogonal to it there.
        turns = np.exp(-2j * math.pi / self.period * np.array(times[1:])) * base[1:]
        phases = turns.reshape(self.periods, -1).mean(1)
        lead = np.angle(phases[-1] / phases[0]) / (2 * math.pi * (self.periods - 1))
        return {
            "pressure error": float(np.mean(errors)),
            "period error": float(1 / (1 + lead) - 1),
            "peak error": max(base) / max(exact_base) - 1,
        }


CASES = (Hydrostatic(), HydrostaticDrop())
