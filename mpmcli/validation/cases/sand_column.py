"""Columns of dry sand that collapse to a heap, in the band of experiments and continuum models."""

import math
from typing import Any

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, elastic

GRAVITY, DENSITY, FRICTION, NU = 9.81, 1600.0, 30.0, 0.3
L0 = 0.2
# Bulk modulus of the plane over density g H0: compressed by two thousandths at the base.
STIFFNESS = 500.0
# End of the run, in sqrt(H0 / g): nothing moves any more.
UNITS = 5.0


class SandColumn(Case):
    """A column `aspect` times as high as wide, against a smooth wall and on a rough floor, that is let go."""

    group = "plastic"
    source = (
        "Lube et al. 2005 (PRE 72:041301), Lajeunesse et al. 2005 (Phys. Fluids 17:103302), mu(I) of Lagree et al. "
        "2011 (JFM 686:378)"
    )
    resolution = "cells across the column"

    def __init__(
        self,
        aspect: int,
        resolutions: tuple[int, int, int],
        runout: tuple[float, float],
        height: tuple[float, float],
        refined: tuple[float, float, float],
        settled: tuple[float, float],
        note: str,
    ) -> None:
        """`runout` and `height` are bands of (L - L0) / L0 and of H / L0; `resolutions`, those of the three levels.

        `refined` has R, A and a bound: the run-out is R - A / n as the grid is refined. `settled`: height and bound.
        """
        self.aspect, self.runout, self.height, self.note = aspect, runout, height, note
        self.refined, self.settled = refined, settled
        self.name = f"sand_column_{aspect}"
        # What the knobs do shows in one of them.
        self.varies = ("precision", "kernel", "transfer", "walls") if aspect == 2 else ("precision",)
        self.title = f"Column of sand, height over width {aspect}"
        coarse, usual, fine = resolutions
        self.levels = {"coarse": (coarse,), "default": (coarse, usual), "fine": (coarse, usual, fine)}
        self.measures = (
            Measure(
                "run-out from mid-band",
                "L0",
                f"Run-out (L - L0) / L0 of 99 % of the sand, less {sum(runout) / 2:.4g}, the middle of the band.",
                bound=lambda n: (runout[1] - runout[0]) / 2,
            ),
            Measure(
                "height from mid-band",
                "L0",
                f"Height of 99 % of the sand over L0, less {sum(height) / 2:.4g}, the middle of the band.",
                bound=lambda n: (height[1] - height[0]) / 2,
            ),
            Measure(
                "run-out against refinement",
                "L0",
                f"Run-out less {refined[0]:g} - {refined[1]:g} / n: first order, as the toe is thinner than a cell.",
                bound=lambda n: refined[2],
                # Rounding decides where grains roll to: run-outs differ by up to 0.02 from precision to precision.
                single=lambda n: 0.08,
            ),
            Measure(
                "height against refinement",
                "L0",
                f"Height less {settled[0]:g}, where grids of other spacings have it.",
                bound=lambda n: settled[1],
                single=lambda n: 0.01,
            ),
            Measure("run-out", "L0", "(L - L0) / L0 of 99 % of the sand."),
            Measure("height", "L0", "H / L0 of 99 % of the sand."),
            Measure(
                "speed at the end",
                "",
                "Root of the mean square, over sqrt(g H0): it has come to rest.",
                bound=lambda n: 0.02,
                single=lambda n: 4e-3,
            ),
        )

    def tables(self, n: int) -> dict[str, Any]:
        h = L0 / n
        across, up = (2 + math.ceil(self.runout[1])) * n, self.aspect * n + 4
        height = self.aspect * L0
        # E for K = lambda + mu, the bulk modulus of the plane.
        young = STIFFNESS * DENSITY * GRAVITY * height * 2 * (1 + NU) * (1 - 2 * NU)
        return {
            "domain": {
                "size": [across * h, up * h],
                "cells": [across, up],
                "gravity": [0.0, -GRAVITY],
                "walls": {"default": "separate", "x_min": "slip", "y_min": "stick"},
            },
            "time": {"end": UNITS * math.sqrt(height / GRAVITY), "frames": 2},
            "output": {"fields": ["velocity"]},
            "bodies": [
                {
                    "name": "sand",
                    "material": elastic("sand", DENSITY, young, NU, friction_angle=FRICTION),
                    "shape": {"box": {"min": [0.0, 0.0], "max": [L0, height]}},
                }
            ],
        }

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
        (1.7, 9.6, 0.05),
        (0.79, 0.02),
        "The toe is thinner than the cells of a coarse grid, and is held back by the floor: run-out 0.85, 1.12, 1.27, "
        "1.40, 1.49 and 1.51 at 8, 16, 24, 32, 48 and 64 cells.",
    ),
    SandColumn(
        2,
        (16, 32, 64),
        # 1.2 a (Lube) and half as much again, and room around a^0.4 = 1.32: the band that judges MUD, an SPH code.
        (2.4, 3.6),
        (0.8, 1.7),
        (3.41, 8.0, 0.15),
        (1.02, 0.03),
        "Converges from below: run-out 2.18, 2.91, 3.20 and 3.25 at 8, 16, 32 and 64 cells. Experiments have 2.4 "
        "(Lube, Lajeunesse): sand of constant friction, which the speed of flow does not change, runs further, as is "
        "known of it. At a friction angle of 63 degrees the run-out is 1.2, which the band rejects.",
    ),
    SandColumn(
        5,
        (12, 16, 32),
        # 1.6 a^(2/3) (Lube) to 2.2 a (mu(I)); 0.65 a^0.35 (mu(I)) to a^0.4 (Lube).
        (4.68, 11.0),
        (1.14, 1.9),
        (7.4, 6.5, 0.22),
        (1.21, 0.03),
        "Run-out 6.0, 6.8, 7.1 and 7.1 at 8, 12, 16 and 32 cells, which is 6 % beyond the farthest coefficient of "
        "experiments, 2.3 a^(2/3) = 6.7, and converged: constant friction runs further from tall columns than sand "
        "does. The upper end of the band is therefore that of mu(I), 2.2 a, as for the column of height 1.",
    ),
)
