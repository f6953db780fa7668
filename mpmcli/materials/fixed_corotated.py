"""Fixed corotated solid: energy quadratic in the stretches, for large rotation and moderate strain."""

import math
from typing import Literal

import numpy as np

from mpmcli.materials.elasticity import SolidParameters
from mpmcli.materials.law import Law, Mode, StateBound, principal
from mpmcli.materials.tensors import from_principal, polar_rotation, principal_stretches, rounding, volume_strain
from mpmcli.quick_taichi import ti

# Places in the vector of constants.
MU, LAMBDA = range(2)

# Largest entry of F F^T - I for which its series is accurate to single and double precision.
SMALL = 2e-3, 2e-6


class FixedCorotatedParameters(SolidParameters):
    """Parameters of the fixed corotated solid."""

    law: Literal["fixed_corotated"] = "fixed_corotated"


@ti.data_oriented
class FixedCorotated(Law):
    """tau = 2 mu (F - R) F^T + lambda (J - 1) J I (Stomakhin et al. 2012; docs/theory.md, 5.4); plane strain in 2D.

    R is the rotation nearest to F. It is also defined for inverted states, which the stress drives back
    (`polar_rotation` in 2D, `signed_stretches` in 3D). The energy of complete collapse is finite, and the stress
    vanishes as F approaches 0.
    """

    name = "fixed_corotated"
    parameters = FixedCorotatedParameters
    deformation = "F"
    coherent = True
    elastic = True

    def constants(self, parameters: FixedCorotatedParameters) -> tuple[float, ...]:
        return (parameters.shear_modulus, parameters.lame_lambda)

    def modes(self, parameters: FixedCorotatedParameters, bound: StateBound) -> list[Mode]:
        return [Mode(corotated_stiffness(parameters.shear_modulus, parameters.lame_lambda, self.dimension, bound))]

    def reference_modes(self, parameters: FixedCorotatedParameters, bound: StateBound) -> list[Mode]:
        """Return 2 mu + lambda (d s^(2d-2) + |J - 1| s^(d-2)), where s is the largest stretch, at least 1.

        P = 2 mu (F - R) + lambda (J - 1) cof F. The derivative of R is positive, cof F has entries of up to s^(d-1) in
        the principal frame, and its derivative eigenvalues of up to s^(d-2).
        """
        d, s = self.dimension, math.sqrt(max(bound.stretch_squared_max, 1.0))
        volume = max(abs(bound.volume_ratio_max - 1), abs(bound.volume_ratio_min - 1))
        volumetric = max(parameters.lame_lambda, 0.0) * (d * s ** (2 * d - 2) + volume * s ** (d - 2))
        return [Mode(2 * parameters.shear_modulus + volumetric)]

    def rebound_stretch(self, J: float) -> float:
        """Return 2 - J, because the volumetric energy depends on (J - 1)^2."""
        return 2 - J

    def stored_energy(self, parameters: FixedCorotatedParameters, deformation: np.ndarray) -> np.ndarray:
        s = principal(deformation, self.dimension)
        stretch, volume = ((s - 1) ** 2).sum(axis=1), s.prod(axis=1) - 1
        return parameters.shear_modulus * stretch + 0.5 * parameters.lame_lambda * volume**2

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau, tau_zz = lambda (J - 1) J, Pa, and F and the internal variables unchanged; see `Law.respond`."""
        F = deformation
        J = F.determinant()
        pressure_part = constants[LAMBDA] * (J - 1.0) * J
        tau = pressure_part * ti.Matrix.identity(float, F.n)
        if ti.static(F.n == 2):
            # F^T = S R^T, so that R F^T is symmetric up to rounding.
            stretched = (F - polar_rotation(F)) @ F.transpose()
            tau += constants[MU] * (stretched + stretched.transpose())
        else:
            # Without the iterations of R, which would prevent vectorisation.
            Q, s = signed_stretches(F, J)
            # S^2 - S = B/2 + B^2/8 + O(B^3) with B = F F^T - I, whose digits F F^T would lose near rest.
            H = F - ti.Matrix.identity(float, F.n)
            B = H + H.transpose() + H @ H.transpose()
            at_rest = ti.abs(B).max() < ti.static(SMALL[rounding() < 1e-10])
            bent, near = from_principal(Q, (s - 1.0) * s), 0.5 * B + 0.125 * (B @ B)
            for i, j in ti.static(ti.ndrange(3, 3)):
                tau[i, j] += 2.0 * constants[MU] * ti.select(at_rest, near[i, j], bent[i, j])
        # Out of plane F is 1 and R is 1.
        return tau, pressure_part, deformation, internal

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        return corotated_energy(deformation, constants[MU], constants[LAMBDA])

    @ti.func
    def wave_modulus(self, constants: ti.template()):
        return constants[LAMBDA] + 2.0 * constants[MU]


@ti.func
def signed_stretches(F: ti.template(), J: float):
    """Return the eigenvectors and eigenvalues of S in F = S R in 3D: where J = det F < 0 the smallest is negative."""
    Q, s = principal_stretches(F)
    smallest = ti.min(s[0], ti.min(s[1], s[2]))
    turned = J < 0.0
    for i in ti.static(range(3)):
        turns = turned and s[i] == smallest
        # The first of equal ones.
        turned = turned and not turns
        s[i] = ti.select(turns, -s[i], s[i])
    return Q, s


@ti.func
def corotated_energy(F: ti.template(), mu: float, lame_lambda: float):
    """Return mu |F - R|^2 + lambda/2 (J - 1)^2, J/m^3 (Stomakhin et al. 2012)."""
    stretch = F - polar_rotation(F)
    volume = volume_strain(F - ti.Matrix.identity(float, F.n))
    return mu * (stretch * stretch).sum() + 0.5 * lame_lambda * volume * volume


def corotated_stiffness(mu: float, lame_lambda: float, dimension: int, bound: StateBound) -> float:
    """Return the largest d lambda J (2J - 1) + 2 mu s (2s - 1), Pa, over J and stretches s within `bound` and at rest.

    Under C dt, the normal entries of tau in the principal frame see the matrix diag(2 mu s_i (2 s_i - 1)) +
    lambda J (2J - 1) (1 1^T), and a pair of shear entries 2 mu (s_i^2 + s_j^2)(1 - 1/(s_i + s_j)), which is largest
    where both stretches are. The sum bounds both, and is exact at rest: d lambda + 2 mu. An inverted state
    (J < 0) has one negative stretch, for which |s| (2 |s| + 1) bounds s (2s - 1).
    """
    ends = {1.0, bound.volume_ratio_min, bound.volume_ratio_max}
    if bound.volume_ratio_min < 0.25 < bound.volume_ratio_max:
        ends.add(0.25)
    volumetric = max(0.0, *(dimension * lame_lambda * J * (2 * J - 1) for J in ends))
    stretch = math.sqrt(max(bound.stretch_squared_max, 1.0))
    turn = -1 if bound.volume_ratio_min >= 0 else 1
    return volumetric + 2 * mu * stretch * (2 * stretch + turn)


LAW = FixedCorotated
