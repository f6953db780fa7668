"""One run from a loaded scene to a stored result: check, resume, run, store."""

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from mpmcli.check.finding import Finding, merged, passes
from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import DiskFullError, InputError, MpmcliError, RunError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output import RunRecord, check_directory, open_result
from mpmcli.output.directory import SCENE, take_directory
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import sealed_segments
from mpmcli.output.series import SERIES
from mpmcli.output.store import SegmentStore
from mpmcli.scene import LoadedScene, Scene, scene_to_toml
from mpmcli.simulation.engine import backend_for
from mpmcli.simulation.resume import find_resumption, go_on, require_same_run, take_over
from mpmcli.simulation.settings import RunSettings, StopCondition
from mpmcli.simulation.stored_run import (
    Checkpointer,
    RunContext,
    finish,
    new_record,
    new_store,
    new_summary,
    write_scene,
)
from mpmcli.simulation.summary import RunSummary, Stopwatch
from mpmcli.solver.engine.plan import Plan, make_plan, require_memory
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.solver.machine.backend import Backend, is_out_of_memory, out_of_memory_sentence, start


def simulate(
    loaded: LoadedScene,
    settings: RunSettings,
    on_start: Callable[[RunSummary], None] = lambda summary: None,
    on_frame: Callable[[LedgerRow, RunSummary], None] = lambda row, summary: None,
    stop: Callable[[], bool | str] = lambda: False,
) -> RunSummary:
    """Check a scene, run it until it ends or stops, and store the result.

    All input is validated before anything is written. A run that becomes unstable, is interrupted (`stop`, or
    KeyboardInterrupt), approaches a limit or cannot write keeps its sealed frames; its summary has the reason. A run
    interrupted before its first frame leaves no files.

    Args:
        on_start: called before the first step, with the notes and warnings of the check in the summary.
        on_frame: called after each stored frame with its ledger row and the summary so far.
        stop: called after every step and every stored frame; returns whether to interrupt the run, or the name of the
            requesting signal.

    Raises:
        InputError: the check finds errors, or the scene, the backend or the directory cannot be used, for example
            because another process writes to it; nothing was written.
        KeyboardInterrupt: the run was interrupted before it began; nothing was written.
    """
    began = time.perf_counter()
    scene = loaded.scene
    check_directory(settings.directory, settings.overwrite, resume=settings.resume)
    earlier = find_resumption(loaded, settings.directory) if settings.resume else None
    backend = backend_for(scene, settings.arch, settings.threads, compile_cache=settings.compile_cache)
    plan = make_plan(scene, backend)
    check = check_scene(loaded, plan=plan, directory=settings.directory, threads=backend.threads)
    findings = check.findings
    if not (settings.force or passes(findings)):
        raise InputError(refusal(loaded.source, findings))
    complete = earlier is not None and earlier.complete
    run = None if complete else _build(scene, settings, plan, backend)
    if stop():
        raise KeyboardInterrupt
    # Last, because what is in it may be replaced.
    inputs = loaded.inputs
    with take_directory(settings.directory, settings.overwrite, resume=settings.resume, inputs=inputs) as taken:
        if settings.resume:
            # Checked again under the lock, which excludes other writers.
            earlier = find_resumption(loaded, settings.directory)
            if run is None and (earlier is None or not earlier.complete):
                raise InputError(
                    f"{settings.directory} was changed by another process meanwhile: give the command again."
                )
            if earlier is None:
                taken.clear()
        notes = (*loaded.notes, *(one.line for one in merged(findings) if one.severity != "note"))
        context = RunContext(loaded, settings, plan, backend, earlier, notes, began, taken, check)
        if run is None:
            return _complete(context, on_start, stop)
        return _store_run(context, run, on_start, on_frame, stop)


def _build(scene: Scene, settings: RunSettings, plan: Plan, backend: Backend) -> Run:
    """Put a scene on the device; InputError: there is too little memory, or a particle is not in the domain."""
    require_memory(plan)
    settings.limits.require_memory(plan)
    start(backend)
    try:
        return build_run(scene, backend, force=settings.force)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        raise InputError(out_of_memory_sentence(backend.arch, error)) from error


def _store_run(
    context: RunContext,
    run: Run,
    on_start: Callable[[RunSummary], None],
    on_frame: Callable[[LedgerRow, RunSummary], None],
    stop: Callable[[], bool | str],
) -> RunSummary:
    scene, settings, plan, earlier = context.scene, context.settings, context.plan, context.earlier
    text = scene_to_toml(scene)
    header = RunHeader.of(scene, text, [laws()[name] for name in run.laws], context.facts)
    if earlier is not None:
        require_same_run(earlier, header.stored, context.directory)
        go_on(run, earlier, context.backend, forced=context.forced)
        take_over(context.directory, earlier)
    summary = new_summary(context)
    summary.particles = run.particle_count
    if earlier is None:
        stored = context.backend.on_cpu and run.batch.launch_cpu.is_there()
        summary.outlook = context.check.outlook(stored=stored)
        summary.compiling = None if stored else context.check.forecast.compile_seconds
    on_start(summary)
    record, taken = new_record(context, summary), context.taken

    def begin(first: Path | None = None) -> None:
        if taken.replaces:
            taken.clear(first)
        record.write()
        write_scene(context.directory, text)

    if not taken.replaces:
        begin()
    store = new_store(context, header.stored, begin if taken.replaces else None)
    options = {"size": plan.particles * plan.bytes_per_particle, "every": settings.checkpoint_every}
    checkpoints = Checkpointer(context.directory, run, store, summary.backend, forced=context.forced, **options)
    clock = Stopwatch(summary.timings, context.began)
    halt = StopCondition(stop, settings.limits, compress=scene.output.compress)
    failure: dict = {}
    try:
        _compute(run, store, checkpoints, record, summary, clock, on_frame, halt)
        summary.status = "finished"
    except KeyboardInterrupt:
        halt.interrupted()
        summary.status, summary.message = halt.status, halt.message
        failure = {"signal": halt.signal} if halt.signal else {}
    except UnstableRunError as error:
        summary.status, summary.message = "unstable", str(error)
        failure = vars(error.diagnosis)
    except DiskFullError as error:
        summary.status, summary.message = "stopped", str(error)
    except MpmcliError as error:
        summary.status, summary.message = "failed", str(error)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        summary.status, summary.message = "failed", out_of_memory_sentence(context.backend.arch, error)
    finally:
        if summary.status == "running" and not taken.replaces:
            # A fault of mpmcli: the record must not state that the run continues.
            record.close("failed", "an internal error ended the run")
    summary.steps = run.step_count
    if taken.replaces:
        summary.message = f"{summary.message.rstrip('.')}; the earlier result in {context.directory} is kept."
        taken.undo()
        return summary
    clock.book(run.first_step_seconds, "compile_s")
    with clock.adding("output_s"):
        finish(context, store, summary, halt)
    clock.stop()
    if summary.status == "interrupted" and not summary.frames:
        taken.undo()
        return summary
    record.timings = summary.timings
    record.close(summary.status, summary.message, **failure)
    _judge(summary, halt)
    return summary


def _complete(
    context: RunContext, on_start: Callable[[RunSummary], None], stop: Callable[[], bool | str]
) -> RunSummary:
    """Pack the frames of a run that has stored all of them, unless they are packed."""
    settings, earlier, directory = context.settings, context.earlier, context.directory
    summary = new_summary(context)
    on_start(summary)
    clock = Stopwatch(summary.timings, context.began)
    text = scene_to_toml(context.scene)
    packed = not sealed_segments(directory)
    series = directory / SERIES
    same = (directory / SCENE).read_text(encoding="utf-8") == text
    done = packed and same and earlier.record["status"] == "finished"
    if done and (settings.form == "vtkhdf" or series.exists()):
        summary.status = "finished"
        summary.path = series if settings.form == "vtk" else open_result(directory).path
        return summary
    record = new_record(context, summary)
    take_over(directory, earlier)
    write_scene(directory, text)
    store = new_store(context, {**earlier.index.header, "scene": text})
    summary.status = "finished"
    halt = StopCondition(stop, settings.limits, compress=context.scene.output.compress)
    with clock.adding("output_s"):
        finish(context, store, summary, halt)
    clock.stop()
    record.timings = summary.timings
    record.close(summary.status, summary.message)
    _judge(summary, halt)
    return summary


def _judge(summary: RunSummary, halt: StopCondition) -> None:
    """Check a finished result as `mpmcli check` does, unless an interrupt or --max-time comes first."""
    if summary.status == "finished":
        with suppress(KeyboardInterrupt):
            summary.check = check_result(summary.directory, halt.packing)


def _compute(
    run: Run,
    store: SegmentStore,
    checkpoints: Checkpointer,
    record: RunRecord,
    summary: RunSummary,
    clock: Stopwatch,
    on_frame: Callable[[LedgerRow, RunSummary], None],
    halt: StopCondition,
) -> None:
    """Compute and store each frame; the record and the summary count only sealed frames."""
    rows: list[LedgerRow] = []
    kept = store.frames_written

    def after_step() -> bool:
        with clock.adding("output_s"):
            store.seal_due()
        if store.frames_written > max(kept, summary.frames):
            report()
        ends = halt()
        if ends or checkpoints.due():
            checkpoints.take()
        return ends

    def report() -> None:
        sealed = rows[summary.frames - kept : store.frames_written - kept]
        with clock.adding("output_s"):
            clock.book(run.first_step_seconds, "compile_s")
            clock.book(run.frame_seconds + checkpoints.seconds, "output_s")
            summary.steps, summary.time = run.step_count, run.time
            summary.timings["watch_s"] = run.measure_seconds
            record.timings = summary.timings
            for row in sealed:
                record.observe(row)
            if sealed:
                record.write()
        for row in sealed:
            summary.frames += 1
            summary.first, summary.last = summary.first or row, row
            on_frame(row, summary)

    frames = run.frames(after_step)
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
            # Release the frame, whose memory the next one reuses.
            del frame
            report()
            halt.wrote(store.bytes_written, store.seconds)
    except BaseException:
        # Report the first error.
        with suppress(RunError):
            store.seal()
            report()
        raise
    with clock.adding("output_s"):
        store.seal()
        if checkpoints.taken:
            # A final checkpoint permits resumption with a later end.
            checkpoints.take()
    report()


def refusal(source: str, findings: Iterable[Finding], *, forced: bool = True) -> str:
    """Return the message for a scene refused by the check, a line per error; `forced`: whether --force is known."""
    errors = [finding for finding in findings if finding.severity == "error"]
    lines = [f"{source}: {finding.what} {finding.fix}" for finding in errors]
    # A run that does not fit into memory cannot be forced.
    if forced and not any(finding.rule == "memory" for finding in errors):
        lines.append("--force runs it all the same.")
    return "\n".join(lines)
