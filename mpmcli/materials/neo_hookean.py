"""Compressible neo-Hookean solid, for large elastic deformation."""

import math
from typing import Literal

import numpy as np

from mpmcli.materials.elasticity import SolidParameters
from mpmcli.materials.elementary import log
from mpmcli.materials.law import SMALLEST, Law, Mode, StateBound, carried_stiffness, least_stretch, principal
from mpmcli.materials.tensors import log_ratio, volume_strain
from mpmcli.quick_taichi import ti

# Places in the vector of constants.
MU, LAMBDA = range(2)


class NeoHookeanParameters(SolidParameters):
    """Parameters of the neo-Hookean solid."""

    law: Literal["neo_hookean"] = "neo_hookean"


@ti.data_oriented
class NeoHookean(Law):
    """tau = mu (F F^T - I) + lambda ln(J) I (Bonet and Wood 2008, eq. 6.28); plane strain in 2D.

    Source: docs/theory.md, 5.3.
    """

    name = "neo_hookean"
    parameters = NeoHookeanParameters
    deformation = "F"
    coherent = True
    elastic = True

    def constants(self, parameters: NeoHookeanParameters) -> tuple[float, ...]:
        return (parameters.shear_modulus, parameters.lame_lambda)

    def modes(self, parameters: NeoHookeanParameters, bound: StateBound) -> list[Mode]:
        """Return d lambda + 2 mu s^2, where s is the largest stretch, and the addition for bulk under pressure.

        Under C dt, tau changes by mu (C b + b C^T) dt + lambda tr(C) dt I. In the principal frame of b = F F^T the
        normal entries see the matrix 2 mu diag(s_i^2) + lambda (1 1^T), the pairs of shear entries mu (s_i^2 + s_j^2):
        no eigenvalue exceeds the sum above, which is exact at rest. Compression does not stiffen a lone particle,
        because lambda ln(J) I changes by lambda tr(C) dt at any J. In bulk the pressure adds to the stiffness
        (`carried_stiffness`): -tau_i = mu (1 - s_i^2) - lambda ln J.
        """
        lam, mu = max(parameters.lame_lambda, 0.0), parameters.shear_modulus
        shear = 2 * mu * bound.stretch_squared_max
        low, J = least_stretch(bound, self.dimension), min(max(bound.volume_ratio_min, SMALLEST), 1.0)
        pressure = mu * (1 - min(low, 1.0) ** 2) - lam * math.log(J)
        return [Mode(max(self.dimension * lam + shear, carried_stiffness(lam + shear, pressure)))]

    def reference_modes(self, parameters: NeoHookeanParameters, bound: StateBound) -> list[Mode]:
        """Return mu + (|mu - lambda ln J| + d lambda) / s^2, where s is the smallest stretch, at most 1.

        P = mu F + (lambda ln J - mu) F^-T, whose last factor changes by up to |dF| / s^2.
        """
        lam, mu = max(parameters.lame_lambda, 0.0), parameters.shear_modulus
        smallest = min(least_stretch(bound, self.dimension), 1.0)
        ends = (max(bound.volume_ratio_min, SMALLEST), max(bound.volume_ratio_max, SMALLEST), 1.0)
        pressure = max(abs(mu - lam * math.log(J)) for J in ends)
        return [Mode(mu + (pressure + self.dimension * lam) / smallest**2)]

    def stored_energy(self, parameters: NeoHookeanParameters, deformation: np.ndarray) -> np.ndarray:
        s = principal(deformation, self.dimension)
        log_volume = np.log(s).sum(axis=1)
        shear = 0.5 * (s**2 - 1).sum(axis=1) - log_volume
        return parameters.shear_modulus * shear + 0.5 * parameters.lame_lambda * log_volume**2

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        identity = ti.Matrix.identity(float, C.n)
        left_cauchy_green = deformation @ deformation.transpose()
        pressure_part = constants[LAMBDA] * log(deformation.determinant())
        tau = constants[MU] * (left_cauchy_green - identity) + pressure_part * identity
        # Out of plane F is 1, so that b - I vanishes there.
        return tau, pressure_part, deformation, internal

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """mu/2 (tr b - d) - mu ln J + lambda/2 (ln J)^2, from F - I, which avoids cancellation at small strain."""
        H = deformation - ti.Matrix.identity(float, deformation.n)
        log_volume = log_ratio(volume_strain(H))
        stretch = H.trace() + 0.5 * (H * H).sum()
        return constants[MU] * (stretch - log_volume) + 0.5 * constants[LAMBDA] * log_volume**2

    @ti.func
    def wave_modulus(self, constants: ti.template()):
        return constants[LAMBDA] + 2.0 * constants[MU]


LAW = NeoHookean
