"""Elastic constants, and Hencky elasticity, linear in the logarithms of the principal stretches.

Laws with an isotropic elastic part share the first, sand and von Mises plasticity the second (docs/theory.md, 5.1
and 5.5).
"""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from mpmcli.materials.elementary import exp_minus_1, log
from mpmcli.materials.fluid import QUIET_SPEED, compressibility_of
from mpmcli.materials.law import Law, Mode, StateBound, carried_stiffness, principal
from mpmcli.materials.tensors import from_principal
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Knob, MaterialParameters, SceneBounds
from mpmcli.scene.quantity import LARGEST, NotNegative, Positive

# Lower bound on a stretch, which keeps the logarithm of a flat particle finite.
STRETCH_MIN = 1e-4
# Smallest ratio of Young's modulus to strength that "auto" chooses: a yield strain of half a percent.
MODULUS_PER_STRENGTH = 200.0

PoissonsRatio = Annotated[
    float, Field(gt=-1, lt=0.5, description="Poisson's ratio, between -1 and 0.5, both excluded.")
]
Compressibility = compressibility_of("youngs_modulus")
YoungsModulus = Annotated[
    Positive | Literal["auto"],
    Field(
        description='Young\'s modulus E, Pa; "auto" picks the softest that keeps the density variation under '
        "`compressibility` in the deepest column and at the highest speed that can reach the body."
    ),
]


class ElasticParameters(MaterialParameters):
    """Parameters of a material with an isotropic elastic part."""

    youngs_modulus: Annotated[
        Positive, Knob("springiness", 1e3, 1e7, "0 is soft jelly, 0.3 firm jelly, 0.75 rubber, 1 hard rubber")
    ] = Field(description="Young's modulus E, Pa.")
    poissons_ratio: PoissonsRatio = 0.3

    @property
    def shear_modulus(self) -> float:
        """mu = E / (2 (1 + nu)), Pa."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def lame_lambda(self) -> float:
        """lambda = E nu / ((1 + nu)(1 - 2 nu)), Pa."""
        nu = self.poissons_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))


class SolidParameters(ElasticParameters):
    """Parameters of a solid that stays elastic."""

    solid = True

    surface_friction: NotNegative = Field(
        0.0,
        description='Coefficient of Coulomb friction with bodies that "separate" from it and are no softer, where '
        "contact gives none.",
    )


class HenckyParameters(ElasticParameters):
    """Parameters of a solid whose Young's modulus may be "auto"."""

    youngs_modulus: YoungsModulus
    compressibility: Compressibility = 0.01


def soft_youngs_modulus(parameters: HenckyParameters, bounds: SceneBounds) -> tuple[float, str]:
    """Return Young's modulus E, Pa, for which the load strains the volume by `compressibility`, and words for the load.

    The pressure of the deepest column and of the fastest flow is density (g H + v^2), with the largest density of all
    bodies that can reach this one, and at least the load by colliders. The bulk modulus K = lambda + 2 mu / d (in 2D
    that of the plane) is proportional to E.
    """
    speed = bounds.speed if bounds.speed > 0 else QUIET_SPEED
    pressure = max(parameters.density, bounds.density) * (bounds.gravity * bounds.height + speed**2)
    said = f"under a column of {bounds.height:.4g} m and at the highest speed, {bounds.speed:.4g} m/s"
    if bounds.load > pressure:
        pressure, said = bounds.load, f"at {bounds.load:.4g} Pa, the pressure with which colliders push the material"
    one_pascal = parameters.model_copy(update={"youngs_modulus": 1.0})
    bulk = one_pascal.lame_lambda + 2 * one_pascal.shear_modulus / bounds.dimension
    return min(max(pressure / (parameters.compressibility * bulk), 1 / LARGEST), LARGEST), said


class HenckyLaw(Law):
    """tau_i = 2 mu e_i + lambda tr e in the principal frame of F F^T, with e_i = ln s_i (Hencky 1928).

    Source: docs/theory.md, 5.5.
    """

    deformation = "F"
    # d lambda + 2 mu at any strain; x coth x = 1 + x^2/3 for shear. Only below about J = 0.4 is bulk stiffer, which
    # measurements at the longest interval detect.
    sensitivity = 0.0

    def modes(self, parameters: HenckyParameters, bound: StateBound) -> list[Mode]:
        """Return d lambda + 2 mu for normal strain, 2 mu x coth x for shear, x = ln(s_i / s_j), and that of bulk.

        Under C dt the normal strains change by the normal entries of C dt. In a pair of shear entries tau_ij = (tau_i -
        tau_j) / (s_i^2 - s_j^2) b_ij, where b_ij changes by (C_ij s_j^2 + C_ji s_i^2) dt. Plastic flow only reduces the
        differences tau_i - tau_j. The stiffness of a lone particle does not depend on its state; in bulk the pressure
        adds to it (`carried_stiffness`): -tau_i = -2 mu e_i - lambda ln J.
        """
        lam, mu, d = max(parameters.lame_lambda, 0.0), parameters.shear_modulus, self.dimension
        largest = max(math.sqrt(bound.stretch_squared_max), STRETCH_MIN)
        smallest = min(max(bound.volume_ratio_min / largest ** (d - 1), STRETCH_MIN), largest)
        x = math.log(largest / smallest)
        J = min(max(bound.volume_ratio_min, STRETCH_MIN**d), 1.0)
        pressure = -2 * mu * math.log(min(smallest, 1.0)) - lam * math.log(J)
        return [
            Mode(d * lam + 2 * mu),
            Mode(2 * mu * (x / math.tanh(x) if x > 0 else 1.0)),
            Mode(carried_stiffness(lam + 2 * mu, pressure)),
        ]

    def stored_energy(self, parameters: HenckyParameters, deformation: np.ndarray) -> np.ndarray:
        """Return mu |e|^2 + lambda/2 (tr e)^2, before plastic flow dissipates a part of it."""
        e = np.log(np.maximum(principal(deformation, self.dimension), STRETCH_MIN))
        return parameters.shear_modulus * (e**2).sum(axis=1) + 0.5 * parameters.lame_lambda * e.sum(axis=1) ** 2


@ti.func
def hencky_strains(s: ti.template()):
    """Return ln s_i of the principal stretches."""
    strains = s
    for i in ti.static(range(s.n)):
        strains[i] = log(ti.max(s[i], STRETCH_MIN))
    return strains


@ti.func
def stretch_tensor(Q: ti.template(), strains: ti.template()):
    """Return Q diag(exp e_i) Q^T, which is I exactly where the strains are 0."""
    extensions = strains
    for i in ti.static(range(strains.n)):
        extensions[i] = exp_minus_1(strains[i])
    return ti.Matrix.identity(float, Q.n) + from_principal(Q, extensions)
