"""The base class of the parameters of every law."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mpmcli.scene.quantity import Positive


@dataclass(frozen=True)
class SceneBounds:
    """What a scene can reach, from its initial state alone.

    Attributes:
        dimension: 2 or 3.
        spacing: grid spacing h, m.
        gravity: magnitude of gravity, m/s^2.
        speed: highest speed that any particle can reach, m/s, from initial speeds and fall height.
        height: extent of the matter along gravity that can press on its lowest point, m.
        density: the largest at rest of any body, kg/m^3: what may press on the others.
    """

    dimension: int
    spacing: float
    gravity: float
    speed: float
    height: float
    density: float = 0.0


class Internal(NamedTuple):
    """One internal variable of a law, a number that each particle stores in addition to its deformation.

    Attributes:
        name: of the output field that shows it.
        at_rest: its value at the start, and in that field for particles of laws without it.
        description: what it is, with its unit.
        dimensions: where a particle has it.
    """

    name: str
    at_rest: float
    description: str
    dimensions: tuple[int, ...] = (2, 3)


class MaterialParameters(BaseModel):
    """Parameters of a constitutive law, as written in a scene; one subclass per law.

    A subclass narrows `law` to a Literal with a default and adds its own parameters, each with a
    range and a description that names its unit. Validation is strict: "1000" and true are no numbers.

    Attributes:
        internal: what a particle stores beside its deformation.
        stores: what it stores of its deformation, "J" or "F", as the law says that these parameters belong to.
        elastic: whether its stress is a function of F alone.
        hydrostatic: whether it is a fluid whose J follows from the pressure, by `volume_ratio_under`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    law: Annotated[str, Field(description="Name of the constitutive law.")]
    density: Annotated[Positive, Field(description="Density at rest, kg/m^3.")]

    internal: ClassVar[tuple[Internal, ...]] = ()
    stores: ClassVar[Literal["J", "F"]] = "F"
    elastic: ClassVar[bool] = False
    hydrostatic: ClassVar[bool] = False

    @classmethod
    def internal_in(cls, dimension: int) -> tuple[Internal, ...]:
        """Return the internal variables that a particle has in 2D or 3D."""
        return tuple(variable for variable in cls.internal if dimension in variable.dimensions)

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Return these parameters with every "auto" replaced, and a sentence for each choice."""
        return self, []

    def volume_ratio_under(self, load: np.ndarray) -> np.ndarray:
        """Return the J, (n,), at which the material at rest has J p = `load`, (n,), Pa; nan where none does."""
        raise NotImplementedError
