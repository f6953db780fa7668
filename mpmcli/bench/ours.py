"""The contestants of mpmcli: the same block, as a scene, and a solid in its place."""

from dataclasses import replace

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, CORNER, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import BodyParticles, estimate_particles, parse_scene, sample_bodies

# Of the solid block, whose waves are as fast as those of the fluid.
POISSONS_RATIO = 0.2


def scene_of(case: BenchCase, precision: str, block: str = "ours") -> dict:
    """Return a case as the dictionary of a scene file; `block` is one of BLOCKS."""
    material = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK_MODULUS}
    if block == "solid":
        nu = POISSONS_RATIO
        modulus = BULK_MODULUS * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        material = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": modulus, "poissons_ratio": nu}
    corners = {"min": [CORNER] * case.dimension, "max": [CORNER + EDGE] * case.dimension}
    body = {"name": "block", "material": material, "shape": {"box": corners}, "velocity": case.velocity().tolist()}
    return case.scene("Falling block", [body], GRAVITY, precision=precision, deterministic=block == "deterministic")


def particles_of(case: BenchCase) -> BodyParticles:
    """Return the initial particles of the peer, with equal shares of the block."""
    d = case.dimension
    volume = EDGE**d / case.particles
    return BodyParticles(
        name="block",
        position=case.positions(),
        velocity=np.tile(case.velocity(), (case.particles, 1)),
        affine=np.zeros((case.particles, d, d)),
        volume=volume,
        mass=DENSITY * volume,
    )


class Ours:
    """A run of a scene in this process; Taichi starts only once per process.

    Attributes:
        run: what computes it.
        threads: of the processor, that it uses.
    """

    def __init__(
        self,
        data: dict,
        step: float,
        particles: list[BodyParticles] | None = None,
        *,
        threads: int,
        precision: str,
        arch: str,
        force: bool = False,
        directory: str = ".",
    ) -> None:
        """Put the scene on the device.

        Args:
            data: the scene; step: its time.step, s.
            particles: one entry per body, in place of the scene's own sampling.
            force: take time.step above the stable step too.
            directory: of the files that the scene names.
        """
        # Imported here, so that a scene can be described without importing Taichi.
        from mpmcli.solver.engine.batch import Batch
        from mpmcli.solver.engine.build import useful_threads
        from mpmcli.solver.engine.compiled_kind import CompiledKind
        from mpmcli.solver.engine.run import Run
        from mpmcli.solver.machine.backend import choose_backend, start
        from mpmcli.solver.machine.plan import make_plan

        scene = parse_scene(data, laws=parameter_models(), source=data["title"], directory=directory).scene
        backend = choose_backend(arch, threads, precision, compile_cache=False)
        count = sum(body.count for body in particles) if particles else estimate_particles(scene)
        if backend.on_cpu:
            backend = replace(backend, threads=useful_threads(count, threads))
        start(backend)
        particles = particles or sample_bodies(scene)
        # Kernels of steps that bodies set themselves: those of a benchmark are short, and would keep motion.
        usual = scene.model_copy(update={"time": scene.time.model_copy(update={"step": "auto"})})
        batch = Batch(CompiledKind.of(usual, particles).roomy(), backend)
        self.run = Run(batch, 0, scene, particles, force=force)
        self.threads = backend.threads
        self.smallest_step = step
        self.particles: int = self.run.particle_count
        self.bytes_per_particle: int = make_plan(usual, backend).bytes_per_particle

    def advance(self, count: int) -> int:
        """Take about `count` steps and return how many."""
        steps, smallest = self.run.advance(count)
        self.smallest_step = min(self.smallest_step, smallest)
        return steps

    def sync(self) -> None:
        """Do nothing: each launch waits until its steps are done."""

    def positions(self) -> np.ndarray:
        """Return the positions of the particles, (particles, dimension), m, in their initial order."""
        return self.run.frame()[0].position

    def is_sound(self) -> bool:
        """Whether every particle is in the domain, a unit square or cube whose origin is 0."""
        # A frame of 1e8 particles takes minutes.
        places = [group.arrays.x.to_numpy() for group in self.run.groups]
        return all(bool(((position >= 0) & (position <= 1)).all()) for position in places)


def falling_block(case: BenchCase, block: str = "ours", *, threads: int, precision: str, arch: str) -> Ours:
    """Return what `mpmcli simulate` computes with, on the block of the peer or another one of BLOCKS."""
    data, particles = scene_of(case, precision, block), [particles_of(case)]
    return Ours(data, case.step, particles, threads=threads, precision=precision, arch=arch, force=True)
