"""The contestants of mpmcli: the same block, as a scene, and a solid in its place."""

from dataclasses import replace

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, CORNER, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import BodyParticles, estimate_particles, parse_scene

# Of the solid block, whose waves are as fast as those of the fluid.
POISSONS_RATIO = 0.2


def scene_of(case: BenchCase, precision: str, block: str = "ours") -> dict:
    """Return a case as the dictionary of a scene file; `block` is one of BLOCKS."""
    d = case.dimension
    material = {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK_MODULUS}
    if block == "solid":
        nu = POISSONS_RATIO
        modulus = BULK_MODULUS * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        material = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": modulus, "poissons_ratio": nu}
    return {
        "title": f"Falling block, {case.name}",
        "domain": {
            "size": [1.0] * d,
            "cells": [case.cells] * d,
            "gravity": [0.0, -GRAVITY, 0.0][:d],
            "walls": "separate",
        },
        "time": {"end": 1.0, "frames": 1, "step": case.step},
        "bodies": [
            {
                "name": "block",
                "material": material,
                "shape": {"box": {"min": [CORNER] * d, "max": [CORNER + EDGE] * d}},
                "velocity": case.velocity().tolist(),
            }
        ],
        "solver": {"precision": precision, "deterministic": block == "deterministic"},
    }


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
        engine: what computes it.
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
        batched: bool = False,
        force: bool = False,
        directory: str = ".",
    ) -> None:
        """Put the scene on the device.

        Args:
            data: the scene; step: its time.step, s.
            particles: one entry per body, in place of the scene's own sampling.
            batched: compute it as `mpmcli simulate` does; otherwise by a `Solver`, which tells what its parts take.
            force: take time.step above the stable step too.
            directory: of the files that the scene names.
        """
        # Imported here, so that a scene can be described without importing Taichi.
        from mpmcli.solver.backend import choose_backend, start
        from mpmcli.solver.engine import build_engine, useful_threads
        from mpmcli.solver.plan import make_plan

        scene = parse_scene(data, laws=parameter_models(), source=data["title"], directory=directory).scene
        backend = choose_backend(arch, threads, precision, compile_cache=False)
        count = sum(body.count for body in particles) if particles else estimate_particles(scene)
        # On a GPU a batch is for many runs: a launch of it takes 32 steps or none.
        batched = batched and backend.on_cpu
        if batched:
            backend = replace(backend, threads=useful_threads(count, threads))
        start(backend)
        self.engine = build_engine(scene, backend, particles, batched=batched, force=force)
        self.threads = backend.threads
        self._batched = batched
        self.smallest_step = step
        self.particles: int = self.engine.particle_count
        self.bytes_per_particle: int = make_plan(scene, backend).bytes_per_particle

    @property
    def watch_seconds(self) -> float:
        """Wall time of the measurements of the state, s."""
        return self.engine.measure_seconds

    def advance(self, count: int) -> int:
        """Take about `count` steps and return how many."""
        steps, smallest = self.engine.advance(count)
        self.smallest_step = min(self.smallest_step, smallest)
        return steps

    def sync(self) -> None:
        """Wait until every requested step is done; on the CPU each step waits."""
        self.engine.wait()

    def positions(self) -> np.ndarray:
        """Return the positions of the particles, (particles, dimension), m, in their initial order."""
        return self.engine.frame()[0].position

    def is_sound(self) -> bool:
        """Whether every particle is in the domain, a unit square or cube whose origin is 0."""
        # A frame of 1e8 particles takes minutes.
        groups = [] if self._batched else self.engine.groups
        places = [group.x.to_numpy() for group in groups] or [self.positions()]
        return all(bool(((position >= 0) & (position <= 1)).all()) for position in places)


def falling_block(case: BenchCase, block: str = "ours", *, threads: int, precision: str, arch: str) -> Ours:
    """Return what `mpmcli simulate` computes with, on the block of the peer or another one of BLOCKS."""
    data, particles = scene_of(case, precision, block), [particles_of(case)]
    return Ours(data, case.step, particles, threads=threads, precision=precision, arch=arch, batched=True, force=True)
