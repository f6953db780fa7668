"""One run from a loaded scene to a stored result: check, resume, run, store."""

import time
from collections.abc import Callable, Iterable

from mpmcli.check.finding import Finding, passes
from mpmcli.check.scene_check import check_scene
from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import check_directory
from mpmcli.output.directory import take_directory
from mpmcli.scene import LoadedScene, Scene
from mpmcli.simulation.engine import backend_for
from mpmcli.simulation.resume import find_resumption
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.stored_run import StoredRun
from mpmcli.simulation.summary import RunSummary
from mpmcli.solver.engine.plan import Plan, make_plan, require_memory
from mpmcli.solver.engine.run import Run, build_run
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
    if not (settings.force or passes(check.findings)):
        raise InputError(refusal(loaded.source, check.findings))
    complete = earlier is not None and earlier.complete
    run = None if complete else _build(scene, settings, plan, backend)
    if stop():
        raise KeyboardInterrupt
    # Last, because what is in it may be replaced.
    options = {"resume": settings.resume, "inputs": loaded.inputs}
    with take_directory(settings.directory, settings.overwrite, **options) as taken:
        if settings.resume:
            # Checked again under the lock, which excludes other writers.
            earlier = find_resumption(loaded, settings.directory)
            if run is None and (earlier is None or not earlier.complete):
                raise InputError(
                    f"{settings.directory} was changed by another process meanwhile: give the command again."
                )
            if earlier is None:
                taken.clear()
        stored = StoredRun(loaded, settings, plan, backend, check, earlier, taken, began, on_start, on_frame, stop)
        return stored.pack() if run is None else stored.compute(run)


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


def refusal(source: str, findings: Iterable[Finding], *, forced: bool = True) -> str:
    """Return the message for a scene refused by the check, a line per error; `forced`: whether --force is known."""
    errors = [finding for finding in findings if finding.severity == "error"]
    lines = [f"{source}: {finding.what} {finding.fix}" for finding in errors]
    # A run that does not fit into memory cannot be forced.
    if forced and not any(finding.rule == "memory" for finding in errors):
        lines.append("--force runs it all the same.")
    return "\n".join(lines)
