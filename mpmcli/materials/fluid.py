"""Weakly compressible fluid: pressure as a function of the volume ratio, and Newtonian viscosity."""

import math
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field

from mpmcli.materials.elementary import exp_minus_1, log
from mpmcli.materials.law import CARRIED, Law, Mode, StateBound
from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Knob, MaterialParameters, SceneBounds
from mpmcli.scene.quantity import LARGEST, Flag, NotNegative, Positive

# Places in the vector of constants.
BULK_MODULUS, EXPONENT, VISCOSITY, SECOND_VISCOSITY, LARGEST_J, SOUND_SPEED = range(6)

# A particle is relaxed if every node of its stencil is filled beyond this fraction, hence not at a free surface, where
# the kernel includes air. The grid resolves J up to its inverse.
FULL = 0.2
# It opens only if the nodes beside the stencil are filled beyond this fraction of the mean over the stencil.
BESIDE = 0.4
# Difference of the volume ratio that is ignored under pressure. The density of particles that are not on a lattice
# varies by as much; its relaxation would turn this noise into pressure.
DEAD_BAND = 0.02
# Largest lack of volume that causes pressure, so that coincident particles do not explode.
LARGEST_LACK = 0.1
# Difference that is ignored without pressure.
FREE_DEAD_BAND = 0.005
# Suction that a fluid bears before it tears: that of this opening, and at most one atmosphere, where liquids boil. It
# draws a stream together while gravity stretches it. With a fifth of it a column that is drawn out at once tears;
# four times as much changes nothing.
TEARS, ATMOSPHERE = 0.005, 101325.0
# J up to which deformation opens; beyond it J follows the grid alone.
OPENED = 2.0
# Speed that "auto" assumes if nothing in the scene moves or falls, m/s.
QUIET_SPEED = 1.0
# The pressure of a nonlinear equation of state is constant below this J, so that J^-g stays within single precision for
# the largest exponent. The value is far outside weak compressibility; it keeps crushed particles finite.
CRUSHED = 0.05
# Suction that a viscous fluid without tension bears, in units of its viscous stress. The side of a stream stretched by
# gravity is free of stress only if the inward suction equals the viscous resistance; without suction the stream widens
# (docs/theory.md, 5.2). Values from 1 to 6 give the same results.
SUCTION = 3.0
# Fraction of the difference between J and the value on the grid that is removed while sound crosses a cell: 1 % in ten
# steps in 2D. Half of it leaves a broken dam 5 % too shallow; twice adds 0.5 % of energy to a floating raft.
RELAXATION = 0.00175
# Limit on Newton iterations; about six suffice for any load.
ITERATIONS_MAX = 100


def compressibility_of(modulus: str) -> Any:
    """Return the type of the parameter that determines a modulus which may be "auto"."""
    meaning = "0 lets the density vary by 10 %, 1 by 0.01 %, in steps 30 times as many"
    return Annotated[
        float,
        Field(gt=0, le=0.1, description=f'Density variation that {modulus} = "auto" allows, a fraction.'),
        Knob("stiffness", 0.1, 1e-4, meaning, excludes=(modulus,)),
    ]


class WeaklyCompressibleParameters(MaterialParameters):
    """Parameters of a fluid whose bulk modulus may be "auto"."""

    bulk_modulus: Positive | Literal["auto"] = Field(
        "auto",
        description='Bulk modulus K = density c^2, Pa; "auto" picks the softest that keeps the density '
        "variation under `compressibility` at the highest speed and load that can reach the body.",
    )
    compressibility: compressibility_of("bulk_modulus") = 0.01


class FluidParameters(WeaklyCompressibleParameters):
    """Parameters of the weakly compressible fluid."""

    hydrostatic = True

    law: Literal["fluid"] = "fluid"
    exponent: float = Field(
        1.0,
        ge=1,
        le=15,
        description="Exponent g of the equation of state p = K/g (J^-g - 1): 1 is linear in the density, "
        "7 the Tait equation of water.",
    )
    viscosity: Annotated[
        NotNegative, Knob("thickness", 1e-3, 1e2, "0 is water, 0.4 olive oil, 0.8 honey, 1 cold treacle")
    ] = Field(0.0, description="Shear (dynamic) viscosity, Pa s; water 1e-3.")
    bulk_viscosity: NotNegative = Field(
        0.0, description="Bulk viscosity, Pa s: resists changes of volume, and damps sound."
    )
    tension_cutoff: Flag = Field(
        True,
        description="Whether the fluid tears: it bears suction only until J is 1.005, and none without "
        "`volume_correction`. False holds droplets together by suction.",
    )
    volume_correction: Flag = Field(
        True,
        description="Whether fluid without tension follows the density that the grid sees, and must close up again "
        "before it bears pressure. Otherwise it gains volume in splashes and loses it when it is stirred.",
    )

    @property
    def relaxes(self) -> bool:
        """Whether J follows the density of the grid; a fluid with suction keeps its volume."""
        return self.tension_cutoff and self.volume_correction

    def shear_stress_at(self, rate: float, pressure: float) -> float:
        return self.viscosity * rate

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Replace "auto" by the softest bulk modulus for the speed and the load that can reach the body."""
        if self.bulk_modulus != "auto":
            return self, []
        modulus, note = soft_bulk_modulus(self.density, self.compressibility, bounds)
        return self.model_copy(update={"bulk_modulus": modulus}), [note]

    def volume_ratio_under(self, load: np.ndarray) -> np.ndarray:
        """Return J, (n,), where K/g (J^(1-g) - J) is `load`, (n,), Pa, by Newton's method; nan below CRUSHED."""
        g, strain = self.exponent, np.asarray(load, dtype=np.float64) / self.bulk_modulus
        if g == 1:
            return np.where(strain < 1, 1 - strain, np.nan)
        J = np.ones_like(strain)
        for _ in range(ITERATIONS_MAX):
            step = ((J ** (1 - g) - J) / g - strain) / (((g - 1) * J**-g + 1) / g)
            J = np.clip(J + step, J / 2, 2 * J)
            if np.all(np.abs(step) <= 1e-15 * J):
                break
        return np.where(J > CRUSHED, J, np.nan)


def soft_bulk_modulus(
    density: float, compressibility: float, bounds: SceneBounds, strength: float = 0.0
) -> tuple[float, str]:
    """Return K = p / compressibility, Pa, and a sentence that states it.

    The pressure p is the largest of density v^2, with v the highest speed, of the load by colliders, of what draws a
    stream together, and of the `strength`, Pa, under which the material at rest yields. The density is the largest of
    all bodies that can reach the fluid, because a denser one may press on it.

    The density of weakly compressible flow varies by v^2/c^2 (Monaghan 1994). A column released without
    compression reaches a pressure of 2 density g H = density v^2, the same bound. In a head-on impact on fluid or a
    wall the pressure briefly reaches density c v (water hammer), which varies the density by v/c.
    """
    speed = bounds.speed if bounds.speed > 0 else QUIET_SPEED
    dynamic = max(density, bounds.density) * speed**2
    # What requires more suction than one atmosphere tears in any case.
    drawn = bounds.drawn if bounds.drawn < 2 * ATMOSPHERE else 0.0
    pressure = max(dynamic, bounds.load, drawn, strength)
    modulus = min(max(pressure / compressibility, 1 / LARGEST), LARGEST)
    said = f"bulk_modulus = {modulus:.4g} Pa (sound speed {np.sqrt(modulus / density):.4g} m/s) lets the density "
    if pressure > dynamic:
        causes = {
            strength: "under which it yields",
            drawn: "at which a stream is drawn together",
            bounds.load: "with which colliders push the material",
        }
        said += f"vary by {100 * compressibility:.3g} % at {pressure:.4g} Pa"
        return modulus, f"{said}, the pressure {causes[pressure]}"
    impact = f"a hard impact at that speed reaches {100 * np.sqrt(compressibility):.3g} %"
    return modulus, (
        f"{said}of smooth flow vary by {100 * compressibility:.3g} % at the highest speed, {speed:.4g} m/s; {impact}"
    )


@ti.func
def relaxed_volume(J: float, seen: float, crossings: float, rate: float, opens: float):
    """Return J after relaxation towards `seen`, the value on the grid, and the part of its change that causes pressure.

    Above 1 J follows at once (docs/theory.md, 5.11); below, by the share `rate` while sound crosses a cell. Where
    `opens` is 0 the volume may not grow.
    """
    free = J
    if J >= 1.0:
        free = ti.max(J + opens * ti.max(seen - J - DEAD_BAND, 0.0) + ti.min(seen - J + FREE_DEAD_BAND, 0.0), 1.0)
    gap = ti.max(seen, ti.min(free, 1.0) - LARGEST_LACK) - free
    # At the density at rest there is no space to open: evenly spaced particles may bear pressure.
    room = ti.max(ti.min(gap, seen - 1.0) - DEAD_BAND, 0.0)
    change = opens * room + ti.min(gap + DEAD_BAND, 0.0)
    change *= rate * crossings / (1.0 + rate * crossings)
    change += opens * ti.max(ti.min(seen, 1.0) - LARGEST_LACK - free - change, 0.0)
    return free + change, ti.abs(change)


@ti.func
def shear_rate(C: ti.template()):
    """Return sqrt(2 D':D'), 1/s, D' the deviator in 3D of the symmetric part of C."""
    square = -2.0 / 3.0 * C.trace() ** 2
    for i, j in ti.static(ti.ndrange(C.n, C.n)):
        square += 0.5 * (C[i, j] + C[j, i]) ** 2
    return ti.sqrt(ti.max(square, 0.0))


@ti.func
def largest_suction(bulk_modulus: float, opening: float):
    """Return the suction, Pa, that a fluid with J - 1 = opening bears: it rises until it tears, and then falls."""
    strength = ti.min(TEARS * bulk_modulus, ATMOSPHERE)
    return ti.max(ti.min(bulk_modulus * opening, 2.0 * strength - bulk_modulus * opening), 0.0)


@ti.func
def opened_volume(J_minus_1: float, growth: float):
    """Return J - 1 after J grew by the factor 1 + growth, for material that stores its opening."""
    opened = J_minus_1 + (growth + growth * J_minus_1)
    # Comparisons with NaN are false, so that a lost particle stays not finite.
    if opened > OPENED - 1.0 and opened > J_minus_1:
        opened = ti.max(J_minus_1, OPENED - 1.0)
    return opened


@ti.data_oriented
class Fluid(Law):
    """p = K/g (J^-g - 1) and tau = -J p I + viscosity (C + C^T - (2/3) tr C I) + bulk_viscosity tr C I.

    With tension_cutoff, fluid that expands in a splash, J > 1, has no pressure. With volume_correction J stays there
    and follows the density of the grid, and there is suction until J = 1.01, and up to the viscous stress; without it
    J falls back to 1. Source: docs/theory.md, 5.2 and 5.11.
    """

    name = "fluid"
    parameters = FluidParameters
    deformation = "J"
    coherent = True
    flows = True
    shifts = True
    eases = (1.5, 1.8)

    def __init__(self, members: tuple[FluidParameters, ...], dimension: int) -> None:
        """Set the flags of the kernels by what any of the fluids has, or all of them have."""
        super().__init__(members, dimension)
        self.linear = all(member.exponent == 1 for member in members)
        self.viscous = any(member.viscosity > 0 or member.bulk_viscosity > 0 for member in members)
        self.relaxes = any(member.relaxes for member in members)
        self.all_relax = all(member.relaxes for member in members)
        self.cut = any(member.tension_cutoff for member in members)
        self.projects = any(member.tension_cutoff and not member.relaxes for member in members)
        self.grows_by_constants = self.relaxes and not self.all_relax
        cut = all(member.tension_cutoff for member in members)
        if not cut:
            # What coheres does not become weaker.
            self.eases = ()
        self.sensitivity = 0.0 if self.linear and cut else max(member.exponent for member in members)

    def constants(self, parameters: FluidParameters) -> tuple[float, ...]:
        largest = 1.0 if parameters.tension_cutoff and not parameters.relaxes else LARGEST
        return (
            parameters.bulk_modulus,
            parameters.exponent,
            parameters.viscosity,
            parameters.bulk_viscosity - 2 / 3 * parameters.viscosity,
            largest,
            (parameters.bulk_modulus / parameters.density) ** 0.5 if parameters.relaxes else 0.0,
        )

    def modes(self, parameters: FluidParameters, bound: StateBound) -> list[Mode]:
        """Return d K ((g - 1) J^(1-g) + J) / g for volume, with viscosity (2 - 2d/3) mu + d zeta, and 2 mu for shear.

        -J p changes by that K-term times tr(C) dt, and tr(C) is a sum of d entries. The term is convex in J,
        therefore largest at an end of its range. Strongly compressed bulk fluid is stiffer: K J^(1-g), see CARRIED.
        """
        d, g, K = self.dimension, parameters.exponent, parameters.bulk_modulus
        largest = min(bound.volume_ratio_max, 1.0 if parameters.tension_cutoff else LARGEST)
        ends = (max(min(bound.volume_ratio_min, largest), CRUSHED), max(largest, CRUSHED))
        stiffness = max(d * K * ((g - 1) * J ** (1 - g) + J) / g for J in ends)
        stiffness = max(stiffness, CARRIED * K * ends[0] ** (1 - g))
        volumetric = (2 - 2 * d / 3) * parameters.viscosity + d * parameters.bulk_viscosity
        modes = [Mode(stiffness, volumetric)]
        return modes + [Mode(0.0, 2 * parameters.viscosity)] * (parameters.viscosity > 0)

    def rebound_bound(self, bound: StateBound) -> StateBound:
        """Return the bound with the rebound from tension: J = 1.1 to about 1 / 1.1."""
        if self.cut or not bound.volume_ratio_max > 1:
            return super().rebound_bound(bound)
        smallest = min(bound.volume_ratio_min, 1 / bound.volume_ratio_max)
        return super().rebound_bound(replace(bound, volume_ratio_min=smallest))

    def rebound_stretch(self, J: float) -> float:
        """Return a bound on the J > 1 at which x - 1 - ln x is that of J: 1 + W + sqrt(2 W)."""
        W = J - 1 - math.log(J)
        return min(1 / J, 1 + W + math.sqrt(2 * W)) if self.linear else 1 / J

    def stored_energy(self, parameters: FluidParameters, deformation: np.ndarray) -> np.ndarray:
        J, g = np.maximum(deformation, CRUSHED), parameters.exponent
        if parameters.tension_cutoff:
            J = np.minimum(J, 1.0)
        other = -np.log(J) if g == 1 else (J ** (1 - g) - 1) / (g - 1)
        return parameters.bulk_modulus * (J - 1 + other) / g

    def stiffest(self, parameters: FluidParameters, bounds: SceneBounds) -> StateBound:
        """Return the compression by water hammer, density c v, and by the weight of the column."""
        c = (parameters.bulk_modulus / parameters.density) ** 0.5
        strain = bounds.speed / c + bounds.gravity * bounds.height / c**2
        largest = 1.0 if parameters.tension_cutoff else 1 + strain
        return StateBound(1 / (1 + strain), largest, largest**2)

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return tau and tau_zz, Pa, J, at most LARGEST_J if the law `projects`, and the internal variables."""
        J = deformation
        if ti.static(self.projects):
            J = ti.min(J, constants[LARGEST_J])
        # -J p, which is K (J - 1) for g = 1.
        spherical = constants[BULK_MODULUS] * (J - 1.0)
        if ti.static(not self.linear):
            crushed = J
            if J < CRUSHED:
                crushed = CRUSHED
            # 1 - J^-g, by the exponential of a small number.
            excess = -exp_minus_1(-constants[EXPONENT] * log(crushed))
            spherical = constants[BULK_MODULUS] * crushed * excess / constants[EXPONENT]
        if ti.static(self.relaxes):
            suction = largest_suction(constants[BULK_MODULUS], J - 1.0)
            if ti.static(self.viscous):
                suction = ti.max(suction, SUCTION * constants[VISCOSITY] * shear_rate(C))
            if ti.static(self.all_relax):
                spherical = ti.min(spherical, suction)
            elif constants[SOUND_SPEED] > 0.0:
                spherical = ti.min(spherical, suction)
        if ti.static(self.viscous):
            spherical += constants[SECOND_VISCOSITY] * C.trace()
        tau = spherical * ti.Matrix.identity(float, C.n)
        if ti.static(self.viscous):
            tau += constants[VISCOSITY] * (C + C.transpose())
        return tau, spherical, J, internal

    @ti.func
    def eased(self, tau: ti.template(), tau_zz: float, share: float):
        """Reduce the pressure, which `respond` returns as tau_zz in 3D, too; viscosity has its own bound."""
        return tau - (1.0 - share) * tau_zz * ti.Matrix.identity(float, tau.n), share * tau_zz

    @ti.func
    def released(self, deformation: ti.template(), share: float):
        # An opening causes hardly any stress.
        return ti.max(deformation, 1.0) + share * ti.min(deformation - 1.0, 0.0)

    @ti.func
    def grown(self, J_minus_1: float, growth: float, constants: ti.template()):
        result = J_minus_1 + (growth + growth * J_minus_1)
        if ti.static(self.all_relax):
            result = opened_volume(J_minus_1, growth)
        elif ti.static(self.relaxes):
            if constants[SOUND_SPEED] > 0.0:
                result = opened_volume(J_minus_1, growth)
        return result

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
        """Move J towards the value on the grid."""
        J, pressed = relaxed_volume(deformation, seen, constants[SOUND_SPEED] * time, RELAXATION, opens)
        return J, internal, pressed / J

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """K/g (J - 1 + (J^(1-g) - 1)/(g - 1)), and K (J - 1 - ln J) for g = 1; 0 without tension."""
        J = deformation
        if ti.static(self.relaxes):
            if constants[SOUND_SPEED] > 0.0:
                J = ti.min(J, 1.0)
        result = volume_energy(J)
        if ti.static(not self.linear):
            g = constants[EXPONENT]
            if g > 1.0:
                if J < CRUSHED:
                    J = CRUSHED
                # J^(1-g) - 1, by the exponential of a small number.
                power = exp_minus_1((1.0 - g) * log(J))
                result = (J - 1.0 + power / (g - 1.0)) / g
        return constants[BULK_MODULUS] * result


@ti.func
def volume_energy(J: float):
    """Return J - 1 - ln J without cancellation near 1: with y = x/(2 + x), ln(1 + x) = 2 (y + y^3/3 + ...)."""
    x = J - 1.0
    result = x - log(ti.max(J, 1e-9))
    if ti.abs(x) < 0.05:
        y = x / (2.0 + x)
        square = y * y
        result = y * (x - square * (2.0 / 3.0 + square * (2.0 / 5.0 + square * (2.0 / 7.0 + square * (2.0 / 9.0)))))
    return result


LAW = Fluid
