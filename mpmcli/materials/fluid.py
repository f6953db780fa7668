"""Weakly compressible inviscid fluid: pressure from the volume ratio alone."""

from typing import Annotated, Literal, Self

import numpy as np
import taichi as ti
from pydantic import Field

from mpmcli.materials.law import Law, StateBound
from mpmcli.scene.material import MaterialParameters, SceneBounds
from mpmcli.scene.quantity import LARGEST, Positive

# The speed that "auto" assumes where nothing in the scene moves or falls, m/s.
QUIET_SPEED = 1.0


class FluidParameters(MaterialParameters):
    """Parameters of the weakly compressible fluid."""

    law: Literal["fluid"] = "fluid"
    bulk_modulus: Annotated[
        Positive | Literal["auto"],
        Field(
            description='Bulk modulus K = density c^2, Pa; "auto" picks the softest that keeps the density '
            "variation under `compressibility` at the highest speed the scene can reach."
        ),
    ] = "auto"
    compressibility: Annotated[
        float,
        Field(gt=0, le=0.1, description='Density variation that bulk_modulus = "auto" allows, a fraction.'),
    ] = 0.01

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Replace "auto" by K = density v^2 / compressibility, with v the highest speed of the scene.

        Weakly compressible flow varies in density by v^2/c^2 (Monaghan 1994); a column that is let
        go uncompressed presses with up to 2 density g H = density v^2, the same bound. Where fluid hits
        fluid or a wall head on, the pressure is density c v for a moment (water hammer), and so v/c.
        """
        if self.bulk_modulus != "auto":
            return self, []
        speed = bounds.speed if bounds.speed > 0 else QUIET_SPEED
        modulus = min(max(self.density * speed**2 / self.compressibility, 1 / LARGEST), LARGEST)
        note = (
            f"bulk_modulus = {modulus:.4g} Pa (sound speed {np.sqrt(modulus / self.density):.4g} m/s) lets the density "
            f"of smooth flow vary by {100 * self.compressibility:.3g} % at the highest speed, {speed:.4g} m/s; "
            f"a hard impact at that speed reaches {100 * np.sqrt(self.compressibility):.3g} %"
        )
        return self.model_copy(update={"bulk_modulus": modulus}), [note]


@ti.data_oriented
class Fluid(Law):
    """p = K (1/J - 1), linear in the density: tau = -K (1 - J) I, energy K (J - 1 - ln J)."""

    name = "fluid"
    parameters = FluidParameters
    deformation = "J"

    def constants(self, parameters: FluidParameters) -> tuple[float, ...]:
        return (parameters.bulk_modulus,)

    def stiffness(self, parameters: FluidParameters, bound: StateBound, dimension: int) -> float:
        """d K J: tau changes by K J tr(C) dt, and tr(C) by d entries (verification: 10.1)."""
        return dimension * parameters.bulk_modulus * bound.volume_ratio_max

    def cauchy_stress(self, parameters: FluidParameters, deformation: np.ndarray) -> np.ndarray:
        pressure = parameters.bulk_modulus * (1.0 / deformation - 1.0)
        return -pressure[:, None, None] * np.eye(3, dtype=deformation.dtype)

    def energy_density(self, parameters: FluidParameters, deformation: np.ndarray) -> np.ndarray:
        # log1p keeps the difference of nearly equal numbers near J = 1.
        strain = deformation - 1.0
        return parameters.bulk_modulus * (strain - np.log1p(strain))

    @ti.func
    def kirchhoff_stress(self, deformation: ti.template(), C: ti.template(), constants: ti.template()):
        return constants[0] * (deformation - 1.0) * ti.Matrix.identity(float, C.n)


LAW = Fluid
