"""How a validation case is computed: every choice that trades speed against error."""

from dataclasses import dataclass, fields
from typing import Any

# What a scene takes where it says nothing: `solver_table` leaves these out.
SCENE_DEFAULTS = {"precision": "f32", "kernel": "quadratic", "transfer": "apic", "walls": "folded"}


@dataclass(frozen=True)
class Setting:
    """One choice of every knob; the defaults are those of a scene, but in double precision.

    Attributes:
        precision: "f32" or "f64".
        kernel: "quadratic" or "cubic".
        transfer: "apic", "pic" or "aflip".
        walls: "folded" or "zeroed".
        per_axis: particles per cell and axis.
        safety: fraction of the stability limit that a step takes.
    """

    precision: str = "f64"
    kernel: str = "quadratic"
    transfer: str = "apic"
    walls: str = "folded"
    per_axis: int = 2
    safety: float = 0.8

    def solver_table(self) -> dict[str, Any]:
        """Return the table [solver] of a scene, without what is its default."""
        return {key: getattr(self, key) for key, usual in SCENE_DEFAULTS.items() if getattr(self, key) != usual}

    def particles_per_cell(self, dimension: int) -> int:
        """Return particles per cell, as a body states them."""
        return self.per_axis**dimension

    def changed_from(self, other: "Setting") -> dict[str, Any]:
        """Return what is chosen differently than in another setting, by name."""
        names = [field.name for field in fields(self)]
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(other, name)}
