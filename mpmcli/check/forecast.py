"""Forecast of steps, time, memory and disk space of a run, with or without a probe, and rules on the last two."""

import math
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from timeit import repeat

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.errors import InputError
from mpmcli.output.durable import largest_file
from mpmcli.output.layout import POSITION, ArrayLayout, FrameLayout
from mpmcli.output.store import HOLD
from mpmcli.plain_text import size_text
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.engine.plan import Plan, make_plan, require_memory
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import backend_for, build_run
from mpmcli.solver.frames.builder import POSITION_ERROR
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, start
from mpmcli.solver.machine.costs import cheapest, cost_of
from mpmcli.solver.transfer.kept_motion import OWN_STEP, own_limit
from mpmcli.stability.transfer_factors import loss_per_step

# Bytes of a packed file without particles, measured on files of 51 to 151 frames in 2D and 3D: headers of the data
# sets, and per frame the tables of steps and ledger without momenta.
HEADER_BYTES = 21_500
FRAME_BYTES = 324
# Base64 encodes 3 bytes as 4. Each particle is one cell, with number, offset and type; the rest is XML.
BASE64 = 4 / 3
CELL_BYTES = 24
VTU_BYTES = 1300
# Seconds to flush a group of frames to disk and to take a frame into one, and bytes per second of a disk, measured on
# four scenes.
SEAL_SECONDS = 0.03
# Seconds until a run begins to compile, and to load stored kernels.
START_SECONDS, LOAD_SECONDS = 1.0, 1.5
FRAME_SECONDS = 0.0005
DISK_BYTES_PER_SECOND = 4e8
# A frame is written once as a segment, read, written into the packed file, and compared: four passes.
DISK_PASSES = 4
# More frames than this take hours to write.
MOST_FRAMES = 100_000
# During packing two copies are on the disk.
COPIES = 2
# Wall time of the steps that are counted, s.
SECONDS = 2.0
# Steps that are not counted: the first compiles, and the next fill the caches of the processor.
WARM_UP = 3


@dataclass(frozen=True)
class Probe:
    """Measured cost: seconds to start, to compile, of a step (None if the probe became unstable) and of a frame."""

    backend: Backend
    start_seconds: float
    compile_seconds: float
    step_seconds: float | None
    frame_seconds: float
    steps: int
    failure: str = ""


def probe_scene(loaded: LoadedScene, steps: int, *, threads: int | None = None) -> tuple[Probe, Plan]:
    """Run a scene for SECONDS of its `steps`; return cost and plan. InputError: no backend, or little memory."""
    scene = loaded.scene
    asked = Resolved(scene)
    began = time.perf_counter()
    backend = backend_for(asked, lambda: steps, "auto", threads)
    start(backend)
    plan = make_plan(asked, backend)
    require_memory(plan)
    run = build_run(asked, backend)
    started = time.perf_counter() - began
    run.begin()
    run.frame()
    first_frame = time.perf_counter() - began - started
    # The smallest of three: the second frame allocates memory, which later ones reuse.
    frame = min(repeat(run.frame, number=1, repeat=3))
    compiled = max(0.0, first_frame - frame)
    measured, spent, failure = 0, 0.0, ""
    try:
        warm = time.perf_counter()
        run.advance(WARM_UP)
        compiled += time.perf_counter() - warm
        # A run launches and waits at least once for each frame.
        chunk, most = 1, max(1, round(steps / scene.time.frames))
        since = time.perf_counter()
        while measured == 0 or (spent < SECONDS and run.time < scene.time.end):
            measured += run.advance(chunk)[0]
            spent = time.perf_counter() - since
            chunk = max(1, min(most, int(measured / spent * (SECONDS - spent))))
    except UnstableRunError as error:
        failure = str(error)
    step_seconds = spent / measured if measured else None
    return Probe(backend, started, compiled, step_seconds, frame, run.step_count, failure), plan


@dataclass(frozen=True)
class Forecast:
    """Forecast of a run."""

    # Expected number, and the numbers with the step of the start and with that of the stiffest state.
    steps: int
    steps_range: tuple[int, int]
    # Those stored, including the first.
    frames: int
    # Wall time of the run, part of it for the compilation of kernels, and that of a step: by a probe if `measured`,
    # else by the table of costs, which has none for GPUs.
    seconds: float | None
    compile_seconds: float | None
    step_seconds: float | None
    measured: bool
    # All fields on the device; a frame and its sources, or the initial state; the packed file without
    # compression; the series of --format vtk.
    device_bytes: int
    host_bytes: int
    file_bytes: int
    vtk_bytes: int


def forecast_of(facts: SceneFacts, plan: Plan, probe: Probe | None, threads: int) -> Forecast:
    """Return the forecast of a run on some threads; times are those of the probe, if there is one."""
    scene = facts.scene
    steps = expected_steps(facts)
    file_bytes = packed_bytes(scene, plan.particles)
    frames = scene.time.frames + 1
    start, compiling, step, frame = START_SECONDS, None, None, 0.0
    if probe is not None:
        start, frame = probe.start_seconds, probe.frame_seconds
        compiling, step = probe.compile_seconds, probe.step_seconds
    elif plan.arch == "cpu":
        cost = cost_of(scene, cheapest(scene, steps, threads))
        compiling, step = cost.compile, cost.step_on(threads)
    seconds = None
    if compiling is not None and step is not None:
        computing = steps * step + frames * frame
        # Frames are sealed in groups, once in HOLD seconds.
        sealing = min(frames, 1 + computing / HOLD) * SEAL_SECONDS
        seconds = start + compiling + computing + frames * FRAME_SECONDS + sealing
        seconds += DISK_PASSES * file_bytes / DISK_BYTES_PER_SECOND
    return Forecast(
        steps=steps,
        steps_range=(steps_at(facts, facts.step_at_start), steps_at(facts, facts.step)),
        frames=frames,
        seconds=seconds,
        compile_seconds=compiling,
        step_seconds=step,
        measured=probe is not None,
        device_bytes=plan.device_bytes,
        host_bytes=plan.host_bytes,
        file_bytes=file_bytes,
        vtk_bytes=series_bytes(scene, plan.particles),
    )


def steps_at(facts: SceneFacts, step: float) -> int:
    """Return the number of steps of a run in which `step` (s) is stable; equal steps end on each frame."""
    # The same division of an interval, with the same tolerance for round-off, as in the solver.
    return facts.scene.time.frames * max(1, math.ceil(facts.interval / facts.taken(step) - 1e-6))


def expected_steps(facts: SceneFacts) -> int:
    """Return the expected number of steps: steps of rest until the first contact, then steps of the stiffest state.

    Elastic bodies keep oscillating after an impact, and hardening is permanent. Frames divide both parts.
    """
    frames = facts.scene.time.frames
    # Until then no material is stiffer than at rest.
    first_contact = min((body.arrival.time for body in facts.bodies), default=0.0)
    free = min(1.0, first_contact / facts.scene.time.end)
    before, after = (steps_at(facts, step) / frames for step in (facts.step_at_start, facts.step_expected))
    whole = math.floor(free * frames)
    mixed = (free * frames - whole) * before + (1 - free * frames + whole) * after if whole < frames else 0.0
    return round(whole * before + mixed + max(0, frames - whole - 1) * after)


def seconds_of_one(scene: Scene, steps: int) -> float:
    """Return the time of one of many runs on one thread, s, from the table of costs."""
    return steps * cost_of(scene, "most").step + scene.time.frames * FRAME_SECONDS


def damped_step(facts: SceneFacts, body: BodyFacts, step: float, shorter: float = 1.0) -> float:
    """Return the step (s) that determines the damping of a body in a run with `step`: its own if that is longer.

    shorter: ratio of its own step then to that at the start.
    """
    return max(step, OWN_STEP * shorter * own_limit(body.body, body.law, facts.scene))


def wave_loss(thickness: float, spacing: float, step: float, settings: SolverSettings) -> float:
    """Return the rate, 1/s, at which the longest wave across a body loses energy, relative to its energy.

    Its wave number is k = pi / thickness. `step`, s, is the step that determines the damping, see `damped_step`: the
    loss in one such step does not depend on its length (docs/theory.md, 2.4).
    """
    return loss_per_step(settings, math.pi * spacing / thickness) / step


def layout_of(scene: Scene) -> FrameLayout:
    """Return the layout of the frames of a run."""
    d = scene.dimension
    real = "float64" if scene.solver.precision == "f64" else "float32"
    far = float(np.abs([scene.domain.origin, scene.domain.upper]).max())
    coarse = far * np.finfo(np.float32).eps > POSITION_ERROR * scene.domain.spacing
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {POSITION: ("float64" if coarse else real, (d,))}
    shapes |= {name: ("int32", ()) for name in ("id", "body", "material")}
    shapes["velocity"] = (real, (d,))
    tensors = {"stress": (9,), "affine": (d * d,), "deformation_gradient": (d * d,)}
    shapes |= {name: (real, tensors.get(name, ())) for name in scene.output.fields if name != "velocity"}
    if "initial_position" in shapes:
        shapes["initial_position"] = shapes[POSITION]
    return FrameLayout(d, {name: ArrayLayout(name, kind, shape, d) for name, (kind, shape) in shapes.items()})


def packed_bytes(scene: Scene, particles: int) -> int:
    """Return the bytes of the packed file, not compressed."""
    frames = scene.time.frames + 1
    momenta = 8 * (3 if scene.dimension == 2 else 6)
    data = particles * (frames * layout_of(scene).bytes_per_particle + 8)
    return data + HEADER_BYTES + frames * (FRAME_BYTES + momenta) + len(scene_to_toml(scene))


def series_bytes(scene: Scene, particles: int) -> int:
    """Return the bytes of the .vtu files of --format vtk, not compressed."""
    each = BASE64 * particles * (layout_of(scene).bytes_per_particle + CELL_BYTES) + VTU_BYTES
    return round((scene.time.frames + 1) * each)


def output_findings(facts: SceneFacts, plan: Plan, forecast: Forecast, directory: Path) -> Iterator[Finding]:
    """Yield the findings on frames, disk and memory; `directory` is where results would be written."""
    scene = facts.scene
    if facts.interval < facts.step_at_start and forecast.steps < forecast.frames:
        what = (
            f"Frames are {facts.interval:.3g} s apart, less than the stable step of {facts.step_at_start:.3g} s: every "
            "step is stored, and steps are shorter than they need be."
        )
        fix = f"Set time.frames to {max(1, int(scene.time.end / facts.step_at_start))} or fewer."
        yield Finding("note", "frames", what, fix, facts.interval)
    if scene.time.frames > MOST_FRAMES:
        what = f"The run stores {forecast.frames:,} frames, which take longer to write than most runs to compute."
        yield Finding("warning", "frames", what, f"Set time.frames to {MOST_FRAMES:,} or fewer.", forecast.frames)
    # The directory need not exist yet.
    there = next(place for place in (directory.absolute(), *directory.absolute().parents) if place.exists())
    disk, largest = shutil.disk_usage(there), largest_file()
    takes = f"The result takes {size_text(forecast.file_bytes)}"
    # File systems without a disk, such as /proc, have no size.
    if COPIES * forecast.file_bytes > disk.free and disk.total > 0:
        what = f"{takes}, twice that while it is packed, and the disk has {size_text(disk.free)} left."
        fix = "Store fewer frames or output.fields, or write to another disk with -o."
        yield Finding("warning", "disk", what, fix, forecast.file_bytes)
    if largest is not None and forecast.file_bytes > largest:
        what = f"{takes}, and a file may have {size_text(largest)} here."
        fix = "Raise the limit on the size of a file (ulimit -f), or store fewer frames or output.fields."
        yield Finding("warning", "disk", what, fix, forecast.file_bytes)
    try:
        require_memory(plan)
    except InputError as error:
        what, _, fix = str(error).rstrip(".").rpartition("; ")
        total = plan.device_bytes + plan.host_bytes
        yield Finding("error", "memory", f"{what[:1].upper()}{what[1:]}.", f"{fix[:1].upper()}{fix[1:]}.", total)
    if facts.bounds.speed == 0 and facts.bounds.gravity == 0:
        what = "Nothing moves: there is no gravity, and no body has a velocity."
        yield Finding("note", "at-rest", what, "Give domain.gravity, or a velocity to a body.")
