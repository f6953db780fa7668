"""Free blocks of one law each in homogeneous motion: hardening, cohesion, tearing, viscous flow, in 2D and 3D.

As in `homogeneous`, a block whose velocity is linear in the position has no internal forces until waves arrive from its
faces: F = I + t L. Principal directions and the ratios of the plastic strains are constant along the paths, so that the
stress is a closed form of the final F, for any number of steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, elastic, field, fluid, free_blocks, in_middle, lame_moduli, problem

DENSITY, YOUNG, NU = 1000.0, 1e6, 0.1
MU, LAMBDA = lame_moduli(YOUNG, NU)
SIZE = 0.5
# Width of the evaluated middle, relative to the size, and empty cells around a block.
MIDDLE, GAP = 0.15, 4
# Distance that a wave travels until the end, relative to the size.
WAVE_PATH = 0.2
END = WAVE_PATH * SIZE / math.sqrt((LAMBDA + 2 * MU) / DENSITY)
# Smallest bound of an error: effect of numerical precursors of the waves on the middle.
LEAST = 1e-6

YIELD, HARDENING = 0.02 * MU, MU
FRICTION, COHESION = 30.0, 0.002 * MU
COMPRESSION, STRETCH, SNOW_HARDENING = 0.025, 0.0075, 10.0
# The run takes 40 relaxation times of the paste, and half of its stress is viscous.
PASTE_YIELD = 0.0025 * MU
CONSISTENCY = MU * END / 40
BULK, BULK_VISCOSITY, VISCOSITY = MU, 0.1 * MU * END, 0.1 * MU * END
# Soft enough that waves hardly propagate.
SOFT = BULK / 20
# The stretch of the sand that opens is cos wt + s sin wt; it ends at CLOSED, compressed by 0.5 %.
SWING, CLOSED = 0.5 / END, 0.995
OPENING = (CLOSED - math.cos(SWING * END)) / math.sin(SWING * END)

METAL = elastic("von_mises", DENSITY, YOUNG, NU, yield_stress=YIELD, hardening_modulus=HARDENING)
# Friction that follows the pressure late would be judged with the cone.
DAMP = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION, cohesion=COHESION, friction_delay=0.0)
DRY = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION, friction_delay=0.0)
SNOW = elastic(
    "snow", DENSITY, YOUNG, NU, critical_compression=COMPRESSION, critical_stretch=STRETCH, hardening=SNOW_HARDENING
)
PASTE = fluid(DENSITY, BULK, yield_stress=PASTE_YIELD, consistency=CONSISTENCY, shear_modulus=MU, law="viscoplastic")
WATER, SOFT_WATER = fluid(DENSITY, BULK), fluid(DENSITY, SOFT)
OIL = WATER | {"bulk_viscosity": BULK_VISCOSITY, "viscosity": VISCOSITY}


@dataclass(frozen=True)
class Block:
    """A block, whose measure is the error of its Kirchhoff stress, d x d, Pa; unknown entries of `stress` are nan.

    At the end it is stretched by `last` along the last axis and by `everywhere` along all, and the first axis is
    sheared along the last. The error is relative to `scale`, or to the norm of the known stress. At n = 32 it has the
    quadrature error `noise`, which grows as n^2, and the time step error `lag`, which falls as 1/n. If `swings`, a body
    force linear in the position drives the block, and `motion` is its initial rate times END.
    """

    name: str
    material: Tables
    stress: Callable[[np.ndarray], np.ndarray]
    last: float = 0.0
    everywhere: float = 0.0
    shear: float = 0.0
    scale: float | None = None
    noise: float = 0.0
    lag: float = 0.0
    swings: bool = False

    def motion(self, d: int) -> np.ndarray:
        """Return F - I at the end."""
        L = self.everywhere * np.eye(d)
        L[-1, -1] += self.last
        L[0, -1] += self.shear
        return L

    def bound(self, n: int) -> float:
        """Return the largest admissible error."""
        return max(1.5 * (self.noise * (n / 32) ** 2 + self.lag * 32 / n), LEAST)


def hardened(F: np.ndarray) -> np.ndarray:
    """Return K ln J I plus a deviator s, sqrt(3/2) |s| = yield + H a, in uniaxial strain; a from consistency."""
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
    """Return the tension at the apex of the cone of damp sand, c cot(phi)."""
    return COHESION / math.tan(math.radians(FRICTION)) * np.eye(len(F))


def reopened(F: np.ndarray) -> np.ndarray:
    """Return K ln J I: the pressure rises once the volume is less than at the start, not once it decreases."""
    d = len(F)
    return (LAMBDA + 2 * MU / d) * math.log(np.linalg.det(F)) * np.eye(d)


def snow(F: np.ndarray) -> np.ndarray:
    """Return h (2 mu (s - 1) s + lambda (s - 1) s) along the axis, h = exp(xi (1 - J/s)), s within its bounds."""
    d, J = len(F), F[-1, -1]
    s = min(max(J, 1 - COMPRESSION), 1 + STRETCH)
    part = math.exp(SNOW_HARDENING * (1 - J / s)) * (s - 1) * s
    return part * (LAMBDA * np.eye(d) + np.diag([0.0] * (d - 1) + [2 * MU]))


def flowing(F: np.ndarray) -> np.ndarray:
    """Return the shear stress, yield stress plus consistency times the shear rate; other entries are nan."""
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
    """Return (K (J - 1) + (bulk viscosity - 2/3 viscosity) tr C) I + viscosity (C + C^T), with the final C."""
    d, J = len(F), np.linalg.det(F)
    C = (F - np.eye(d)) @ np.linalg.inv(F) / END
    spherical = BULK * (J - 1) + (BULK_VISCOSITY - 2 / 3 * VISCOSITY) * np.trace(C)
    return spherical * np.eye(d) + VISCOSITY * (C + C.T)


def compressed(F: np.ndarray) -> np.ndarray:
    """Return K (J - 1) I of the soft fluid."""
    return SOFT * (np.linalg.det(F) - 1) * np.eye(len(F))


BLOCKS = (
    Block("hardening", METAL, hardened, last=-0.03, noise=2.9e-4),
    Block("cohesion", DAMP, pressed, last=-0.01, noise=1.4e-5),
    Block("tension", DAMP, at_the_tip, everywhere=0.01),
    Block("reopened", DRY, reopened, everywhere=SWING * END * OPENING, swings=True),
    Block("packed snow", SNOW, snow, last=-0.05, noise=8.2e-4),
    Block("torn snow", SNOW, snow, last=0.02, noise=1.5e-5),
    Block("paste that flows", PASTE, flowing, shear=0.1, lag=1.3e-4),
    Block("paste at rest", PASTE, resting, last=-0.001, shear=0.6 * PASTE_YIELD / MU),
    Block("viscous fluid", OIL, squeezed, last=-0.005, lag=5.3e-5),
    Block("soft fluid", SOFT_WATER, compressed, last=-0.05, noise=4.5e-5),
    Block("opened fluid", WATER, np.zeros_like, everywhere=0.01, scale=BULK / 100),
)


class PlasticBlocks(Case):
    """v = L (x - c) in free blocks of one law, each on its own path."""

    text = case_text("plastic_blocks")
    group = "plastic"
    varies = ("precision",)

    def __init__(self, name: str, law: str, title: str, dimension: int = 2) -> None:
        self.name = f"{name}_blocks" + ("_3d" if dimension == 3 else "")
        self.title = title + (" in 3D" if dimension == 3 else "")
        self.dimension = dimension
        self.blocks = tuple(block for block in BLOCKS if block.material["law"] == law)
        coarse, usual, fine = (32, 64, 128) if dimension == 2 else (16, 24, 32)
        self.levels = {"coarse": (coarse,), "default": (coarse, usual), "fine": (coarse, usual, fine)}
        self.measures = tuple(self.text.measure(block.name, block.bound, rounding=2e-4) for block in self.blocks)

    def tables(self, n: int) -> Tables:
        """Return free blocks, n cells per edge, each with a material and a homogeneous motion of its own."""
        d = self.dimension
        domain, shapes = free_blocks(n, SIZE, len(self.blocks), [GAP] * d)
        bodies, forces = [], []
        for block, shape in zip(self.blocks, shapes, strict=True):
            rate = (block.motion(d) / END).tolist()
            # In its middle a lattice has no noise that would change the volume of particles.
            bodies.append(body(block.name, block.material, shape, velocity_gradient=rate, sampling="lattice"))
            if block.swings:
                places = zip("xyz", shape["box"]["min"], strict=False)
                pull = [f"{-(SWING**2)!r} * ({axis} - {x + SIZE / 2!r})" for axis, x in places]
                forces.append({"body": block.name, "acceleration": pull})
        return problem(domain, (END, 1), "stress initial_position", bodies, forces=forces)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the error of J times the stress in the middle of each block at the end, over its scale."""
        *_, (last, _) = frames
        d = self.dimension
        start = field(last, "initial_position")
        stress = field(last, "stress").reshape(-1, 3, 3)[:, :d, :d]
        values = {}
        for k, block in enumerate(self.blocks):
            middle = in_middle(last, scene, k, MIDDLE * SIZE)
            F = np.eye(d) + block.motion(d)
            if block.swings:
                # F from the positions: integration of the force in steps has an error of (swing dt)^2.
                x = last.position[middle, 0].astype(np.float64)
                F = np.polyfit(start[middle, 0], x, 1)[0] * np.eye(d)
            known = block.stress(F)
            off_by = (np.linalg.det(F) * stress[middle].mean(axis=0) - known)[np.isfinite(known)]
            scale = block.scale or np.linalg.norm(known[np.isfinite(known)])
            values[block.name] = float(np.linalg.norm(off_by) / scale)
        return values


CASES = (
    PlasticBlocks("metal", "von_mises", "Free blocks of a metal that hardens"),
    PlasticBlocks("metal", "von_mises", "Free blocks of a metal that hardens", 3),
    PlasticBlocks("sand", "sand", "Free blocks of sand"),
    PlasticBlocks("sand", "sand", "Free blocks of sand", 3),
    PlasticBlocks("snow", "snow", "Free blocks of snow"),
    PlasticBlocks("paste", "viscoplastic", "Free blocks of a Bingham fluid"),
    PlasticBlocks("fluid", "fluid", "Free blocks of a fluid"),
)
