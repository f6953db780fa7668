"""What every constitutive law states: its parameters, its state, its response to deformation, and how stiff it is."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import taichi as ti

from mpmcli.scene.material import Internal, MaterialParameters, SceneBounds


@dataclass(frozen=True)
class StateBound:
    """How far the particles of one law have gone from rest, as bounds over all of them.

    Attributes:
        volume_ratio_min, volume_ratio_max: range of J, or of det F, as stored.
        stretch_squared_max: bound on the largest eigenvalue of b = F F^T (J^2 for a law that keeps J).
        internal: (smallest, largest) value of each internal variable, by name.
    """

    volume_ratio_min: float = 1.0
    volume_ratio_max: float = 1.0
    stretch_squared_max: float = 1.0
    internal: Mapping[str, tuple[float, float]] = field(default_factory=dict)


class Mode(NamedTuple):
    """One independent way in which an isolated particle answers a velocity gradient C.

    Attributes:
        stiffness: by how much tau changes per strain C dt, Pa: an eigenvalue of d tau / d(C dt).
        viscosity: by how much tau changes with C itself, Pa s: an eigenvalue of d tau / dC.
    """

    stiffness: float
    viscosity: float = 0.0


class Law(ABC):
    """One constitutive law for the particles of some bodies.

    A particle stores J or F (of a law with plastic flow: the elastic part) and the law's internal variables.
    A step deforms it, J <- J det(I + dt C) or F <- (I + dt C) F; the next one begins with `respond`, which
    returns the stress, and the state after plastic flow where there is any.

    Instances are handed to kernels as templates and compare by identity, so that two laws never share a
    compiled kernel. What no member needs, such as viscosity, is decided at construction and not compiled.

    Attributes:
        name: the word for it in a scene.
        parameters: the pydantic model of its parameters, which also lists its internal variables.
        deformation: what a particle stores, "J" (the volume ratio) or "F" (the deformation gradient).
        projects: whether `respond` may change the state.
        stiffness_parameters, viscosity_parameters: names of the parameters that set the stiffness and the viscosity;
            messages name the first that is a positive number. A law that calls them otherwise lists its own.
        coherent: whether the material resists being pulled apart, so that `check` reports a J far above 1.
        sensitivity: growth of the logarithm of the largest stiffness per strain that is stored: how closely the state
            is watched; 0 where none is stiffer than rest.
        hardening: the same growth by way of the internal variables, which are watched by themselves: 0 without any.
        members: parameters of the bodies that follow this law.
        dimension: 2 (plane strain) or 3.
        internal: the internal variables that a particle stores.
    """

    name: ClassVar[str]
    parameters: ClassVar[type[MaterialParameters]]
    deformation: ClassVar[Literal["J", "F"]]
    projects: bool = False
    coherent: ClassVar[bool] = False
    stiffness_parameters: ClassVar[tuple[str, ...]] = ("bulk_modulus", "youngs_modulus", "shear_modulus")
    viscosity_parameters: ClassVar[tuple[str, ...]] = ("viscosity", "consistency", "bulk_viscosity")
    sensitivity: float = 1.0
    hardening: float = 0.0

    def __init_subclass__(cls, **options: object) -> None:
        """Tell the parameters, which a scene checks before there is a law, what a particle stores."""
        super().__init_subclass__(**options)
        parameters = getattr(cls, "parameters", None)
        if isinstance(parameters, type) and issubclass(parameters, MaterialParameters):
            parameters.stores = getattr(cls, "deformation", parameters.stores)

    def __init__(self, members: Sequence[MaterialParameters], dimension: int) -> None:
        self.members = tuple(members)
        self.dimension = dimension
        self.internal: tuple[Internal, ...] = self.parameters.internal_in(dimension)

    @abstractmethod
    def constants(self, parameters: MaterialParameters) -> tuple[float, ...]:
        """Return the numbers that `respond` and `energy` read, in their order; one at least."""

    @staticmethod
    def first_set(parameters: MaterialParameters, names: Sequence[str]) -> tuple[str, float] | None:
        """Return the first of `names` that is a positive number among the parameters, with its value, or None."""
        values = ((name, getattr(parameters, name, None)) for name in names)
        return next(((name, value) for name, value in values if isinstance(value, int | float) and value > 0), None)

    @abstractmethod
    def modes(self, parameters: MaterialParameters, bound: StateBound) -> list[Mode]:
        """Return the modes of an isolated particle, each with the largest values over states within `bound`.

        The step is stable while dt^2 stiffness + 2 dt viscosity <= density h^2 for each (verification: 10.1).
        """

    def stiffest(self, parameters: MaterialParameters, bounds: SceneBounds) -> StateBound:
        """Return the state that the scene can drive the material to, for limits before the run.

        An impact at speed v strains an elastic material by about v / c, and a column H high by
        g H / c^2; a law whose stiffness grows otherwise, by hardening say, states its own.
        """
        stiffness = max(mode.stiffness for mode in self.modes(parameters, StateBound()))
        wave_speed = math.sqrt(stiffness / parameters.density)
        strain = bounds.speed / wave_speed + bounds.gravity * bounds.height / wave_speed**2
        return StateBound(1 / (1 + strain), 1 + strain, (1 + strain) ** 2)

    def total_volume_ratio(self, J: np.ndarray, internal: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return volume over volume at rest, (n,), of the stored J or det F and the internal variables, (n,) each."""
        return J

    @ti.func
    def respond(
        self, deformation: ti.template(), internal: ti.template(), C: ti.template(), dt: float, constants: ti.template()
    ):
        """Return (tau, tau_zz, deformation, internal): the stress, and the state after plastic flow.

        Args:
            deformation: J, or F as a d x d matrix, after the last step's deformation.
            internal: vector of the internal variables in their order; one meaningless 0 where there are none.
            C: velocity gradient, d x d, 1/s.
            dt: the step, s; only rates need it.
            constants: vector of what `constants` returned.

        Returns:
            tau = J sigma per volume at rest, d x d, Pa; its component out of the plane (0.0 in 3D); the
            deformation and the internal variables, as given or projected.
        """
        raise NotImplementedError

    @ti.func
    def energy(self, deformation: ti.template(), internal: ti.template(), constants: ti.template()):
        """Return the stored energy per volume at rest, J/m^3, of a state that `respond` returned."""
        raise NotImplementedError
