"""Columns of dry sand that collapse to a heap, in the band of experiments and continuum models."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.tables import Tables, body, box, elastic, problem

GRAVITY, DENSITY, REPOSE, NU = 9.81, 1600.0, 30.0, 0.3
L0 = 0.2
# Bulk modulus of the plane over density g H0: compressed by two thousandths at the base.
STIFFNESS = 500.0
# End of the run, in sqrt(H0 / g): nothing moves any more.
UNITS = 5.0


class SandColumn(Case):
    """A column `aspect` times as high as wide, against a smooth wall and on a rough floor, that is let go."""

    text = case_text("sand_column")
    group = "plastic"

    def __init__(
        self,
        aspect: int,
        resolutions: tuple[int, int, int],
        runout: tuple[float, float],
        height: tuple[float, float],
        refined: tuple[float, float, float],
        settled: tuple[float, float],
    ) -> None:
        """`runout` and `height` are bands of (L - L0) / L0 and of H / L0; `resolutions`, those of the three levels.

        `refined` has R, A and a bound: the run-out is R - A / n as the grid is refined. `settled`: height and bound.
        """
        self.aspect, self.runout, self.height = aspect, runout, height
        self.refined, self.settled = refined, settled
        self.name = f"sand_column_{aspect}"
        self.note = case_text(self.name).note
        # What the knobs do shows in one of them.
        self.varies = ("precision", "kernel", "transfer") if aspect == 2 else ("precision",)
        self.title = f"Column of sand, height over width {aspect}"
        coarse, usual, fine = resolutions
        self.levels = {"coarse": (coarse,), "default": (coarse, usual), "fine": (coarse, usual, fine)}
        middles = {"runout": sum(runout) / 2, "height": sum(height) / 2}
        text = self.text.filled(**middles, limit=refined[0], slope=refined[1], settled=settled[0])
        self.measures = (
            # The grid cuts the toe short by as much as the refinement says.
            text.measure("run-out from mid-band (L0)", lambda n: (runout[1] - runout[0]) / 2 + refined[1] / n),
            text.measure("height from mid-band (L0)", (height[1] - height[0]) / 2),
            # Rounding decides where grains roll to: run-outs differ by up to 0.1 from precision to precision.
            text.measure("run-out against refinement (L0)", refined[2], rounding=0.1),
            text.measure("height against refinement (L0)", settled[1], rounding=0.01),
            text.measure("run-out (L0)"),
            text.measure("height (L0)"),
            text.measure("speed at the end", 0.02, rounding=4e-3),
        )

    def tables(self, n: int) -> Tables:
        h = L0 / n
        across, up = (2 + math.ceil(self.runout[1])) * n, self.aspect * n + 4
        height = self.aspect * L0
        # E for K = lambda + mu, the bulk modulus of the plane.
        young = STIFFNESS * DENSITY * GRAVITY * height * 2 * (1 + NU) * (1 - 2 * NU)
        material = elastic("sand", DENSITY, young, NU, repose_angle=REPOSE)
        return problem(
            {
                "size": [across * h, up * h],
                "cells": [across, up],
                "gravity": [0.0, -GRAVITY],
                "walls": {"default": "separate", "x_min": "slip", "y_min": "stick"},
            },
            (UNITS * math.sqrt(height / GRAVITY), 2),
            "velocity",
            [body("sand", material, box([0.0, 0.0], [L0, height]))],
        )

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        for frame, row in frames:
            position, kinetic, mass = frame.position, row.kinetic, row.mass
        reach, top = np.quantile(position.astype(np.float64), 0.99, axis=0) / L0
        runout, height = float(reach - 1), float(top)
        return {
            "run-out from mid-band": runout - sum(self.runout) / 2,
            "height from mid-band": height - sum(self.height) / 2,
            "run-out against refinement": runout - (self.refined[0] - self.refined[1] / n),
            "height against refinement": height - self.settled[0],
            "run-out": runout,
            "height": height,
            "speed at the end": math.sqrt(2 * kinetic / mass / (GRAVITY * self.aspect * L0)),
        }


CASES = (
    SandColumn(
        1,
        (24, 48, 64),
        # 1.2 a (Lube) to 2.2 a (mu(I)); 0.65 a^0.35 (mu(I)) to a (Lube).
        (1.2, 2.2),
        (0.65, 1.0),
        (1.35, 8.1, 0.05),
        (0.853, 0.02),
    ),
    SandColumn(
        2,
        (16, 32, 64),
        # 1.2 a (Lube) and half as much again, and room around a^0.4 = 1.32: the band that judges MUD, an SPH code.
        (2.4, 3.6),
        (0.8, 1.7),
        (2.74, 7.2, 0.18),
        (1.12, 0.03),
    ),
    SandColumn(
        5,
        (12, 16, 32),
        # 1.6 a^(2/3) (Lube) to 2.2 a (mu(I)); 0.65 a^0.35 (mu(I)) to a^0.4 (Lube).
        (4.68, 11.0),
        (1.14, 1.9),
        (5.99, 7.2, 0.22),
        (1.62, 0.03),
    ),
)
