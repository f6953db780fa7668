"""Compiles the kernels of scenes ahead, each in a process of its own."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mpmcli.processes.each import Fault, in_processes

# Time limit of a process, s.
TIMEOUT = 1800.0
# No step of a scene is as small, s: it compiles, and computes nothing worth keeping.
NO_STEP = 1e-12


@dataclass(frozen=True)
class Warmed:
    """The outcome of a process.

    Attributes:
        stored: whether a stored kernel was found; seconds: of wall time.
        fault: why there is no outcome, "" if there is one.
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
    """Take a step of each scene in a process of its own, and yield outcomes as they end."""
    compile_one = partial(_compile, arch=arch, threads=threads)
    for scene, outcome in in_processes(scenes, at_once, compile_one, TIMEOUT, stop):
        yield Warmed(scene, fault=outcome.words) if isinstance(outcome, Fault) else outcome


def _compile(path: Path, arch: str, threads: int | None) -> Warmed:
    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import load_scene
    from mpmcli.simulation.engine import backend_for
    from mpmcli.solver.engine.build import build_run
    from mpmcli.solver.machine.backend import start, stop_backend

    began = time.perf_counter()
    scene = load_scene(path, laws=parameter_models()).scene
    backend = backend_for(scene, arch, threads)
    start(backend)
    run = build_run(scene, backend)
    run.step(NO_STEP)
    stored = backend.on_cpu and run.batch.launch_cpu.stored
    stop_backend()
    return Warmed(path, stored, time.perf_counter() - began)
