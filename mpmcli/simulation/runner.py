"""Computes many scenes in one process; scenes of one kind share the device and its kernels."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from mpmcli.check.finding import OF_STEP, Verdict
from mpmcli.check.result_check import check_kept
from mpmcli.errors import MpmcliError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import BodyParticles, Scene, scene_to_toml
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.plan import make_plan, require_memory
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, build_run, frames_of_all, suits_batch
from mpmcli.solver.frames.diagnosis import LEFT, OUTRAN, UnstableRunError
from mpmcli.solver.grid.sparse_grid import wants_sparse
from mpmcli.solver.machine.backend import Arch, Backend, Optimisation, choose_backend, start, stop_backend
from mpmcli.solver.machine.costs import power_of_two

# Takes a frame that is not kept.
Observe = Callable[[Frame, LedgerRow], None]


@dataclass(frozen=True)
class Recording:
    """A run with T frames and rows, fewer if it stopped, its verdict, and the reason if that is not "stable".

    `seconds`: wall time of its steps, without the first launch of a new batch, which compiles its kernels. `of_step`:
    whether a shorter step may change the verdict.
    """

    header: RunHeader
    frames: Sequence[Frame]
    ledger: Sequence[LedgerRow]
    steps: int
    particles: int
    verdict: Verdict
    reason: str
    seconds: float = 0.0
    of_step: bool = True


class Recorder:
    """Collects the frames of a run in progress, or gives them to `observe`, and collects only the ledger."""

    def __init__(self, run: Run, scene: Scene, backend: Backend, observe: Observe | None = None) -> None:
        names = [laws()[name] for name in run.laws]
        self._header = RunHeader.of(scene, scene_to_toml(scene), names, backend.facts)
        self._run = run
        self._observe = observe
        self._frames: list[Frame] = []
        self._ledger: list[LedgerRow] = []
        self._began = run.batch.seconds - run.batch.first_seconds

    def take(self, frame: Frame, row: LedgerRow) -> None:
        """Keep a frame."""
        if self._observe is None:
            self._frames.append(frame)
        else:
            self._observe(frame, row)
        self._ledger.append(row)

    def finished(self) -> Recording:
        """Return the recording of a run that has reached its end."""
        check = check_kept(self._header, None if self._observe else self._frames, self._ledger)
        bad = [finding for finding in check.findings if finding.severity != "note"]
        of_step = any(finding.rule in OF_STEP for finding in bad)
        return self._recording(check.verdict, bad[0].what if bad else "", of_step=of_step)

    def stopped(self, error: UnstableRunError) -> Recording:
        """Return the recording of a run that became unstable."""
        escaped = error.diagnosis.cause.startswith((LEFT, OUTRAN))
        return self._recording("escaped" if escaped else "unstable", str(error))

    def _recording(self, verdict: Verdict, reason: str, *, of_step: bool = True) -> Recording:
        counts = self._run.step_count, self._run.particle_count
        seconds = self._run.batch.seconds - self._run.batch.first_seconds - self._began
        return Recording(self._header, self._frames, self._ledger, *counts, verdict, reason, seconds, of_step)


# Largest number of kinds with kept kernels, and largest number of particles of a scene that uses kept kernels.
MOST_KINDS, FEW_PARTICLES = 8, 20_000
# Runs that advance together on a GPU.
MOST_RUNS = 256


class Runner:
    """Computes scenes with kernels that are kept.

    Taichi can only free all fields at once, so the backend restarts for kinds that need more memory, and for large
    scenes.
    """

    def __init__(
        self,
        arch: Arch = "auto",
        threads: int | None = 1,
        optimisation: Optimisation | None = None,
        *,
        most_runs: int = MOST_RUNS,
        alike: bool = False,
    ) -> None:
        """Choose the backend; `threads` are for many particles, and `most_runs` advance together on a GPU.

        If scenes are `alike`, all of them use kept kernels and the threads.
        """
        self._arch, self._threads, self._optimisation = arch, threads, optimisation
        self._most_runs, self._alike = most_runs, alike
        self._backend: Backend | None = None
        self._batches: list[Batch] = []

    def expect(self, scenes: Iterable[Scene]) -> None:
        """Reserve memory for scenes that follow, so that they need no restart."""
        kinds: list[CompiledKind] = []
        backend = None
        for scene in scenes:
            asked = Resolved(scene).sampled()
            backend = self._choose(asked)
            if not backend.on_cpu or not self._keeps(asked, backend):
                continue
            kind = asked.kind
            place = next((i for i, known in enumerate(kinds) if known.joined(kind) is not None), None)
            if place is None:
                kinds.append(kind)
            else:
                kinds[place] = kinds[place].joined(kind)
        for kind in kinds[:MOST_KINDS]:
            self._batch_for(kind, backend)

    def run(
        self,
        scene: Scene,
        stop: Callable[[], bool] = lambda: False,
        observe: Observe | None = None,
        particles: list[BodyParticles] | None = None,
    ) -> Recording:
        """Run a scene until it ends or stops; InputError: it cannot be run; KeyboardInterrupt: `stop` returned True.

        Frames are given to `observe` instead of being kept, if there is one; `particles` are those of the scene.
        """
        asked = Resolved(scene, particles).sampled()
        backend = self._choose(asked)
        keeps = self._keeps(asked, backend)
        if self._alike or not keeps:
            require_memory(make_plan(asked, backend))
        if keeps:
            backend = replace(backend, threads=1) if backend.on_cpu and not self._alike else backend
            run = Run(self._batch_for(asked.kind, backend), 0, scene, asked.particles)
        else:
            self._restart(backend)
            run = build_run(asked, backend)
        recorder = Recorder(run, scene, backend, observe)
        try:
            for frame, row in run.frames(stop):
                recorder.take(frame, row)
        except UnstableRunError as error:
            return recorder.stopped(error)
        return recorder.finished()

    def run_all(self, scenes: Sequence[Scene]) -> Iterator[tuple[int, Recording | Exception]]:
        """Yield the index of each scene with its recording or error, as they end; small ones run together on a GPU."""
        alone: list[int] = []
        kinds: list[tuple[CompiledKind, list[int]]] = []
        sampled: dict[int, Resolved] = {}
        for place, scene in enumerate(scenes):
            try:
                asked = Resolved(scene).sampled()
                backend = self._choose(asked)
            except MpmcliError as error:
                yield place, error
                continue
            if backend.on_cpu or not self._keeps(asked, backend):
                alone.append(place)
                continue
            sampled[place], kind = asked, asked.kind
            for i, (known, own) in enumerate(kinds):
                if len(own) < self._most_runs and (joined := known.joined(kind)):
                    kinds[i] = joined, [*own, place]
                    break
            else:
                kinds.append((kind, [place]))
        for place in alone:
            try:
                outcome = self.run(scenes[place])
            except Exception as error:
                outcome = error
            yield place, outcome
        for kind, places in kinds:
            yield from self._run_together(kind, {place: sampled[place] for place in places})

    def _run_together(
        self, kind: CompiledKind, scenes: Mapping[int, Resolved]
    ) -> Iterator[tuple[int, Recording | Exception]]:
        """Yield the recording of each scene of a kind, or its error, from runs in one batch."""
        backend = self._choose(next(iter(scenes.values())))
        batch = self._batch_for(kind, backend, len(scenes))
        runs: dict[int, Run] = {}
        recorders: dict[int, Recorder] = {}
        for slot, (place, asked) in enumerate(scenes.items()):
            try:
                runs[place] = Run(batch, slot, asked.scene, asked.particles)
                recorders[place] = Recorder(runs[place], asked.scene, backend)
            except Exception as error:
                yield place, error
        for place, event in frames_of_all(runs):
            if isinstance(event, tuple):
                recorders[place].take(*event)
            elif event is None:
                yield place, recorders.pop(place).finished()
            else:
                yield place, recorders[place].stopped(event) if isinstance(event, UnstableRunError) else event

    def _choose(self, asked: Resolved) -> Backend:
        own = {"optimisation": self._optimisation, "doubles": asked.layers.separate}
        return choose_backend(self._arch, self._threads, asked.scene.solver.precision, **own)

    def _restart(self, backend: Backend) -> None:
        self._batches.clear()
        stop_backend()
        self._backend = start(backend)

    def _batch_for(self, kind: CompiledKind, backend: Backend, runs: int = 1) -> Batch:
        """Return a batch for the given number of runs of this kind."""
        if self._backend != backend:
            self._restart(backend)
        wanted = kind
        for batch in self._batches:
            joined = batch.kind.joined(kind)
            if joined == batch.kind and runs <= batch.runs:
                return batch
            wanted = joined or wanted
        if wanted is not kind or len(self._batches) == MOST_KINDS:
            self._restart(backend)
        self._batches.append(Batch(wanted.padded(), backend, power_of_two(runs)))
        return self._batches[-1]

    def _keeps(self, asked: Resolved, backend: Backend) -> bool:
        """Return whether a scene uses kernels that are kept for others."""
        count = sum(body.count for body in asked.particles)
        if wants_sparse(asked.scene) and backend.on_cpu:
            return False
        return self._alike or (suits_batch(count, backend) and (count < FEW_PARTICLES or not backend.on_cpu))
