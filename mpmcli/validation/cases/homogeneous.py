"""Free blocks of four materials in homogeneous motion: every law's stress at large strain and rotation, in closed form.

A body whose velocity is linear in the place has homogeneous stress and feels no force, until waves come in from its
faces: x = F X with F = I + t L. APIC carries linear fields exactly. What is left is quadrature: as the lattice of the
particles shears against the grid, homogeneous stress makes small forces.
"""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

DENSITY, YOUNG, NU = 1000.0, 1e6, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
SIZE = 0.5
# t L at the end: a shear and a compression. F <- (I + dt C) F is exact, and so is J <- J det(I + dt C).
FINAL = np.array([[-0.06, 0.3], [0.0, 0.0]])
# A wave runs so far until then, and the middle is so wide, in parts of the size.
REACH, MIDDLE = 0.2, 0.1
END = REACH * SIZE / math.sqrt((LAMBDA + 2 * MU) / DENSITY)
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
    "fluid": {
        "law": "fluid",
        "density": DENSITY,
        "bulk_modulus": BULK,
        "exponent": EXPONENT,
        "viscosity": VISCOSITY,
    },
    "plastic": elastic("von_mises", *ELASTIC, yield_stress=YIELD, hardening_modulus=0.0),
}


def rotation(F: np.ndarray) -> np.ndarray:
    """Return the rotation of the polar decomposition."""
    U, _, V = np.linalg.svd(F)
    return U @ V


def known_stress(name: str, F: np.ndarray) -> np.ndarray:
    """Return the Cauchy stress in the plane, 2 x 2, Pa, of a material at F = I + FINAL."""
    J, unit = np.linalg.det(F), np.eye(2)
    match name:
        case "neo-Hookean":
            tau = MU * (F @ F.T - unit) + LAMBDA * math.log(J) * unit
        case "corotated":
            tau = 2 * MU * (F - rotation(F)) @ F.T + LAMBDA * (J - 1) * J * unit
        case _:
            C = FINAL @ np.linalg.inv(F) / END
            pressure = BULK / EXPONENT * (J**-EXPONENT - 1)
            # Per volume at rest, as all stress here: the viscosity is that of the fluid at rest.
            viscous = VISCOSITY * (C + C.T - 2 / 3 * np.trace(C) * unit)
            tau = viscous - J * pressure * unit
    return tau / J


class Homogeneous(Case):
    """v = L (X - c) in four free blocks."""

    name = "homogeneous"
    varies = ("precision", "kernel", "transfer")
    title = "Free blocks in homogeneous motion"
    group = "invariants"
    source = "Closed forms: F = I + t L, and the laws at that F"
    resolution = "cells across a block"
    levels = {"coarse": (32,), "default": (32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        Measure(
            "deformation error", "", "Largest |F - (I + t L)| in the middle of the solids.", bound=lambda n: 1.2e-4
        ),
        Measure(
            "neo-Hookean",
            "",
            "Stress in the middle less the closed form, over it.",
            bound=lambda n: 1.2e-4 * (32 / n) ** 1.2,
        ),
        Measure("corotated", "", "The same of the fixed corotated solid.", bound=lambda n: 1e-4 * (32 / n) ** 0.8),
        Measure(
            "fluid", "", "The same of the fluid of exponent 7, with viscosity.", bound=lambda n: 0.002 * (32 / n) ** 1.3
        ),
        Measure(
            "plastic",
            "",
            "Von Mises stress of the metal over its yield stress, less 1.",
            bound=lambda n: max(5e-6 * (32 / n) ** 2, 6e-7),
        ),
        Measure(
            "plastic pressure",
            "",
            "Its pressure over (lambda + 2 mu / 3) ln J / J, less 1.",
            bound=lambda n: max(9e-5 * (32 / n) ** 2, 1.2e-5),
        ),
    )
    note = (
        "A check of the laws in the solver at large strain and rotation, with hardly any discretisation in it. The "
        "viscous stress is first order in the step, as C is that of the step before."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = SIZE / n
        across, up = n + 2 * BESIDE, len(MATERIALS) * (n + ABOVE) + ABOVE
        bodies = []
        for k, (name, material) in enumerate(MATERIALS.items()):
            low = [BESIDE * h, (ABOVE + k * (n + ABOVE)) * h]
            bodies.append(
                {
                    "name": name,
                    "material": material,
                    "shape": {"box": {"min": low, "max": [x + SIZE for x in low]}},
                    "velocity_gradient": (FINAL / END).tolist(),
                }
            )
        return {
            "domain": {"size": [across * h, up * h], "cells": [across, up], "walls": "separate"},
            "time": {"end": END, "frames": 1},
            "output": {"fields": ["velocity", "stress", "deformation_gradient", "initial_position"]},
            "bodies": bodies,
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for frame, _ in frames:
            last = frame
        F = np.eye(2) + FINAL
        place = last.fields["initial_position"].astype(np.float64)
        stress = last.fields["stress"].astype(np.float64).reshape(-1, 3, 3)
        deformation = last.fields["deformation_gradient"].astype(np.float64).reshape(-1, 2, 2)
        found, errors = {}, []
        for k, body in enumerate(scene.bodies):
            centre = np.mean(body.shape.form.bounds(), axis=0)
            middle = (last.body == k) & (np.abs(place - centre).max(axis=1) < MIDDLE * SIZE / 2)
            mean = stress[middle].mean(axis=0)
            if body.name == "plastic":
                pressure = -np.trace(mean) / 3
                deviator = mean + pressure * np.eye(3)
                J = float(np.linalg.det(F))
                found["plastic"] = float(math.sqrt(1.5) * np.linalg.norm(deviator) * J / YIELD - 1)
                known = -(LAMBDA + 2 * MU / 3) * math.log(J) / J
                found["plastic pressure"] = float(pressure / known - 1)
                continue
            known = known_stress(body.name, F)
            found[body.name] = float(np.linalg.norm(mean[:2, :2] - known) / np.linalg.norm(known))
            if body.name != "fluid":
                errors.append(float(np.abs(deformation[middle] - F).max()))
        return {"deformation error": max(errors), **found}


CASES = (Homogeneous(),)
