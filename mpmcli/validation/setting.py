"""Numerical settings of a validation run, which trade speed against error."""

from dataclasses import dataclass, fields
from typing import Any

# Defaults of a scene, omitted by `solver_table`.
SCENE_DEFAULTS = {"precision": "f32", "kernel": "quadratic", "transfer": "apic", "walls": "folded"}


@dataclass(frozen=True)
class Setting:
    """Numerical settings. The defaults are those of a scene, except for double precision.

    Attributes:
        precision: "f32" or "f64".
        kernel: "quadratic" or "cubic".
        transfer: "apic", "pic" or "aflip".
        walls: "folded" or "zeroed".
        per_axis: particles per cell and axis.
        safety: time step over the stability limit (Courant fraction).
    """

    precision: str = "f64"
    kernel: str = "quadratic"
    transfer: str = "apic"
    walls: str = "folded"
    per_axis: int = 2
    safety: float = 0.8

    def solver_table(self) -> dict[str, Any]:
        """Return the table [solver] of a scene, without entries at their default."""
        return {key: getattr(self, key) for key, usual in SCENE_DEFAULTS.items() if getattr(self, key) != usual}

    def changed_from(self, other: "Setting") -> dict[str, Any]:
        """Return the fields that differ from those of another setting, by name."""
        names = [field.name for field in fields(self)]
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(other, name)}
