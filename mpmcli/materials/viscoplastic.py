"""Viscoplastic fluid: elastic below its yield stress, viscous above; lava, mud, paste."""

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from mpmcli.materials.elementary import exp, log
from mpmcli.materials.fluid import WeaklyCompressibleParameters, soft_bulk_modulus, volume_energy
from mpmcli.materials.law import CARRIED, Law, Mode, StateBound
from mpmcli.materials.tensors import rounding
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Knob, SceneBounds
from mpmcli.scene.quantity import LARGEST, Flag, NotNegative, Positive

# Places in the vector of constants.
BULK_MODULUS, SHEAR_MODULUS, YIELD_STRESS, CONSISTENCY, FLOW_INDEX, LARGEST_J = range(6)

# Largest elastic shear strain at yield for shear_modulus = "auto".
YIELD_STRAIN = 0.05
# Pressure under a smooth punch over the yield stress, by slip lines (Prandtl 1920).
PUNCH = 2 + math.pi
# Dilation, as ln J, that reduces the shear stress of a torn particle to 1/e.
TEAR_STRAIN = 0.1
# A particle with J below the first is treated as inverted; with a mean of the isochoric b above the second, as flat.
CRUSHED, FLAT = 1e-9, 100.0
ITERATIONS_MAX = 30


class ViscoplasticParameters(WeaklyCompressibleParameters):
    """Parameters of the Bingham and of the Herschel-Bulkley fluid."""

    law: Literal["viscoplastic"] = "viscoplastic"
    usual_sampling: ClassVar[Literal["lattice", "turned"]] = "turned"

    yield_stress: Annotated[
        NotNegative, Knob("strength", 1.0, 1e5, "0 is thin slurry, 0.3 ketchup, 0.4 mud, 0.6 lava, 1 stiff clay")
    ] = Field(description="Shear stress below which the material does not flow, Pa; mud 10 to 1000.")
    consistency: Annotated[
        Positive, Knob("thickness", 0.1, 1e5, "0 is paint, 0.3 mud, 0.6 runny lava, 1 lava that is about to set")
    ] = Field(description="Stress above yield at a shear rate of 1/s, Pa s^n; for n = 1 the plastic viscosity, Pa s.")
    flow_index: float = Field(
        1.0, ge=0.1, le=2, description="Exponent n of the shear rate: 1 Bingham, below 1 thinning, above 1 thickening."
    )
    shear_modulus: Positive | Literal["auto"] = Field(
        "auto",
        description='Elastic shear modulus below yield, Pa; "auto" takes the larger of a quarter of the bulk '
        "modulus, which leaves the time step alone, and 20 yield stresses, which keep elastic strain under 5 %.",
    )
    tension_cutoff: Flag = Field(
        False,
        description="Whether the material takes no tension: below the density at rest its pressure is 0, "
        "and it forgets its shear stress as it opens. Pastes hang together, and swell where they cannot.",
    )

    def shear_stress_at(self, rate: float, pressure: float) -> float:
        return self.yield_stress + self.consistency * rate**self.flow_index

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Replace "auto" by the bulk modulus of the fluid, and by a shear modulus of small strain at yield."""
        bulk, shear, notes = self.bulk_modulus, self.shear_modulus, []
        if bulk == "auto":
            bulk, note = soft_bulk_modulus(self.density, self.compressibility, bounds, PUNCH * self.yield_stress)
            notes.append(note)
        if shear == "auto":
            shear = min(max(bulk / 4, self.yield_stress / YIELD_STRAIN), LARGEST)
            notes.append(
                f"shear_modulus = {shear:.4g} Pa lets the material at rest give way elastically by "
                f"{100 * self.yield_stress / shear:.3g} % before it yields"
            )
        return self.model_copy(update={"bulk_modulus": bulk, "shear_modulus": shear}), notes


@ti.data_oriented
class Viscoplastic(Law):
    """tau = K (J - 1) I + G dev(b) with b = J^(-2/d) F F^T, relaxing by ((q - yield_stress)/consistency)^(1/n).

    The material is an elastic solid for shear stresses q = |dev tau|/sqrt(2) up to yield_stress, and can rest
    indefinitely. Above, the shear stress of steady flow is yield_stress + consistency rate^n (Yue et al. 2015;
    docs/theory.md, 5.9). Relaxation is implicit over the step, so that viscosity does not limit the step. A particle
    stores the lower triangular factor of its elastic F F^T, which omits the rotation; det F is the total volume ratio.

    With tension_cutoff the stored J is at most 1, as in the fluid, and the shear stress falls by J^(-1/TEAR_STRAIN):
    material that has dilated by a tenth is torn, while small oscillations of material at rest change little. In 2D
    dev is taken in the plane, without an out-of-plane deviator. The shape of inverted and flat particles is reset.
    """

    name = "viscoplastic"
    parameters = ViscoplasticParameters
    deformation = "F"
    projects = True
    coherent = True
    flows = True
    levels = True

    def __init__(self, members: tuple[ViscoplasticParameters, ...], dimension: int) -> None:
        super().__init__(members, dimension)
        self.bingham = all(member.flow_index == 1 for member in members)
        self.tears = any(member.tension_cutoff for member in members)

    def constants(self, parameters: ViscoplasticParameters) -> tuple[float, ...]:
        return (
            parameters.bulk_modulus,
            parameters.shear_modulus,
            parameters.yield_stress,
            parameters.consistency,
            parameters.flow_index,
            1.0 if parameters.tension_cutoff else LARGEST,
        )

    def modes(self, parameters: ViscoplasticParameters, bound: StateBound) -> list[Mode]:
        """Return d K J for volume, and 2 G b_max for shear, with b_max the largest eigenvalue of the isochoric b.

        The two do not couple: C = c I does not change the isochoric b, and the rest of C changes dev b only, by G (b_i
        + b_j) at most for a pair of shear entries and by diag(2 G b_i) without its trace for the normal ones.
        Relaxation reduces the result for any step. Strongly compressed bulk matter is stiffer: K, see `law.CARRIED`.
        """
        largest = min(bound.volume_ratio_max, 1.0) if parameters.tension_cutoff else bound.volume_ratio_max
        smallest = max(bound.volume_ratio_min, CRUSHED)
        isochoric = bound.stretch_squared_max * smallest ** (-2 / self.dimension)
        isochoric = min(max(isochoric, 1.0), self.dimension * FLAT)
        bulk = max(self.dimension * largest, CARRIED) * parameters.bulk_modulus
        return [Mode(bulk), Mode(2 * parameters.shear_modulus * isochoric)]

    def rebound_stretch(self, J: float) -> float:
        """Return a bound on the J > 1 at which x - 1 - ln x is that of J: 1 + W + sqrt(2 W)."""
        W = J - 1 - math.log(J)
        return min(1 / J, 1 + W + math.sqrt(2 * W))

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau and tau_zz, Pa, F with its deviator relaxed, torn or reset, and the internal variables."""
        F = deformation
        J = F.determinant()
        size = length_ratio(ti.max(J, CRUSHED), F.n)
        dev, mean = isochoric_parts(F, size)
        if J <= CRUSHED or mean > FLAT:
            J = ti.max(J, CRUSHED)
            mean = 1.0
            dev = ti.Matrix.zero(float, F.n, F.n)
            F = size * ti.Matrix.identity(float, F.n)
        share = self.remaining(
            constants[SHEAR_MODULUS] * ti.sqrt(0.5 * (dev * dev).sum()), constants[SHEAR_MODULUS] * mean * dt, constants
        )
        if ti.static(self.tears):
            largest = constants[LARGEST_J]
            if largest < J:
                # Dilation by rounding must not accumulate.
                opened = ti.static(1.0 + 8.0 * rounding())
                if opened < J:
                    share *= exp(ti.static(-1.0 / TEAR_STRAIN) * log(J))
                J = 1.0
                size = 1.0
        if share < 1.0:
            dev *= share
            F = triangular_factor(dev, isochoric_mean(dev, mean), J, size)
        pressure_part = constants[BULK_MODULUS] * (J - 1.0)
        tau = pressure_part * ti.Matrix.identity(float, F.n) + constants[SHEAR_MODULUS] * dev
        return tau, pressure_part, F, internal

    @ti.func
    def remaining(self, q: float, modulus_time: float, constants: ti.template()):
        """Return the factor by which the shear stress q, Pa, relaxes: 1 below yield, else (yield_stress + x) / q.

        x solves x = over - G mean(b) dt (x/consistency)^(1/n) with over = q - yield_stress; G mean(b) is the modulus at
        finite strain (Simo and Hughes 1998, box 9.1), and modulus_time its product with dt, Pa s.
        """
        over = q - constants[YIELD_STRESS]
        share = 1.0
        if over > 0.0:
            rest = 0.0
            if ti.static(self.bingham):
                rest = over / (1.0 + modulus_time / constants[CONSISTENCY])
            else:
                # The relaxed part w = 1 - x / over solves w + D w^n = 1, D = consistency (over / G dt)^n / over.
                n = constants[FLOW_INDEX]
                D = ti.min(constants[CONSISTENCY] * (over / modulus_time) ** n / over, 1e30)
                if n > 1.0:
                    rest = over * D * convex_root(1.0, D, n) ** n
                else:
                    # With v = w^n: D v + v^(1/n) = 1.
                    rest = over * D * convex_root(D, 1.0, 1.0 / n)
            share = (constants[YIELD_STRESS] + ti.min(rest, over)) / q
        return share

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """K (J - 1 - ln J) + G/2 (tr b - d)."""
        J = ti.max(deformation.determinant(), CRUSHED)
        dev, mean = isochoric_parts(deformation, length_ratio(J, deformation.n))
        # From det(dev + mean I) = 1, which avoids cancellation at small strain.
        excess = 0.5 * (dev * dev).sum() / (mean + 1.0)
        if ti.static(deformation.n == 3):
            excess = (0.5 * (dev * dev).sum() * mean - dev.determinant()) / (mean * mean + mean + 1.0)
        return constants[BULK_MODULUS] * volume_energy(J) + 0.5 * deformation.n * constants[SHEAR_MODULUS] * excess


@ti.func
def length_ratio(J: float, dimension: ti.template()):
    """Return J^(1/d), 1 where J is 1."""
    result = ti.sqrt(J)
    if ti.static(dimension == 3):
        result = exp(log(J) * ti.static(1 / 3))
    return result


@ti.func
def isochoric_parts(F: ti.template(), size: float):
    """Return dev(b) and the mean of its diagonal tr(b)/d for b = F F^T / size^2, with size = J^(1/d)."""
    b = F @ F.transpose() / (size * size)
    mean = b.trace() / F.n
    return b - mean * ti.Matrix.identity(float, F.n), mean


@ti.func
def isochoric_mean(dev: ti.template(), above: float):
    """Return m with det(dev + m I) = 1 and dev + m I positive definite; `above` is an upper bound on m."""
    square = 0.5 * (dev * dev).sum()
    m = ti.sqrt(1.0 + square)
    if ti.static(dev.n == 3):
        # m^3 - square m + det dev = 1, convex above the root: Newton's method decreases to it. As det dev is at least
        # -2 (square/3)^(3/2), the root is at most 2 (square/3)^(1/2) + 1. A loop with a convergence test would prevent
        # vectorisation; this number suffices for particles that are not flat.
        m = ti.min(above, 2.0 * ti.sqrt(square * ti.static(1 / 3)) + 1.0)
        constant = dev.determinant() - 1.0
        for _ in ti.static(range(12 if rounding() > 1e-10 else 15)):
            m -= ((m * m - square) * m + constant) / (3.0 * m * m - square)
    return m


@ti.func
def triangular_factor(dev: ti.template(), mean: float, J: float, size: float):
    """Return the lower triangular F with det F = J = size^d and F F^T = size^2 (dev + mean I) (Cholesky)."""
    F = ti.Matrix.zero(float, dev.n, dev.n)
    F[0, 0] = ti.sqrt(dev[0, 0] + mean)
    F[1, 0] = dev[1, 0] / F[0, 0]
    # The last entry follows from the determinant, so that rounding does not change the volume.
    if ti.static(dev.n == 2):
        F *= size
        F[1, 1] = J / F[0, 0]
    else:
        F[2, 0] = dev[2, 0] / F[0, 0]
        F[1, 1] = ti.sqrt(ti.max(dev[1, 1] + mean - F[1, 0] ** 2, 1e-7))
        F[2, 1] = (dev[2, 1] - F[2, 0] * F[1, 0]) / F[1, 1]
        F *= size
        F[2, 2] = J / (F[0, 0] * F[1, 1])
    return F


@ti.func
def convex_root(a: float, b: float, power: float):
    """Return the root of a v + b v^power = 1 for a, b > 0 and power >= 1, by Newton's method from above."""
    v = ti.min(1.0 / a, b ** (-1.0 / power))
    resolution = ti.static(4.0 * rounding())
    step = v
    count = 0
    while step > resolution * v and count < ITERATIONS_MAX:
        part = b * v ** (power - 1.0)
        step = ((a + part) * v - 1.0) / (a + power * part)
        v -= step
        count += 1
    return v


LAW = Viscoplastic
