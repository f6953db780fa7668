"""Executes one run of a case in this process and measures its processor time."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.solver.backend import Backend, start_backend
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.solver import Solver
from mpmcli.solver.sums import NO_STEPS, StepsTaken
from mpmcli.validation.case import Case
from mpmcli.validation.run_result import RunResult, failure, not_finite
from mpmcli.validation.setting import Setting


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
    facts: dict = {}
    began = time.perf_counter()
    try:
        scene = scene_of(case, n, setting)
        backend = backend or start_backend("cpu", 1, scene.solver.precision)
        facts = {"arch": backend.arch, "precision": backend.precision, "threads": backend.threads}
        solver = TimedSolver(scene, backend)
    except MpmcliError as error:
        return failure(str(error), **facts)
    facts |= {"particles": solver.particle_count, "start_seconds": time.perf_counter() - began}
    values: dict[str, float] = {}
    status, message = "finished", ""
    try:
        values = {name: float(value) for name, value in case.measure(n, scene, solver.timed_frames()).items()}
        message = not_finite(values)
        missing = [measure.name for measure in case.measures if measure.name not in values]
        if missing:
            message = f"The case returned no {' and no '.join(missing)}."
        if message:
            status, values = "failed", {}
    except UnstableRunError as error:
        status, message = "unstable", str(error)
    except MpmcliError as error:
        status, message = "failed", str(error)
    except (ArithmeticError, ValueError) as error:
        # The solver did not detect the instability, but the state cannot be evaluated.
        status, message = "failed", f"The frames cannot be measured: {error}."
    return RunResult(status, message, values, **facts, **solver.facts())


class TimedSolver(Solver):
    """A solver that measures the processor time of its steps, which excludes that of other programs."""

    def __init__(self, scene: Scene, backend: Backend) -> None:
        super().__init__(scene, backend)
        self._watched = self.measure_seconds
        self._frames_seconds = self._excluded_seconds = 0.0

    def timed_frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames. The time that the caller spends on them is not counted."""
        frames = self.frames()
        while True:
            began = time.process_time()
            try:
                found = next(frames, None)
            finally:
                self._frames_seconds += time.process_time() - began
            if found is None:
                return
            yield found

    def step(self, dt: float, until: float | None = None) -> None:
        """Advance by dt, s. The first step compiles the kernels and is not counted."""
        if self.step_count:
            super().step(dt, until)
        else:
            with self._excluded():
                super().step(dt, until)

    def frame(self, index: int = 0, taken: StepsTaken = NO_STEPS) -> tuple[Frame, LedgerRow]:
        """Return a frame. The time for building it is not counted."""
        with self._excluded():
            return super().frame(index, taken)

    @contextmanager
    def _excluded(self) -> Iterator[None]:
        began = time.process_time()
        try:
            yield
        finally:
            self._excluded_seconds += time.process_time() - began

    def facts(self) -> dict[str, float]:
        """Return the step count and times of a `RunResult`."""
        return {
            "steps": self.step_count,
            "seconds": max(self._frames_seconds - self._excluded_seconds, 0.0),
            "watch_seconds": self.measure_seconds - self._watched,
            "compile_seconds": self.first_step_seconds,
            "frame_seconds": self.frame_seconds,
        }
