"""One problem with a known answer: a scene at any resolution, and how far off its frames are."""

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


def unbounded(n: int) -> float:
    """Accept any error."""
    return math.inf


@dataclass(frozen=True)
class Measure:
    """One number that a case takes from its frames.

    Attributes:
        name: in two or three words; unit: "" where it is a fraction.
        text: what it is, in one sentence.
        bound: (n) -> the largest |value| that is right at resolution n, with the default setting in double precision.
        order: the smallest order that |value| must fall at between the two finest resolutions, None where it need not.
        expected: the order that theory gives, for the report; None where there is none.
        order_to: the finest resolution that takes part in the order, None for all: beyond it another error rules, as
            the note of the case says.
    """

    name: str
    unit: str
    text: str
    bound: Callable[[int], float] = unbounded
    order: float | None = None
    expected: float | None = None
    order_to: int | None = None

    def has_order_at(self, n: int) -> bool:
        """Return whether resolution n takes part in the order."""
        return self.order_to is None or n <= self.order_to


class Case(ABC):
    """One problem with a known answer.

    Attributes:
        name: what the command line calls it; title: what people call it.
        group: the chapter of the report.
        source: where the problem and its answer come from.
        resolution: what n counts, such as "cells along the bar".
        levels: the resolutions of each level, from coarse to fine.
        measures: what is measured; the first one is the error of the case.
        varies: the knobs that mean something here; the report tries each of their values.
        note: what a reader of the result must know, such as why a bound is what it is; "" where there is nothing.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    group: ClassVar[Literal["solids", "fluids", "plastic", "invariants"]]
    source: ClassVar[str]
    resolution: ClassVar[str]
    levels: ClassVar[dict[Level, tuple[int, ...]]]
    measures: ClassVar[tuple[Measure, ...]]
    varies: ClassVar[tuple[str, ...]] = ("precision", "kernel", "transfer", "walls", "per_axis", "safety")
    note: ClassVar[str] = ""

    @abstractmethod
    def tables(self, n: int, setting: Setting) -> dict[str, Any]:
        """Return the scene at resolution n as the tables of its TOML file."""

    @abstractmethod
    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the value of every measure, by its name, from the frames of a run of that scene, as they come."""
