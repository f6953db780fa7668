"""One run from a loaded scene to a stored result: what `simulate` does, and every run of a sweep."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mpmcli import __version__
from mpmcli.errors import MpmcliError, RunError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output import RunRecord, SegmentStore, VtkSeriesStore, check_directory, prepare_directory
from mpmcli.output.durable import write_text
from mpmcli.scene import LoadedScene, scene_to_toml
from mpmcli.solver.backend import Arch, start_backend
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.plan import Plan, make_plan, require_room
from mpmcli.solver.solver import Solver

SCENE = "scene.toml"


@dataclass(frozen=True)
class RunSettings:
    """How a scene is run and stored, beside what it says itself.

    Attributes:
        directory: where the result goes.
        arch: backend to use; threads: CPU threads, all of them where None.
        form: "vtkhdf" for one packed file, "vtk" for a .vtu series.
        overwrite: whether an earlier result in the directory may be replaced.
        force: whether time.step is taken as it is, above the stable step too.
        compile_cache: whether compiled kernels are kept for the next start.
        command: the command line, for the record.
    """

    directory: Path
    arch: Arch = "auto"
    threads: int | None = None
    form: Literal["vtkhdf", "vtk"] = "vtkhdf"
    overwrite: bool = False
    force: bool = False
    compile_cache: bool = True
    command: Sequence[str] = ()


@dataclass
class RunSummary:
    """How a run went.

    Attributes:
        directory: where the result is; path: the file to open, None where no frame was written.
        status: "finished", "unstable", "interrupted" or "failed".
        message: why it ended early, "" where it did not.
        frames, steps, particles: counts.
        timings: seconds by name: start_s (load and allocate), compile_s (first step, compilation
            included), solve_s (all further steps), watch_s (of these, measuring the state for the limits), output_s
            (frames and packing), wall_s.
        first, last: ledger rows of the first and the last frame.
    """

    directory: Path
    particles: int
    backend: dict
    notes: tuple[str, ...]
    plan: Plan
    status: str = "running"
    message: str = ""
    path: Path | None = None
    frames: int = 0
    steps: int = 0
    timings: dict[str, float] = field(default_factory=dict)
    first: LedgerRow | None = None
    last: LedgerRow | None = None

    @property
    def rate(self) -> float:
        """Particle-steps per second, compilation and output not counted."""
        seconds = self.timings.get("solve_s", 0.0)
        return self.particles * max(self.steps - 1, 0) / seconds if seconds > 0 else 0.0

    def as_dict(self) -> dict:
        """Return all of it as JSON can hold it."""
        return {
            "status": self.status,
            "message": self.message,
            "path": None if self.path is None else str(self.path),
            "directory": str(self.directory),
            "frames": self.frames,
            "steps": self.steps,
            "particles": self.particles,
            "particle_steps_per_s": self.rate,
            "backend": self.backend,
            "bytes_per_particle": self.plan.bytes_per_particle,
            "plan": self.plan.as_dict(),
            "timings": self.timings,
            "energy": None
            if self.first is None or self.last is None
            else {"first": self.first.energy, "last": self.last.energy},
            "notes": list(self.notes),
        }


Watch = Callable[[LedgerRow, RunSummary], None]


def run_scene(
    loaded: LoadedScene,
    settings: RunSettings,
    watch: Watch = lambda row, summary: None,
    stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Run a scene to its end, or to where it stops, and store it.

    Everything that can be refused is refused before anything is written. A run that becomes unstable, is
    interrupted (`stop`, or KeyboardInterrupt) or cannot write keeps its sealed frames; its summary says so.

    Args:
        watch: called after each stored frame with its ledger row and the summary so far.
        stop: asked after every step and every stored frame whether to interrupt the run.

    Raises:
        InputError: the scene, the backend or the directory cannot be used; nothing was written.
    """
    began = time.perf_counter()
    scene = loaded.scene
    check_directory(settings.directory, settings.overwrite)
    backend = start_backend(
        settings.arch, settings.threads, scene.solver.precision, compile_cache=settings.compile_cache
    )
    plan = make_plan(scene, backend)
    require_room(plan)
    solver = Solver(scene, backend, force=settings.force)
    # Last, since it removes an earlier result.
    prepare_directory(settings.directory, settings.overwrite)

    facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
    summary = RunSummary(settings.directory, solver.particle_count, facts, loaded.notes, plan)
    text = scene_to_toml(scene)
    record = RunRecord(
        settings.directory,
        command=settings.command,
        backend=facts,
        seeds={body.name: body.seed for body in scene.bodies if body.sampling == "jittered"},
        frames_expected=scene.time.frames + 1,
        particles=solver.particle_count,
        notes=loaded.notes,
    )
    try:
        write_text(settings.directory / SCENE, text)
    except OSError as error:
        raise RunError(f"{settings.directory / SCENE} could not be written ({error.strerror or error}).") from error
    record.write()
    header = {
        "version": __version__,
        "title": scene.title,
        "dimension": scene.dimension,
        "spacing": scene.domain.spacing,
        "origin": list(scene.domain.origin),
        "size": list(scene.domain.size),
        "bodies": [body.name for body in scene.bodies],
        "materials": list(solver.laws),
        "precision": backend.precision,
        "backend": facts,
        "scene": text,
    }
    kind = VtkSeriesStore if settings.form == "vtk" else SegmentStore
    store = kind(settings.directory, header, compress=scene.output.compress)

    clock = _Clock(summary.timings, began)
    facts_of_failure: dict = {}
    try:
        frames = solver.frames(stop)
        while True:
            with clock.adding("solve_s"):
                frame, row = next(frames, (None, None))
            if frame is None:
                break
            with clock.adding("output_s"):
                store.write(frame, row)
                record.observe(row)
                summary.frames, summary.steps = store.frames_written, solver.step_count
                summary.first, summary.last = summary.first or row, row
                clock.book(solver.first_step_seconds, "compile_s")
                clock.book(solver.frame_seconds, "output_s")
                summary.timings["watch_s"] = solver.measure_seconds
                record.timings = summary.timings
                record.write()
            watch(row, summary)
            if stop():
                raise KeyboardInterrupt
        summary.status = "finished"
    except KeyboardInterrupt:
        summary.status = "interrupted"
    except UnstableRunError as error:
        summary.status, summary.message = "unstable", str(error)
        facts_of_failure = vars(error.diagnosis)
    except MpmcliError as error:
        summary.status, summary.message = "failed", str(error)
    finally:
        if summary.status == "running":
            # An error of ours: the record must not claim that the run goes on.
            record.close("failed", "an internal error ended the run")
    if summary.status == "interrupted":
        summary.message = "the run was interrupted"
    summary.steps = solver.step_count
    clock.book(solver.first_step_seconds, "compile_s")
    with clock.adding("output_s"):
        # Until it is packed, the result is the directory with its sealed frames.
        summary.path = settings.directory
        try:
            summary.path = store.finish()
        except KeyboardInterrupt:
            summary.status, summary.message = (
                "interrupted",
                "the run was interrupted while its frames were packed",
            )
        except RunError as error:
            if summary.status == "finished":
                summary.status = "failed"
            summary.message = f"{summary.message} {error}".strip()
    clock.stop()
    record.timings = summary.timings
    record.close(summary.status, summary.message, **facts_of_failure)
    return summary


class _Clock:
    """Adds up where the time of a run goes."""

    def __init__(self, timings: dict[str, float], began: float) -> None:
        self._timings = timings
        self._began = began
        self._key = ""
        self._booked: dict[str, float] = {}
        timings.update(start_s=time.perf_counter() - began, compile_s=0.0, solve_s=0.0, output_s=0.0, wall_s=0.0)

    def adding(self, key: str) -> "_Clock":
        """Add the time of a with block to an entry."""
        self._key = key
        return self

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter()
        self._timings[self._key] += now - self._since
        self._timings["wall_s"] = now - self._began

    def book(self, total: float, key: str) -> None:
        """Move seconds that the solver spent so far on something else from solve_s to another entry."""
        seconds = total - self._booked.get(key, 0.0)
        self._booked[key] = total
        self._timings["solve_s"] -= seconds
        self._timings[key] += seconds

    def stop(self) -> None:
        """Set the total."""
        self._timings["wall_s"] = time.perf_counter() - self._began
