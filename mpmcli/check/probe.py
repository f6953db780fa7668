"""Probe: measures the cost of a step by running the first seconds of a scene on this machine."""

import time
from dataclasses import dataclass

from mpmcli.scene import LoadedScene
from mpmcli.solver.backend import Arch, Backend, start_backend
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.plan import Plan, make_plan, require_room
from mpmcli.solver.solver import Solver

# Steps that are not counted: the first compiles, and the next fill the caches of the processor.
WARM_UP = 3


@dataclass(frozen=True)
class Probe:
    """Measured cost of the start of a run.

    Attributes:
        backend: backend of the probe.
        start_seconds: time to start the backend, sample and allocate.
        compile_seconds: time of the first step and frame in excess of later ones.
        step_seconds: wall time of a step, None if the run became unstable in the first one.
        frame_seconds: time to build a frame and its ledger row.
        steps: number of measured steps.
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
    loaded: LoadedScene, *, arch: Arch = "auto", threads: int | None = None, seconds: float = 2.0
) -> tuple[Probe, Plan]:
    """Run a scene for `seconds` of wall time; it starts Taichi in this process and writes nothing.

    Returns:
        The measured cost, and the plan of a run on the backend that was started.

    Raises:
        InputError: the backend is not available, or the scene does not fit into memory.
    """
    scene = loaded.scene
    began = time.perf_counter()
    backend = start_backend(arch, threads, scene.solver.precision)
    plan = make_plan(scene, backend)
    require_room(plan)
    solver = Solver(scene, backend)
    start = time.perf_counter() - began
    solver.frame(0, [])
    first_frame = time.perf_counter() - began - start
    # The smallest of three: the second frame allocates memory, later ones reuse it.
    frame = min(_seconds_of_a_frame(solver) for _ in range(3))
    compiled = max(0.0, first_frame - frame)
    steps, spent, failure = 0, 0.0, ""
    try:
        warm = time.perf_counter()
        for _ in range(WARM_UP):
            _advance(solver)
        solver.measure_state(0.0)
        compiled += time.perf_counter() - warm
        since = time.perf_counter()
        while steps == 0 or (spent < seconds and solver.time < scene.time.end):
            _advance(solver)
            steps += 1
            spent = time.perf_counter() - since
        # A GPU is synchronised only here.
        solver.measure_state(0.0)
        spent = time.perf_counter() - since
    except UnstableRunError as error:
        failure = str(error)
    return Probe(backend, start, compiled, spent / steps if steps else None, frame, steps, failure), plan


def _advance(solver: Solver) -> None:
    """Take one step of a run, ignoring the times of frames."""
    dt, _ = solver.stable_step()
    interval = solver.scene.time.end / solver.scene.time.frames
    solver.step(min(dt, interval))


def _seconds_of_a_frame(solver: Solver) -> float:
    since = time.perf_counter()
    solver.frame(0, [])
    return time.perf_counter() - since
