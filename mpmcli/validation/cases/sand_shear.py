"""Sand that is sheared at constant volume: the friction angle that acts, in plane strain."""

import math

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.measuring import field, in_middle
from mpmcli.validation.tables import Tables, body, elastic, free_blocks, lame_moduli, problem

DENSITY, YOUNG, NU, FRICTION = 1600.0, 1e7, 0.3, 30.0
MU, LAMBDA = lame_moduli(YOUNG, NU)
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
        end = REACH * SIZE / WAVE_SPEED
        rate, stretch = SHEAR / end, math.exp(SQUEEZE / 2)
        domain, (shape,) = free_blocks(n, SIZE, 1, (4, 4))
        material = elastic("sand", DENSITY, YOUNG, NU, friction_angle=FRICTION)
        start = {"velocity_gradient": [[-rate, 0.0], [0.0, rate]], "deformation": [[stretch, 0.0], [0.0, stretch]]}
        return problem(domain, (end, 1), "velocity stress initial_position", [body("sand", material, shape, **start)])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        *_, (last, _) = frames
        stress = field(last, "stress")[in_middle(last, scene, 0, MIDDLE * SIZE)].mean(axis=0).reshape(3, 3)
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
