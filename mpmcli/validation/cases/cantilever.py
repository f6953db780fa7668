"""Clamped beams with a load at the tip: small and large deflections, against Reissner's beam and the elastica."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Levels, Measure, Tables, case_text
from mpmcli.validation.shared import after_ramp, body, box, elastic, field, problem, smooth_ramp

if TYPE_CHECKING:
    from scipy.integrate import OdeSolution


@dataclass(frozen=True)
class Beam:
    """A beam of length 1 and bending stiffness EI = 1, straight along x and clamped at 0, with a load along y.

    The load, P L^2 / EI, is spread over the last fraction `spread` of the length. The axial stiffness, EA L^2 / EI, and
    the shear stiffness, k G A L^2 / EI, are infinite for the elastica.
    """

    load: float
    spread: float = 0.0
    axial: float = math.inf
    shear: float = math.inf

    def bent(self) -> "OdeSolution":
        """Return the centre line in equilibrium: a function of s from 0 to 1 that gives x, y, theta and M.

        theta' = M, M' = -x' f, (x, y)' = (1 + N/EA) (cos, sin) theta + V/kGA (-sin, cos) theta with N = f sin theta,
        V = f cos theta, and f the part of the load that acts beyond s (Reissner 1972). M at the clamp is the root of
        M(1) = 0. Its upper bound follows from the elastica, for which M^2 / 2 + load sin theta is constant.
        """
        from scipy.optimize import brentq

        highest = 1.2 * math.sqrt(2 * self.load)
        moment = brentq(lambda moment: self._shoot(moment)(1.0)[3], 0.0, highest, xtol=1e-15)
        return self._shoot(moment)

    def _shoot(self, moment: float) -> "OdeSolution":
        """Return x, y, theta and the moment along the beam, s from 0 at the clamp to 1, for a moment at the clamp."""
        from scipy.integrate import solve_ivp

        def slopes(s: float, state: np.ndarray) -> tuple[float, ...]:
            """Return d(x, y, theta, M)/ds."""
            _, _, theta, moment = state
            f = self.load * min((1 - s) / self.spread if self.spread else 1.0, 1.0)
            c, d = math.cos(theta), math.sin(theta)
            along, across = 1 + f * d / self.axial, f * c / self.shear
            x = along * c - across * d
            return x, along * d + across * c, moment, -x * f

        accuracy = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-16, "max_step": 0.02}
        return solve_ivp(slopes, (0.0, 1.0), (0.0, 0.0, 0.0, moment), dense_output=True, **accuracy).sol


LENGTH, THICKNESS, YOUNG, DENSITY = 5.0, 1.0, 1e6, 1000.0
SLENDERNESS = LENGTH / THICKNESS
# Fraction of the length, at the tip, that carries the load.
SPREAD = 0.1
# First period of the straight beam, s: 2 pi / 3.516 sqrt(density A L^4 / EI).
PERIOD = 2 * math.pi / 3.516 * LENGTH * SLENDERNESS * math.sqrt(12 * DENSITY / YOUNG)
# In first periods: the ramp of the load, and the averaging window after it.
RAMP, WINDOW, FRAMES_PER_PERIOD = 3, 2, 24
# Extent of the domain beyond the beam, m; the beam lies from 0 to its thickness, and its tip sinks by 1.5 m.
RIGHT, BELOW, ABOVE = 1.0, 3.0, 1.0
TIP = "Distance of the tip from that of Reissner's beam, over its displacement."
THIN = Measure("deflection against thin: Deflection of the tip over that of a beam without shear and stretch, minus 1.")


class Cantilever(Case):
    """EI theta'' = -P cos theta along the line of a thin beam; Reissner's beam adds shear and stretch.

    P rises smoothly within three periods of the beam and stays along y; the measures are means over the two periods
    after that. With nu = 0 fixed corotated bends linearly, M = EI kappa at any kappa. The wall sticks and so holds the
    whole end face.
    """

    group = "solids"
    resolution = "cells through the thickness"
    load: float

    def beam(self, *, thin: bool = False) -> Beam:
        """Return the beam in units of its length and bending stiffness: G = E/2, and k = 5/6 for a rectangle."""
        if thin:
            return Beam(self.load, SPREAD)
        return Beam(self.load, SPREAD, axial=12 * SLENDERNESS**2, shear=5 * SLENDERNESS**2)

    def tables(self, n: int) -> Tables:
        """Return a beam n cells thick, whose load near the tip grows over RAMP periods and stays for WINDOW."""
        # P / (density thickness length of the loaded part), m/s^2.
        pull = self.load * YOUNG * THICKNESS**2 / (12 * LENGTH**2) / (DENSITY * SPREAD * LENGTH)
        load = f"-{pull!r} * {smooth_ramp(RAMP * PERIOD)} if X > {(1 - SPREAD) * LENGTH!r} else 0"
        return problem(
            {
                "origin": [0.0, -BELOW],
                "size": [LENGTH + RIGHT, BELOW + THICKNESS + ABOVE],
                "spacing": THICKNESS / n,
                "walls": {"x_min": "stick"},
            },
            ((RAMP + WINDOW) * PERIOD, (RAMP + WINDOW) * FRAMES_PER_PERIOD),
            "initial_position",
            [body("beam", elastic("fixed_corotated", DENSITY, YOUNG, 0.0), box([0.0, 0.0], [LENGTH, THICKNESS]))],
            forces=[{"name": "load", "acceleration": [0.0, load]}],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the error of the mean place of the tip, over its way, and the deflection against a thin beam's."""
        tip = np.zeros(2)
        for weight, frame in after_ramp(frames, RAMP * FRAMES_PER_PERIOD, WINDOW * FRAMES_PER_PERIOD):
            along = field(frame, "initial_position")[:, 0]
            # The last particles before the end face.
            last = along > along.max() - scene.domain.spacing / 100
            tip += weight * frame.position[last].astype(np.float64).mean(axis=0)
        place = float(along.max()) / LENGTH
        # Along x and down from the middle of the beam, over the length.
        moved = np.array([tip[0], THICKNESS / 2 - tip[1]]) / LENGTH
        exact = self.beam().bent()(place)[:2]
        return {
            "tip error": float(np.linalg.norm(moved - exact) / np.linalg.norm(exact - [place, 0.0])),
            "deflection against thin": float(moved[1] / self.beam(thin=True).bent()(place)[1] - 1),
        }


class SmallBend(Cantilever):
    """The tip sinks by 0.03 m, a quarter of the finest cells: particles hardly move relative to the cells."""

    text = case_text("cantilever_small")
    name, title = "cantilever_small", "Cantilever that hardly bends"
    varies = ("precision", "kernel", "transfer")
    load = 0.02
    levels: Levels = {"coarse": (2, 4), "default": (2, 4, 8), "fine": (2, 4, 6, 8)}  # noqa: RUF012
    measures = (Measure(f"tip error: {TIP}", lambda n: 1.3 * 0.175 / n**2, order=1.9, expected=2.0), THIN)


class LargeBend(Cantilever):
    """The tip sinks by three tenths of the length; that of a linear beam would sink by a third."""

    text = case_text("cantilever")
    name, title = "cantilever", "Cantilever that bends far: the elastica"
    load = 1.0
    finer = 4
    varies = ("precision", "kernel", "transfer")
    levels: Levels = {"coarse": (2, 4), "default": (2, 4, 8), "fine": (2, 4, 8, 12)}  # noqa: RUF012
    measures = (Measure(f"tip error: {TIP}", lambda n: 0.013 if n < 4 else 0.02 if n < 8 else 0.015), THIN)


class TotalBend(LargeBend):
    """The same as a total Lagrangian solid, with the default number of particles."""

    text = case_text("cantilever_total")
    name, title = "cantilever_total", "Cantilever that bends far, total Lagrangian"
    finer = 1
    solids = "total"
    varies = ("precision", "transfer")
    measures = (
        Measure(f"tip error: {TIP}", lambda n: 1.2 * (0.17 / n**2 + 0.0025), order=1.6, expected=2.0, order_to=4),
        THIN,
    )
