"""The benchmark cases: a falling block of fluid at several sizes."""

from dataclasses import dataclass

import numpy as np

# The fluid of the examples, in their units: a unit box, density 1, p = -E (J - 1).
DENSITY = 1.0
BULK_MODULUS = 400.0
GRAVITY = 9.8
# Initial downward speed of mpm88, here of every block: particles change cells, so that steps include sorting.
SPEED = 1.0
# Lower corner and edge of the block in the example mpm88; mpm3d starts at 0.15, with the same edge.
CORNER = 0.2
EDGE = 0.4


@dataclass(frozen=True)
class BenchCase:
    """One size for all workers: cells along an edge (a power of two for mpm3d), particles, and time step, s."""

    dimension: int
    cells: int
    particles: int
    step: float

    @property
    def name(self) -> str:
        """Name in tables and on the command line, like "3d-128"."""
        return f"{self.dimension}d-{self.cells}"

    @property
    def peer(self) -> str:
        """The example of the taichi package that solves the same problem."""
        return "mpm3d" if self.dimension == 3 else "mpm88"

    def positions(self) -> np.ndarray:
        """Return the initial positions, (particles, dimension) float64: uniform in the block."""
        return CORNER + EDGE * np.random.default_rng(0).random((self.particles, self.dimension))

    def velocity(self) -> np.ndarray:
        """Return the initial velocity, (dimension,) float64, m/s."""
        return np.array([0.0, -SPEED, 0.0][: self.dimension])

    def scene(self, body: dict, gravity: float, precision: str) -> dict:
        """Return the dictionary of a scene file with a body in the unit box."""
        d = self.dimension
        domain = {"size": [1.0] * d, "cells": [self.cells] * d, "gravity": [0.0, -gravity, 0.0][:d]}
        return {
            "title": f"{body['name']}, {self.name}",
            "domain": domain | {"walls": "separate"},
            "time": {"end": 1.0, "frames": 1, "step": self.step},
            "bodies": [body],
            "solver": {"precision": precision},
        }


# Steps are those of the examples where given: 4e-4, 2e-4, 8e-5 at 32, 64, 128 cells for mpm3d, 2e-4 at 128 for mpm88.
# There are about 4 particles per cell; at the smallest size 8 in 2D and 2 in 3D.
CASES = (
    BenchCase(dimension=2, cells=64, particles=5_000, step=4e-4),
    BenchCase(dimension=2, cells=128, particles=10_000, step=2e-4),
    BenchCase(dimension=2, cells=256, particles=42_000, step=1e-4),
    BenchCase(dimension=2, cells=512, particles=168_000, step=5e-5),
    BenchCase(dimension=3, cells=32, particles=5_000, step=4e-4),
    BenchCase(dimension=3, cells=64, particles=65_536, step=2e-4),
    BenchCase(dimension=3, cells=128, particles=524_288, step=8e-5),
)
