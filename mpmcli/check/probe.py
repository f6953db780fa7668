"""Probe: measures the cost of a step by running the first seconds of a scene on this machine."""

import time
from dataclasses import dataclass

from mpmcli.scene import LoadedScene
from mpmcli.solver.backend import Arch, Backend, start
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.engine import Engine, build_engine, choose_engine
from mpmcli.solver.plan import Plan, make_plan, require_room

# Steps that are not counted: the first compiles, and the next fill the caches of the processor.
WARM_UP = 3


@dataclass(frozen=True)
class Probe:
    """Measured cost of the start of a run.

    Attributes:
        backend: backend of the probe.
        start_seconds: time to start the backend, sample and allocate.
        compile_seconds: time of the first step and frame in excess of later ones.
        step_seconds: wall time of a step, None if the run became unstable before one was measured.
        frame_seconds: time to build a frame and its ledger row.
        steps: number of steps taken.
        failure: message of an unstable run, "" otherwise.
    """

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
    """Run a scene as `mpmcli simulate` would; it starts Taichi in this process and writes nothing.

    Args:
        steps: expected number of steps of the whole run.
        seconds: wall time of the steps that are measured.

    Returns:
        The measured cost, and the plan of a run on the backend that was started.

    Raises:
        InputError: the backend is not available, or the scene does not fit into memory.
    """
    scene = loaded.scene
    began = time.perf_counter()
    backend, batched = choose_engine(scene, lambda: steps, arch, threads)
    start(backend)
    plan = make_plan(scene, backend)
    require_room(plan)
    engine = build_engine(scene, backend, batched=batched)
    started = time.perf_counter() - began
    engine.begin()
    engine.frame()
    first_frame = time.perf_counter() - began - started
    # The smallest of three: the second frame allocates memory, later ones reuse it.
    frame = min(_seconds_of_a_frame(engine) for _ in range(3))
    compiled = max(0.0, first_frame - frame)
    measured, spent, failure = 0, 0.0, ""
    try:
        warm = time.perf_counter()
        engine.advance(WARM_UP)
        engine.wait()
        compiled += time.perf_counter() - warm
        # A run launches and waits at least once for each frame.
        chunk, most = 1, max(1, round(steps / scene.time.frames))
        since = time.perf_counter()
        while measured == 0 or (spent < seconds and engine.time < scene.time.end):
            measured += engine.advance(chunk)[0]
            engine.wait()
            spent = time.perf_counter() - since
            chunk = max(1, min(most, int(measured / spent * (seconds - spent))))
    except UnstableRunError as error:
        failure = str(error)
    step_seconds = spent / measured if measured else None
    return Probe(backend, started, compiled, step_seconds, frame, engine.step_count, failure), plan


def _seconds_of_a_frame(engine: Engine) -> float:
    since = time.perf_counter()
    engine.frame()
    return time.perf_counter() - since
