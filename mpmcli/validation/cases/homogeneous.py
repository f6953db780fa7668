"""Free blocks of four materials in homogeneous motion: closed forms of the stress at large strain and rotation.

A body whose velocity is linear in the position has homogeneous stress and no internal forces until waves arrive from
its faces: x = F X with F = I + t L. APIC transfers linear fields exactly. The remaining error is that of quadrature: as
the particle lattice shears relative to the grid, homogeneous stress causes small forces.
"""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, elastic, field, fluid, free_blocks, in_middle, lame_moduli, problem

DENSITY, YOUNG, NU = 1000.0, 1e6, 0.3
MU, LAMBDA = lame_moduli(YOUNG, NU)
SIZE = 0.5
# t L at the end: a shear and a compression. F <- (I + dt C) F is exact, and so is J <- J det(I + dt C).
FINAL = np.array([[-0.06, 0.3], [0.0, 0.0]])
# Distance that a wave travels until the end, and width of the middle, relative to the size.
WAVE_PATH, MIDDLE = 0.2, 0.1
END = WAVE_PATH * SIZE / math.sqrt((LAMBDA + 2 * MU) / DENSITY)
YIELD, EXPONENT = 0.05 * MU, 7.0
BULK = LAMBDA + MU
# Viscous stress is a third of the pressure.
VISCOSITY = 0.02 * BULK * END / FINAL[0, 1]
# Empty cells at the sides of a block and above it, for the motion of its faces.
BESIDE, ABOVE = 10, 8
ELASTIC = (DENSITY, YOUNG, NU)
MATERIALS = {
    "neo-Hookean": elastic("neo_hookean", *ELASTIC),
    "corotated": elastic("fixed_corotated", *ELASTIC),
    "fluid": fluid(DENSITY, BULK, exponent=EXPONENT, viscosity=VISCOSITY),
    "plastic": elastic("von_mises", *ELASTIC, yield_stress=YIELD, hardening_modulus=0.0),
}


def known_stress(name: str, F: np.ndarray) -> np.ndarray:
    """Return the Cauchy stress in the plane, 2 x 2, Pa, of a material at F = I + FINAL."""
    J, unit = np.linalg.det(F), np.eye(2)
    match name:
        case "neo-Hookean":
            tau = MU * (F @ F.T - unit) + LAMBDA * math.log(J) * unit
        case "corotated":
            U, _, V = np.linalg.svd(F)
            tau = 2 * MU * (F - U @ V) @ F.T + LAMBDA * (J - 1) * J * unit
        case _:
            C = FINAL @ np.linalg.inv(F) / END
            pressure = BULK / EXPONENT * (J**-EXPONENT - 1)
            # Kirchhoff stress, per volume at rest, as all stress here; the viscosity is that of the fluid at rest.
            viscous = VISCOSITY * (C + C.T - 2 / 3 * np.trace(C) * unit)
            tau = viscous - J * pressure * unit
    return tau / J


class Homogeneous(Case):
    """v = L (X - c) in four free blocks."""

    text = case_text("homogeneous")
    name, title, group = "homogeneous", "Free blocks in homogeneous motion", "invariants"
    varies = ("precision", "kernel", "transfer")
    levels = {"coarse": (32,), "default": (32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("deformation error", 1.2e-4),
        text.measure("neo-Hookean", lambda n: 1.2e-4 * (32 / n) ** 1.2),
        text.measure("corotated", lambda n: 1e-4 * (32 / n) ** 0.8),
        text.measure("fluid", lambda n: 0.002 * (32 / n) ** 1.3),
        text.measure("plastic", lambda n: max(5e-6 * (32 / n) ** 2, 6e-7)),
        text.measure("plastic pressure", lambda n: max(9e-5 * (32 / n) ** 2, 1.2e-5)),
    )

    def tables(self, n: int) -> Tables:
        domain, shapes = free_blocks(n, SIZE, len(MATERIALS), (BESIDE, ABOVE))
        bodies = [
            body(name, material, shape, velocity_gradient=(FINAL / END).tolist())
            for (name, material), shape in zip(MATERIALS.items(), shapes, strict=True)
        ]
        return problem(domain, (END, 1), "velocity stress deformation_gradient initial_position", bodies)

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of the stress of each law, and the largest of F, in the middle of the blocks at the end."""
        *_, (last, _) = frames
        F = np.eye(2) + FINAL
        J = float(np.linalg.det(F))
        stress = field(last, "stress").reshape(-1, 3, 3)
        deformation = field(last, "deformation_gradient").reshape(-1, 2, 2)
        values, errors = {}, []
        for k, solid in enumerate(scene.bodies):
            middle = in_middle(last, scene, k, MIDDLE * SIZE)
            mean = stress[middle].mean(axis=0)
            if solid.name == "plastic":
                pressure = -np.trace(mean) / 3
                deviator = mean + pressure * np.eye(3)
                values["plastic"] = float(math.sqrt(1.5) * np.linalg.norm(deviator) * J / YIELD - 1)
                known = -(LAMBDA + 2 * MU / 3) * math.log(J) / J
                values["plastic pressure"] = float(pressure / known - 1)
                continue
            known = known_stress(solid.name, F)
            values[solid.name] = float(np.linalg.norm(mean[:2, :2] - known) / np.linalg.norm(known))
            if solid.name != "fluid":
                errors.append(float(np.abs(deformation[middle] - F).max()))
        return {"deformation error": max(errors), **values}
