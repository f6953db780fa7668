"""Parameters of a law: their model, the knobs that set them, and their units."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mpmcli.scene.quantity import Positive


@dataclass(frozen=True)
class Knob:
    """A named key of a scene, from 0 to 1, that sets one parameter of a law.

    It belongs to the metadata of that parameter:
    `viscosity: Annotated[NotNegative, Knob("thickness", 1e-3, 1e2, "...")] = Field(0.0, description=...)`.

    Attributes:
        name: the key in a scene.
        low: value of the parameter at position 0, in its own unit.
        high: value at position 1; below `low` where the word means less of the parameter.
        meaning: description of some positions, a sentence without its full stop.
        scale: equal steps of a logarithmic knob multiply the parameter; those of a linear one add to it.
        excludes: other parameters that set the same quantity; it is an error to give one of them with the knob.
    """

    name: str
    low: float
    high: float
    meaning: str
    scale: Literal["logarithmic", "linear"] = "logarithmic"
    excludes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.scale == "logarithmic" and min(self.low, self.high) <= 0:
            raise ValueError(f'The knob "{self.name}" is logarithmic, so both of its ends must be greater than 0.')

    def value(self, position: float) -> float:
        """Return the parameter at a position from 0 to 1; exactly `low` and `high` at the ends."""
        if self.scale == "linear":
            return float(self.low * (1 - position) + self.high * position)
        return float(self.low ** (1 - position) * self.high**position)

    def position(self, value: float) -> float | None:
        """Return the position of the knob for a value of the parameter, or None if the value is beyond its ends."""
        low, high, x = self.low, self.high, value
        if not min(low, high) <= x <= max(low, high):
            return None
        if self.scale == "logarithmic":
            low, high, x = math.log(low), math.log(high), math.log(x)
        return (x - low) / (high - low)

    def reach(self, unit: str) -> str:
        """Write the parameter at both ends, and the scale: `0.001 to 100 Pa s, logarithmic`."""
        return f"{f'{self.low:g} to {self.high:g} {unit}'.rstrip()}, {self.scale}"


def knobs_of(model: type[BaseModel]) -> dict[str, tuple[str, Knob]]:
    """Return (parameter, knob) of every knob of a parameter model, by the knob's name."""
    return {
        entry.name: (parameter, entry)
        for parameter, field in model.model_fields.items()
        for entry in field.metadata
        if isinstance(entry, Knob)
    }


# After a comma: kg/m^3, Pa s, degrees, ...; then the sentence ends, or continues after a punctuation mark.
_SYMBOL = r"(?:kg|Pa|mol|degrees|rad|[mskJNKW1])(?:\^(?:-?\d+|n))?"
_UNIT = re.compile(rf", ({_SYMBOL}(?:[ /]{_SYMBOL})*)(?=[.,;:)]|$)")


def unit_of(description: str | None) -> str:
    """Return the unit in a description such as "Viscosity, Pa s; water 1e-3.", or "" where it names none."""
    found = _UNIT.search(description or "")
    return found[1] if found else ""


@dataclass(frozen=True)
class SceneBounds:
    """Bounds on the state that a scene can reach, from its initial state alone.

    Attributes:
        dimension: 2 or 3.
        spacing: grid spacing h, m.
        gravity: magnitude of gravity, m/s^2.
        speed: highest speed that any particle can reach, m/s, from initial speeds and fall height.
        height: extent of the matter along gravity that can press on its lowest point, m.
        density: largest density at rest of any body, kg/m^3, for the pressure on the others.
        load: largest pressure with which colliders push the material, Pa.
        drawn: twice the largest suction that draws a stream together where it begins to fall, Pa.
    """

    dimension: int
    spacing: float
    gravity: float
    speed: float
    height: float
    density: float = 0.0
    load: float = 0.0
    drawn: float = 0.0


class Internal(NamedTuple):
    """One internal variable of a law, a number that each particle stores in addition to its deformation.

    Attributes:
        name: of the output field that shows it.
        at_rest: its value at the start, and in that field for particles of laws without it.
        description: what it is, with its unit.
        dimensions: dimensions of scenes in which a particle has it.
    """

    name: str
    at_rest: float
    description: str
    dimensions: tuple[int, ...] = (2, 3)


class MaterialParameters(BaseModel):
    """Parameters of a constitutive law, as written in a scene; one subclass per law.

    A subclass narrows `law` to a Literal with a default and adds its own parameters, each with a
    range and a description that names its unit. Validation is strict: "1000" and true are not numbers.

    Attributes:
        sets: for each parameter that is an alias, the name of the law's parameter.
        internal: variables that a particle stores besides its deformation.
        stores: the stored deformation measure, "J" or "F", as for the law of these parameters.
        elastic: whether its stress is a function of F alone.
        hydrostatic: whether it is a fluid whose J follows from the pressure, by `volume_ratio_under`.
        solid: whether a body of it keeps its shape, so that it stays in place.
        usual_sampling: of its bodies; "turned" where it flows far and its particles are not shifted.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    law: str = Field(description="Name of the constitutive law.")
    density: Positive = Field(description="Density at rest, kg/m^3.")

    sets: ClassVar[Mapping[str, str]] = {}
    internal: ClassVar[tuple[Internal, ...]] = ()
    stores: ClassVar[Literal["J", "F"]] = "F"
    elastic: ClassVar[bool] = False
    hydrostatic: ClassVar[bool] = False
    solid: ClassVar[bool] = False
    usual_sampling: ClassVar[Literal["lattice", "turned"]] = "lattice"

    @classmethod
    def internal_in(cls, dimension: int) -> tuple[Internal, ...]:
        """Return the internal variables that a particle has in 2D or 3D."""
        return tuple(variable for variable in cls.internal if dimension in variable.dimensions)

    @property
    def has_surface(self) -> bool:
        """Whether the particles of a body may represent its surface, at which it separates from others."""
        return self.elastic

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Return these parameters with every "auto" replaced, and a sentence for each choice."""
        return self, []

    def shear_stress_at(self, rate: float, pressure: float) -> float:
        """Return the shear stress, Pa, at which it flows at a shear rate, 1/s, and a pressure, Pa; 0 of solids."""
        return 0.0

    def volume_ratio_under(self, load: np.ndarray) -> np.ndarray:
        """Return the J, (n,), at which the material at rest has J p = `load`, (n,), Pa; nan where there is none."""
        raise NotImplementedError


Laws = tuple[type[MaterialParameters], ...]
