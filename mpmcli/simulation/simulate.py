"""One run from a loaded scene to a stored result: check, refuse or go on, run, store."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mpmcli.check.finding import Finding, passes
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError, MpmcliError, NoRoomError, RunError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output import RunRecord, SegmentStore, VtkSeriesStore, check_directory
from mpmcli.output.directory import TakenDirectory, take_directory
from mpmcli.output.durable import write_text
from mpmcli.output.header import RunHeader
from mpmcli.output.store import HOLD, Store
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.simulation.engine import choose_engine
from mpmcli.simulation.limits import Halt, Limits
from mpmcli.simulation.stopwatch import Stopwatch
from mpmcli.simulation.summary import RunSummary
from mpmcli.solver.backend import Arch, Backend, start
from mpmcli.solver.device_memory import is_out_of_memory, out_of_memory_sentence
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.engine import Engine, build_engine
from mpmcli.solver.plan import Plan, make_plan, require_room

SCENE = "scene.toml"


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that are not part of its scene.

    Attributes:
        directory: where the result goes.
        arch: backend to use; threads: CPU threads, where None one for few particles and otherwise all.
        form: "vtkhdf" for one packed file, "vtk" for a .vtu series.
        overwrite: whether an earlier result in the directory may be replaced.
        force: whether to run although the check finds errors, and to take time.step above the stable step too.
        compile_cache: whether compiled kernels are kept for the next start.
        limits: on time and memory.
        command: the command line, for the record.
    """

    directory: Path
    arch: Arch = "auto"
    threads: int | None = None
    form: Literal["vtkhdf", "vtk"] = "vtkhdf"
    overwrite: bool = False
    force: bool = False
    compile_cache: bool = True
    limits: Limits = field(default_factory=Limits)
    command: Sequence[str] = ()


def simulate(
    loaded: LoadedScene,
    settings: RunSettings,
    on_start: Callable[[RunSummary], None] = lambda summary: None,
    on_frame: Callable[[LedgerRow, RunSummary], None] = lambda row, summary: None,
    stop: Callable[[], bool | str] = lambda: False,
) -> RunSummary:
    """Check a scene, run it to its end or to where it stops, and store it.

    Everything that can be refused is refused before anything is written. A run that becomes unstable, is
    interrupted (`stop`, or KeyboardInterrupt), comes near a limit or cannot write keeps its sealed frames; its summary
    says so. One that is interrupted before its first frame leaves nothing.

    Args:
        on_start: called before the first step, with the notes and warnings of the check in the summary.
        on_frame: called after each stored frame with its ledger row and the summary so far.
        stop: called after every step and every stored frame; returns whether to interrupt the run, or the name of the
            signal that asks for it.

    Raises:
        InputError: the check finds errors, or the scene, the backend or the directory cannot be used, as when another
            process writes it; nothing was written.
        KeyboardInterrupt: the run was interrupted before it began; nothing was written.
    """
    began = time.perf_counter()
    scene = loaded.scene
    check_directory(settings.directory, settings.overwrite)
    backend, batched = choose_engine(scene, settings.arch, settings.threads, compile_cache=settings.compile_cache)
    plan = make_plan(scene, backend)
    findings = check_scene(loaded, plan=plan, directory=settings.directory).findings
    if not (settings.force or passes(findings)):
        raise InputError(_refusal(loaded.source, findings))
    require_room(plan)
    settings.limits.require_room(plan)
    start(backend)
    try:
        solver = build_engine(scene, backend, batched=batched, force=settings.force)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        raise InputError(out_of_memory_sentence(backend.arch, error)) from error
    if stop():
        raise KeyboardInterrupt
    # Last, since it removes an earlier result.
    with take_directory(settings.directory, settings.overwrite) as taken:
        return _store_run(loaded, settings, findings, plan, backend, solver, taken, began, on_start, on_frame, stop)


def _store_run(
    loaded: LoadedScene,
    settings: RunSettings,
    findings: Sequence[Finding],
    plan: Plan,
    backend: Backend,
    solver: Engine,
    taken: TakenDirectory,
    began: float,
    on_start: Callable[[RunSummary], None],
    on_frame: Callable[[LedgerRow, RunSummary], None],
    stop: Callable[[], bool | str],
) -> RunSummary:
    """Run a scene and store it in a directory that is this process's to write; see `simulate`."""
    scene = loaded.scene
    notes = (*loaded.notes, *(finding.line for finding in findings if finding.severity != "note"))
    facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
    summary = RunSummary(settings.directory, solver.particle_count, scene.time.frames + 1, facts, notes, plan)
    on_start(summary)
    record = _new_record(scene, settings, summary)
    text = scene_to_toml(scene)
    try:
        write_text(settings.directory / SCENE, text)
    except OSError as error:
        raise RunError(f"{settings.directory / SCENE} could not be written ({error.strerror or error}).") from error
    record.write()
    header = RunHeader.of(scene, text, [laws()[name] for name in solver.laws], summary.backend)
    kind = VtkSeriesStore if settings.form == "vtk" else SegmentStore
    options = {"compress": scene.output.compress, "hold": HOLD, "colliders": scene.colliders}
    store = kind(settings.directory, header.stored, **options)

    clock = Stopwatch(summary.timings, began)
    halt = Halt(stop, settings.limits, compress=scene.output.compress)
    failure: dict = {}
    try:
        _run(solver, store, record, summary, clock, on_frame, halt)
        summary.status = "finished"
    except KeyboardInterrupt:
        halt.interrupted()
        summary.status, summary.message = halt.status, halt.message
        failure = {"signal": halt.signal} if halt.signal else {}
    except UnstableRunError as error:
        summary.status, summary.message = "unstable", str(error)
        failure = vars(error.diagnosis)
    except NoRoomError as error:
        summary.status, summary.message = "stopped", str(error)
    except MpmcliError as error:
        summary.status, summary.message = "failed", str(error)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        summary.status, summary.message = "failed", out_of_memory_sentence(backend.arch, error)
    finally:
        if summary.status == "running":
            # A fault of mpmcli: the record must not state that the run is going on.
            record.close("failed", "an internal error ended the run")
    summary.steps = solver.step_count
    clock.book(solver.first_step_seconds, "compile_s")
    with clock.adding("output_s"):
        _finish(store, summary, halt)
    clock.stop()
    if summary.status == "interrupted" and not summary.frames:
        taken.undo()
        return summary
    record.timings = summary.timings
    record.close(summary.status, summary.message, **failure)
    return summary


def _run(
    solver: Engine,
    store: Store,
    record: RunRecord,
    summary: RunSummary,
    clock: Stopwatch,
    on_frame: Callable[[LedgerRow, RunSummary], None],
    halt: Halt,
) -> None:
    """Compute and store frame after frame; the record and the summary follow the frames that are sealed."""
    rows: list[LedgerRow] = []

    def after_step() -> bool:
        store.seal_due()
        return halt()

    def report() -> None:
        sealed = rows[summary.frames : store.frames_written]
        with clock.adding("output_s"):
            clock.book(solver.first_step_seconds, "compile_s")
            clock.book(solver.frame_seconds, "output_s")
            summary.steps = solver.step_count
            summary.timings["watch_s"] = solver.measure_seconds
            record.timings = summary.timings
            for row in sealed:
                record.observe(row)
            if sealed:
                record.write()
        for row in sealed:
            summary.frames += 1
            summary.first, summary.last = summary.first or row, row
            on_frame(row, summary)

    frames = solver.frames(after_step)
    try:
        while True:
            with clock.adding("solve_s"):
                frame, row = next(frames, (None, None))
            if frame is None:
                break
            rows.append(row)
            with clock.adding("output_s"):
                store.write(frame, row)
            report()
            halt.wrote(store.bytes_written, store.seconds)
            if halt():
                raise KeyboardInterrupt
    except BaseException:
        # The first error is the one to be told.
        with suppress(RunError):
            store.seal()
            report()
        raise
    with clock.adding("output_s"):
        store.seal()
    report()


def _finish(store: Store, summary: RunSummary, halt: Halt) -> None:
    """Pack what was stored; until then, the result is the directory with its sealed frames."""
    summary.path = summary.directory
    try:
        summary.path = store.finish(halt.packing)
    except KeyboardInterrupt:
        if not halt.status:
            halt.interrupted()
        where = f"its frames were left unpacked, and stay readable in {store.place}"
        summary.status, summary.message = halt.status, f"{halt.message}; {where}"
    except RunError as error:
        if summary.status == "finished":
            summary.status = "stopped" if isinstance(error, NoRoomError) else "failed"
        summary.message = f"{summary.message} {error}".strip()


def _new_record(scene: Scene, settings: RunSettings, summary: RunSummary) -> RunRecord:
    return RunRecord(
        settings.directory,
        command=settings.command,
        backend=summary.backend,
        seeds={body.name: body.seed for body in scene.bodies if body.sampling == "jittered"},
        frames_expected=summary.frames_expected,
        particles=summary.particles,
        notes=summary.notes,
    )


def _refusal(source: str, findings: Iterable[Finding]) -> str:
    """Return the message of a scene that the check refuses, a line for each error."""
    errors = [finding for finding in findings if finding.severity == "error"]
    lines = [f"{source}: {finding.what} {finding.fix}" for finding in errors]
    # A run that does not fit into memory cannot be forced.
    if not any(finding.rule == "memory" for finding in errors):
        lines.append("--force runs it all the same.")
    return "\n".join(lines)
