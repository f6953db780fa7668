"""Problems that lock unless volume changes are averaged over cells: Cook's membrane and Prandtl's punch."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, Tables, case_text
from mpmcli.validation.shared import after_ramp, body, box, elastic, field, lame_moduli, problem, smooth_ramp

# Cook's membrane: corners, m, Young's modulus, Pa, and Poisson's ratio.
CORNERS = (0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0)
YOUNG, RATIO, DENSITY = 250.0, 0.499, 1e-3
SHEAR, LAME = lame_moduli(YOUNG, RATIO)
# Width of the loaded strip, m, and the force on it per area, N/m^2.
STRIP, PULL = 2.0, 0.2
# Approximate first period, s. In units of it: the ramp and the averaging window.
PERIOD = 7 * CORNERS[1][0] / math.sqrt(SHEAR / DENSITY)
RAMP, WINDOW, FRAMES_PER_PERIOD = 3, 2, 24
# Prandtl's punch: half of its width and the extent of the clay, m; undrained strength, stiffness, Pa, and density.
HALF, WIDE, DEEP = 1.0, 5.0, 3.0
STRENGTH, STIFFNESS, CLAY = 1e4, 1e7, 2000.0
# Travel of the punch, m, its duration, s, and the last fraction of it over which the load is averaged.
PUSH, TIME, LOOKED_AT = 0.04, 2.0, 0.5
# Displacement along y of the middle of the right side of Cook's membrane, m, by biquadratic elements in plane strain
# that do not lock, as in tests/test_validation_statics.py.
DEFLECTION = 0.4693228940693549


class Membrane(Case):
    """A clamped trapezium of nearly incompressible material, pulled upwards along its right side."""

    text = case_text("cook")
    name, title, group = "cook", "Cook's membrane, nearly incompressible", "solids"
    varies = ("precision",)
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    measures = (text.measure("deflection", lambda n: 1.3 * 0.24 / n, order=0.8),)

    def tables(self, n: int) -> Tables:
        start = CORNERS[1][0] - STRIP
        pull = f"{PULL / DENSITY!r} * {smooth_ramp(RAMP * PERIOD)} if X > {start!r} else 0"
        shape = {"polygon": {"vertices": [list(corner) for corner in CORNERS]}}
        return problem(
            {"size": [56.0, 64.0], "spacing": 16 / n, "walls": {"default": "slip", "x_min": "stick"}},
            ((RAMP + WINDOW) * PERIOD, (RAMP + WINDOW) * FRAMES_PER_PERIOD),
            "initial_position",
            [body("membrane", elastic("neo_hookean", DENSITY, YOUNG, RATIO), shape)],
            forces=[{"name": "load", "acceleration": [0.0, pull]}],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        h = scene.domain.spacing
        middle = (CORNERS[1][1] + CORNERS[2][1]) / 2
        moved = 0.0
        for weight, frame in after_ramp(frames, RAMP * FRAMES_PER_PERIOD, WINDOW * FRAMES_PER_PERIOD):
            start = field(frame, "initial_position")
            near = (start[:, 0] > CORNERS[1][0] - h / 2) & (np.abs(start[:, 1] - middle) < 1.01 * h)
            moved += weight * float((frame.position[near, 1] - start[near, 1]).mean())
        return {"deflection": moved / DEFLECTION - 1}


class Punch(Case):
    """A strip of the surface of weightless clay, pushed in by springs; half of it, beside a plane of symmetry."""

    text = case_text("prandtl")
    name, title, group = "prandtl", "Prandtl's punch: the bearing capacity of clay", "plastic"
    varies = ("precision",)
    f_bar = True
    levels = {"coarse": (4, 8), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    measures = (
        Measure(
            f"load: Load on the punch over its width and (2 + pi) c, minus 1: mean over the last {LOOKED_AT:.0%} of "
            "its travel.",
            lambda n: 1.4 / n,
            order=0.6,
        ),
    )

    def tables(self, n: int) -> Tables:
        h = HALF / n
        push = f"{self.spring(h)!r} * (Y - y - {PUSH / TIME!r} * t) if X < {HALF!r} and Y > {DEEP - h!r} else 0"
        material = elastic("von_mises", CLAY, STIFFNESS, 0.49, yield_stress=math.sqrt(3) * STRENGTH)
        return problem(
            {"size": [WIDE, DEEP + 1.0], "spacing": h, "walls": {"default": "slip", "y_min": "stick"}},
            (TIME, 80),
            "initial_position mass",
            [body("clay", material, box([0.0, 0.0], [WIDE, DEEP]))],
            forces=[{"name": "punch", "acceleration": [0.0, push]}],
        )

    @staticmethod
    def spring(h: float) -> float:
        """Return the spring constant over mass, 1/s^2, of the top layer of cells: c stretches it by PUSH / 400."""
        return 400 * STRENGTH / (CLAY * PUSH * h)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        h, loads = scene.domain.spacing, []
        for frame, _ in frames:
            if frame.time <= (1 - LOOKED_AT) * TIME:
                continue
            start = field(frame, "initial_position")
            pushed = (start[:, 0] < HALF) & (start[:, 1] > DEEP - h)
            stretched = start[pushed, 1] - frame.position[pushed, 1] - PUSH / TIME * frame.time
            loads.append(-self.spring(h) * frame.fields["mass"][pushed] @ stretched)
        return {"load": float(np.mean(loads)) / (HALF * (2 + math.pi) * STRENGTH) - 1}
