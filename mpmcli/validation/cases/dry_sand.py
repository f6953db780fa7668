"""Dry sand: collapse of columns, compared with experiments and models, and the effective friction angle."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import body, box, elastic, field, free_blocks, in_middle, lame_moduli, problem

GRAVITY, DENSITY, REPOSE, NU = 9.81, 1600.0, 30.0, 0.3
L0 = 0.2
# Bulk modulus in plane strain over density g H0: compression by two thousandths at the base.
STIFFNESS = 500.0
# End of the run, in sqrt(H0 / g), when the sand is at rest.
UNITS = 6.0


class SandColumn(Case):
    """A column `aspect` times as high as wide, released beside a smooth wall on a rough floor."""

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
        """`runout` and `height` are bands of (L - L0) / L0 and of H / L0; `resolutions` has the finest of each level.

        `refined` has R, A and a bound: the run-out converges as R - A / n. `settled` has the height and its bound.
        """
        self.aspect, self.runout, self.height = aspect, runout, height
        self.refined, self.settled = refined, settled
        self.name = f"sand_column_{aspect}"
        self.note = case_text(self.name).note
        # One of the columns covers the other settings. Sand keeps more of its motion than AFLIP.
        self.varies = ("precision", "kernel") if aspect == 2 else ("precision",)
        self.title = f"Column of sand, height over width {aspect}"
        coarse, usual, fine = resolutions
        self.levels = {"coarse": (coarse,), "default": (coarse, usual), "fine": (coarse, usual, fine)}
        middles = {"runout": sum(runout) / 2, "height": sum(height) / 2}
        text = self.text.filled(**middles, limit=refined[0], slope=refined[1], settled=settled[0])
        self.measures = (
            # The grid shortens the toe by A / n.
            text.measure("run-out from mid-band (L0)", lambda n: (runout[1] - runout[0]) / 2 + refined[1] / n),
            text.measure("height from mid-band (L0)", (height[1] - height[0]) / 2),
            # Paths of grains follow rounding: between precisions run-outs differ by up to 0.1, heights by 0.2 cells.
            text.measure("run-out against refinement (L0)", refined[2], rounding=0.1),
            text.measure("height against refinement (L0)", settled[1], rounding=lambda n: 0.2 / n),
            text.measure("run-out (L0)"),
            text.measure("height (L0)"),
            text.measure("speed at the end", 0.02, rounding=4e-3),
        )

    def tables(self, n: int) -> Tables:
        """Return half of a column, n cells wide, between a plane of symmetry and a rough floor."""
        h = L0 / n
        across, up = (2 + math.ceil(self.runout[1])) * n, self.aspect * n + 4
        height = self.aspect * L0
        # E for K = lambda + mu, the bulk modulus in plane strain.
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
        """Return run-out and height at the end, against bands of experiments and refined runs, and the speed left."""
        for frame, _ in frames:
            position, speed = frame.position, np.linalg.norm(frame.velocity.astype(np.float64), axis=1)
        reach, top = np.quantile(position.astype(np.float64), 0.99, axis=0) / L0
        runout, height = float(reach - 1), float(top)
        slow = speed[speed <= np.quantile(speed, 0.99)]
        return {
            "run-out from mid-band": runout - sum(self.runout) / 2,
            "height from mid-band": height - sum(self.height) / 2,
            "run-out against refinement": runout - (self.refined[0] - self.refined[1] / n),
            "height against refinement": height - self.settled[0],
            "run-out": runout,
            "height": height,
            "speed at the end": math.sqrt((slow**2).mean() / (GRAVITY * self.aspect * L0)),
        }


# The sheared block.
YOUNG, FRICTION = 1e7, 30.0
MU, LAMBDA = lame_moduli(YOUNG, NU)
WAVE_SPEED = math.sqrt((LAMBDA + 2 * MU) / DENSITY)
SIZE = 0.2
# Initial ln J: the pressure is a thousandth of the bulk modulus.
SQUEEZE = -1e-3
# Final shear strain; the sand yields from K |SQUEEZE| sin(phi) / (2 mu), about half of a thousandth, on.
SHEAR = 3e-3
# Distance that a wave travels from the faces until the end, and width of the middle, relative to the size.
WAVE_PATH, MIDDLE = 0.2, 0.2


class SandShear(Case):
    """A compressed free block that is pressed along x and stretched along y: v = rate (-x, y) from its centre.

    Its middle is sheared homogeneously until a wave arrives from the faces.
    """

    text = case_text("sand_shear")
    name, title, group = "sand_shear", "Sand sheared at constant volume", "plastic"
    varies = ("precision",)
    levels = {"coarse": (32,), "default": (32, 64), "fine": (32, 64, 128)}  # noqa: RUF012
    measures = (
        text.measure("strength error", 1e-13),
        text.measure("pressure error", lambda n: 1.5e-6 * n / 32, rounding=2.5e-4),
        text.measure("friction angle (degrees)"),
    )

    def tables(self, n: int) -> Tables:
        end = WAVE_PATH * SIZE / WAVE_SPEED
        rate, stretch = SHEAR / end, math.exp(SQUEEZE / 2)
        domain, (shape,) = free_blocks(n, SIZE, 1, (4, 4))
        material = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION, friction_delay=0.0)
        start = {"velocity_gradient": [[-rate, 0.0], [0.0, rate]], "deformation": [[stretch, 0.0], [0.0, stretch]]}
        return problem(domain, (end, 1), "velocity stress initial_position", [body("sand", material, shape, **start)])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return errors of strength and pressure in the middle at the end, and the friction angle found, degrees."""
        *_, (last, _) = frames
        stress = field(last, "stress")[in_middle(last, scene, 0, MIDDLE * SIZE)].mean(axis=0).reshape(3, 3)
        ratio = (stress[0, 0] - stress[1, 1]) / (stress[0, 0] + stress[1, 1])
        volume = math.log1p(-(SHEAR**2)) + SQUEEZE
        # The Cauchy stress is that of the Hencky strain over J.
        known = -(LAMBDA + MU) * volume / math.exp(volume)
        return {
            "strength error": float(ratio / math.sin(math.radians(FRICTION)) - 1),
            "pressure error": float(-(stress[0, 0] + stress[1, 1]) / 2 / known - 1),
            "friction angle": math.degrees(math.asin(min(1.0, max(-1.0, float(ratio))))),
        }


CASES = (
    SandColumn(
        1,
        (24, 48, 64),
        # 1.2 a (Lube) to 2.2 a (mu(I)); 0.65 a^0.35 (mu(I)) to a (Lube).
        (1.2, 2.2),
        (0.65, 1.0),
        (1.28, 3.2, 0.05),
        (0.853, 0.02),
    ),
    SandColumn(
        2,
        (16, 32, 64),
        # 1.2 a (Lube) to 1.5 times that, and a band around a^0.4 = 1.32: as in the validation of MUD, an SPH code.
        (2.4, 3.6),
        (0.8, 1.7),
        (2.7, 2.5, 0.1),
        (1.12, 0.03),
    ),
    SandColumn(
        5,
        (12, 16, 32),
        # 1.6 a^(2/3) (Lube) to 2.2 a (mu(I)); 0.65 a^0.35 (mu(I)) to a^0.4 (Lube).
        (4.68, 11.0),
        (1.14, 1.9),
        (5.8, 1.0, 0.15),
        (1.62, 0.03),
    ),
    SandShear(),
)
