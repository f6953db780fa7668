"""Computes many scenes, one after another, in one process: scenes of one kind share the device and its kernels."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from mpmcli.errors import MpmcliError
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.simulation.recording import Recorder, Recording, record
from mpmcli.solver.backend import Arch, Backend, Optimisation, choose_backend, start, stop_backend
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_kind import Kind
from mpmcli.solver.batch_run import BatchRun
from mpmcli.solver.diagnosis import UnstableRunError
from mpmcli.solver.engine import build_engine, suits_batch
from mpmcli.solver.plan import make_plan, require_room
from mpmcli.solver.sparse_choice import wants_sparse

# Kinds whose kernels are kept at once, and particles below which a scene is computed by kernels that are kept.
MOST_KINDS, FEW_PARTICLES = 8, 20_000
# Runs that advance at once on a GPU.
MOST_RUNS = 256


class Runner:
    """Computes scenes with kernels that stay compiled.

    Taichi frees fields only where all of them are freed, so that memory stays flat by a restart of the backend: for
    a kind that needs more room than an earlier one, and for each scene with many particles.
    """

    def __init__(
        self,
        arch: Arch = "auto",
        threads: int | None = 1,
        optimisation: Optimisation | None = None,
        *,
        most_runs: int = MOST_RUNS,
    ) -> None:
        """Choose the backend; nothing starts.

        Args:
            threads: CPU threads of a scene with many particles; one with few takes a single thread.
            most_runs: that advance at once on a GPU.
        """
        self._arch, self._threads, self._optimisation = arch, threads, optimisation
        self._most_runs = most_runs
        self._backend: Backend | None = None
        self._batches: list[Batch] = []

    def expect(self, scenes: Iterable[Scene]) -> None:
        """Make room for scenes to come, so that they need no restart."""
        kinds: list[Kind] = []
        backend = None
        for scene in scenes:
            particles = sample_bodies(scene)
            backend = self._choose(scene)
            if not backend.on_cpu or not _keeps(scene, particles, backend):
                continue
            kind = Kind.of(scene, particles)
            place = next((i for i, known in enumerate(kinds) if known.joined(kind) is not None), None)
            if place is None:
                kinds.append(kind)
            else:
                kinds[place] = kinds[place].joined(kind)
        for kind in kinds[:MOST_KINDS]:
            self._batch_for(kind, backend)

    def run(self, scene: Scene, stop: Callable[[], bool] = lambda: False) -> Recording:
        """Run a scene to its end or to where it stops.

        Raises:
            InputError: it cannot be run: a particle outside the domain, too little memory, no such backend.
            KeyboardInterrupt: `stop` returned True.
        """
        particles = sample_bodies(scene)
        backend = self._choose(scene)
        if _keeps(scene, particles, backend):
            backend = replace(backend, threads=1) if backend.on_cpu else backend
            engine = BatchRun(self._batch_for(Kind.of(scene, particles), backend), 0, scene, particles)
        else:
            require_room(make_plan(scene, backend))
            self._restart(backend)
            engine = build_engine(scene, backend, particles, batched=backend.on_cpu)
        return record(engine, scene, backend, stop)

    def run_all(self, scenes: Sequence[Scene]) -> Iterator[tuple[int, Recording | Exception]]:
        """Yield the place of each scene with its recording, or with the error that it ended with, as they end.

        On a GPU those of a kind with few particles advance at once.
        """
        alone: list[int] = []
        kinds: list[tuple[Kind, list[int]]] = []
        sampled: dict[int, list[BodyParticles]] = {}
        for place, scene in enumerate(scenes):
            try:
                particles = sample_bodies(scene)
                backend = self._choose(scene)
            except MpmcliError as error:
                yield place, error
                continue
            if backend.on_cpu or not _keeps(scene, particles, backend):
                alone.append(place)
                continue
            sampled[place] = particles
            kind = Kind.of(scene, particles)
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
            yield from self._run_together(kind, {place: (scenes[place], sampled[place]) for place in places})

    def _run_together(
        self, kind: Kind, scenes: Mapping[int, tuple[Scene, list[BodyParticles]]]
    ) -> Iterator[tuple[int, Recording | Exception]]:
        """Advance scenes of a kind at once; see `run_all`."""
        backend = self._choose(next(iter(scenes.values()))[0])
        batch = self._batch_for(kind, backend, len(scenes))
        runs: dict[int, tuple[Recorder, Iterator]] = {}
        for slot, (place, (scene, particles)) in enumerate(scenes.items()):
            try:
                run = BatchRun(batch, slot, scene, particles)
                runs[place] = Recorder(run, scene, backend), run.events()
            except Exception as error:
                yield place, error
        while runs:
            for place, (recorder, events) in list(runs.items()):
                outcome: Recording | Exception | None = None
                try:
                    while (event := next(events)) is not None:
                        recorder.take(*event)
                except StopIteration:
                    outcome = recorder.finished()
                except UnstableRunError as error:
                    outcome = recorder.stopped(error)
                except Exception as error:
                    outcome = error
                if outcome is not None:
                    del runs[place]
                    yield place, outcome
            if runs:
                try:
                    batch.launch()
                except Exception as error:
                    yield from ((place, error) for place in runs)
                    return

    def _choose(self, scene: Scene) -> Backend:
        return choose_backend(self._arch, self._threads, scene.solver.precision, optimisation=self._optimisation)

    def _restart(self, backend: Backend) -> None:
        self._batches.clear()
        stop_backend()
        self._backend = start(backend)

    def _batch_for(self, kind: Kind, backend: Backend, runs: int = 1) -> Batch:
        """Return a batch with room for so many runs of this kind."""
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
        self._batches.append(Batch(_roomy(wanted), backend, _power(runs)))
        return self._batches[-1]


def _keeps(scene: Scene, particles: Sequence[BodyParticles], backend: Backend) -> bool:
    """Return whether a scene with these particles is computed by kernels that are kept for others."""
    count = sum(len(body.position) for body in particles)
    if wants_sparse(scene) and backend.on_cpu:
        return False
    if (scene.comes_and_goes or scene.solver.deterministic) and not backend.on_cpu:
        # There a batch does not sort, and does not add in fixed point.
        return False
    return suits_batch(count, backend) and (count < FEW_PARTICLES or not backend.on_cpu)


def _roomy(kind: Kind) -> Kind:
    """Return a kind with some room to spare, so that few sizes occur and compiled kernels are found again."""
    return replace(
        kind,
        particles=tuple(map(_rounded, kind.particles)),
        bodies=tuple(map(_power, kind.bodies)),
        comings=replace(kind.comings, cells=_power(kind.comings.cells) if kind.comings.cells else 0),
    )


def _rounded(count: int) -> int:
    """Return the next quarter of a power of two."""
    quarter = max(64, _power(count) // 8)
    return math.ceil(count / quarter) * quarter


def _power(count: int) -> int:
    return 1 << max(0, count - 1).bit_length()
