"""A column that settles under its own weight, applied slowly: the stress is known for any law."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, Tables, case_text
from mpmcli.validation.shared import after_ramp, body, elastic, field, problem, shaft, smooth_ramp

HEIGHT, DENSITY, GRAVITY = 50.0, 80.0, 10.0
WEIGHT = DENSITY * GRAVITY
# Strain at the base: 0.4 % in the firm column, 4 % in the soft one.
FIRM, SOFT = 1e7, 1e6
# In first periods of the column: the ramp of the load, and the averaging window after it.
RAMP, WINDOW, FRAMES_PER_PERIOD = 10, 2, 24


def stretch(law: str, youngs_modulus: float, Y: np.ndarray) -> np.ndarray:
    """Return F_yy at the initial height Y, m: the root of P(F) = -density g (height - Y).

    With nu = 0 the only stress is along y. neo_hookean: P = E/2 (F - 1/F); fixed_corotated: P = E (F - 1);
    von_mises below its yield stress, Hencky's law: P = E ln F / F.
    """
    a = WEIGHT * (HEIGHT - Y) / youngs_modulus
    if law == "neo_hookean":
        return np.sqrt(1 + a * a) - a
    if law == "fixed_corotated":
        return 1 - a
    F = np.ones_like(a)
    for _ in range(20):
        F = F - (np.log(F) + a * F) / (1 / F + a)
    return F


def rest_place(law: str, youngs_modulus: float, Y: np.ndarray) -> np.ndarray:
    """Return the height at rest of material from height Y, m: the integral of F_yy from 0 to Y, by Gauss quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    half = Y[..., None] / 2
    return (stretch(law, youngs_modulus, half * (1 + nodes)) * half) @ weights


class WeightedColumn(Case):
    """sigma_yy = -density g (height - Y), Y the initial height, in a column between rollers with nu = 0.

    Gravity rises smoothly within ten periods of the column; the measures are means over the two periods after that.
    """

    group = "solids"
    source = "Bardenhagen and Kober 2004; Charlton et al. 2017; Coombs and Augarde 2020 (AMPLE)"
    resolution = "cells along the column"
    law: str
    youngs_modulus: float
    extra: dict[str, float] = {}  # noqa: RUF012

    def tables(self, n: int) -> Tables:
        # 4 height / c, s.
        period = 4 * HEIGHT / math.sqrt(self.youngs_modulus / DENSITY)
        domain, shape = shaft(n, HEIGHT, f"-{GRAVITY} * {smooth_ramp(RAMP * period)}")
        column = body("column", elastic(self.law, DENSITY, self.youngs_modulus, 0.0, **self.extra), shape)
        time = (RAMP + WINDOW) * period, (RAMP + WINDOW) * FRAMES_PER_PERIOD
        return problem(domain, time, "stress initial_position", [column])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of stress and settlement, of means over the window after the load has grown."""
        stress = height = 0.0
        for weight, frame in after_ramp(frames, RAMP * FRAMES_PER_PERIOD, WINDOW * FRAMES_PER_PERIOD):
            stress = stress + weight * field(frame, "stress").reshape(-1, 3, 3)[:, 1, 1]
            height = height + weight * frame.position[:, 1].astype(np.float64)
        Y = field(frame, "initial_position")[:, 1]
        settled = HEIGHT - float(rest_place(self.law, self.youngs_modulus, np.array(HEIGHT)))
        error = np.abs(height - rest_place(self.law, self.youngs_modulus, Y)).max() / settled
        # Every particle has the same volume.
        return {
            "stress error": float(np.abs(stress + WEIGHT * (HEIGHT - Y)).mean()) / (WEIGHT * HEIGHT),
            "settlement error": float(error),
        }


STRESS = "Mean over the volume of |sigma_yy - exact|, over density g height."
SETTLEMENT = "Largest error of the height of a particle, over the settlement of the top."


class ColumnStatic(WeightedColumn):
    """The firm column: at strains of 0.4 % particles hardly move relative to the cells."""

    text = case_text("column_static")
    name, title = "column_static", "Column at rest under its own weight"
    law, youngs_modulus = "neo_hookean", FIRM
    levels = {"coarse": (16, 32), "default": (16, 32, 64), "fine": (16, 32, 64, 128)}  # noqa: RUF012
    measures = (
        Measure(f"stress error: {STRESS}", lambda n: 1.1 * 3 / 32 / n, order=1.0, expected=1.0),
        Measure(
            f"settlement error: {SETTLEMENT}",
            lambda n: 1.3 * (0.132 / n**2 + 1.6e-4),
            rounding=lambda n: 0.0046 * n / 64,
        ),
    )


class ColumnSettlement(WeightedColumn):
    """The soft column: at strains of 4 % the settlement depends on the law."""

    text = case_text("column_settlement")
    youngs_modulus = SOFT
    # The firm column covers the other settings.
    varies = ("precision",)
    levels = {"coarse": (32,), "default": (16, 32, 64), "fine": (16, 32, 64, 128)}  # noqa: RUF012
    measures = (
        Measure(f"settlement error: {SETTLEMENT}", lambda n: 1.3 * 0.021 / n, expected=1.0),
        Measure(f"stress error: {STRESS}", lambda n: 1.4 * (0.8 / n**2 + 1.1e-3)),
    )

    def __init__(self, name: str, title: str, law: str, **extra: float) -> None:
        self.name, self.title, self.law, self.extra = name, title, law, extra


CASES = (
    ColumnStatic(),
    ColumnSettlement("column_neo_hookean", "Settlement of a neo-Hookean column", "neo_hookean"),
    ColumnSettlement("column_corotated", "Settlement of a fixed corotated column", "fixed_corotated"),
    # Strong enough never to yield.
    ColumnSettlement("column_hencky", "Settlement of a column of Hencky's law", "von_mises", yield_stress=1e9),
)
