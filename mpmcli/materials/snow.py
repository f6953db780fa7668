"""Snow: fixed corotated elasticity with bounded stretches, and hardening by compaction."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from mpmcli.materials.elasticity import ElasticParameters, PoissonsRatio
from mpmcli.materials.elementary import exp
from mpmcli.materials.fixed_corotated import corotated_energy, corotated_stiffness
from mpmcli.materials.law import Law, Mode, StateBound
from mpmcli.materials.tensors import from_principal, principal_stretches, rounding
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Internal, Knob, SceneBounds
from mpmcli.scene.quantity import Positive

# Places in the vector of constants.
MU, LAMBDA, SMALLEST_STRETCH, LARGEST_STRETCH, HARDENING, SMALLEST_PLASTIC_J, LARGEST_PLASTIC_J = range(7)

# Bounds on the plastic volume ratio, for snow with little hardening.
PACKED_MOST, LOOSE_MOST = 0.1, 10.0
# Largest stress in an impact over that behind a plane wave: 1.6 to 6 below blocks, 3 to 9 in most balls, and up to 23
# (30 impacts in 2D at 1 to 10 m/s, 32 to 64 cells).
FOCUS = 6.0


class SnowParameters(ElasticParameters):
    """Parameters of snow, by default those of Stomakhin et al. 2013."""

    law: Literal["snow"] = "snow"
    youngs_modulus: Annotated[
        Positive, Knob("stiffness", 1e4, 1e6, "0 is fresh powder, 0.6 snow that packs well, 1 old firm snow")
    ] = Field(1.4e5, description="Young's modulus E before hardening, Pa.")
    poissons_ratio: PoissonsRatio = 0.2
    critical_compression: float = Field(
        0.025, gt=0, lt=1, description="Elastic compression at which snow begins to pack; smaller is more powdery."
    )
    critical_stretch: float = Field(
        0.0075, gt=0, le=1, description="Elastic extension at which snow begins to break; larger is chunkier."
    )
    hardening: Annotated[
        float,
        Knob("hardness", 0.0, 20.0, "0 is slush that packs without hardening, 0.5 snow, 1 icy snow", scale="linear"),
    ] = Field(
        10.0, ge=0, le=100, description="Hardening xi: packed snow is exp(xi (1 - J_P)) times as stiff, J_P its volume."
    )
    hardening_limit: float = Field(
        100.0, ge=1, le=1e6, description="Packing stiffens by this factor at most, and breaking softens by no more."
    )

    internal: ClassVar[tuple[Internal, ...]] = (
        Internal("plastic_volume_ratio", 1.0, "Permanent volume ratio J_P: below 1 packed, above 1 broken."),
    )

    @property
    def plastic_range(self) -> tuple[float, float]:
        """Smallest and largest plastic volume ratio J_P, dimensionless."""
        reach = math.log(self.hardening_limit) / self.hardening if self.hardening > 0 else math.inf
        return max(1 - reach, PACKED_MOST), min(1 + reach, LOOSE_MOST)

    def hardness(self, plastic_volume_ratio: float) -> float:
        """Return h = exp(hardening (1 - J_P)), the factor on both moduli."""
        low, high = self.plastic_range
        return math.exp(self.hardening * (1 - min(max(plastic_volume_ratio, low), high)))


@ti.data_oriented
class Snow(Law):
    """tau_i = h (2 mu (s_i - 1) s_i + lambda (J_E - 1) J_E), h = exp(hardening (1 - J_P)) (Stomakhin et al. 2013).

    The elastic stretches s_i are clamped to [1 - critical_compression, 1 + critical_stretch], and the excess multiplies
    J_P. The particle stores F_E = Q diag(s) Q^T, with J_E = det F_E (docs/theory.md, 5.6). Plane strain in 2D.

    J_P is bounded so that h stays within [1/hardening_limit, hardening_limit]. The upper bound on J_P keeps fragments
    in flight from expanding without limit; such fragments would have to be compressed by as much before they carried
    load, and a heap of them would collapse. A state with det F_E < 0 is treated as its mirror image.
    """

    name = "snow"
    parameters = SnowParameters
    deformation = "F"
    projects = True

    def __init__(self, members: tuple[SnowParameters, ...], dimension: int) -> None:
        super().__init__(members, dimension)
        self.hardening = max(member.hardening for member in members)

    def constants(self, parameters: SnowParameters) -> tuple[float, ...]:
        return (
            parameters.shear_modulus,
            parameters.lame_lambda,
            1 - parameters.critical_compression,
            1 + parameters.critical_stretch,
            parameters.hardening,
            *parameters.plastic_range,
        )

    def modes(self, parameters: SnowParameters, bound: StateBound) -> list[Mode]:
        """Return h times the stiffness of the fixed corotated solid, or the stiffness of packing if that is larger.

        In the principal frame the normal entries of tau see a matrix with one column per stretch: within its bounds
        the elastic one, outside -hardening J_P tau_i, as only J_P and therefore h changes. No eigenvalue exceeds
        the largest sum of a column's absolute values, h (2 mu s (2s - 1) + d lambda J_E (2 J_E - 1)) or
        d hardening J_P max|tau_i|. Shear entries are softer outside, where tau_i - tau_j is constant.

        h is evaluated after the next projection: a determinant below the product of one stretch at its lower bound
        and the others at their largest reduces J_P by their ratio.
        """
        d = self.dimension
        low, high = 1 - parameters.critical_compression, 1 + parameters.critical_stretch
        stretch = min(max(math.sqrt(max(bound.stretch_squared_max, 0.0)), 1.0), high)
        volumes = (min(max(J, low**d), high**d) for J in (bound.volume_ratio_min, bound.volume_ratio_max))
        elastic = corotated_stiffness(
            parameters.shear_modulus, parameters.lame_lambda, d, StateBound(*volumes, stretch**2)
        )
        packed, loose = bound.internal.get("plastic_volume_ratio", (1.0, 1.0))
        packed *= min(max(bound.volume_ratio_min / (low * stretch ** (d - 1)), 0.0), 1.0)
        least, most = parameters.plastic_range
        packed, loose = (min(max(J_P, least), most) for J_P in (packed, loose))
        # J_P h is largest at J_P = 1 / hardening.
        worst = min(max(1 / parameters.hardening, packed), loose) if parameters.hardening > 0 else loose
        # A bound on |tau_i| / h, Pa; (1 - x) x is largest at 1/2.
        shear = max((1 - max(low, 0.5)) * max(low, 0.5), (high - 1) * high)
        volume = max((1 - max(low**d, 0.5)) * max(low**d, 0.5), (high**d - 1) * high**d)
        largest_stress = 2 * parameters.shear_modulus * shear + abs(parameters.lame_lambda) * volume
        packing = d * parameters.hardening * worst * parameters.hardness(worst) * largest_stress
        return [Mode(max(parameters.hardness(packed) * elastic, packing))]

    def stiffest(self, parameters: SnowParameters, bounds: SceneBounds) -> StateBound:
        """Return the state behind a compaction wave, or under the weight of the column.

        By the balance of momentum, the stress behind a wave that stops the speed v and compacts by the strain e is
        density (v^2/e + g H); where flow converges, v^2/e counts FOCUS times. Snow compacts to the strain e for which
        h(e) times the yield stress in confined compression equals it. The density is the largest of all bodies that can
        reach the snow, because a denser one may fall on it.
        """
        low, high = 1 - parameters.critical_compression, 1 + parameters.critical_stretch
        modulus = 2 * parameters.shear_modulus + parameters.lame_lambda
        yields_at = modulus * (1 - low) * low
        density = max(parameters.density, bounds.density)
        weight = density * bounds.gravity * bounds.height
        packed, loose = parameters.plastic_range[0], 1.0
        if packed == 1 or weight + bounds.speed * math.sqrt(density * modulus) <= yields_at:
            packed = 1.0
        else:
            for _ in range(60):
                middle = (packed + loose) / 2
                stress = weight + FOCUS * density * bounds.speed**2 / (1 - middle)
                if parameters.hardness(middle) * yields_at > stress:
                    packed = middle
                else:
                    loose = middle
        return StateBound(1.0, high**self.dimension, high**2, {"plastic_volume_ratio": (packed, 1.0)})

    def total_volume_ratio(self, J: np.ndarray, internal: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return J_E J_P, (n,)."""
        return J * internal["plastic_volume_ratio"]

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau and tau_zz, Pa, F with clamped stretches, and J_P, which takes what was cut off."""
        F = deformation
        variables = internal
        Q, s = principal_stretches(F)
        # The rounding of a stretch set by an earlier projection must not count as plastic flow.
        slack = ti.static(6.0 * rounding())
        lost = 1.0
        flows = 0
        for i in ti.static(range(F.n)):
            before = s[i]
            if before < constants[SMALLEST_STRETCH] - slack:
                s[i] = constants[SMALLEST_STRETCH]
                flows = 1
            if before > constants[LARGEST_STRETCH] + slack:
                s[i] = constants[LARGEST_STRETCH]
                flows = 1
            lost *= before / s[i]
        if flows == 1:
            F = from_principal(Q, s)
            variables[0] = ti.max(
                ti.min(variables[0] * lost, constants[LARGEST_PLASTIC_J]), constants[SMALLEST_PLASTIC_J]
            )
        hardness = exp(constants[HARDENING] * (1.0 - variables[0]))
        J = s[0]
        for i in ti.static(range(1, F.n)):
            J *= s[i]
        pressure_part = hardness * constants[LAMBDA] * (J - 1.0) * J
        tau = from_principal(Q, 2.0 * hardness * constants[MU] * (s - 1.0) * s + pressure_part)
        # Out of plane F is 1.
        return tau, pressure_part, F, variables

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """h (mu sum (s_i - 1)^2 + lambda/2 (J_E - 1)^2)."""
        return exp(constants[HARDENING] * (1.0 - internal[0])) * corotated_energy(
            deformation, constants[MU], constants[LAMBDA]
        )


LAW = Snow
