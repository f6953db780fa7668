"""A validation case: a problem with a known solution, its scene at any resolution, and its error measures."""

import math
import re
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.resources import files
from typing import Any, ClassVar, Literal

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene

Tables = dict[str, Any]  # tables of a scene, as in a TOML file
Level = Literal["coarse", "default", "fine"]
Levels = dict[Level, tuple[int, ...]]
Frames = Iterable[tuple[Frame, LedgerRow]]
# Format of the definition of a measure.
DEFINITION = re.compile(r"(?P<name>[^(:]+?)(?: \((?P<unit>.+?)\))?: (?P<text>.+)")
# Values of each field of `Setting` in the validation, and their labels.
KNOBS: dict[str, dict[object, str]] = {
    "precision": {"f64": "f64", "f32": "f32"},
    "kernel": {"quadratic": "quadratic kernel", "cubic": "cubic kernel"},
    "transfer": {"apic": "APIC", "aflip": "AFLIP"},
    "per_axis": {1: "1 particle per axis", 2: "2 particles per axis", 3: "3 particles per axis"},
    "safety": {value: f"Courant fraction {value:g}" for value in (0.1, 0.2, 0.4, 0.8, 0.95)},
}


@dataclass(frozen=True)
class Setting:
    """Numerical settings. The defaults are those of a scene, except for double precision.

    `per_axis` is the number of particles per cell and axis, `safety` the ratio of the time step to the stability limit
    (Courant fraction).
    """

    precision: str = "f64"
    kernel: str = "quadratic"
    transfer: str = "apic"
    per_axis: int = 2
    safety: float = 0.8

    @property
    def label(self) -> str:
        """Differences from the default setting, or "default"."""
        changed = [(knob, value) for knob, value in asdict(self).items() if value != getattr(Setting(), knob)]
        return ", ".join(KNOBS[knob].get(value, f"{knob} {value}") for knob, value in changed) or "default"


@dataclass(frozen=True)
class Measure:
    """A scalar that a case computes from the frames of a run; limit and rounding may be functions of n."""

    definition: str  # "name (unit): One sentence.", without the unit for a fraction; the name has two or three words
    # The largest admissible |value| with the default setting in double precision.
    limit: float | Callable[[int], float] = math.inf
    # The smallest admissible order of convergence of |value| between the two finest resolutions.
    order: float | None = None
    expected: float | None = None  # the theoretical order, shown in the report
    # The finest resolution used for the order. At finer ones another error dominates; see the note of the case.
    order_to: float = math.inf
    # The |value| that rounding alone may cause in single precision; the bound is 1.2 times this or that in double.
    rounding: float | Callable[[int], float] = 1e-4

    name: str = field(init=False)
    unit: str = field(init=False)
    text: str = field(init=False)

    def __post_init__(self) -> None:
        for part, value in DEFINITION.fullmatch(self.definition).groupdict("").items():
            object.__setattr__(self, part, value)

    def bound(self, n: int) -> float:
        """Return the largest admissible |value| at resolution n."""
        return self.limit(n) if callable(self.limit) else self.limit

    def rounding_at(self, n: int) -> float:
        """Return the |value| that rounding alone may cause in single precision at resolution n."""
        return self.rounding(n) if callable(self.rounding) else self.rounding

    @property
    def unit_suffix(self) -> str:
        """The unit after a space, or an empty string."""
        return f" {self.unit}" if self.unit else ""


@dataclass(frozen=True)
class CaseText:
    """Text of a case in the report, from `page/cases.toml`; `measures` maps "name" or "name (unit)" to a sentence."""

    source: str = ""
    resolution: str = ""
    note: str = ""
    measures: dict[str, str] = field(default_factory=dict)

    def measure(self, name: str, *bounds: Any, **more: Any) -> Measure:
        """Return the measure "name" or "name (unit)" with its sentence; other arguments are those of `Measure`."""
        return Measure(f"{name}: {self.measures[name]}", *bounds, **more)

    def filled(self, **facts: Any) -> "CaseText":
        """Return the text with the {names} in its note and its sentences replaced by facts."""
        measures = {name: sentence.format(**facts) for name, sentence in self.measures.items()}
        return replace(self, note=self.note.format(**facts), measures=measures)


def case_text(name: str) -> CaseText:
    """Return the text of a case, or of a group of cases that share it."""
    return CaseText(**_texts()[name])


@cache
def _texts() -> dict[str, dict]:
    return tomllib.loads(files("mpmcli.validation").joinpath("page/cases.toml").read_text(encoding="utf-8"))


class Case(ABC):
    """A problem with a known solution."""

    name: ClassVar[str]  # on the command line
    title: ClassVar[str]  # heading in the report
    group: ClassVar[Literal["solids", "fluids", "plastic", "invariants"]]  # chapter of the report
    source: ClassVar[str]  # reference of the problem and its solution
    resolution: ClassVar[str]  # what n counts, such as "cells along the bar"
    levels: ClassVar[Levels]  # the resolutions of each level, from coarse to fine
    measures: ClassVar[tuple[Measure, ...]]  # the first one is the error of the case
    # The fields of `Setting` that are varied.
    varies: ClassVar[tuple[str, ...]] = ("precision", "kernel", "transfer", "per_axis", "safety")
    finer: ClassVar[int] = 1  # factor on the particles per cell and axis of the setting
    solids: str = "updated"  # grid of elastic bodies, as in a scene
    f_bar: ClassVar[bool | str] = "auto"  # whether volume changes are averaged over cells, as in a scene
    note: ClassVar[str] = ""  # remarks on the result, such as the origin of a bound

    text: ClassVar[CaseText]  # if a class has it, its source, resolution and note become those of the case

    def __init_subclass__(cls) -> None:
        for name in ("source", "resolution", "note"):
            if value := getattr(vars(cls).get("text"), name, ""):
                setattr(cls, name, value)

    @abstractmethod
    def tables(self, n: int) -> Tables:
        """Return the tables of the scene at resolution n without the setting, which `scene_tables` adds."""

    def scene_tables(self, n: int, setting: Setting) -> Tables:
        """Return the scene at resolution n, as the tables of a TOML file."""
        tables = self.tables(n)
        per_cell = (self.finer * setting.per_axis) ** len(tables["domain"]["size"])
        schemes = {name: getattr(setting, name) for name in ("precision", "kernel", "transfer")}
        return {
            "title": self.title,
            **tables,
            "time": {**tables["time"], "safety": setting.safety},
            "solver": {**schemes, "solids": self.solids, "f_bar": self.f_bar},
            "bodies": [{**body, "particles_per_cell": per_cell} for body in tables["bodies"]],
        }

    @abstractmethod
    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the value of each measure by name. The frames of a run of the scene are consumed in order."""
