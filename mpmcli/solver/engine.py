"""What computes a scene: a batch of one run, which many small scenes need, or a solver on all threads.

Both compute the same bytes.
"""

from collections.abc import Callable, Iterator
from typing import Protocol

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene, estimate_particles, sample_bodies
from mpmcli.solver.backend import Arch, Backend, choose_backend
from mpmcli.solver.batch import Batch, Kind
from mpmcli.solver.batch_run import BatchRun
from mpmcli.solver.solver import Solver

# Particles, by dimension, below which one thread is faster than two: the hand-over to a pool of threads takes
# about 0.4 ms of each step.
FEW_PARTICLES = {2: 20_000, 3: 10_000}
# On a GPU, where runs advance at once; its kernels count time in double precision, which Metal lacks.
FEW_ON_GPU, BATCHING_GPUS = 100_000, ("cuda", "vulkan")
# Particle-steps below which the time to optimise kernels exceeds what faster steps save.
LITTLE_WORK = 1e8


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

    def frame(self, index: int, taken: list[tuple[float, float, str]]) -> tuple[Frame, LedgerRow]:
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
        expected_steps: their number; called only where a batch runs the scene.
        threads: CPU threads; None for one where a batch runs the scene, and otherwise for all.

    Raises:
        InputError: the backend cannot be used.
    """
    backend = choose_backend(arch, threads, scene.solver.precision, compile_cache=compile_cache)
    particles = estimate_particles(scene)
    if not _is_small(scene, particles, backend) or threads not in (None, 1):
        return backend, False
    optimisation = "few" if particles * expected_steps() < LITTLE_WORK else "most"
    return choose_backend(
        "cpu", 1, scene.solver.precision, compile_cache=compile_cache, optimisation=optimisation
    ), True


def suits_batch(scene: Scene, particles: int, backend: Backend) -> bool:
    """Return whether a batch can run a scene of so many particles, and, of many runs, faster than a `Solver`."""
    return _is_small(scene, particles, backend) or (backend.arch in BATCHING_GPUS and particles < FEW_ON_GPU)


def _is_small(scene: Scene, particles: int, backend: Backend) -> bool:
    return backend.on_cpu and particles < FEW_PARTICLES[scene.dimension]


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
