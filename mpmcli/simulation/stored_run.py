"""Opens and closes the record, the summary, the scene and the store of a run."""

from pathlib import Path
from typing import Any

from mpmcli.errors import NoRoomError, RunError
from mpmcli.output import RunRecord, SegmentStore
from mpmcli.output.directory import SCENE
from mpmcli.output.durable import write_text
from mpmcli.output.segments import DAMAGED
from mpmcli.output.series import write_series
from mpmcli.output.store import HOLD
from mpmcli.scene import LoadedScene
from mpmcli.simulation.limits import Halt
from mpmcli.simulation.resume import Resumption, file_digests
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.summary import RunSummary
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.machine.plan import Plan


def new_summary(
    loaded: LoadedScene,
    settings: RunSettings,
    plan: Plan,
    backend: Backend,
    earlier: Resumption | None,
    notes: tuple[str, ...],
) -> RunSummary:
    """Return the summary of a run that begins, or goes on from an earlier part."""
    facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
    summary = RunSummary(settings.directory, plan.particles, loaded.scene.time.frames + 1, facts, notes, plan)
    if earlier is not None:
        summary.notes += (earlier.note,)
        summary.frames = earlier.frames
        if earlier.rows:
            summary.first, summary.last = earlier.rows[0], earlier.rows[-1]
            summary.steps = int(earlier.index.steps[-1])
        summary.steps_before = earlier.step
    return summary


def new_store(
    loaded: LoadedScene, settings: RunSettings, header: dict[str, Any], earlier: Resumption | None
) -> SegmentStore:
    """Return the store of a run, which goes on after the frames that are there."""
    scene = loaded.scene
    store = SegmentStore(
        settings.directory,
        header,
        compress=scene.output.compress,
        hold=HOLD,
        colliders=scene.colliders,
    )
    if earlier is not None and earlier.index is not None:
        store.go_on_after(earlier.index)
    return store


def write_scene(directory: Path, text: str) -> None:
    """Write the effective scene beside the frames; RunError: the disk is full or refuses."""
    try:
        write_text(directory / SCENE, text)
    except OSError as error:
        raise RunError(f"{directory / SCENE} could not be written ({error.strerror or error}).") from error


def finish(store: SegmentStore, summary: RunSummary, halt: Halt, loaded: LoadedScene, settings: RunSettings) -> None:
    """Pack what was stored, and write it as a series too, if that is asked for.

    Until then, the result is the directory with its sealed frames.
    """
    summary.path = summary.directory
    try:
        summary.path = store.finish(halt.packing)
        (settings.directory / DAMAGED).unlink(missing_ok=True)
        if settings.form == "vtk" and summary.path is not None:
            scene = loaded.scene
            compress = scene.output.compress
            summary.path = write_series(settings.directory, scene.colliders, compress=compress, stop=halt.packing)
    except KeyboardInterrupt:
        if not halt.status:
            halt.interrupted()
        where = f"its frames were left unpacked, and stay readable in {store.place}"
        if summary.path != summary.directory:
            where = "the series was not written, which --resume does"
        summary.status, summary.message = halt.status, f"{halt.message}; {where}"
    except RunError as error:
        if summary.status == "finished":
            summary.status = "stopped" if isinstance(error, NoRoomError) else "failed"
        summary.message = f"{summary.message} {error}".strip()


def new_record(
    loaded: LoadedScene, settings: RunSettings, summary: RunSummary, earlier: Resumption | None
) -> RunRecord:
    """Return the record of a run, which goes on from that of an earlier part."""
    record = RunRecord(
        settings.directory,
        command=settings.command,
        backend=summary.backend,
        seeds={
            source.name: source.seed for source in loaded.scene.sources if source.sampling in ("jittered", "poisson")
        },
        forced=settings.force and loaded.scene.time.step != "auto",
        files=file_digests(loaded),
        frames_expected=summary.frames_expected,
        particles=summary.particles,
        notes=summary.notes,
    )
    if earlier is not None:
        record.go_on_from(earlier.record, earlier.rows, earlier.step)
    return record
