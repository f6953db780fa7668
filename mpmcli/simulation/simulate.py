"""One run from a loaded scene to a stored result: check, refuse or go on, run, store."""

import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from mpmcli.check.finding import Finding, passes
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError, MpmcliError, RunError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output import (
    RunRecord,
    check_directory,
    open_result,
    prepare_directory,
)
from mpmcli.output.directory import SCENE
from mpmcli.output.header import RunHeader
from mpmcli.output.segments import sealed_segments
from mpmcli.output.store import Store
from mpmcli.scene import LoadedScene, scene_to_toml
from mpmcli.simulation.checkpointing import Checkpointer
from mpmcli.simulation.engine import choose_engine
from mpmcli.simulation.resume import Resumption, find_resumption, go_on, take_over
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.stopwatch import Stopwatch
from mpmcli.simulation.stored_run import finish, new_record, new_store, new_summary, write_scene
from mpmcli.simulation.summary import RunSummary
from mpmcli.solver.backend import Backend, start
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.engine import Engine, build_engine
from mpmcli.solver.plan import Plan, make_plan, require_room


def simulate(
    loaded: LoadedScene,
    settings: RunSettings,
    on_start: Callable[[RunSummary], None] = lambda summary: None,
    on_frame: Callable[[LedgerRow, RunSummary], None] = lambda row, summary: None,
    stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Check a scene, run it to its end or to where it stops, and store it.

    Everything that can be refused is refused before anything is written. A run that becomes unstable, is
    interrupted (`stop`, or KeyboardInterrupt) or cannot write keeps its sealed frames; its summary says so.

    Args:
        on_start: called before the first step, with the notes and warnings of the check in the summary.
        on_frame: called after each stored frame with its ledger row and the summary so far.
        stop: called after every step and every stored frame; returns whether to interrupt the run.

    Raises:
        InputError: the check finds errors, or the scene, the backend or the directory cannot be used; nothing was
            written.
    """
    began = time.perf_counter()
    scene = loaded.scene
    check_directory(settings.directory, settings.overwrite, resume=settings.resume)
    earlier = find_resumption(loaded, settings.directory, settings.form) if settings.resume else None
    backend, batched = choose_engine(scene, settings.arch, settings.threads, compile_cache=settings.compile_cache)
    plan = make_plan(scene, backend)
    findings = check_scene(loaded, plan=plan, directory=settings.directory).findings
    if not (settings.force or passes(findings)):
        raise InputError(_refusal(loaded.source, findings))
    if earlier is not None and earlier.complete:
        return _complete(loaded, settings, earlier, plan, backend, on_start)
    require_room(plan)
    start(backend)
    solver = build_engine(scene, backend, batched=batched, force=settings.force)
    forced = settings.force and scene.time.step != "auto"
    if earlier is None:
        # Last, since it removes an earlier result.
        prepare_directory(settings.directory, settings.overwrite or settings.resume)
    else:
        go_on(solver, earlier, backend, forced=forced)
        take_over(settings.directory, earlier)

    notes = (*loaded.notes, *(finding.line for finding in findings if finding.severity != "note"))
    summary = new_summary(loaded, settings, plan, backend, earlier, notes)
    on_start(summary)
    record = new_record(loaded, settings, summary, earlier)
    text = scene_to_toml(scene)
    record.write()
    write_scene(settings.directory, text)
    header = RunHeader.of(scene, text, [laws()[name] for name in solver.laws], summary.backend)
    store = new_store(loaded, settings, header.stored, earlier)
    checkpoints = Checkpointer(
        settings.directory,
        solver,
        store,
        summary.backend,
        size=plan.particles * plan.bytes_per_particle,
        forced=forced,
        every=settings.checkpoint_every,
    )

    clock = Stopwatch(summary.timings, began)
    failure: dict = {}
    try:
        _run(solver, store, checkpoints, record, summary, clock, on_frame, stop)
        summary.status = "finished"
    except KeyboardInterrupt:
        summary.status, summary.message = "interrupted", "the run was interrupted"
    except UnstableRunError as error:
        summary.status, summary.message = "unstable", str(error)
        failure = vars(error.diagnosis)
    except MpmcliError as error:
        summary.status, summary.message = "failed", str(error)
    finally:
        if summary.status == "running":
            # A fault of mpmcli: the record must not state that the run is going on.
            record.close("failed", "an internal error ended the run")
    summary.steps = solver.step_count
    clock.book(solver.first_step_seconds, "compile_s")
    with clock.adding("output_s"):
        finish(store, summary)
    clock.stop()
    record.timings = summary.timings
    record.close(summary.status, summary.message, **failure)
    return summary


def _complete(
    loaded: LoadedScene,
    settings: RunSettings,
    earlier: Resumption,
    plan: Plan,
    backend: Backend,
    on_start: Callable[[RunSummary], None],
) -> RunSummary:
    """Pack the frames of a run that had stored all of them; nothing is done where they are packed."""
    began = time.perf_counter()
    summary = new_summary(loaded, settings, plan, backend, earlier, loaded.notes)
    on_start(summary)
    clock = Stopwatch(summary.timings, began)
    text = scene_to_toml(loaded.scene)
    packed = settings.form == "vtk" or not sealed_segments(settings.directory)
    same = (settings.directory / SCENE).read_text(encoding="utf-8") == text
    if packed and same and earlier.record["status"] == "finished":
        summary.status, summary.path = "finished", open_result(settings.directory).path
        return summary
    record = new_record(loaded, settings, summary, earlier)
    take_over(settings.directory, earlier)
    write_scene(settings.directory, text)
    store = new_store(loaded, settings, {**earlier.index.header, "scene": text}, earlier)
    summary.status = "finished"
    with clock.adding("output_s"):
        finish(store, summary)
    clock.stop()
    record.timings = summary.timings
    record.close(summary.status, summary.message)
    return summary


def _run(
    solver: Engine,
    store: Store,
    checkpoints: Checkpointer,
    record: RunRecord,
    summary: RunSummary,
    clock: Stopwatch,
    on_frame: Callable[[LedgerRow, RunSummary], None],
    stop: Callable[[], bool],
) -> None:
    """Compute and store frame after frame; the record and the summary follow the frames that are sealed."""
    rows: list[LedgerRow] = []
    kept = store.frames_written

    def after_step() -> bool:
        store.seal_due()
        ends = stop()
        if ends or checkpoints.due():
            checkpoints.take()
        return ends

    def report() -> None:
        sealed = rows[summary.frames - kept : store.frames_written - kept]
        with clock.adding("output_s"):
            clock.book(solver.first_step_seconds, "compile_s")
            clock.book(solver.frame_seconds + checkpoints.seconds, "output_s")
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
            if frame.index >= kept:
                rows.append(row)
            with clock.adding("output_s"):
                store.write(frame, row)
            report()
    except BaseException:
        # The first error is the one to be told.
        with suppress(RunError):
            store.seal()
            report()
        raise
    with clock.adding("output_s"):
        store.seal()
        if checkpoints.taken:
            # So that the run can go on where its end is put off.
            checkpoints.take()
    report()


def _refusal(source: str, findings: Iterable[Finding]) -> str:
    """Return the message of a scene that the check refuses, a line for each error."""
    errors = [finding for finding in findings if finding.severity == "error"]
    lines = [f"{source}: {finding.what} {finding.fix}" for finding in errors]
    # A run that does not fit into memory cannot be forced.
    if not any(finding.rule == "memory" for finding in errors):
        lines.append("--force runs it all the same.")
    return "\n".join(lines)
