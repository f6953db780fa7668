"""One hard case: a scene in words, what must come of it, and what came."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import stop_backend


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        passed: whether the criterion is met.
        figure: the numbers that the criterion speaks of, in a few words.
        detail: what else is worth knowing, one or two sentences, "" where there is nothing.
        seconds: wall time, compilation included.
    """

    passed: bool
    figure: str
    detail: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class HardCase:
    """One row of the catalogue.

    Attributes:
        name: "H1" to "H24"; title: in a few words.
        scene: what is computed, in words; criterion: what must come of it.
        slow: whether it takes more than a few seconds.
        run: compute it, on a backend of its own.
        short: a smaller version of a slow case, None where there is none.
    """

    name: str
    title: str
    scene: str
    criterion: str
    slow: bool
    run: Callable[[], Outcome]
    short: Callable[[], Outcome] | None = None


def carry_out(case: HardCase, *, short: bool = False) -> Outcome:
    """Run a case, or its short version where it has one, and time it; a run that stops unexpectedly has not passed."""
    began = time.perf_counter()
    run = case.short if short and case.short is not None else case.run
    try:
        outcome = run()
    except UnstableRunError as error:
        outcome = Outcome(False, "the run stopped", str(error))
    finally:
        stop_backend()
    return replace(outcome, passed=bool(outcome.passed), seconds=time.perf_counter() - began)
