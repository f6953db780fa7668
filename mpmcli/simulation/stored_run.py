"""Creates and completes the files of a run: record, scene, frames and checkpoints."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from mpmcli.check.scene_check import SceneCheck
from mpmcli.errors import DiskFullError, RunError
from mpmcli.output import RunRecord
from mpmcli.output.checkpoints import Checkpoint, write_checkpoint
from mpmcli.output.directory import SCENE, TakenDirectory
from mpmcli.output.durable import write_text
from mpmcli.output.layout import DAMAGED
from mpmcli.output.series import write_series
from mpmcli.output.store import HOLD, SegmentStore
from mpmcli.scene import LoadedScene, Scene
from mpmcli.simulation.resume import Resumption, file_digests
from mpmcli.simulation.settings import RunSettings, StopCondition
from mpmcli.simulation.summary import RunSummary
from mpmcli.solver.engine.plan import Plan
from mpmcli.solver.engine.run import Run
from mpmcli.solver.machine.backend import Backend


class RunContext(NamedTuple):
    """The inputs of a run.

    Attributes:
        began: start in the time of `time.perf_counter`, s; earlier: the resumed part. notes: automatic choices, and
            warnings of the check. taken: the directory, locked against other processes.
    """

    loaded: LoadedScene
    settings: RunSettings
    plan: Plan
    backend: Backend
    earlier: Resumption | None
    notes: tuple[str, ...]
    began: float
    taken: TakenDirectory
    check: SceneCheck

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.loaded.scene

    @property
    def directory(self) -> Path:
        """The output directory."""
        return self.settings.directory

    @property
    def forced(self) -> bool:
        """Whether time.step is used even above the stable step."""
        return self.settings.force and self.scene.time.step != "auto"

    @property
    def facts(self) -> dict[str, object]:
        """The backend, as in a header."""
        backend = self.backend
        return {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}


def new_summary(context: RunContext) -> RunSummary:
    """Return the summary of a new or resumed run."""
    plan, earlier = context.plan, context.earlier
    expected = context.scene.time.frames + 1
    summary = RunSummary(context.directory, plan.particles, expected, context.facts, context.notes, plan)
    if earlier is not None:
        summary.notes += (earlier.note,)
        summary.frames = earlier.frames
        if earlier.rows:
            summary.first, summary.last = earlier.rows[0], earlier.rows[-1]
            summary.steps = int(earlier.index.steps[-1])
        summary.steps_before = earlier.step
    return summary


def new_store(
    context: RunContext, header: dict[str, Any], replace_earlier: Callable[[Path], None] | None = None
) -> SegmentStore:
    """Return the store of a run, which continues after the existing frames, or replaces those of another run."""
    scene, earlier = context.scene, context.earlier
    options = {"compress": scene.output.compress, "colliders": scene.colliders, "replace_earlier": replace_earlier}
    store = SegmentStore(context.directory, header, hold=HOLD, **options)
    if earlier is not None and earlier.index is not None:
        store.go_on_after(earlier.index)
    return store


def write_scene(directory: Path, text: str) -> None:
    """Write the effective scene to the output directory; RunError: the disk is full or a write failed."""
    try:
        write_text(directory / SCENE, text)
    except OSError as error:
        raise RunError(f"{directory / SCENE} could not be written ({error.strerror or error}).") from error


def finish(context: RunContext, store: SegmentStore, summary: RunSummary, halt: StopCondition) -> None:
    """Pack the stored frames, and also write them as a series if requested.

    Before that, the result is the directory with its sealed frames.
    """
    summary.path = summary.directory
    try:
        summary.path = store.finish(halt.packing)
        (context.directory / DAMAGED).unlink(missing_ok=True)
        if context.settings.form == "vtk" and summary.path is not None:
            colliders, compress = context.scene.colliders, context.scene.output.compress
            summary.path = write_series(context.directory, colliders, compress=compress, stop=halt.packing)
    except KeyboardInterrupt:
        if not halt.status:
            halt.interrupted()
        where = f"its frames were left unpacked, and stay readable in {store.place}"
        if summary.path != summary.directory:
            where = "the series was not written, which --resume does"
        summary.status, summary.message = halt.status, f"{halt.message}; {where}"
    except RunError as error:
        if summary.status == "finished":
            summary.status = "stopped" if isinstance(error, DiskFullError) else "failed"
        summary.message = f"{summary.message} {error}".strip()


def new_record(context: RunContext, summary: RunSummary) -> RunRecord:
    """Return the record of a run, continued from that of an earlier part."""
    earlier = context.earlier
    record = RunRecord(
        context.directory,
        command=context.settings.command,
        backend=summary.backend,
        seeds={one.name: one.seed for one in context.scene.sources if one.sampling in ("jittered", "poisson")},
        forced=context.forced,
        files=file_digests(context.loaded),
        frames_expected=summary.frames_expected,
        particles=summary.particles,
        notes=summary.notes,
    )
    if earlier is not None:
        record.go_on_from(earlier.record, earlier.rows, earlier.step)
    return record


# Fraction of the wall time that checkpoints may take, and the shortest time between two, s.
SHARE, LEAST = 0.008, 5.0
# Cost assumed before the first one: seconds to compile the kernels that read the device, and bytes written per second.
FIRST, RATE = 1.0, 3e8


class Checkpointer:
    """Writes checkpoints of one run; `seconds` of wall time spent so far, and number `taken`."""

    def __init__(
        self,
        directory: Path,
        run: Run,
        store: SegmentStore,
        backend: Mapping[str, object],
        *,
        size: int,
        forced: bool,
        every: float | None = None,
    ) -> None:
        """Begin; `size` of the particles, bytes; `every` in s, None: as often as costs SHARE of the time."""
        self._directory, self._run, self._store = directory, run, store
        self._backend = {name: str(backend[name]) for name in ("arch", "precision")}
        self._forced, self._every = forced, every
        self._cost = FIRST + size / RATE
        self._last = time.monotonic()
        self.seconds, self.taken = 0.0, 0

    def due(self) -> bool:
        """Return whether the next checkpoint is due."""
        wait = max(LEAST, self._cost / SHARE) if self._every is None else self._every
        return time.monotonic() - self._last >= wait

    def take(self) -> None:
        """Seal waiting frames, then write the state; RunError: frames cannot be sealed. A full disk skips the state."""
        began = time.monotonic()
        self._store.seal()
        sealed = time.monotonic()
        with suppress(OSError, RunError):
            saved = self._run.save()
            numbers = saved.numbers
            point = Checkpoint(
                frame=int(numbers["frames"][0]),
                step=self._run.step_count,
                time=self._run.time,
                backend=self._backend,
                forced=self._forced,
                numbers=numbers,
                arrays=saved.arrays,
            )
            write_checkpoint(self._directory, point, saved.arrays.nbytes)
            self.taken += 1
        self._last = time.monotonic()
        self._cost = self._last - sealed
        self.seconds += self._last - began
