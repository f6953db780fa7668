"""Knobs: parameters of a law in the language of the phenomenon, each from 0 to 1 on a documented scale."""

import math
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel


@dataclass(frozen=True)
class Knob:
    """A word, and a position from 0 to 1, for one parameter of a law.

    It is an entry of the metadata of that parameter, after its range:
    `viscosity: Annotated[NotNegative, Field(description=...), Knob("thickness", 1e-3, 1e2, "...")] = 0.0`.

    Attributes:
        name: the key that a scene says.
        low: value of the parameter at position 0, in its own unit.
        high: value at position 1; below `low` where the word means less of the parameter.
        meaning: what some positions are like, a sentence without its full stop.
        scale: equal steps of a logarithmic knob multiply the parameter, of a linear one add to it.
        excludes: further parameters that settle the same thing, so that the knob is refused beside them.
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
        """Return where the knob stands for a value of the parameter, or None where that is beyond its ends."""
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
