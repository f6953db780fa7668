"""Manufactured solutions with body forces: a standing wave, and a ring in large cyclic shear (docs/theory.md, 10)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, Tables, case_text
from mpmcli.validation.shared import ball, body, box, elastic, field, lame_moduli, problem

# The grid has at least five cells per axis; in 1D the strip fills them.
STRIP = 5
FRAMES = 8
AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class StandingWave:
    """Motion, force and stress of a neo-Hookean or fixed corotated solid; `signs` has s_i, one per moving axis.

    Along each axis i, with s_i = 1 or -1 (phases 0 and pi of Wallstedt and Guilkey 2008), in a unit square or cube of
    density 1 at rest between slip walls:
        u_i = s_i A sin(k X_i) sin(w t), so that F is diagonal with F_i = 1 + s_i A k cos(k X_i) sin(w t),
        b_i = d2u_i/dt2 - dP_ii/dX_i, with dF_i/dX_i = -k^2 u_i.
    At t = 0 the displacement is zero. Moduli are in Pa, the amplitude A in m.
    """

    law: str
    signs: tuple[int, ...]
    # k / pi.
    half_waves: int
    young: float
    poisson: float
    amplitude: float = 0.05

    @property
    def frequency(self) -> float:
        """Return w = pi c with c = sqrt(E / rho), rad/s; rho = 1."""
        return math.pi * math.sqrt(self.young)

    def velocity(self) -> list[str]:
        """Return the initial velocity, m/s, as expressions of a scene, one per moving axis."""
        peak = self.amplitude * self.frequency
        return [f"{sign * peak!r} * sin({self._wave} * {name})" for sign, name in zip(self.signs, AXES, strict=False)]

    def force(self) -> list[str]:
        """Return b, m/s^2, as expressions of a scene, one per moving axis."""
        mu, lam = lame_moduli(self.young, self.poisson)
        k2 = (self.half_waves * math.pi) ** 2
        swing = f"sin({self.frequency!r} * t)"
        # F_i - 1 = s_i A k cos(k X_i) sin(w t), with A k as a multiple of pi.
        slope = f"{self.amplitude * self.half_waves!r} * pi * cos({self._wave} *"
        moving = list(zip(self.signs, AXES, strict=False))
        stretches = [f"(1 {'+' if sign > 0 else '-'} {slope} {name}) * {swing})" for sign, name in moving]
        texts = []
        for i, F in enumerate(stretches):
            if self.law == "neo_hookean":
                # P_ii = mu (F_i - 1/F_i) + lambda ln J / F_i
                stiffness = f"{mu!r} * (1 + 1 / {F}**2)"
                if lam:
                    stiffness += f" + {lam!r} * (1 - log({' * '.join(stretches)})) / {F}**2"
            else:
                # P_ii = 2 mu (F_i - 1) + lambda (J - 1) J / F_i, where J / F_i is the product of the others.
                others = " * ".join(f"{stretch}**2" for j, stretch in enumerate(stretches) if j != i)
                stiffness = f"{2 * mu!r} + {lam!r} * {others}" if others else f"{2 * mu + lam!r}"
            moved = f"{self.signs[i] * self.amplitude!r} * sin({self._wave} * {AXES[i]}) * {swing}"
            texts.append(f"{moved} * ({k2!r} * ({stiffness}) - {self.frequency**2!r})")
        return texts

    def displacement(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return u, (n, d), m, of particles that start at X, (n, d), m: only the moving axes."""
        signs = np.array(self.signs)
        moving = X[:, : len(signs)]
        return signs * self.amplitude * np.sin(self.half_waves * np.pi * moving) * np.sin(self.frequency * time)

    def stretches(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return F_i, (n, 3): 1 along axes that do not move."""
        signs = np.array(self.signs)
        k = self.half_waves * np.pi
        F = np.ones((len(X), 3))
        moving = X[:, : len(signs)]
        F[:, : len(signs)] += signs * self.amplitude * k * np.cos(k * moving) * np.sin(self.frequency * time)
        return F

    def piola_stress(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return the diagonal of the first Piola-Kirchhoff stress, (n, 3), Pa."""
        F = self.stretches(X, time)
        J = F.prod(axis=1)[:, None]
        mu, lam = lame_moduli(self.young, self.poisson)
        if self.law == "neo_hookean":
            return mu * (F - 1 / F) + lam * np.log(J) / F
        return 2 * mu * (F - 1) + lam * (J - 1) * J / F

    def cauchy_stress(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return the diagonal of the Cauchy stress, (n, 3), Pa."""
        F = self.stretches(X, time)
        return self.piola_stress(X, time) * F / F.prod(axis=1)[:, None]

    @property
    def _wave(self) -> str:
        return "pi" if self.half_waves == 1 else f"{self.half_waves} * pi"


class ManufacturedWave(Case):
    """u_i = s_i A sin(k X_i) sin(w t) for one period, A = 0.05, w = pi sqrt(E / rho)."""

    text = case_text("manufactured_wave")
    group = "solids"

    def __init__(
        self,
        name: str,
        title: str,
        wave: StandingWave,
        error: tuple[float, float],
        stress: Callable[[int], float],
        note: str = "",
        solids: str = "updated",
    ) -> None:
        """`error` has the bounds of the displacement error at n = 16 and 32 (see `_displacement`), `stress` its bound.

        `note` is the name of the text with the note, by default that of the case.
        """
        self.name, self.title, self.wave, self.solids = name, f"Manufactured wave in a {title}", wave, solids
        self.source = STEFFEN if len(wave.signs) == 1 else WALLSTEDT
        # The cases with the other law cover the other settings.
        self.varies = ("precision",) if wave.law == "fixed_corotated" else Case.varies
        self.levels = CUBE_LEVELS if len(wave.signs) == 3 else LEVELS
        total = solids == "total"
        own = case_text(note or name).note
        self.note = own if total else f"{own} {self.text.note}"
        self.measures = (
            self.text.measure(
                "displacement error",
                lambda n: _displacement(n, *error),
                order=1.9,
                expected=2.0,
                order_to=math.inf if total else 16,
            ),
            self.text.measure("largest displacement error", lambda n: 3.6 * _displacement(n, *error), expected=2.0),
            self.text.measure("stress error", stress, order=1.0 if total else None, expected=2.0),
        )

    def tables(self, n: int) -> Tables:
        """Return a solid that fills n cells per axis, and the force that causes the chosen motion, for one period."""
        wave = self.wave
        d = len(wave.signs)
        size, cells, velocity, force = [1.0] * d, [n] * d, wave.velocity(), wave.force()
        if d == 1:
            size, cells, velocity, force = [1.0, STRIP / n], [n, STRIP], [*velocity, 0.0], [*force, 0.0]
        solid = elastic(wave.law, 1.0, wave.young, wave.poisson)
        return problem(
            {"size": size, "cells": cells, "walls": "slip"},
            (2 * math.pi / wave.frequency, FRAMES),
            "velocity stress initial_position",
            [body("solid", solid, box([0.0] * len(size), size), velocity=velocity)],
            forces=[{"acceleration": force}],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of displacement over its amplitude, and of stress over that of the wave, of all frames."""
        wave = self.wave
        squares, largest, stress = [], 0.0, []
        for frame, _ in frames:
            if frame.index == 0:
                continue
            X = field(frame, "initial_position")
            off = frame.position - X
            off[:, : len(wave.signs)] -= wave.displacement(X, frame.time)
            squares.append((off**2).sum(axis=1).mean())
            largest = max(largest, float(np.sqrt((off**2).sum(axis=1)).max()))
            sigma = frame.fields["stress"].reshape(-1, 3, 3) - wave.cauchy_stress(X, frame.time)[:, None] * np.eye(3)
            stress.append((sigma**2).sum(axis=(1, 2)).mean())
        scale = wave.young * wave.amplitude * wave.half_waves * math.pi
        return {
            "displacement error": math.sqrt(np.mean(squares)) / wave.amplitude,
            "largest displacement error": largest / wave.amplitude,
            "stress error": math.sqrt(np.mean(stress)) / scale,
        }


def _second_order(n: int, at_16: float, least: float) -> float:
    return max(at_16 * (16 / n) ** 2, least)


def _displacement(n: int, at_16: float, at_32: float) -> float:
    """Return the bound: second order, but at least the quadrature error, which halves once more at n = 64."""
    return _second_order(n, at_16, at_32 * max(32 / n, 0.5))


COROTATED = StandingWave("fixed_corotated", (1, -1), 1, 1000.0, 0.3)
LEVELS: Levels = {"coarse": (8, 16), "default": (8, 16, 32, 64), "fine": (8, 16, 32, 64, 128)}
CUBE_LEVELS: Levels = {"coarse": (12, 16), "default": (12, 16, 32), "fine": (12, 16, 32, 48)}
STEFFEN = "Steffen, Wallstedt, Guilkey, Kirby and Berzins 2008 (CMES 31:107)"
WALLSTEDT = "Wallstedt and Guilkey 2008 (JCP 227:9628)"

# Inner and outer radius of the ring, m; the outer one is that of the disc.
INNER, OUTER = 0.75, 1.25
MIDDLE, HALF = (OUTER + INNER) / 2, (OUTER - INNER) / 2
YOUNG, POISSON, DENSITY = 1000.0, 0.3, 1000.0
MU = YOUNG / (2 * (1 + POISSON))
# Largest angle, rad; the largest engineering shear is 2.1.
ANGLE = 0.3
PERIOD = 1.0
MARGIN = 0.25


def turn(R: np.ndarray, time: float) -> np.ndarray:
    """Return the angle alpha, rad, by which a circle of radius R, m, is rotated at a time, s."""
    s = (R - MIDDLE) / HALF
    shape = np.where(np.abs(s) < 1, (1 - s**2) ** 2, 0.0)
    return ANGLE * (1 - math.cos(2 * math.pi * time / PERIOD)) / 2 * shape


def body_force() -> list[str]:
    """Return the acceleration, m/s^2, as expressions of a scene.

    With kappa = R dalpha/dR and J = 1, P = mu (F - F^-T) and

        a_r = mu kappa^2 / (rho R) - R (dalpha/dt)^2,
        a_theta = R d2alpha/dt2 - mu (dkappa/dR + 2 kappa / R) / rho

    along the radial and tangential directions at the current position.
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
    """Circles between R = 0.75 and 1.25 m rotate by alpha(R, t) and back; the material inside them stays at rest."""

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
        """Return errors of position at the end and over all frames, over the arc in the middle of the ring."""
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


CASES = (
    ManufacturedWave(
        "mms_1d",
        "bar, neo-Hookean",
        StandingWave("neo_hookean", (1,), 2, 100.0, 0.0),
        error=(0.0053, 0.002),
        stress=lambda n: _second_order(n, 0.0172, 0.0137),
    ),
    ManufacturedWave(
        "mms_2d_neo_hookean",
        "square, neo-Hookean",
        StandingWave("neo_hookean", (1, -1), 1, 1000.0, 0.3),
        error=(0.0119, 0.004),
        stress=lambda n: _second_order(n, 0.033, 0.042),
        note="mms_square",
    ),
    ManufacturedWave(
        "mms_2d_corotated",
        "square, fixed corotated",
        COROTATED,
        error=(0.0132, 0.004),
        stress=lambda n: _second_order(n, 0.033, 0.042),
        note="mms_square",
    ),
    ManufacturedWave(
        "mms_2d_total",
        "square, total Lagrangian",
        COROTATED,
        error=(0.0118, 0.0),
        stress=lambda n: max(0.0326 * (16 / n) ** 2, 0.0284 * 16 / n),
        solids="total",
    ),
    ManufacturedWave(
        "mms_3d",
        "cube, neo-Hookean",
        StandingWave("neo_hookean", (1, -1, 1), 1, 1000.0, 0.3),
        error=(0.015, 0.005),
        stress=lambda n: _second_order(n, 0.043, 0.045),
    ),
    Vortex(),
)
