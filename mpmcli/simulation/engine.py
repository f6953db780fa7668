"""Chooses the backend of a scene by the forecast of the check, and compiles kernels in advance."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps
from mpmcli.materials.registry import parameter_models
from mpmcli.processes.pool import Fault, in_processes
from mpmcli.scene import Scene, load_scene
from mpmcli.solver.engine import run as engine_run
from mpmcli.solver.machine.backend import Arch, Backend, start, stop_backend


def backend_for(scene: Scene, arch: Arch = "auto", threads: int | None = None) -> Backend:
    """Return the backend for a scene, not started; InputError: it cannot be used, or no step is stable."""
    return engine_run.backend_for(scene, lambda: expected_steps(SceneFacts(scene)), arch, threads)


# Time limit of a process, s.
TIMEOUT = 1800.0
# Step of a run that only compiles, s; smaller than the step of any scene.
NO_STEP = 1e-12


@dataclass(frozen=True)
class Warmed:
    """The outcome of compiling a scene in a process.

    Attributes:
        stored: whether a stored kernel was found; seconds: of wall time.
        fault: reason of a failure, "" on success.
    """

    scene: Path
    stored: bool = False
    seconds: float = 0.0
    fault: str = ""


def warm(
    scenes: Sequence[Path],
    at_once: int,
    arch: str = "auto",
    threads: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Warmed]:
    """Compute one step of each scene in a separate process, and yield outcomes as they end."""
    compile_one = partial(_compile, arch=arch, threads=threads)
    for scene, outcome in in_processes(scenes, at_once, compile_one, TIMEOUT, stop):
        yield Warmed(scene, fault=outcome.words) if isinstance(outcome, Fault) else outcome


def _compile(path: Path, arch: str, threads: int | None) -> Warmed:
    began = time.perf_counter()
    scene = load_scene(path, laws=parameter_models()).scene
    backend = backend_for(scene, arch, threads)
    start(backend)
    run = engine_run.build_run(scene, backend)
    run.step(NO_STEP)
    stored = backend.on_cpu and run.batch.launch_cpu.stored
    stop_backend()
    return Warmed(path, stored, time.perf_counter() - began)
