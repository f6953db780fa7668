"""A validation case: a problem with a known solution, its scene at any resolution, and its error measures."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.validation.setting import Setting

Level = Literal["coarse", "default", "fine"]
Frames = Iterable[tuple[Frame, LedgerRow]]


def elastic(law: str, density: float, youngs_modulus: float, poissons_ratio: float, **more: float) -> dict[str, Any]:
    """Return the table of a material with elastic moduli and further parameters, in SI units."""
    moduli = {"youngs_modulus": youngs_modulus, "poissons_ratio": poissons_ratio}
    return {"law": law, "density": density, **moduli, **more}


def unbounded(n: int) -> float:
    """Return an infinite bound."""
    return math.inf


def rounded(n: int) -> float:
    """Return what most values may come to by rounding in single precision."""
    return 1e-4


@dataclass(frozen=True)
class Measure:
    """A scalar that a case computes from the frames of a run.

    Attributes:
        name: two or three words.
        unit: "" for a fraction.
        text: definition, in one sentence.
        bound: (n) -> the largest admissible |value| at resolution n, with the default setting in double precision.
        order: the smallest admissible order of convergence of |value| between the two finest resolutions; None for no
            requirement.
        expected: the theoretical order, shown in the report; None if there is none.
        order_to: the finest resolution used for the order; None for all. At finer ones another error dominates, as the
            note of the case explains.
        single: (n) -> the |value| that rounding alone may make in single precision, where a larger one may be 1.2
            times that of double precision.
    """

    name: str
    unit: str
    text: str
    bound: Callable[[int], float] = unbounded
    order: float | None = None
    expected: float | None = None
    order_to: int | None = None
    single: Callable[[int], float] = rounded

    def has_order_at(self, n: int) -> bool:
        """Return whether resolution n is used for the order."""
        return self.order_to is None or n <= self.order_to


class Case(ABC):
    """A problem with a known solution.

    Attributes:
        name: identifier on the command line.
        title: heading in the report.
        group: chapter of the report.
        source: reference of the problem and its solution.
        resolution: what n counts, such as "cells along the bar".
        levels: the resolutions of each level, from coarse to fine.
        measures: the measures; the first one is the error of the case.
        varies: the fields of `Setting` that are varied.
        finer: factor on the particles per cell and axis of the setting.
        solids: grid of elastic bodies, as in a scene; f_bar: whether volumes are averaged over cells, as in a scene.
        note: remarks on the result, such as the origin of a bound; may be "".
    """

    name: ClassVar[str]
    title: ClassVar[str]
    group: ClassVar[Literal["solids", "fluids", "plastic", "invariants"]]
    source: ClassVar[str]
    resolution: ClassVar[str]
    levels: ClassVar[dict[Level, tuple[int, ...]]]
    measures: ClassVar[tuple[Measure, ...]]
    varies: ClassVar[tuple[str, ...]] = ("precision", "kernel", "transfer", "walls", "per_axis", "safety")
    finer: ClassVar[int] = 1
    solids: str = "updated"
    f_bar: ClassVar[bool | str] = "auto"
    note: ClassVar[str] = ""

    @abstractmethod
    def tables(self, n: int) -> dict[str, Any]:
        """Return the problem at resolution n, as the tables of a scene; `scene_tables` adds those of the setting."""

    def scene_tables(self, n: int, setting: Setting) -> dict[str, Any]:
        """Return the scene at resolution n, as the tables of a TOML file."""
        tables = self.tables(n)
        per_cell = (self.finer * setting.per_axis) ** len(tables["domain"]["size"])
        return {
            "title": self.title,
            **tables,
            "time": {**tables["time"], "safety": setting.safety},
            "solver": setting.solver_table()
            | ({"solids": "total"} if self.solids == "total" else {})
            | ({"f_bar": self.f_bar} if self.f_bar != "auto" else {}),
            "bodies": [{**body, "particles_per_cell": per_cell} for body in tables["bodies"]],
        }

    @abstractmethod
    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the value of each measure by name.

        Args:
            frames: the frames and ledger rows of a run of the scene, consumed in order.
        """
