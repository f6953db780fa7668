"""Metal and clay: elastic up to a yield stress, then plastic flow at constant volume."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from mpmcli.materials.elasticity import (
    MODULUS_PER_STRENGTH,
    STRETCH_MIN,
    HenckyLaw,
    HenckyParameters,
    hencky_strains,
    soft_youngs_modulus,
    stretch_tensor,
)
from mpmcli.materials.tensors import from_principal, principal_stretches
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Internal, Knob, SceneBounds
from mpmcli.scene.quantity import LARGEST, NotNegative, Positive

# Places in the vector of constants.
MU, LAMBDA, YIELD_STRESS, HARDENING_MODULUS = range(4)


class VonMisesParameters(HenckyParameters):
    """Parameters of the elastic-plastic solid."""

    solid = True

    law: Literal["von_mises"] = "von_mises"
    yield_stress: Annotated[
        Positive,
        Knob("strength", 1e3, 1e9, "0 is soft putty, 0.3 clay, 0.75 soft aluminium, 0.9 mild steel, 1 tool steel"),
    ] = Field(description="Yield stress in uniaxial tension, Pa; clay 1e4 to 1e5, metal 1e7 to 1e9.")
    hardening_modulus: Annotated[NotNegative, Knob("hardness", 1e3, 1e9, "0 does not harden, 1 hardens like steel")] = (
        Field(0.0, description="Growth of the yield stress per plastic strain, Pa; 0 is perfectly plastic.")
    )

    surface_friction: NotNegative | Literal["stick"] = Field(
        "stick",
        description='Coefficient of Coulomb friction with bodies that separate from it, as of elastic laws; "stick": '
        "solids that it meets weld to it.",
    )

    internal: ClassVar[tuple[Internal, ...]] = (
        Internal("plastic_strain", 0.0, "Equivalent plastic strain, dimensionless."),
        Internal("elastic_strain_zz", 0.0, "Elastic Hencky strain out of the plane, dimensionless.", (2,)),
    )

    @property
    def has_surface(self) -> bool:
        """Whether it has a coefficient of friction."""
        return self.surface_friction != "stick"

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Replace "auto" by the softest modulus that the scene allows and whose yield strain is small."""
        if self.youngs_modulus != "auto":
            return self, []
        soft, under = soft_youngs_modulus(self, bounds)
        modulus = min(max(soft, MODULUS_PER_STRENGTH * self.yield_stress), LARGEST)
        if modulus > soft:
            said = f"youngs_modulus = {modulus:.4g} Pa lets it yield at a strain of {100 / MODULUS_PER_STRENGTH:.3g} %"
        else:
            said = (
                f"youngs_modulus = {modulus:.4g} Pa lets the density vary by {100 * self.compressibility:.3g} % {under}"
            )
        return self.model_copy(update={"youngs_modulus": modulus}), [said]


@ti.data_oriented
class VonMises(HenckyLaw):
    """J2 plasticity in Hencky strain with linear isotropic hardening: sqrt(3/2) |dev tau| <= yield_stress + H a.

    a is the equivalent plastic strain. The return mapping is radial and exact for linear hardening (Simo 1992; de Souza
    Neto, Peric and Owen 2008, box 7.5; docs/theory.md, 5.8), and keeps the volume. 2D is plane strain: the elastic
    strain along z is minus the plastic strain along z, and is stored in addition to the in-plane elastic F.
    """

    name = "von_mises"
    parameters = VonMisesParameters
    projects = True
    coherent = True

    def constants(self, parameters: VonMisesParameters) -> tuple[float, ...]:
        return (parameters.shear_modulus, parameters.lame_lambda, parameters.yield_stress, parameters.hardening_modulus)

    def total_volume_ratio(self, J: np.ndarray, internal: Mapping[str, np.ndarray]) -> np.ndarray:
        return J * np.exp(internal["elastic_strain_zz"]) if self.dimension == 2 else J

    @ti.func
    def strains(self, s: ti.template(), internal: ti.template()):
        """Return the three principal Hencky strains, in 2D with the out-of-plane strain last."""
        in_frame = hencky_strains(s)
        e = ti.Vector([in_frame[0], in_frame[1], 0.0])
        if ti.static(self.dimension == 2):
            e[2] = internal[1]
        else:
            e[2] = in_frame[2]
        return e

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau and tau_zz, Pa, F after the radial return, the plastic strain and, in 2D, the elastic one in z."""
        F = deformation
        variables = internal
        mu = constants[MU]
        Q, s = principal_stretches(deformation)
        e = self.strains(s, internal)
        volume = e.sum()
        deviator = e - volume / 3.0
        # sqrt(3/2) |dev tau|
        stress = ti.static(math.sqrt(6.0)) * mu * ti.sqrt(deviator.dot(deviator))
        excess = stress - (constants[YIELD_STRESS] + constants[HARDENING_MODULUS] * variables[0])
        if excess > 0.0 or s.min() < STRETCH_MIN:
            if excess > 0.0:
                flow = excess / (3.0 * mu + constants[HARDENING_MODULUS])
                variables[0] += flow
                e = volume / 3.0 + (1.0 - 3.0 * mu * flow / stress) * deviator
            if ti.static(self.dimension == 2):
                variables[1] = e[2]
                F = stretch_tensor(Q, ti.Vector([e[0], e[1]]))
            else:
                F = stretch_tensor(Q, e)
        principal = 2.0 * mu * e + constants[LAMBDA] * volume
        tau = ti.Matrix.zero(float, F.n, F.n)
        tau_zz = 0.0
        if ti.static(self.dimension == 2):
            tau = from_principal(Q, ti.Vector([principal[0], principal[1]]))
            tau_zz = principal[2]
        else:
            tau = from_principal(Q, principal)
        return tau, tau_zz, F, variables

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """mu |e|^2 + lambda/2 (tr e)^2, of all three strains."""
        _Q, s = principal_stretches(deformation)
        e = self.strains(s, internal)
        return constants[MU] * e.dot(e) + 0.5 * constants[LAMBDA] * e.sum() ** 2


LAW = VonMises
