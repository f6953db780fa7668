"""Sand: Drucker-Prager plasticity, frictional under pressure; grains separate in tension."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from mpmcli.materials.elasticity import (
    MODULUS_PER_STRENGTH,
    STRETCH_MIN,
    Compressibility,
    HenckyLaw,
    HenckyParameters,
    YoungsModulus,
    hencky_strains,
    soft_youngs_modulus,
    stretch_tensor,
)
from mpmcli.materials.elementary import log
from mpmcli.materials.tensors import from_principal, principal_stretches
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Internal, Knob, SceneBounds
from mpmcli.scene.quantity import LARGEST, Flag, NotNegative, flaw, scene_dimension

# Places in the vector of constants.
MU, LAMBDA, TIP, SLOPE, CORRECTION, SOUND_SPEED, DELAY = range(7)

# Dense sand, 24 to 96 MPa (US Army Corps of Engineers, EM 1110-1-1904, Settlement analysis, 1990).
REAL_MODULUS = 5e7
# Upper bound on the plastic volume strain, ln J. It caps dilation, so that loose grains can recompact.
SCATTERED = 2.0
# Difference from the volume strain on the grid within which sand stays open, because the density varies by as much
# between grains. Opening has no such band: the slope of the filling, which varies as well, hides as much.
BAND = 0.025
# Fraction of the rest by which sand under pressure opens while sound crosses a cell. With a tenth, as for fluids,
# scattered sand stays up to 3 % too voluminous.
RELAXATION = 0.0175
# Largest ratio of the pressure and the delayed one, both ways. With 1.05 a thin flow has 1.5 % less friction.
BEHIND = 1.02
# Above this angle, degrees, the cone in 3D admits a tensile principal stress.
STEEPEST_3D = 60.0
_PULLED = "above which the yield cone lets sand be pulled"


def _is_3d(info: ValidationInfo) -> bool:
    return isinstance(info.context, dict) and scene_dimension(info) == 3


class SandParameters(HenckyParameters):
    """Parameters of sand."""

    law: Literal["sand"] = "sand"
    youngs_modulus: YoungsModulus = "auto"
    compressibility: Compressibility = 0.002
    friction_angle: Annotated[
        float,
        Knob(
            "grip",
            20.0,
            45.0,
            "0 is smooth beads, 0.4 loose sand, 0.6 packed sand, 1 crushed rock",
            scale="linear",
            excludes=("repose_angle",),
        ),
    ] = Field(
        gt=0, lt=90, description="Friction angle that acts in plane strain, degrees; glass beads 22, dry sand 30 to 40."
    )
    repose_angle: float | None = Field(
        None,
        gt=0,
        lt=45,
        description="Slope of a heap, degrees; sets friction_angle, whose sine is its tangent. Dry sand 30 to 35.",
    )
    cohesion: NotNegative = Field(
        0.0, description="Shear strength that is left without pressure, Pa; dry sand 0, damp sand 1e3."
    )
    volume_correction: Flag = Field(
        True,
        description="Whether sand that has come apart follows the density that the grid sees, and must close up "
        "again before it bears pressure. False makes it gain volume each time it is stirred.",
    )

    friction_delay: NotNegative | Literal["auto"] = Field(
        "auto",
        description='Time after which friction follows the pressure, s; "auto" is that of a pressure wave through the '
        "deepest column. At 0 steady shear excites waves, which lower the friction by up to a third.",
    )

    sets: ClassVar[Mapping[str, str]] = {"repose_angle": "friction_angle"}
    internal: ClassVar[tuple[Internal, ...]] = (
        Internal(
            "plastic_volume_strain", 0.0, "Volume gained by coming apart, as the logarithm of a ratio, dimensionless."
        ),
        Internal(
            "delayed_volume_strain", 0.0, "Elastic volume strain whose pressure sets the friction, dimensionless."
        ),
    )

    @model_validator(mode="before")
    @classmethod
    def _of_the_heap(cls, said: Any, info: ValidationInfo) -> Any:
        """Set the friction angle from the slope of a heap, sin(phi) = tan(repose) (Davis 1968; docs/theory.md, 5.7)."""
        slope = said.get("repose_angle") if isinstance(said, Mapping) else None
        if slope is None:
            return said
        if not (isinstance(slope, int | float) and 0 < slope < 45):
            # The field itself reports its fault.
            return {"friction_angle": 30.0, **said}
        angle = math.degrees(math.asin(math.tan(math.radians(slope))))
        given = said.get("friction_angle", angle)
        if not (isinstance(given, int | float) and math.isclose(given, angle, rel_tol=1e-6)):
            raise flaw("sets friction_angle, which is given as well; leave one of them out", "repose_angle")
        if _is_3d(info) and angle > STEEPEST_3D:
            most = math.floor(10 * math.degrees(math.atan(math.sin(math.radians(STEEPEST_3D))))) / 10
            raise flaw(f"must be at most {most:g} degrees in 3D, {_PULLED}; found {slope:g}", "repose_angle")
        return {**said, "friction_angle": angle}

    @field_validator("friction_angle", "repose_angle", mode="before")
    @classmethod
    def _rubs(cls, value: Any) -> Any:
        """Refuse material without friction, whose law is another one: in simple shear it yields at its cohesion."""
        if value == 0 and value is not False:
            other = 'law = "von_mises" with a yield_stress of 1.73 times its cohesion'
            raise flaw(f"must be greater than 0; for a material without friction take {other}; found {value}")
        return value

    @field_validator("friction_angle")
    @classmethod
    def _within_the_cone(cls, value: float, info: ValidationInfo) -> float:
        """Reject angles whose cone in 3D admits tension: triaxial extension reaches p (1 - 2 sin(phi) / sqrt(3))."""
        if _is_3d(info) and value > STEEPEST_3D:
            raise flaw(f"must be at most {STEEPEST_3D:g} degrees in 3D, {_PULLED}; found {value:g}")
        return value

    @property
    def sound_speed(self) -> float:
        """Speed of pressure waves, m/s."""
        return math.sqrt((self.lame_lambda + 2 * self.shear_modulus) / self.density)

    def shear_stress_at(self, rate: float, pressure: float) -> float:
        angle = math.radians(self.friction_angle)
        return pressure * math.sin(angle) + self.cohesion * math.cos(angle)

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Replace "auto" by the softest modulus that the scene allows, at most that of real sand, and by a delay."""
        chosen, told = self, []
        if self.youngs_modulus == "auto":
            soft, under = soft_youngs_modulus(self, bounds)
            modulus = min(max(min(soft, REAL_MODULUS), MODULUS_PER_STRENGTH * self.cohesion), LARGEST)
            varies = f"the density vary by {100 * self.compressibility * soft / modulus:.3g} %"
            if modulus < soft:
                said = f"youngs_modulus = {modulus:.4g} Pa, that of real sand, lets {varies} {under}"
            elif modulus > soft:
                said = f"youngs_modulus = {modulus:.4g} Pa keeps the strain at which the cohesion gives way near 0.5 %"
            else:
                said = f"youngs_modulus = {modulus:.4g} Pa lets {varies} {under}"
            chosen, told = self.model_copy(update={"youngs_modulus": modulus}), [said]
        if self.friction_delay == "auto":
            chosen = chosen.model_copy(update={"friction_delay": bounds.height / chosen.sound_speed})
        return chosen, told


@ti.data_oriented
class Sand(HenckyLaw):
    """Drucker-Prager plasticity in Hencky strain (Klar et al. 2016), matched to Mohr-Coulomb in plane strain.

    The yield condition is (docs/theory.md, 5.7)

        |s| <= sqrt(2) (p sin(phi) + c cos(phi)),

    where p = -(lambda + 2 mu / d) tr e is the mean pressure and s the deviator of tau, both in d dimensions. The
    largest shear stress in the plane is then p sin(phi) + c cos(phi), so that phi is the effective friction angle in
    2D, and in 3D under plane strain. (The alpha of Klar et al. matches triaxial compression; in plane strain it never
    yields for phi >= 42.2 degrees. The angle in triaxial compression is asin(3 sin(phi) / (2 sqrt(3) + sin(phi))).)
    Plastic shear keeps tr e and causes no dilation. Beyond the tip of the cone, at a tension of c cot(phi), the grains
    separate: the strain is projected to the tip, and the difference is added to the plastic volume strain v, at most 2.
    ln J = tr e + v, where J is the total volume ratio. With `volume_correction`, compression first reduces v and causes
    pressure only at v = 0 (after Tampubolon et al. 2017), and v is relaxed towards the density of the grid
    (docs/theory.md, 5.11). In 2D the out-of-plane stress is the mean of the in-plane principal stresses, which plastic
    flow in plane strain approaches.
    """

    name = "sand"
    parameters = SandParameters
    projects = True
    flows = True
    shifts = True
    eases = (1.4, 1.6)
    opens_at_surfaces = True
    lost = 0.15

    def __init__(self, members: tuple[SandParameters, ...], dimension: int) -> None:
        super().__init__(members, dimension)
        self.closes = any(member.volume_correction for member in members)
        self.relaxes = self.closes

    def constants(self, parameters: SandParameters) -> tuple[float, ...]:
        """Return mu, lambda, volume strain at the tip, |dev e| per volume strain below it, and the others in order."""
        mu, lam = parameters.shear_modulus, parameters.lame_lambda
        bulk = lam + 2 * mu / self.dimension
        phi = math.radians(parameters.friction_angle)
        tip = parameters.cohesion / (math.tan(phi) * bulk)
        slope = math.sqrt(2) * math.sin(phi) * bulk / (2 * mu)
        delay = 0.0 if parameters.friction_delay == "auto" else parameters.friction_delay
        return (mu, lam, tip, slope, float(parameters.volume_correction), parameters.sound_speed, delay)

    def total_volume_ratio(self, J: np.ndarray, internal: Mapping[str, np.ndarray]) -> np.ndarray:
        return J * np.exp(internal["plastic_volume_strain"])

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau and tau_zz, Pa, F after the return to the cone, and both volume strains, see `SandParameters`."""
        F = deformation
        v = internal
        Q, s = principal_stretches(deformation)
        e = hencky_strains(s)
        volume = e.sum()
        deviator = e - volume / ti.static(float(self.dimension))
        closed = 0.0
        if ti.static(self.closes):
            if volume < 0.0:
                closed = ti.min(constants[CORRECTION] * v[0], -volume)
        kept = ti.min(volume + closed, constants[TIP])
        shear = ti.sqrt(deviator.dot(deviator))
        bears = kept
        # Without an earlier pressure there is no delay: where sand lands, and at the start.
        if constants[DELAY] > 0.0 and kept < 0.0:
            bears = v[1] + (kept - v[1]) * dt / (dt + constants[DELAY])
            bears = ti.max(ti.min(bears, kept / BEHIND), kept * BEHIND)
        v[1] = bears
        strength = constants[SLOPE] * (constants[TIP] - bears)
        if kept != volume or shear > strength or s.min() < STRETCH_MIN:
            if shear > strength:
                deviator *= strength / shear
            e = deviator + kept / ti.static(float(self.dimension))
            F = stretch_tensor(Q, e)
            v[0] = ti.min(v[0] + ti.max(volume - constants[TIP], 0.0) - closed, SCATTERED)
        spherical = constants[LAMBDA] * kept
        tau = from_principal(Q, 2.0 * constants[MU] * e + spherical)
        tau_zz = 0.0
        if ti.static(self.dimension == 2):
            tau_zz = spherical + constants[MU] * kept
        return tau, tau_zz, F, v

    @ti.func
    def released(self, deformation: ti.template(), share: float):
        Q, s = principal_stretches(deformation)
        return stretch_tensor(Q, share * hencky_strains(s))

    @ti.func
    def relax(
        self,
        deformation: ti.template(),
        internal: ti.template(),
        seen: float,
        opens: float,
        time: float,
        constants: ti.template(),
    ):
        """Move v so that J = det F exp(v) lies from `opens` * `seen` to `seen`; v stays between 0 and SCATTERED."""
        v = internal
        if constants[CORRECTION] > 0.0:
            J = deformation.determinant()
            volume, strain = v[0] + log(J), log(seen)
            share = 1.0
            if J < 1.0:
                crossings = constants[SOUND_SPEED] * time
                share = RELAXATION * crossings / (1.0 + RELAXATION * crossings)
            apart = strain + log(opens)
            opening = ti.max(ti.min(apart - volume, apart), 0.0)
            closing = ti.min(strain - volume + BAND, 0.0)
            v[0] = ti.min(ti.max(v[0] + share * opening + closing, 0.0), SCATTERED)
        # A lower pressure does not increase the stiffness.
        return deformation, v, 0.0

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """mu |e|^2 + lambda/2 (tr e)^2."""
        _Q, s = principal_stretches(deformation)
        e = hencky_strains(s)
        return constants[MU] * e.dot(e) + 0.5 * constants[LAMBDA] * e.sum() ** 2


LAW = Sand
