"""Our side of the comparison: the same block, as a scene that any user could write."""

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
    """Return the particles that the peer starts from too, with equal shares of the block."""
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
    """The solver on a scene, running in this process, which it takes over (taichi starts once)."""

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
        # Here rather than above: a scene can be described without starting taichi.
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
        """Wall time spent so far on measuring the state."""
        return self._solver.measure_seconds

    def step(self) -> None:
        """Advance by one step, as `frames` does: of the case's size, unless the limits ask for less."""
        self._dt, _ = self._solver.stable_step()
        self.smallest_step = min(self.smallest_step, self._dt)
        self._solver.step(self._dt)

    def sync(self) -> None:
        """Wait until every step asked for is done; on the CPU each step has waited by itself."""
        if self._waits:
            self._solver.measure_state(self._dt)

    def positions(self) -> np.ndarray:
        """Return where the particles are, (particles, dimension), m, in the order they started in."""
        return self._solver.frame(0, [])[0].position

    def is_sound(self) -> bool:
        """Whether every particle is where it can be."""
        position = self.positions()
        return bool(((position >= 0) & (position <= 1)).all())


def falling_block(case: BenchCase, *, threads: int, precision: str, arch: str) -> Ours:
    """Return the solver on the block that the peer runs, too."""
    data, particles = scene_of(case, precision), [particles_of(case)]
    return Ours(data, case.step, particles, threads=threads, precision=precision, arch=arch)
