"""Carries out one run of a case in this process: scene, solver, measures and the clock."""

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
from mpmcli.validation.case import Case
from mpmcli.validation.run_result import RunResult, failure, not_finite
from mpmcli.validation.setting import Setting


def scene_of(case: Case, n: int, setting: Setting) -> Scene:
    """Return the scene of a case at resolution n.

    Raises:
        InputError: the scene is not valid, as with a knob that scenes do not know.
    """
    return parse_scene(case.tables(n, setting), laws=parameter_models(), source=f"<{case.name}>").scene


def carry_out(case: Case, n: int, setting: Setting, backend: Backend | None = None) -> RunResult:
    """Run a case and measure it; whatever stops it is told in the result.

    Args:
        backend: to run on; where None, the CPU with one thread is started in the precision of the setting.
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
            message = f"The case measured no {' and no '.join(missing)}."
        if message:
            status, values = "failed", {}
    except UnstableRunError as error:
        status, message = "unstable", str(error)
    except MpmcliError as error:
        status, message = "failed", str(error)
    except (ArithmeticError, ValueError) as error:
        # A state that makes no sense, though the solver went on, has nothing to measure.
        status, message = "failed", f"The frames cannot be measured: {error}."
    return RunResult(status, message, values, **facts, **solver.facts())


class TimedSolver(Solver):
    """A solver that knows how much processor time its steps took: that of other programs is not in it."""

    def __init__(self, scene: Scene, backend: Backend) -> None:
        super().__init__(scene, backend)
        self._watched = self.measure_seconds
        self._drawing = self._elsewhere = 0.0

    def timed_frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames; what their receiver does with them is not timed."""
        frames = self.frames()
        while True:
            began = time.process_time()
            try:
                found = next(frames, None)
            finally:
                self._drawing += time.process_time() - began
            if found is None:
                return
            yield found

    def step(self, dt: float) -> None:
        """Advance by dt, s; the first step compiles, and is booked apart."""
        if self.step_count:
            super().step(dt)
        else:
            with self._booked_elsewhere():
                super().step(dt)

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
        """Return a frame, which is booked apart."""
        with self._booked_elsewhere():
            return super().frame(index, taken)

    @contextmanager
    def _booked_elsewhere(self) -> Iterator[None]:
        began = time.process_time()
        try:
            yield
        finally:
            self._elsewhere += time.process_time() - began

    def facts(self) -> dict[str, float]:
        """Return the counts and seconds of a result."""
        return {
            "steps": self.step_count,
            "seconds": max(self._drawing - self._elsewhere, 0.0),
            "watch_seconds": self.measure_seconds - self._watched,
            "compile_seconds": self.first_step_seconds,
            "frame_seconds": self.frame_seconds,
        }
