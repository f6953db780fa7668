"""The elliptical drop of Monaghan (1994): a flow with a free surface and known particle paths."""

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import ball, body, field, fluid, problem

# A0 = 1/s, R = 1 m; END and c = 15 A0 R as in the literature.
DENSITY, SOUND, END = 1000.0, 15.0, 0.76
FRAMES = 4


def half_axis(time: float) -> float:
    """Return the half axis a(t) along x of a drop that starts as a disc, a(0) = 1, with v = (-x, y).

    The flow v = A (-x, y) preserves an ellipse of half axes a and 1/a and the energy A^2 (a^2 + a^-2). Hence
    da/dt = -a A with A = sqrt(2 / (a^2 + a^-2)), integrated to 1e-13.
    """
    from scipy.integrate import solve_ivp

    accuracy = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    solution = solve_ivp(lambda _, a: -a * np.sqrt(2 / (a * a + 1 / (a * a))), (0.0, time), [1.0], **accuracy)
    return float(solution.y[0, -1])


class EllipticalDrop(Case):
    """x = diag(a(t), 1/a(t)) X under v = A0 (-X, Y) at t = 0 and p = density A0^2/2 (1 - r^2)."""

    text = case_text("elliptical_drop")
    name, title, group = "elliptical_drop", "Elliptical drop", "fluids"
    levels = {"coarse": (10, 20), "default": (10, 20, 40), "fine": (20, 40, 80)}  # noqa: RUF012
    measures = (
        # Particle shifting, which moves particles off their paths, contributes 0.013 h, and compressibility 3e-4.
        text.measure("position error (R)", lambda n: 1.35e-3 * 20 / n + 3e-4, expected=1.0),
        # At most the effect of compressibility, 1 / (4 SOUND^2), and less on fine grids.
        text.measure("axes error", lambda n: min(1 / (4 * SOUND**2), 5e-4 + 1e-3 * 20 / n), expected=1.0),
        text.measure("energy loss", 5e-5),
    )

    def tables(self, n: int) -> Tables:
        drop = body(
            "drop",
            fluid(DENSITY, DENSITY * SOUND**2),
            ball([0.0, 0.0], 1.0),
            velocity=["-X", "Y"],
            # p = K (1/J - 1)
            deformation=f"1 / (1 + (1 - X**2 - Y**2) / {2 * SOUND**2!r})",
        )
        domain = {"origin": [-1.5, -2.5], "size": [3.0, 5.0], "cells": [3 * n, 5 * n], "gravity": [0.0, 0.0]}
        return problem(domain, (END, FRAMES), "velocity initial_position", [drop])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the root mean square error of positions, the error of the axes at the end, and the energy lost."""
        rows = []
        for frame, row in frames:
            rows.append(row)
            x, X = frame.position.astype(np.float64), field(frame, "initial_position")
        a = half_axis(END)
        exact = X * [a, 1 / a]
        # Relative to these particles, because a lattice in a disc does not have exactly the second moments of the disc.
        axes = np.sqrt((x**2).mean(0) / (exact**2).mean(0)) - 1
        return {
            "position error": float(np.sqrt(((x - exact) ** 2).sum(1).mean())),
            "axes error": float(axes[np.abs(axes).argmax()]),
            "energy loss": 1 - rows[-1].energy / rows[0].energy,
        }
