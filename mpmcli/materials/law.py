"""What every constitutive law states, once for the host and once for the kernels."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import taichi as ti

from mpmcli.scene.material import MaterialParameters


@dataclass(frozen=True)
class StateBound:
    """How far the particles of one law have gone from rest, as bounds over all of them.

    Attributes:
        volume_ratio_min, volume_ratio_max: range of J = det F.
        stretch_squared_max: bound on the largest eigenvalue of b = F F^T (J^2 for a law that keeps J).
    """

    volume_ratio_min: float = 1.0
    volume_ratio_max: float = 1.0
    stretch_squared_max: float = 1.0


class Law(ABC):
    """One constitutive law: parameters, state, stress, energy and stiffness.

    Instances are handed to kernels as templates and compare by identity, so that two laws never
    share a compiled kernel.

    Attributes:
        name: the word for it in a scene.
        parameters: the pydantic model of its parameters.
        deformation: what a particle stores, "J" (the volume ratio) or "F" (the deformation gradient).
    """

    name: ClassVar[str]
    parameters: ClassVar[type[MaterialParameters]]
    deformation: ClassVar[Literal["J", "F"]]

    @abstractmethod
    def constants(self, parameters: MaterialParameters) -> tuple[float, ...]:
        """Return the numbers that `kirchhoff_stress` reads, in its order."""

    @abstractmethod
    def stiffness(self, parameters: MaterialParameters, bound: StateBound, dimension: int) -> float:
        """Return the largest eigenvalue of d tau / d(velocity gradient dt), Pa, over states within `bound`.

        It is what an isolated particle feels: its step limit is h sqrt(density / stiffness).
        """

    @abstractmethod
    def cauchy_stress(self, parameters: MaterialParameters, deformation: np.ndarray) -> np.ndarray:
        """Return the Cauchy stress (n, 3, 3), Pa, of J (n,) or F (n, d, d); plane strain in 2D."""

    @abstractmethod
    def energy_density(self, parameters: MaterialParameters, deformation: np.ndarray) -> np.ndarray:
        """Return the stored energy per volume at rest (n,), J/m^3, of J (n,) or F (n, d, d)."""

    @ti.func
    def kirchhoff_stress(self, deformation: ti.template(), C: ti.template(), constants: ti.template()):
        """Return tau = J sigma, d x d, Pa, of J or F and the velocity gradient C (1/s)."""
        raise NotImplementedError
