"""What computes a scene: a batch of one run on the CPU, a solver on a GPU. On the CPU both compute the same bytes."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, estimate_particles, sample_bodies
from mpmcli.solver.backend import Arch, Backend, choose_backend
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_kind import Kind
from mpmcli.solver.batch_run import BatchRun
from mpmcli.solver.solver import Solver
from mpmcli.solver.state import SavedState

# Particles that are worth a thread.
WORTH_A_THREAD = 2_500
# On a GPU, where runs advance at once; its kernels count time in double precision, which Metal lacks.
FEW_ON_GPU, BATCHING_GPUS = 100_000, ("cuda", "vulkan")
# Particle-steps below which the time to optimise kernels exceeds what faster steps save, about a tenth: of one law. The
# time grows faster than the number of laws, which share one kernel.
LITTLE_WORK = 8e8


class Engine(Protocol):
    """What `Solver` and `BatchRun` have in common for the run of a scene."""

    particle_count: int
    laws: tuple[str, ...]
    first_step_seconds: float
    frame_seconds: float

    @property
    def time(self) -> float:
        """Time of the state, s."""

    @property
    def step_count(self) -> int:
        """Steps taken."""

    @property
    def measure_seconds(self) -> float:
        """Wall time spent on measuring the state for the limits, s."""

    def begin(self) -> None:
        """Take the bounds of time 0; a second call does nothing."""

    def advance(self, count: int) -> tuple[int, float]:
        """Take about `count` stable steps, whatever the times of frames are, for a measurement of speed.

        Returns:
            The number of steps taken, and the smallest one, s.

        Raises:
            UnstableRunError: a particle left the domain, was inverted or became non-finite.
        """

    def wait(self) -> None:
        """Wait until the device has taken every step.

        Raises:
            UnstableRunError: see `advance`.
        """

    def save(self) -> SavedState:
        """Return the state, where `stop` of `frames` is called.

        Its arrays are copied from the device one by one as they are asked for, which is over when the next step begins.
        """

    def load(self, saved: SavedState) -> None:
        """Go on from a saved state of the same scene, or of one that ends earlier, with the frames that follow.

        Raises:
            InputError: it is of another scene, or of another kind of backend.
        """

    def frame(self) -> tuple[Frame, LedgerRow]:
        """Return the state as a frame, see `Run.frame`; after `begin`."""

    def frames(self, stop: Callable[[], bool]) -> Iterator[tuple[Frame, LedgerRow]]:
        """Yield frames and ledger rows, see `Solver.frames`."""


def choose_engine(
    scene: Scene,
    expected_steps: Callable[[], int],
    arch: Arch = "auto",
    threads: int | None = None,
    *,
    compile_cache: bool = True,
) -> tuple[Backend, bool]:
    """Return the backend for a scene, not started, and whether a batch runs it.

    Args:
        expected_steps: their number; called on the CPU only.
        threads: CPU threads; None for as many as the scene has use for.

    Raises:
        InputError: the backend cannot be used.
    """
    backend = choose_backend(arch, threads, scene.solver.precision, compile_cache=compile_cache)
    if not backend.on_cpu:
        return backend, False
    particles = estimate_particles(scene)
    little = LITTLE_WORK * len({body.material.law for body in scene.sources}) ** 2
    optimisation = "few" if particles * expected_steps() < little else "most"
    count = threads or useful_threads(particles, backend.threads)
    return replace(backend, threads=count, optimisation=optimisation), True


def useful_threads(particles: int, threads: int) -> int:
    """Return how many of these threads a batch of one run has use for."""
    return min(threads, max(1, particles // WORTH_A_THREAD))


def suits_batch(particles: int, backend: Backend) -> bool:
    """Return whether a batch can run a scene of so many particles, and, of many runs, faster than a `Solver`."""
    return backend.on_cpu or (backend.arch in BATCHING_GPUS and particles < FEW_ON_GPU)


def build_engine(
    scene: Scene,
    backend: Backend,
    particles: list[BodyParticles] | None = None,
    *,
    batched: bool,
    force: bool = False,
) -> Engine:
    """Put a scene on the device of a started backend.

    Args:
        particles: one entry per body, in place of the scene's own sampling.
        force: take time.step as it is, above the stable step too.

    Raises:
        InputError: a particle is not in the domain.
    """
    if not batched:
        return Solver(scene, backend, particles, force=force)
    particles = particles or sample_bodies(scene)
    return BatchRun(Batch(Kind.of(scene, particles), backend), 0, scene, particles, force=force)
