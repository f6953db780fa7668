"""The generalized vortex: a ring of a disc is sheared far and back by a body force, with nothing at its surface."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, case_text
from mpmcli.validation.measuring import field
from mpmcli.validation.tables import Tables, ball, body, elastic, problem

# Inner and outer radius of the ring, m; the outer one is that of the disc.
INNER, OUTER = 0.75, 1.25
MIDDLE, HALF = (OUTER + INNER) / 2, (OUTER - INNER) / 2
YOUNG, POISSON, DENSITY = 1000.0, 0.3, 1000.0
MU = YOUNG / (2 * (1 + POISSON))
# Largest angle, rad; the largest engineering shear is 2.1.
ANGLE = 0.3
PERIOD, FRAMES = 1.0, 8
MARGIN = 0.25


def turn(R: np.ndarray, time: float) -> np.ndarray:
    """Return the angle alpha, rad, by which a circle of radius R, m, is turned at a time, s."""
    s = (R - MIDDLE) / HALF
    shape = np.where(np.abs(s) < 1, (1 - s**2) ** 2, 0.0)
    return ANGLE * (1 - math.cos(2 * math.pi * time / PERIOD)) / 2 * shape


def body_force() -> list[str]:
    """Return the acceleration, m/s^2, as expressions of a scene.

    With kappa = R dalpha/dR, P is mu (F - F^-T), as J = 1, and

        a_r = mu kappa^2 / (rho R) - R (dalpha/dt)^2,
        a_theta = R d2alpha/dt2 - mu (dkappa/dR + 2 kappa / R) / rho

    along the directions that the motion has turned.
    """
    R, w = "hypot(X, Y)", 2 * math.pi / PERIOD
    s = f"(({R} - {MIDDLE}) / {HALF})"
    # The shape of alpha over R, and its derivatives with respect to R.
    shape = f"(1 - {s}**2)**2"
    slope = f"({-4 / HALF} * {s} * (1 - {s}**2))"
    bend = f"({-4 / HALF**2} * (1 - 3 * {s}**2))"
    # alpha's factor of time, and its derivatives.
    g = f"({ANGLE / 2} * (1 - cos({w!r} * t)))"
    rate = f"({ANGLE / 2 * w!r} * sin({w!r} * t))"
    rise = f"({ANGLE / 2 * w**2!r} * cos({w!r} * t))"
    kappa = f"({R} * {g} * {slope})"
    radial = f"({MU / DENSITY!r} * {kappa}**2 / {R} - {R} * ({rate} * {shape})**2)"
    around = f"({R} * {rise} * {shape} - {MU / DENSITY!r} * ({g} * ({slope} + {R} * {bend}) + 2 * {kappa} / {R}))"
    alpha = f"({g} * {shape})"
    cosine = f"((X * cos({alpha}) - Y * sin({alpha})) / {R})"
    sine = f"((Y * cos({alpha}) + X * sin({alpha})) / {R})"
    return [
        f"{radial} * {cosine} - {around} * {sine} if {R} > {INNER} else 0",
        f"{radial} * {sine} + {around} * {cosine} if {R} > {INNER} else 0",
    ]


class Vortex(Case):
    """Circles between R = 0.75 and 1.25 m turn by alpha(R, t) and back; what lies inside them stays at rest."""

    text = case_text("vortex")
    name, title, group = "vortex", "Large shear and back: the generalized vortex", "solids"
    solids = "total"
    varies = ("precision", "transfer", "per_axis", "safety")
    levels: Levels = {"coarse": (4, 8), "default": (4, 8, 16), "fine": (4, 8, 16)}  # noqa: RUF012
    measures = (
        text.measure(
            "error at the end", lambda n: 1.3 * 0.0299 * (8 / n) ** 1.8 if n >= 8 else 0.25, order=1.7, expected=2.0
        ),
        text.measure("displacement error", lambda n: 0.036 * (8 / n) ** 1.8 if n >= 8 else 0.15),
    )

    def tables(self, n: int) -> Tables:
        edge = OUTER + MARGIN
        return problem(
            {"origin": [-edge, -edge], "size": [2 * edge, 2 * edge], "spacing": 2 * HALF / n},
            (PERIOD, FRAMES),
            "initial_position",
            [body("disc", elastic("neo_hookean", DENSITY, YOUNG, POISSON), ball([0.0, 0.0], OUTER))],
            forces=[{"acceleration": body_force()}],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        squares = []
        for frame, _ in frames:
            X = field(frame, "initial_position")
            alpha = turn(np.hypot(*X.T), frame.time)
            place = np.stack(
                [X[:, 0] * np.cos(alpha) - X[:, 1] * np.sin(alpha), X[:, 1] * np.cos(alpha) + X[:, 0] * np.sin(alpha)],
                axis=1,
            )
            squares.append(((frame.position - place) ** 2).sum(axis=1).mean())
        scale = ANGLE * MIDDLE
        return {
            "error at the end": math.sqrt(squares[-1]) / scale,
            "displacement error": math.sqrt(np.mean(squares[1:])) / scale,
        }


CASES = (Vortex(),)
