"""A case that was never computed, and results of runs that never ran, for the tests of what follows from them."""

from collections.abc import Callable
from typing import Any

from mpmcli.validation.case import Case, Measure, Setting
from mpmcli.validation.runs import CaseRun, RunResult, runs_of


class Invented(Case):
    """error = 0.5 (8/n)^2, below a bound of 0.6 (8/n)^2."""

    name, title, group = "invented", "An invented <problem> & its answer", "fluids"
    source, resolution, note = "nobody | nowhere", "cells", "A note."
    levels = {"coarse": (8, 16), "default": (8, 16, 32), "fine": (8, 16, 32, 64)}  # noqa: RUF012
    measures = (
        Measure("error: What is wrong.", lambda n: 0.6 * (8 / n) ** 2, order=1.9, expected=2.0),
        Measure("drift (m): How far it went astray."),
    )

    def tables(self, n: int) -> dict[str, Any]:
        raise NotImplementedError

    def measure(self, n: int, scene: object, frames: object) -> dict[str, float]:
        raise NotImplementedError


CASE = Invented()
SINGLE = Setting(precision="f32")
Law = Callable[[CaseRun], float | None]


def result(error: float, particles: int = 100, steps: int = 11, seconds: float = 1.0) -> RunResult:
    """Return the result of a run that finished."""
    values = {"error": error, "drift": -1e-3}
    return RunResult("finished", "", values, particles=particles, steps=steps, seconds=seconds)


def second_order(run: CaseRun) -> float:
    """The law that the case keeps, with any setting."""
    return 0.5 * (8 / run.n) ** 2


def results(law: Law = second_order, level: str = "default") -> dict[CaseRun, RunResult]:
    """Return the results of a level whose errors follow a law; None is a run that became unstable.

    A run takes n^2 particles, n + 1 steps and 1e-6 s for each particle-step but those of the first step.
    """
    found = {}
    for run in runs_of(CASE, level):
        error = law(run)
        lost = RunResult("unstable", "It was <lost>.")
        found[run] = lost if error is None else result(error, run.n**2, run.n + 1, 1e-6 * run.n**3)
    return found
