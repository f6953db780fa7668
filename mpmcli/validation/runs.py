"""The runs of a level, each case at its resolutions with the default setting and its variants; and one run."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.solver.engine.build import build_run
from mpmcli.solver.engine.run import Run as SolverRun
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, start_backend
from mpmcli.validation.case import KNOBS, Case, Level, Setting


@dataclass(frozen=True)
class Run:
    """One case at resolution n with one setting."""

    case: str
    n: int
    setting: Setting


def variants(knob: str) -> list[Setting]:
    """Return the settings that differ from the default one in one field."""
    usual = getattr(Setting(), knob)
    return [Setting(**{knob: value}) for value in KNOBS[knob] if value != usual]


def runs_of(case: Case, level: Level) -> list[Run]:
    """Return the runs of a case at a level, the default setting first, each setting from coarse to fine.

    The level "coarse" has the default setting, and f32 at the finest resolution. Other levels vary every field in
    `case.varies` at every resolution, except for the Courant fraction, which is varied at the (lower) median.
    """
    resolutions = sorted(case.levels[level])
    median, finest = resolutions[(len(resolutions) - 1) // 2], resolutions[-1]
    runs = [Run(case.name, n, Setting()) for n in resolutions]
    for knob in KNOBS:
        if knob not in case.varies or (level == "coarse" and knob != "precision"):
            continue
        at = [finest] if level == "coarse" else [median] if knob == "safety" else resolutions
        runs += [Run(case.name, n, variant) for variant in variants(knob) for n in at]
    return runs


def matrix(cases: Iterable[Case], level: Level) -> list[Run]:
    """Return the runs of several cases, case by case."""
    return [run for case in cases for run in runs_of(case, level)]


@dataclass(frozen=True)
class RunResult:
    """Outcome, measures and cost of a run; times are in s."""

    status: Literal["finished", "unstable", "failed"]  # "unstable" if the solver stopped it
    message: str = ""
    values: dict[str, float] = field(default_factory=dict)  # the measures by name; empty if the run did not finish
    particles: int = 0
    steps: int = 0
    # Processor time of the time steps, without the first one, which compiles the kernels, and without frames and rows.
    seconds: float = 0.0
    compile_seconds: float = 0.0  # of the first step

    @property
    def finished(self) -> bool:
        """Whether the run finished; only then are there values."""
        return self.status == "finished"

    @property
    def rate(self) -> float:
        """Particle-steps per second, without the first step; 0 if nothing was timed."""
        return self.particles * max(self.steps - 1, 0) / self.seconds if self.seconds > 0 else 0.0

    def error(self, measure: str) -> float | None:
        """Return the absolute value of a measure; None if the run did not finish."""
        return abs(self.values[measure]) if self.finished else None


Results = Mapping[Run, RunResult]


def scene_of(case: Case, n: int, setting: Setting) -> Scene:
    """Return the scene of a case at resolution n.

    Raises:
        InputError: the scene is not valid.
    """
    return parse_scene(case.scene_tables(n, setting), laws=parameter_models(), source=f"<{case.name}>").scene


def carry_out(case: Case, n: int, setting: Setting, backend: Backend | None = None) -> RunResult:
    """Run a case and return its measures. Errors are reported in the result.

    Args:
        backend: the backend; None starts the CPU backend with one thread in the precision of the setting.
    """
    try:
        scene = scene_of(case, n, setting)
        run = build_run(scene, backend or start_backend("cpu", 1, scene.solver.precision))
    except MpmcliError as error:
        return RunResult("failed", str(error))
    status, values, clock = "failed", {}, SteppingClock(run)
    try:
        values = {name: float(value) for name, value in case.measure(n, scene, clock.frames()).items()}
        odd = [f"{name} is {value}" for name, value in values.items() if not math.isfinite(value)]
        odd += [f"there is no {measure.name}" for measure in case.measures if measure.name not in values]
        message = f"The run finished, but {' and '.join(odd)}." if odd else ""
        status = "failed" if odd else "finished"
    except UnstableRunError as error:
        status, message = "unstable", str(error)
    except MpmcliError as error:
        message = str(error)
    except (ArithmeticError, ValueError) as error:
        # The solver did not detect the instability, but the state cannot be evaluated.
        message = f"The frames cannot be measured: {error}."
    values = values if status == "finished" else {}
    facts = run.particle_count, run.step_count, clock.seconds, run.first_step_seconds
    return RunResult(status, message, values, *facts)


class SteppingClock:
    """Measures the processor time of the steps of a run, in s, which excludes the time of other programs."""

    def __init__(self, run: SolverRun) -> None:
        self.seconds = 0.0
        self._run = run

    def frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames. Compiling, and what the caller does with frames, is not counted."""
        self._run.begin()
        frames = self._run.frames()
        while True:
            began, before = time.process_time(), self._run.frame_processor_seconds
            try:
                found = next(frames, None)
            finally:
                passed = time.process_time() - began - (self._run.frame_processor_seconds - before)
                self.seconds = max(self.seconds + passed, 0.0)
            if found is None:
                return
            yield found
