"""Compressible neo-Hookean solid, for large elastic deformation."""

from typing import Annotated, Literal

import numpy as np
import taichi as ti
from pydantic import Field

from mpmcli.materials.law import Law, StateBound
from mpmcli.materials.tensors import determinant
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import Positive


class NeoHookeanParameters(MaterialParameters):
    """Parameters of the neo-Hookean solid."""

    law: Literal["neo_hookean"] = "neo_hookean"
    youngs_modulus: Annotated[Positive, Field(description="Young's modulus E, Pa.")]
    poissons_ratio: Annotated[
        float, Field(gt=-1, lt=0.5, description="Poisson's ratio, between -1 and 0.5, both excluded.")
    ] = 0.3

    @property
    def shear_modulus(self) -> float:
        """mu = E / (2 (1 + nu)), Pa."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def lame_lambda(self) -> float:
        """lambda = E nu / ((1 + nu)(1 - 2 nu)), Pa."""
        nu = self.poissons_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))


@ti.data_oriented
class NeoHookean(Law):
    """tau = mu (F F^T - I) + lambda ln(J) I (Bonet and Wood 2008, eq. 6.28); plane strain in 2D."""

    name = "neo_hookean"
    parameters = NeoHookeanParameters
    deformation = "F"

    def constants(self, parameters: NeoHookeanParameters) -> tuple[float, ...]:
        return (parameters.shear_modulus, parameters.lame_lambda)

    def stiffness(self, parameters: NeoHookeanParameters, bound: StateBound, dimension: int) -> float:
        """d lambda + 2 mu s^2, with s the largest stretch.

        Under C dt, tau changes by mu (C b + b C^T) dt + lambda tr(C) dt I. In the principal frame of
        b = F F^T the normal entries see the matrix 2 mu diag(s_i^2) + lambda (1 1^T), the pairs of
        shear entries mu (s_i^2 + s_j^2): none exceeds the sum above, which is exact at rest.
        A compressed state is no stiffer, as lambda ln(J) I changes by lambda tr(C) dt at any J.
        """
        return dimension * max(parameters.lame_lambda, 0.0) + (2 * parameters.shear_modulus * bound.stretch_squared_max)

    def cauchy_stress(self, parameters: NeoHookeanParameters, deformation: np.ndarray) -> np.ndarray:
        count, dimension, _ = deformation.shape
        volume_ratio = determinant(deformation)[:, None]
        pressure_part = parameters.lame_lambda * np.log(volume_ratio)
        # Out of plane F is 1, so that b - I vanishes there.
        stress = np.zeros((count, 3, 3), deformation.dtype)
        stress[:, :dimension, :dimension] = np.einsum("nik,njk->nij", deformation, deformation)
        diagonal = np.einsum("nii->ni", stress)
        diagonal[:, :dimension] -= 1.0
        stress *= parameters.shear_modulus
        diagonal += pressure_part
        return stress / volume_ratio[:, :, None]

    def energy_density(self, parameters: NeoHookeanParameters, deformation: np.ndarray) -> np.ndarray:
        """mu/2 (tr b - d) - mu ln J + lambda/2 (ln J)^2."""
        dimension = deformation.shape[1]
        log_volume = np.log(determinant(deformation))
        trace = np.einsum("nij,nij->n", deformation, deformation)
        shear = 0.5 * parameters.shear_modulus * (trace - dimension - 2 * log_volume)
        return shear + 0.5 * parameters.lame_lambda * log_volume**2

    @ti.func
    def kirchhoff_stress(self, deformation: ti.template(), C: ti.template(), constants: ti.template()):
        identity = ti.Matrix.identity(float, C.n)
        left_cauchy_green = deformation @ deformation.transpose()
        log_volume = ti.log(deformation.determinant())
        return constants[0] * (left_cauchy_green - identity) + constants[1] * log_volume * identity


LAW = NeoHookean
