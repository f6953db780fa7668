"""Problems that lock where changes of volume are not averaged over cells: Cook's membrane, and Prandtl's punch."""

import math
from functools import lru_cache

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, case_text
from mpmcli.validation.measuring import after_ramp, field
from mpmcli.validation.tables import Tables, body, box, elastic, lame_moduli, problem, smooth_ramp

# Cook's membrane: corners, m, Young's modulus, Pa, and Poisson's ratio.
CORNERS = (0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0)
YOUNG, RATIO, DENSITY = 250.0, 0.499, 1e-3
SHEAR, LAME = lame_moduli(YOUNG, RATIO)
# Width of the strip that is pulled, m, and the force on it over its area, N/m^2.
STRIP, PULL = 2.0, 0.2
# About the first period, s. In such periods: the ramp, and the window of the mean.
PERIOD = 7 * CORNERS[1][0] / math.sqrt(SHEAR / DENSITY)
RAMP, WINDOW, FRAMES_PER_PERIOD = 3, 2, 24
# Prandtl's punch: half of its width and the extent of the clay, m; undrained strength, stiffness, Pa, and density.
HALF, WIDE, DEEP = 1.0, 5.0, 3.0
STRENGTH, STIFFNESS, CLAY = 1e4, 1e7, 2000.0
# How far and how fast the punch goes, m and s, and the part of its way over which the load is averaged.
PUSH, TIME, LOOKED_AT = 0.04, 2.0, 0.5
# Elements along the membrane, the part that is pulled not included, and across.
ELEMENTS = 18, 10
# Points and weights of Gauss on [-1, 1].
THREE = ((-(0.6**0.5), 5 / 9), (0.0, 8 / 9), (0.6**0.5, 5 / 9))
TWO = ((-(3**-0.5), 1.0), (3**-0.5, 1.0))


def _shapes(s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic shape functions of a line, and their slopes, at s in [-1, 1]."""
    return np.array([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2]), np.array([s - 0.5, -2 * s, s + 0.5])


@lru_cache
def deflection() -> float:
    """Return the displacement along y of the middle of the right side of Cook's membrane, m.

    Biquadratic elements in plane strain, with the volume integrated by 2 x 2 points where the shape takes 3 x 3, so
    that they do not lock (Hughes 2000, chapter 4). Elements get narrower towards the clamped side and the faces, in
    whose corners the stress is singular, and end where the pull begins.
    """
    (x0, low0), (x1, low1), (_, high1), (_, high0) = CORNERS
    start = x1 - STRIP
    along, across = ELEMENTS
    # Nodes along x, those at the middle of elements included, and across, in parts of the width.
    inner = np.linspace(0, 1, along + 1) ** 1.5
    ends = x0 + (start - x0) * inner
    ends = np.concatenate([ends, np.linspace(start, x1, 3)[1:]])
    x = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    ends = (1 - np.cos(np.pi * np.linspace(0, 1, across + 1))) / 2
    t = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    share = ((x - x0) / (x1 - x0))[:, None]
    low, high = low0 + share * (low1 - low0), high0 + share * (high1 - high0)
    nodes = np.stack(np.broadcast_arrays(x[:, None], low + (high - low) * t), axis=-1)
    numbers = np.arange(len(x) * len(t)).reshape(len(x), len(t))
    K, f = np.zeros((2 * numbers.size,) * 2), np.zeros(2 * numbers.size)
    shape = np.diag([2 * SHEAR, 2 * SHEAR, SHEAR])
    for i in range(0, len(x) - 1, 2):
        for j in range(0, len(t) - 1, 2):
            mine, points = numbers[i : i + 3, j : j + 3].ravel(), nodes[i : i + 3, j : j + 3].reshape(-1, 2)
            k = np.zeros((18, 18))
            for rule in (THREE, TWO):
                for s, ws in rule:
                    for r, wr in rule:
                        (a, da), (b, db) = _shapes(s), _shapes(r)
                        slopes = np.stack([np.outer(da, b).ravel(), np.outer(a, db).ravel()])
                        jacobian = slopes @ points
                        weight = ws * wr * np.linalg.det(jacobian)
                        slopes = np.linalg.solve(jacobian, slopes)
                        if rule is TWO:
                            volume = slopes.T.ravel()
                            k += LAME * weight * np.outer(volume, volume)
                            continue
                        B = np.zeros((3, 18))
                        B[0, 0::2], B[1, 1::2], B[2, 0::2], B[2, 1::2] = slopes[0], slopes[1], slopes[1], slopes[0]
                        k += weight * B.T @ shape @ B
                        if x[i] >= start - 1e-9 * x1:
                            f[2 * mine + 1] += PULL * weight * np.outer(a, b).ravel()
            unknowns = np.stack([2 * mine, 2 * mine + 1], axis=1).ravel()
            K[np.ix_(unknowns, unknowns)] += k
    free = np.arange(2 * len(t), 2 * numbers.size)
    u = np.linalg.solve(K[np.ix_(free, free)], f[free])
    # At the middle of the width of the right side, where there is a node.
    return float(u[2 * numbers[-1, len(t) // 2] + 1 - 2 * len(t)])


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
        return {"deflection": moved / deflection() - 1}


class Punch(Case):
    """A strip of the surface of weightless clay is pushed in by springs; half of it, beside a plane of symmetry."""

    text = case_text("prandtl")
    name, title, group = "prandtl", "Prandtl's punch: the bearing capacity of clay", "plastic"
    varies = ("precision",)
    f_bar = True
    levels = {"coarse": (4, 8), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    measures = (
        Measure(
            f"load: Load on the punch over its width and (2 + pi) c, less 1: mean over the last {LOOKED_AT:.0%} of its "
            "way.",
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
        """Return the acceleration per displacement, 1/s^2, of the top layer of cells: c stretches it by PUSH / 400."""
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


CASES = (Membrane(), Punch())
