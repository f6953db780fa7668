"""Paths of homogeneous deformation on which the stress of a law with plastic or viscous flow is a closed form.

Principal directions and the ratios of the plastic strains stay the same, so that it holds for any number of steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmcli.validation.case import elastic

DENSITY, YOUNG, NU = 1000.0, 1e6, 0.1
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
SIZE = 0.5
# A wave runs so far until the end, in parts of the size.
REACH = 0.2
END = REACH * SIZE / math.sqrt((LAMBDA + 2 * MU) / DENSITY)
# Least bound on an error: what the tails of waves, which the grid carries ahead, bring to the middle.
LEAST = 1e-6

YIELD, HARDENING = 0.02 * MU, MU
FRICTION, COHESION = 30.0, 0.002 * MU
COMPRESSION, STRETCH, SNOW_HARDENING = 0.025, 0.0075, 10.0
# The paste forgets its stress 40 times until the end, and half of its stress is viscous.
PASTE_YIELD, PASTE_SHEAR = 0.0025 * MU, 0.1
CONSISTENCY = MU * END / 40
BULK, BULK_VISCOSITY, VISCOSITY = MU, 0.1 * MU * END, 0.1 * MU * END
# So soft that hardly a wave runs in it.
SOFT = BULK / 20
# The sand that opens swings as cos wt + s sin wt, and ends pressed by a two-hundredth.
SWING, CLOSED = 0.5 / END, 0.995
OPENING = (CLOSED - math.cos(SWING * END)) / math.sin(SWING * END)

METAL = elastic("von_mises", DENSITY, YOUNG, NU, yield_stress=YIELD, hardening_modulus=HARDENING)
DAMP = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION, cohesion=COHESION)
DRY = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION)
SNOW = elastic(
    "snow", DENSITY, YOUNG, NU, critical_compression=COMPRESSION, critical_stretch=STRETCH, hardening=SNOW_HARDENING
)
PASTE = {
    "law": "viscoplastic",
    "density": DENSITY,
    "yield_stress": PASTE_YIELD,
    "consistency": CONSISTENCY,
    "bulk_modulus": BULK,
    "shear_modulus": MU,
}
WATER = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK}
OIL = WATER | {"bulk_viscosity": BULK_VISCOSITY, "viscosity": VISCOSITY}


@dataclass(frozen=True)
class Block:
    """One block.

    Attributes:
        name: of the body and of the measure.
        text: definition of the measure.
        material: table of the scene.
        motion: (d) -> F - I at the end, d x d.
        stress: F -> Kirchhoff stress in the d dimensions, d x d, Pa; nan where it is not known.
        scale: stress over which the error is set, Pa; None for the norm of the known one.
        noise, lag: errors at n = 32 of quadrature, which grows as n^2, and of the step, which falls as 1/n.
        swings: whether a force that is linear in the place drives it, from `motion` as rate times END.
    """

    name: str
    text: str
    material: dict[str, Any]
    motion: Callable[[int], np.ndarray]
    stress: Callable[[np.ndarray], np.ndarray]
    scale: float | None = None
    noise: float = 0.0
    lag: float = 0.0
    swings: bool = False

    def bound(self, n: int) -> float:
        """Return the largest admissible error."""
        return max(1.5 * (self.noise * (n / 32) ** 2 + self.lag * 32 / n), LEAST)


def along_last(strain: float) -> Callable[[int], np.ndarray]:
    """Return a stretch along the last axis."""
    return lambda d: np.diag([0.0] * (d - 1) + [strain])


def in_all(strain: float) -> Callable[[int], np.ndarray]:
    """Return a stretch along all axes."""
    return lambda d: strain * np.eye(d)


def sheared(shear: float, strain: float = 0.0) -> Callable[[int], np.ndarray]:
    """Return a shear of the first axis along the last, and a stretch along the last."""

    def motion(d: int) -> np.ndarray:
        L = np.diag([0.0] * (d - 1) + [strain])
        L[0, -1] = shear
        return L

    return motion


def hardened(F: np.ndarray) -> np.ndarray:
    """Return K ln J I and a deviator of sqrt(3/2) |s| = yield + H a, in uniaxial strain: a by consistency."""
    strain = math.log(F[-1, -1])
    plastic = (2 * MU * abs(strain) - YIELD) / (3 * MU + HARDENING)
    q = math.copysign(YIELD + HARDENING * plastic, strain)
    d = len(F)
    return (LAMBDA + 2 / 3 * MU) * strain * np.eye(d) + q * np.diag([-1 / 3] * (d - 1) + [2 / 3])


def pressed(F: np.ndarray) -> np.ndarray:
    """Return the stress of damp sand on the cone, |s| = sqrt(2) (p sin(phi) + c cos(phi)), in uniaxial strain."""
    d, phi = len(F), math.radians(FRICTION)
    strain = math.log(F[-1, -1])
    p = -(LAMBDA + 2 * MU / d) * strain
    deviator = strain * (np.diag([0.0] * (d - 1) + [1.0]) - np.eye(d) / d)
    strength = math.sqrt(2) * (p * math.sin(phi) + COHESION * math.cos(phi))
    return deviator * strength / np.linalg.norm(deviator) - p * np.eye(d)


def at_the_tip(F: np.ndarray) -> np.ndarray:
    """Return the tension that damp sand bears, c cot(phi)."""
    return COHESION / math.tan(math.radians(FRICTION)) * np.eye(len(F))


def reopened(F: np.ndarray) -> np.ndarray:
    """Return K ln J I: pressure since the volume is less than at the start, not since it began to fall."""
    d = len(F)
    return (LAMBDA + 2 * MU / d) * math.log(np.linalg.det(F)) * np.eye(d)


def snow(F: np.ndarray) -> np.ndarray:
    """Return h (2 mu (s - 1) s + lambda (s - 1) s) along the axis, h = exp(xi (1 - J/s)), s within its bounds."""
    d, J = len(F), F[-1, -1]
    s = min(max(J, 1 - COMPRESSION), 1 + STRETCH)
    part = math.exp(SNOW_HARDENING * (1 - J / s)) * (s - 1) * s
    return part * (LAMBDA * np.eye(d) + np.diag([0.0] * (d - 1) + [2 * MU]))


def flowing(F: np.ndarray) -> np.ndarray:
    """Return a shear stress of the yield stress and consistency times the shear rate; normal stresses are left open."""
    d = len(F)
    tau = np.full((d, d), np.nan)
    tau[0, -1] = tau[-1, 0] = PASTE_YIELD + CONSISTENCY * F[0, -1] / END
    return tau


def resting(F: np.ndarray) -> np.ndarray:
    """Return K (J - 1) I + G dev(J^(-2/d) F F^T)."""
    d, J = len(F), np.linalg.det(F)
    b = F @ F.T * J ** (-2 / d)
    return BULK * (J - 1) * np.eye(d) + MU * (b - np.trace(b) / d * np.eye(d))


def squeezed(F: np.ndarray) -> np.ndarray:
    """Return (K (J - 1) + (bulk viscosity - 2/3 viscosity) tr C) I + viscosity (C + C^T); C as it is at the end."""
    d, J = len(F), np.linalg.det(F)
    C = (F - np.eye(d)) @ np.linalg.inv(F) / END
    spherical = BULK * (J - 1) + (BULK_VISCOSITY - 2 / 3 * VISCOSITY) * np.trace(C)
    return spherical * np.eye(d) + VISCOSITY * (C + C.T)


def compressed(F: np.ndarray) -> np.ndarray:
    """Return K (J - 1) I, of the soft fluid."""
    return SOFT * (np.linalg.det(F) - 1) * np.eye(len(F))


def none(F: np.ndarray) -> np.ndarray:
    """Return no stress."""
    return np.zeros_like(F)


OVER = "Stress in the middle less the closed form, over it"
BLOCKS = (
    Block(
        "hardening", f"{OVER}, of a metal that hardens, 3 % shorter.", METAL, along_last(-0.03), hardened, noise=2.9e-4
    ),
    Block(
        "cohesion", f"{OVER}, of damp sand on its cone, 1 % shorter.", DAMP, along_last(-0.01), pressed, noise=1.4e-5
    ),
    Block("tension", f"{OVER}, of damp sand that is pulled apart.", DAMP, in_all(0.01), at_the_tip),
    Block(
        "reopened",
        f"{OVER}, of dry sand that opens by 3 % a side and closes beyond its start.",
        DRY,
        in_all(SWING * END * OPENING),
        reopened,
        swings=True,
    ),
    Block("packed snow", f"{OVER}, of snow 5 % shorter.", SNOW, along_last(-0.05), snow, noise=8.2e-4),
    Block("torn snow", f"{OVER}, of snow 2 % longer.", SNOW, along_last(0.02), snow, noise=1.5e-5),
    Block(
        "paste that flows",
        f"{OVER}, of a Bingham fluid in steady shear.",
        PASTE,
        sheared(PASTE_SHEAR),
        flowing,
        lag=1.3e-4,
    ),
    Block(
        "paste at rest",
        f"{OVER}, of a Bingham fluid below its yield stress.",
        PASTE,
        sheared(0.6 * PASTE_YIELD / MU, -0.001),
        resting,
    ),
    Block("viscous fluid", f"{OVER}, of a fluid with both viscosities.", OIL, along_last(-0.005), squeezed, lag=5.3e-5),
    Block(
        "soft fluid",
        f"{OVER}, of a soft fluid 5 % shorter.",
        WATER | {"bulk_modulus": SOFT},
        along_last(-0.05),
        compressed,
        noise=4.5e-5,
    ),
    Block(
        "opened fluid",
        "Stress in the middle of a fluid that opens, over a hundredth of its bulk modulus.",
        WATER,
        in_all(0.01),
        none,
        BULK / 100,
    ),
)

METAL_BLOCKS, SAND_BLOCKS, SNOW_BLOCKS, PASTE_BLOCKS, FLUID_BLOCKS = (
    tuple(block for block in BLOCKS if block.material["law"] == law)
    for law in ("von_mises", "sand", "snow", "viscoplastic", "fluid")
)
