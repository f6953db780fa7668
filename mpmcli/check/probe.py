"""Probe: measures the cost of a step by running the first seconds of a scene on this machine."""

import time
from dataclasses import dataclass

from mpmcli.scene import LoadedScene
from mpmcli.solver.engine.build import backend_for, build_run
from mpmcli.solver.engine.run import Run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Arch, Backend, start
from mpmcli.solver.machine.plan import Plan, make_plan, require_room

# Steps that are not counted: the first compiles, and the next fill the caches of the processor.
WARM_UP = 3


@dataclass(frozen=True)
class Probe:
    """Measured cost of a run's start: seconds to start, to compile, of a step (None: unstable before) and a frame."""

    backend: Backend
    start_seconds: float
    compile_seconds: float
    step_seconds: float | None
    frame_seconds: float
    steps: int
    failure: str = ""


def probe_scene(
    loaded: LoadedScene, steps: int, *, arch: Arch = "auto", threads: int | None = None, seconds: float = 2.0
) -> tuple[Probe, Plan]:
    """Run a scene for `seconds` of its `steps`; return cost and plan. InputError: no backend, or little memory."""
    scene = loaded.scene
    began = time.perf_counter()
    backend = backend_for(scene, lambda: steps, arch, threads)
    start(backend)
    plan = make_plan(scene, backend)
    require_room(plan)
    run = build_run(scene, backend)
    started = time.perf_counter() - began
    run.begin()
    run.frame()
    first_frame = time.perf_counter() - began - started
    # The smallest of three: the second frame allocates memory, later ones reuse it.
    frame = min(_seconds_of_a_frame(run) for _ in range(3))
    compiled = max(0.0, first_frame - frame)
    measured, spent, failure = 0, 0.0, ""
    try:
        warm = time.perf_counter()
        run.advance(WARM_UP)
        compiled += time.perf_counter() - warm
        # A run launches and waits at least once for each frame.
        chunk, most = 1, max(1, round(steps / scene.time.frames))
        since = time.perf_counter()
        while measured == 0 or (spent < seconds and run.time < scene.time.end):
            measured += run.advance(chunk)[0]
            spent = time.perf_counter() - since
            chunk = max(1, min(most, int(measured / spent * (seconds - spent))))
    except UnstableRunError as error:
        failure = str(error)
    step_seconds = spent / measured if measured else None
    return Probe(backend, started, compiled, step_seconds, frame, run.step_count, failure), plan


def _seconds_of_a_frame(run: Run) -> float:
    since = time.perf_counter()
    run.frame()
    return time.perf_counter() - since
