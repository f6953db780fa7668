"""The contestant of mpmcli: the same block, as a scene."""

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, CORNER, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import BodyParticles, parse_scene


def scene_of(case: BenchCase, precision: str) -> dict:
    """Return a case as the dictionary of a scene file."""
    d = case.dimension
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
                "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK_MODULUS},
                "shape": {"box": {"min": [CORNER] * d, "max": [CORNER + EDGE] * d}},
                "velocity": case.velocity().tolist(),
            }
        ],
        "solver": {"precision": precision},
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
    """The solver on a scene in this process; Taichi starts only once per process."""

    def __init__(
        self,
        data: dict,
        step: float,
        particles: list[BodyParticles] | None = None,
        *,
        threads: int,
        precision: str,
        arch: str,
    ) -> None:
        # Imported here, so that a scene can be described without importing Taichi.
        from mpmcli.solver.backend import start_backend
        from mpmcli.solver.plan import make_plan
        from mpmcli.solver.solver import Solver

        scene = parse_scene(data, laws=parameter_models(), source=data["title"]).scene
        backend = start_backend(arch, threads, precision, compile_cache=False)
        self._solver = Solver(scene, backend, particles=particles)
        self._waits = not backend.on_cpu
        self._dt = self.smallest_step = step
        self.particles: int = self._solver.particle_count
        self.bytes_per_particle: int | None = make_plan(scene, backend).bytes_per_particle

    @property
    def watch_seconds(self) -> float:
        """Wall time of the measurements of the state, s."""
        return self._solver.measure_seconds

    def step(self) -> None:
        """Advance by one step, as `frames` does: of the case's size, or that of the limits if smaller."""
        self._dt, _ = self._solver.stable_step()
        self.smallest_step = min(self.smallest_step, self._dt)
        self._solver.step(self._dt)

    def sync(self) -> None:
        """Wait until every requested step is done; on the CPU each step waits."""
        if self._waits:
            self._solver.measure_state(self._dt)

    def positions(self) -> np.ndarray:
        """Return the positions of the particles, (particles, dimension), m, in their initial order."""
        return self._solver.frame(0, [])[0].position

    def is_sound(self) -> bool:
        """Whether every particle is in the domain."""
        position = self.positions()
        return bool(((position >= 0) & (position <= 1)).all())


def falling_block(case: BenchCase, *, threads: int, precision: str, arch: str) -> Ours:
    """Return the solver on the block of the peer."""
    data, particles = scene_of(case, precision), [particles_of(case)]
    return Ours(data, case.step, particles, threads=threads, precision=precision, arch=arch)
