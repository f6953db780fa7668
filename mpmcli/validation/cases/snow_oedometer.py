"""Snow compressed in a shaft: the closed form of confined compression (Stomakhin et al. 2013)."""

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, elastic, field, lame_moduli, problem, shaft

DENSITY, DEPTH = 400.0, 1.0
YOUNG, NU, COMPRESSION, HARDENING = 1.4e5, 0.2, 0.025, 10.0
MU, LAMBDA = lame_moduli(YOUNG, NU)
# Final gravity, m/s^2, and its rise time, s, many times the travel time of a wave up and down the shaft. The lowest
# snow ends at 0.8 of its height.
PULL, DURATION = 70.0, 3.0


def confined_stress(stretch: np.ndarray) -> np.ndarray:
    """Return the Cauchy stress along the axis at a stretch below 1, Pa (docs/theory.md, 5.6).

    sigma = exp(xi (1 - J_P)) (2 mu (s - 1) s + lambda (J_E - 1) J_E) / J. The elastic stretch s = J_E is the stretch,
    limited by the critical compression, and J_P = J / J_E.
    """
    s = np.maximum(stretch, 1 - COMPRESSION)
    return np.exp(HARDENING * (1 - stretch / s)) * (2 * MU + LAMBDA) * (s - 1) * s / stretch


class SnowOedometer(Case):
    """A shaft of snow between slip walls with slowly increasing gravity: the compression varies with height."""

    text = case_text("snow_oedometer")
    name, title, group = "snow_oedometer", "Snow pressed together in a shaft", "plastic"
    varies = ("precision", "kernel", "transfer")
    levels = {"coarse": (12,), "default": (12, 24), "fine": (12, 24, 48)}  # noqa: RUF012
    measures = (
        text.measure("stress error", 0.0065),
        text.measure("weight error", lambda n: min(0.02, 0.32 / n)),
        text.measure("height error", 9e-4),
        text.measure("shear stress", 1e-12),
        text.measure("stretch at the base"),
    )

    def tables(self, n: int) -> Tables:
        domain, shape = shaft(n, DEPTH, f"-{PULL!r} * t / {DURATION!r}")
        snow = elastic("snow", DENSITY, YOUNG, NU, critical_compression=COMPRESSION, hardening=HARDENING)
        fields = "velocity stress volume_ratio initial_position"
        return problem(domain, (DURATION, 1), fields, [body("snow", snow, shape)])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of stress, against stretch and weight, and height, row by row of particles at the end."""
        *_, (last, _) = frames
        everything = field(last, "stress")
        Y = field(last, "initial_position")[:, 1]
        rows, row = np.unique(np.round(Y, 9), return_inverse=True)
        values = everything[:, 4], everything[:, 1], last.fields["volume_ratio"], last.position[:, 1]
        stress, shear, stretch, top = (np.bincount(row, value) / np.bincount(row) for value in values)
        weight = -DENSITY * PULL * (DEPTH - rows)
        known = confined_height(rows[-1])
        return {
            "stress error": float(np.abs(stress / confined_stress(stretch) - 1).max()),
            "weight error": float(np.linalg.norm(stress - weight) / np.linalg.norm(weight)),
            "height error": float(top[-1] / known - 1),
            "shear stress": float(np.abs(shear).max() / (DENSITY * PULL * DEPTH)),
            "stretch at the base": float(stretch[0]),
        }


def confined_height(Y: float) -> float:
    """Return the final height, m, of the snow that starts at Y, m, under the weight of the snow above.

    The stretch at each height is that at which the stress of the closed form, which increases with compression, equals
    the weight.
    """
    stretch = np.linspace(1.0, 0.7, 20001)
    heights = (np.arange(2000) + 0.5) * Y / 2000
    found = np.interp(DENSITY * PULL * (DEPTH - heights), -confined_stress(stretch), stretch)
    return float(found.mean() * Y)
