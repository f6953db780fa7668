"""One run from a loaded scene to a stored result: check, resume, run, store its record, frames and checkpoints."""

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding, merged, passes
from mpmcli.check.forecast import expected_steps
from mpmcli.check.result_check import check_result
from mpmcli.check.scene_check import SceneCheck, check_scene
from mpmcli.errors import DiskFullError, InputError, MpmcliError, RunError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output import RunRecord, check_directory, open_result
from mpmcli.output.checkpoints import Checkpoint, write_checkpoint
from mpmcli.output.directory import SCENE, TakenDirectory, take_directory
from mpmcli.output.durable import write_text, writing
from mpmcli.output.header import RunHeader
from mpmcli.output.layout import DAMAGED, sealed_segments
from mpmcli.output.series import SERIES, write_series
from mpmcli.output.store import HOLD, SegmentStore
from mpmcli.scene import LoadedScene, scene_to_toml
from mpmcli.simulation.resume import Resumption, file_digests, find_resumption, go_on, require_same_run, take_over
from mpmcli.simulation.settings import RunSettings, StopCondition
from mpmcli.simulation.summary import RunSummary, Stopwatch
from mpmcli.solver.engine.plan import Plan, make_plan, require_memory
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, backend_for, build_run
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
    asked, facts = Resolved(loaded.scene), cache(partial(SceneFacts, loaded.scene))
    check_directory(settings.directory, settings.overwrite, resume=settings.resume)
    earlier = find_resumption(loaded, settings.directory) if settings.resume else None
    options = {"compile_cache": settings.compile_cache}
    backend = backend_for(asked, lambda: expected_steps(facts()), settings.arch, settings.threads, **options)
    plan = make_plan(asked, backend)
    check = check_scene(loaded, facts=facts(), plan=plan, directory=settings.directory, threads=backend.threads)
    if not (settings.force or passes(check.findings)):
        raise InputError(refusal(loaded.source, check.findings))
    complete = earlier is not None and earlier.complete
    run = None if complete else _build(asked, settings, plan, backend)
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


def _build(asked: Resolved, settings: RunSettings, plan: Plan, backend: Backend) -> Run:
    """Put a scene on the device; InputError: there is too little memory, or a particle is not in the domain."""
    require_memory(plan)
    settings.limits.require_memory(plan)
    start(backend)
    try:
        return build_run(asked, backend, force=settings.force)
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


@dataclass
class StoredRun:
    """A run, new or resumed, whose frames `compute` computes and stores, or `pack` only packs.

    Attributes:
        check: of the scene. earlier: the resumed part. taken: the directory, locked against other processes.
        began: start in the time of `time.perf_counter`, s. on_start, on_frame, stop: see `simulate`.
    """

    loaded: LoadedScene
    settings: RunSettings
    plan: Plan
    backend: Backend
    check: SceneCheck
    earlier: Resumption | None
    taken: TakenDirectory
    began: float
    on_start: Callable[[RunSummary], None]
    on_frame: Callable[[LedgerRow, RunSummary], None]
    stop: Callable[[], bool | str]

    def __post_init__(self) -> None:
        """Prepare the summary, which continues that of an earlier part of the run."""
        scene, earlier = self.loaded.scene, self.earlier
        self._scene, self._directory, self._text = scene, self.settings.directory, scene_to_toml(scene)
        # Whether time.step is used even above the stable step.
        self._forced = self.settings.force and scene.time.step != "auto"
        self._halt = StopCondition(self.stop, self.settings.limits, compress=scene.output.compress)
        notes = (*self.loaded.notes, *(one.line for one in merged(self.check.findings) if one.severity != "note"))
        counts = self.plan.particles, scene.time.frames + 1
        self._summary = summary = RunSummary(self._directory, *counts, self.backend.facts, notes, self.plan)
        if earlier is not None:
            summary.notes += (earlier.note,)
            summary.frames = earlier.frames
            if earlier.rows:
                summary.first, summary.last = earlier.rows[0], earlier.rows[-1]
                summary.steps = int(earlier.index.steps[-1])
            summary.steps_before = earlier.step

    def compute(self, run: Run) -> RunSummary:
        """Compute and store the frames that are missing, and pack all."""
        summary, earlier, taken, halt = self._summary, self.earlier, self.taken, self._halt
        names = [laws()[name] for name in run.laws]
        header = RunHeader.of(self._scene, self._text, names, self.backend.facts).stored
        if earlier is not None:
            require_same_run(earlier, header, self._directory)
            go_on(run, earlier, self.backend, forced=self._forced)
            take_over(self._directory, earlier)
        summary.particles = run.particle_count
        if earlier is None:
            stored = self.backend.on_cpu and run.batch.launch_cpu.is_there()
            summary.outlook = self.check.outlook(stored=stored)
            summary.compiling = None if stored else self.check.forecast.compile_seconds
        self.on_start(summary)
        self._open(header)
        if not taken.replaces:
            self._begin()
        size, every = self.plan.particles * self.plan.bytes_per_particle, self.settings.checkpoint_every
        checkpoints = Checkpointer(
            self._directory, run, self._store, summary.backend, size=size, forced=self._forced, every=every
        )
        self._clock = Stopwatch(summary.timings, self.began)
        failure: dict = {}
        try:
            self._compute(run, checkpoints)
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
            summary.status, summary.message = "failed", out_of_memory_sentence(self.backend.arch, error)
        finally:
            if summary.status == "running" and not taken.replaces:
                # A fault of mpmcli: the record must not state that the run continues.
                self._record.close("failed", "an internal error ended the run")
        summary.steps = run.step_count
        if taken.replaces:
            summary.message = f"{summary.message.rstrip('.')}; the earlier result in {self._directory} is kept."
            taken.undo()
            return summary
        self._clock.book(run.first_step_seconds, "compile_s")
        return self._close(failure)

    def pack(self) -> RunSummary:
        """Pack the frames of a run that has stored all of them, unless they are packed."""
        summary, earlier, directory, form = self._summary, self.earlier, self._directory, self.settings.form
        self.on_start(summary)
        self._clock = Stopwatch(summary.timings, self.began)
        packed = not sealed_segments(directory)
        series = directory / SERIES
        same = (directory / SCENE).read_text(encoding="utf-8") == self._text
        done = packed and same and earlier.record["status"] == "finished"
        summary.status = "finished"
        if done and (form == "vtkhdf" or series.exists()):
            summary.path = series if form == "vtk" else open_result(directory).path
            return summary
        take_over(directory, earlier)
        self._open({**earlier.index.header, "scene": self._text})
        self._write_scene()
        return self._close({})

    def _open(self, header: dict[str, Any]) -> None:
        """Make the record and the store; they continue those of the earlier part."""
        scene, summary, earlier = self._scene, self._summary, self.earlier
        self._record = RunRecord(
            self._directory,
            command=self.settings.command,
            scene=str(Path(self.loaded.source).resolve()),
            backend=summary.backend,
            seeds={one.name: one.seed for one in scene.sources if one.sampling in ("jittered", "poisson")},
            forced=self._forced,
            files=file_digests(self.loaded),
            frames_expected=summary.frames_expected,
            particles=summary.particles,
            notes=summary.notes,
            timings=summary.timings,
        )
        replace = self._begin if self.taken.replaces else None
        options = {"compress": scene.output.compress, "colliders": scene.colliders, "replace_earlier": replace}
        self._store = SegmentStore(self._directory, header, hold=HOLD, **options)
        if earlier is not None:
            self._record.go_on_from(earlier.record, earlier.rows, earlier.step)
            if earlier.index is not None:
                self._store.go_on_after(earlier.index)

    def _begin(self, first: Path | None = None) -> None:
        """Write the first files; remove an earlier result before, but not the `first` file of frames."""
        if self.taken.replaces:
            self.taken.clear(first)
        self._record.write()
        self._write_scene()

    def _write_scene(self) -> None:
        """Write the effective scene; RunError: the disk is full or a write failed."""
        with writing(self._directory / SCENE):
            write_text(self._directory / SCENE, self._text)

    def _compute(self, run: Run, checkpoints: "Checkpointer") -> None:
        """Compute and store each frame; the record and the summary count only sealed frames."""
        store, record, summary, clock, halt = self._store, self._record, self._summary, self._clock, self._halt
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
            """Add the frames sealed since the last call to record and summary, with times so far, s; tell each."""
            sealed = rows[summary.frames - kept : store.frames_written - kept]
            with clock.adding("output_s"):
                clock.book(run.first_step_seconds, "compile_s")
                clock.book(run.frame_seconds + checkpoints.seconds, "output_s")
                summary.steps, summary.time = run.step_count, run.time
                summary.timings["watch_s"] = run.measure_seconds
                for row in sealed:
                    record.observe(row)
                if sealed:
                    record.write()
            for row in sealed:
                summary.frames += 1
                summary.first, summary.last = summary.first or row, row
                self.on_frame(row, summary)

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

    def _close(self, failure: Mapping[str, Any]) -> RunSummary:
        """Pack the stored frames, close the record, and check a finished result as `mpmcli check` does.

        A run interrupted before its first frame leaves no files. An interrupt or --max-time ends the check.
        """
        summary = self._summary
        with self._clock.adding("output_s"):
            self._finish()
        if summary.status == "interrupted" and not summary.frames:
            self.taken.undo()
            return summary
        self._record.close(summary.status, summary.message, **failure)
        if summary.status == "finished":
            with suppress(KeyboardInterrupt):
                summary.check = check_result(self._directory, self._halt.packing)
        return summary

    def _finish(self) -> None:
        """Pack the stored frames, and also write them as a series if requested.

        Before that, the result is the directory with its sealed frames.
        """
        summary, halt, output = self._summary, self._halt, self._scene.output
        summary.path = summary.directory
        try:
            summary.path = self._store.finish(halt.packing)
            (self._directory / DAMAGED).unlink(missing_ok=True)
            if self.settings.form == "vtk" and summary.path is not None:
                options = {"compress": output.compress, "stop": halt.packing}
                summary.path = write_series(self._directory, self._scene.colliders, **options)
        except KeyboardInterrupt:
            if not halt.status:
                halt.interrupted()
            where = f"its frames were left unpacked, and stay readable in {self._store.place}"
            if summary.path != summary.directory:
                where = "the series was not written, which --resume does"
            summary.status, summary.message = halt.status, f"{halt.message}; {where}"
        except RunError as error:
            if summary.status == "finished":
                summary.status = "stopped" if isinstance(error, DiskFullError) else "failed"
            summary.message = f"{summary.message} {error}".strip()


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
