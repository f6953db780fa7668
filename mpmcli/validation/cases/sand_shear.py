"""Sand that is sheared at constant volume: the friction angle that acts, in plane strain."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

DENSITY, YOUNG, NU, FRICTION = 1600.0, 1e7, 0.3, 30.0
MU, LAMBDA = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))
WAVE_SPEED = math.sqrt((LAMBDA + 2 * MU) / DENSITY)
SIZE = 0.2
# ln J at the start: it presses by a thousandth of its bulk modulus.
SQUEEZE = -1e-3
# Shear strain at the end, where half of a thousandth suffices: it slides from K |SQUEEZE| sin(phi) / (2 mu) on.
SHEAR = 3e-3
# A wave from the faces runs so far until then, and the middle is so wide, in parts of the size.
REACH, MIDDLE = 0.2, 0.2


class SandShear(Case):
    """A squeezed block, free all around, that is pressed along x and drawn along y: v = rate (-x, y), off its centre.

    Its middle is sheared homogeneously until a wave arrives from the faces.
    """

    name = "sand_shear"
    varies = ("precision",)
    title = "Sand sheared at constant volume"
    group = "plastic"
    source = "Mohr-Coulomb in plane strain, (s1 - s2) / (s1 + s2) = sin(phi); for Klar's alpha see Klar et al. 2016"
    resolution = "cells across the block"
    levels = {"coarse": (32,), "default": (32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        Measure(
            "strength error",
            "",
            "(s1 - s2) / (s1 + s2) of the stresses along y and x in the middle, over sin(phi), less 1.",
            bound=lambda n: 1e-13,
        ),
        Measure(
            "pressure error",
            "",
            "Pressure in the middle over that of its volume, K ln J with J = (1 - rate^2 t^2) J0, less 1.",
            bound=lambda n: 1.5e-6 * n / 32,
            single=lambda n: 2.5e-4,
        ),
        Measure("friction angle", "degrees", "The one that acts."),
    )
    note = (
        "A law of plasticity in the solver, and no discretisation: homogeneous motion is exact. Klar's alpha, which is "
        "that of triaxial compression, would act as 27.5 degrees here, 7.7 % too weak (docs/theory.md, 5.7)."
    )

    def tables(self, n: int) -> dict[str, Any]:
        h = SIZE / n
        end = REACH * SIZE / WAVE_SPEED
        rate, stretch = SHEAR / end, math.exp(SQUEEZE / 2)
        # Four cells of room all around.
        return {
            "domain": {"size": [(n + 8) * h] * 2, "cells": [n + 8] * 2, "gravity": [0.0, 0.0], "walls": "separate"},
            "time": {"end": end, "frames": 1},
            "output": {"fields": ["velocity", "stress", "initial_position"]},
            "bodies": [
                {
                    "name": "sand",
                    "material": elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION),
                    "shape": {"box": {"min": [4 * h] * 2, "max": [SIZE + 4 * h] * 2}},
                    "velocity_gradient": [[-rate, 0.0], [0.0, rate]],
                    "deformation": [[stretch, 0.0], [0.0, stretch]],
                }
            ],
        }

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for frame, _ in frames:
            last = frame
        centre = np.mean(scene.bodies[0].shape.form.bounds(), axis=0)
        off = np.abs(last.fields["initial_position"] - centre).max(axis=1)
        stress = last.fields["stress"].astype(np.float64)[off < MIDDLE * SIZE / 2].mean(axis=0).reshape(3, 3)
        ratio = (stress[0, 0] - stress[1, 1]) / (stress[0, 0] + stress[1, 1])
        volume = math.log1p(-(SHEAR**2)) + SQUEEZE
        # Cauchy's stress is that of Hencky's strain over J.
        known = -(LAMBDA + MU) * volume / math.exp(volume)
        return {
            "strength error": float(ratio / math.sin(math.radians(FRICTION)) - 1),
            "pressure error": float(-(stress[0, 0] + stress[1, 1]) / 2 / known - 1),
            "friction angle": math.degrees(math.asin(min(1.0, max(-1.0, float(ratio))))),
        }


CASES = (SandShear(),)
