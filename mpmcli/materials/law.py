"""Base class of the constitutive laws: parameters, state, response to deformation, and stiffness."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene.material import Internal, MaterialParameters, SceneBounds
from mpmcli.scene.schema import NEARLY_INCOMPRESSIBLE

# In bulk the pressure itself adds stiffness, because particles carry it with them: the stiffness of pressure waves is
# the sum of the tangent modulus and the pressure (docs/theory.md, 6.6). For a fluid of p = K (1/J - 1) that is K at any
# J. At J = 0.5 and 0.3, where the sum exceeds the tangent modulus of a lone particle, one particle per cell at a random
# position becomes unstable at 0.956 and 0.969 of h/c, c = sqrt(K / density). The factor covers that.
CARRIED = 1.2
# Lower bound on J and on stretches, which keeps their logarithms finite.
SMALLEST = 1e-6


@dataclass(frozen=True)
class StateBound:
    """Bounds on the state of all particles of one law."""

    volume_ratio_min: float = 1.0  # range of J, or of det F, as stored
    volume_ratio_max: float = 1.0
    stretch_squared_max: float = 1.0  # of the largest eigenvalue of b = F F^T (J^2 for a law that keeps J)
    # The smallest and the largest value of each internal variable, by name.
    internal: Mapping[str, tuple[float, float]] = field(default_factory=dict)


class Mode(NamedTuple):
    """One eigenmode of the response of an isolated particle to a velocity gradient C (docs/theory.md, 6.1 and 6.2)."""

    stiffness: float  # eigenvalue of d tau / d(C dt), the change of stress per strain increment, Pa
    viscosity: float = 0.0  # eigenvalue of d tau / dC, the change of stress per velocity gradient, Pa s


def least_stretch(bound: StateBound, dimension: int) -> float:
    """Return a lower bound on the stretches within `bound`: the smallest J over the largest stretches."""
    largest = max(math.sqrt(max(bound.stretch_squared_max, 0.0)), SMALLEST)
    return min(max(bound.volume_ratio_min / largest ** (dimension - 1), SMALLEST), largest)


def principal(deformation: np.ndarray, dimension: int) -> np.ndarray:
    """Return the principal stretches, (n, d), of J, (n,), or F, (n, d, d): those of J are J^(1/d) each."""
    if deformation.ndim == 1:
        s = np.repeat(np.maximum(deformation, 0.0)[:, None] ** (1 / dimension), dimension, axis=1)
    else:
        s = np.linalg.svd(deformation, compute_uv=False)
    return np.maximum(s, SMALLEST)


def carried_stiffness(tangent: float, pressure: float) -> float:
    """Return the stiffness of a wave in compressed bulk, Pa: tangent modulus plus pressure (docs/theory.md, 6.6).

    The tangent modulus is that of a plane wave, d tau / d strain along its direction; the pressure the largest -tau_i.
    """
    return tangent + CARRIED * max(pressure, 0.0)


class Law(ABC):
    """One constitutive law for the particles of some bodies.

    A particle stores J or F (the elastic part of F if the law has plastic flow) and the internal variables of the law.
    A step deforms it, J <- J det(I + dt C) or F <- (I + dt C) F. The next step begins with `respond`, which
    returns the stress and the state after plastic flow.

    Instances are passed to kernels as templates and compare by identity, so that two laws never share a
    compiled kernel. Terms that no member needs, such as viscosity, are excluded at construction and not compiled.

    Attributes:
        name: value of `law` in a scene.
        parameters: pydantic model of the parameters, which also lists the internal variables.
        deformation: stored deformation, "J" (volume ratio) or "F" (deformation gradient).
        projects: whether `respond` may change the state.
        levels: whether particles of a cell take their mean volume in steps that relax volumes, unless f_bar is given.
        relaxes: whether `relax` moves the volume towards its value on the grid (docs/theory.md, 5.11).
        grows_by_constants: whether `grown` reads the constants.
        stiffness_parameters, viscosity_parameters: names of the parameters that set the stiffness and the viscosity;
            messages name the first that is a positive number. A law with other names lists its own.
        coherent: whether the material resists being pulled apart, so that `check` reports a J far above 1.
        locks: whether a body has a Poisson's ratio at which its changes of volume are averaged over cells by default
            (docs/theory.md, 4.4).
        flows: whether it is a liquid or grains, whose volume the ledger compares with the volume filled on the grid.
        shifts: whether particles are shifted out of crowds (docs/theory.md, 5.12).
        eases: in 2D and 3D, the bound on its step over that of a lone particle, if its stress is reduced where few
            particles share nodes (docs/theory.md, 6.1); empty for other laws.
        opens_at_surfaces: whether `relax` applies near free surfaces, too, compared with the density below a plane one.
        lost: fraction of the motion not resolved by nodes that it loses in a step of its own (docs/theory.md, 2.3).
        elastic: whether the stress is a function of F alone, so that the body can be computed on the grid of its state
            at rest (docs/theory.md, 2.6).
        sensitivity: growth of the logarithm of the largest stiffness per stored strain, dimensionless. It sets how
            often the state is measured during a run; 0 if no state is stiffer than rest (docs/theory.md, 6.7).
        hardening: the same growth caused by the internal variables, which are measured separately; 0 without any.
        members: parameters of the bodies that follow this law.
        dimension: 2 (plane strain) or 3.
        internal: the internal variables that a particle stores.
    """

    name: ClassVar[str]
    parameters: ClassVar[type[MaterialParameters]]
    deformation: ClassVar[Literal["J", "F"]]
    projects: bool = False
    levels: ClassVar[bool] = False
    relaxes: bool = False
    grows_by_constants: bool = False
    coherent: ClassVar[bool] = False
    flows: ClassVar[bool] = False
    shifts: ClassVar[bool] = False
    eases: tuple[float, ...] = ()
    opens_at_surfaces: ClassVar[bool] = False
    lost: ClassVar[float] = 1.0
    elastic: ClassVar[bool] = False
    stiffness_parameters: ClassVar[tuple[str, ...]] = ("bulk_modulus", "youngs_modulus", "shear_modulus")
    viscosity_parameters: ClassVar[tuple[str, ...]] = ("viscosity", "consistency", "bulk_viscosity")
    sensitivity: float = 1.0
    hardening: float = 0.0

    def __init_subclass__(cls, **options: object) -> None:
        """Copy the attributes for scene checks to the parameter class, because no instance of the law exists yet."""
        super().__init_subclass__(**options)
        parameters = getattr(cls, "parameters", None)
        if isinstance(parameters, type) and issubclass(parameters, MaterialParameters):
            parameters.stores = getattr(cls, "deformation", parameters.stores)
            parameters.elastic = cls.elastic

    def __init__(self, members: Sequence[MaterialParameters], dimension: int) -> None:
        self.members = tuple(members)
        self.dimension = dimension
        self.internal: tuple[Internal, ...] = self.parameters.internal_in(dimension)
        ratios = [getattr(member, "poissons_ratio", 0.0) for member in members]
        self.locks = max(ratios, default=0.0) > NEARLY_INCOMPRESSIBLE and not self.flows
        self.surfaced = any(member.has_surface for member in members)

    @property
    def terms(self) -> tuple[tuple[str, bool], ...]:
        """Name and value of each flag that selects terms of the law; laws with equal flags share one kernel."""
        return tuple(sorted((name, value) for name, value in vars(self).items() if isinstance(value, bool)))

    @abstractmethod
    def constants(self, parameters: MaterialParameters) -> tuple[float, ...]:
        """Return the constants passed to `respond` and `energy`, in their order; at least one."""

    @staticmethod
    def first_set(parameters: MaterialParameters, names: Sequence[str]) -> tuple[str, float] | None:
        """Return the first of `names` that is a positive number among the parameters, with its value, or None."""
        values = ((name, getattr(parameters, name, None)) for name in names)
        return next(((name, value) for name, value in values if isinstance(value, int | float) and value > 0), None)

    @abstractmethod
    def modes(self, parameters: MaterialParameters, bound: StateBound) -> list[Mode]:
        """Return the modes of an isolated particle, each with its largest values over states within `bound`.

        The step is stable if dt^2 stiffness + 2 dt viscosity <= density h^2 for each mode (docs/theory.md, 6.1).
        """

    @property
    def relief(self) -> float:
        """The stiffness of a lone particle over that which it has left."""
        return self.eases[self.dimension - 2] ** 2 if self.eases else 1.0

    def reference_modes(self, parameters: MaterialParameters, bound: StateBound) -> list[Mode]:
        """Return the modes of an isolated particle on the grid of the state at rest: of dP/dF (docs/theory.md, 6.9).

        Only elastic laws have them.
        """
        raise NotImplementedError

    def rebound_bound(self, bound: StateBound) -> StateBound:
        """Return the bound that also contains rebounding states.

        A lone particle that is compressed to J and released opens to `rebound_stretch` and oscillates between the two
        for ever; the step must be stable for both (docs/theory.md, 6.8).
        """
        if not 0 < bound.volume_ratio_min < 1:
            return bound
        opened = self.rebound_stretch(bound.volume_ratio_min)
        return replace(
            bound,
            volume_ratio_max=max(bound.volume_ratio_max, opened),
            stretch_squared_max=max(bound.stretch_squared_max, opened ** (2 / self.dimension)),
        )

    def rebound_stretch(self, J: float) -> float:
        """Return the J > 1 with about the energy of a volume ratio J, 0 < J < 1: 1 / J for an energy of ln J."""
        return 1 / J

    def stored_energy(self, parameters: MaterialParameters, deformation: np.ndarray) -> np.ndarray:
        """Return a bound on the stored energy of initial states, (n,), J/m^3 of volume at rest, on the host.

        It is S |e|^2 / 2 with the largest stiffness S between rest and the state, and e the logarithms of its
        stretches; the deformation is J, (n,), or F, (n, d, d), finite. A law whose energy has a short formula overrides
        this method.
        """
        s = principal(deformation, self.dimension)
        J = s.prod(axis=1)
        ends = (min(1.0, J.min(initial=1.0)), max(1.0, J.max(initial=1.0)), max(1.0, s.max(initial=1.0) ** 2))
        stiffness = max(mode.stiffness for mode in self.modes(parameters, StateBound(*map(float, ends))))
        return 0.5 * stiffness * (np.log(s) ** 2).sum(axis=1)

    def stiffest(self, parameters: MaterialParameters, bounds: SceneBounds) -> StateBound:
        """Return bounds on the state that the scene can reach, for limits before the run.

        An impact at speed v strains an elastic material by about v / c, and the weight of a column of height H by
        g H / c^2. A law whose stiffness grows in another way, such as hardening, overrides this method.
        """
        stiffness = max(mode.stiffness for mode in self.modes(parameters, StateBound()))
        wave_speed = math.sqrt(stiffness / parameters.density)
        strain = bounds.speed / wave_speed + bounds.gravity * bounds.height / wave_speed**2
        return StateBound(1 / (1 + strain), 1 + strain, (1 + strain) ** 2)

    def total_volume_ratio(self, J: np.ndarray, internal: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the ratio of volume to volume at rest, (n,), from the stored J or det F and the internal variables."""
        return J

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return (tau, tau_zz, deformation, internal): the stress, and the state after plastic flow.

        Args:
            deformation: J, or F as a d x d matrix, after the deformation of the last step.
            internal: vector of the internal variables in their order; a single unused 0 if there are none.
            C: velocity gradient, d x d, 1/s; read by viscous laws.
            dt: time over which plastic flow is integrated, s, the `kick` of a step; read if the flow depends on rate.
            constants: vector of the values that `constants` returned.

        Returns:
            Kirchhoff stress tau = J sigma, d x d, Pa; its out-of-plane component (0.0 in 3D), Pa; the deformation
            and the internal variables, unchanged or after the return mapping.
        """
        raise NotImplementedError

    @ti.func
    def grown(self, J_minus_1: float, growth: float, constants: ti.template()):
        """Return J - 1 after J grew by the factor 1 + growth in a step, for laws that keep J.

        Args:
            constants: as for `respond` if `grows_by_constants`, else a single unused 0.
        """
        return J_minus_1 + (growth + growth * J_minus_1)

    @ti.func
    def eased(self, tau: ti.template(), tau_zz: float, share: float):
        """Return tau and tau_zz of a particle that bears a share of its stress."""
        return share * tau, share * tau_zz

    @ti.func
    def released(self, deformation: ti.template(), share: float):
        """Return the state with a share of the strain that causes stress. Only laws with `eases` have this method."""
        raise NotImplementedError

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
        """Return (deformation, internal, change), moved towards the volume on the grid, at equal momentum and mass.

        The change is the absolute change of the logarithm of the volume, as far as it affects the stiffness. Only laws
        with `relaxes` have this method.

        Args:
            deformation, internal, constants: as for `respond`.
            seen: volume ratio from the density of the grid around the particle. opens: fraction of `seen` to which the
                volume may grow. It is 1, and 0 near a free surface, where the density of the grid is too small; with
                `opens_at_surfaces` it is the filled fraction of dense material there. time: time since the last
                relaxation over the cell's width, s/m; times the speed of sound it is the number of cells that sound
                has crossed.
        """
        raise NotImplementedError

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """Return the stored energy per volume at rest, J/m^3, for a state that `respond` returned."""
        raise NotImplementedError

    @ti.func
    def wave_modulus(self, constants: ti.template()):
        """Return the modulus of pressure waves at rest, lambda + 2 mu, Pa. Only elastic laws have it."""
        raise NotImplementedError
