"""Executes one run of a case in this process and measures its processor time."""

import time
from collections.abc import Iterator

from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.solver.engine.build import build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, start_backend
from mpmcli.validation.case import Case, Setting
from mpmcli.validation.runs import RunResult, failure, not_finite


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
        timed = TimedRun(scene, backend)
    except MpmcliError as error:
        return failure(str(error), **facts)
    facts |= {"particles": timed.run.particle_count, "start_seconds": time.perf_counter() - began}
    values: dict[str, float] = {}
    status, message = "finished", ""
    try:
        values = {name: float(value) for name, value in case.measure(n, scene, timed.frames()).items()}
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
    return RunResult(status, message, values, **facts, **timed.facts())


class TimedRun:
    """A run whose steps are timed by the processor, which excludes the time of other programs."""

    def __init__(self, scene: Scene, backend: Backend) -> None:
        self.run = build_run(scene, backend)
        self._seconds = 0.0

    def frames(self) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield the frames. Compiling, and what the caller does with frames, is not counted."""
        self.run.begin()
        frames = self.run.frames()
        while True:
            began, before = time.process_time(), self.run.frame_processor_seconds
            try:
                found = next(frames, None)
            finally:
                self._seconds += time.process_time() - began - (self.run.frame_processor_seconds - before)
            if found is None:
                return
            yield found

    def facts(self) -> dict[str, float]:
        """Return the step count and times of a `RunResult`."""
        return {
            "steps": self.run.step_count,
            "seconds": max(self._seconds, 0.0),
            "watch_seconds": self.run.measure_seconds,
            "compile_seconds": self.run.first_step_seconds,
            "frame_seconds": self.run.frame_seconds,
        }
