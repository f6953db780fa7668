"""What a scene says of a material: the base class of every law's parameters."""

from dataclasses import dataclass
from typing import Annotated, Self

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
    """

    dimension: int
    spacing: float
    gravity: float
    speed: float
    height: float


class MaterialParameters(BaseModel):
    """Parameters of a constitutive law, as written in a scene; one subclass per law.

    A subclass narrows `law` to a Literal with a default and adds its own parameters, each with a
    range and a description that names its unit. Validation is strict: "1000" and true are no numbers.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    law: Annotated[str, Field(description="Name of the constitutive law.")]
    density: Annotated[Positive, Field(description="Density at rest, kg/m^3.")]

    def resolve(self, bounds: SceneBounds) -> tuple[Self, list[str]]:
        """Return these parameters with every "auto" replaced, and a sentence for each choice."""
        return self, []
