"""Chooses the backend of a scene, and puts the scene on it."""

from collections.abc import Callable
from dataclasses import replace

from mpmcli.scene import BodyParticles, Scene, estimate_particles, sample_bodies
from mpmcli.solver.contact.layers import require_contact_possible
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.run import Run
from mpmcli.solver.machine.backend import Arch, Backend, choose_backend
from mpmcli.solver.machine.costs import cheapest, useful_threads

# On a GPU, where runs advance at once.
FEW_ON_GPU = 100_000


def backend_for(
    scene: Scene,
    expected_steps: Callable[[], int],
    arch: Arch = "auto",
    threads: int | None = None,
    *,
    compile_cache: bool = True,
) -> Backend:
    """Return the backend for a scene, not started.

    Args:
        expected_steps: their number; called on the CPU only.
        threads: CPU threads; None for as many as the scene has use for.

    Raises:
        InputError: the backend cannot be used.
    """
    backend = choose_backend(arch, threads, scene.solver.precision, compile_cache=compile_cache)
    if not backend.on_cpu:
        return backend
    threads = threads or useful_threads(estimate_particles(scene), backend.threads)
    return replace(backend, threads=threads, optimisation=cheapest(scene, expected_steps(), threads))


def suits_batch(particles: int, backend: Backend) -> bool:
    """Return whether many runs of so many particles are faster in one batch than one by one."""
    return backend.on_cpu or particles < FEW_ON_GPU


def build_run(
    scene: Scene, backend: Backend, particles: list[BodyParticles] | None = None, *, force: bool = False
) -> Run:
    """Put a scene on the device of a started backend, alone.

    Args:
        particles: one entry per body, in place of the scene's own sampling.
        force: take time.step as it is, above the stable step too.

    Raises:
        InputError: a particle is not in the domain, or the backend cannot compute the scene.
    """
    require_contact_possible(scene, backend)
    particles = particles or sample_bodies(scene)
    return Run(Batch(CompiledKind.of(scene, particles).roomy(), backend), 0, scene, particles, force=force)
