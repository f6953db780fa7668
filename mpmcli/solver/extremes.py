"""Measures how far the particles of each law have gone: what the limits of the next steps depend on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.materials.law import StateBound
from mpmcli.solver.backend import Backend
from mpmcli.solver.ordering import CHUNK, share_start
from mpmcli.solver.particles import ParticleGroup

SPEED_SQUARED, GRADIENT, J_MIN, J_MAX, STRETCH_SQUARED = range(5)
ENTRIES = 5
# Workers of a measurement on a GPU, each with every so-manieth particle.
GPU_WORKERS = 16384


@dataclass(frozen=True)
class Extremes:
    """Extremes over all particles of one law.

    Attributes:
        speed: largest speed, m/s.
        gradient: bound on the rate of deformation, 1/s: |tr C| where J is stored, else the largest row sum of |C|.
        bound: range of J and of stretches.
    """

    speed: float
    gradient: float
    bound: StateBound


@ti.func
def volume_ratio(group: ti.template(), deformation: ti.template()):
    """Return J of a particle's deformation, which may be padded beyond d x d."""
    J = 1.0
    if ti.static(group.law.deformation == "F"):
        F = ti.Matrix.zero(float, group.dimension, group.dimension)
        for i, j in ti.static(ti.ndrange(group.dimension, group.dimension)):
            F[i, j] = deformation[i, j]
        J = F.determinant()
    else:
        J = deformation
    return J


@ti.func
def row_sum(matrix: ti.template()):
    """Return the largest sum of absolute entries in a row: a bound on every eigenvalue (Gershgorin)."""
    largest = 0.0
    for i in ti.static(range(matrix.n)):
        row = 0.0
        for j in ti.static(range(matrix.m)):
            row += ti.abs(matrix[i, j])
        largest = ti.max(largest, row)
    return largest


def build_extremes(groups: Sequence[ParticleGroup], backend: Backend) -> Callable[[], list[Extremes]]:
    """Compile-ready measurement of all groups: call the result to measure."""
    numbered = tuple(enumerate(groups))
    size = ENTRIES * len(groups)
    vector = ti.types.vector(size, float)
    found = ti.field(float, shape=size)
    # Each worker keeps its own extremes and merges them once: an atomic per particle costs more than the rest.
    workers = CHUNK * backend.threads if backend.on_cpu else GPU_WORKERS
    on_cpu = backend.on_cpu

    @ti.func
    def widen(own: ti.template(), group: ti.template(), p: int):
        v, C = group.motion(p)
        deformation = group.stored(p)
        J = volume_ratio(group, deformation)
        own[SPEED_SQUARED] = ti.max(own[SPEED_SQUARED], v.norm_sqr())
        own[J_MIN] = ti.min(own[J_MIN], J)
        own[J_MAX] = ti.max(own[J_MAX], J)
        if ti.static(group.law.deformation == "F"):
            # The largest eigenvalue of b = F F^T, exact at rest in any rotation.
            own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], row_sum(deformation @ deformation.transpose()))
            own[GRADIENT] = ti.max(own[GRADIENT], row_sum(C))
        else:
            own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], J * J)
            own[GRADIENT] = ti.max(own[GRADIENT], ti.abs(C.trace()))

    @ti.func
    def merge(own: ti.template(), g: ti.template()):
        for i in ti.static(range(ENTRIES)):
            if ti.static(i == J_MIN):
                ti.atomic_min(found[ENTRIES * g + i], own[i])
            else:
                ti.atomic_max(found[ENTRIES * g + i], own[i])

    @ti.func
    def nothing():
        own = ti.Vector.zero(float, ENTRIES)
        own[J_MIN] = 1e30
        return own

    @ti.kernel
    def measure() -> vector:
        for i in ti.static(range(size)):
            found[i] = 1e30 if ti.static(i % ENTRIES == J_MIN) else 0.0
        for g, group in ti.static(numbered):
            for q in range(workers):
                if ti.static(on_cpu):
                    if q % CHUNK == 0:
                        own = nothing()
                        t = q // CHUNK
                        first = share_start(group.count, t, backend.threads)
                        for p in range(first, share_start(group.count, t + 1, backend.threads)):
                            widen(own, group, p)
                        merge(own, g)
                else:
                    own = nothing()
                    p = q
                    while p < group.count:
                        widen(own, group, p)
                        p += workers
                    merge(own, g)
        result = vector(0.0)
        for i in ti.static(range(size)):
            result[i] = found[i]
        return result

    def measured() -> list[Extremes]:
        values = [float(value) for value in measure()]
        return [
            Extremes(
                speed=values[ENTRIES * g + SPEED_SQUARED] ** 0.5,
                gradient=values[ENTRIES * g + GRADIENT],
                bound=StateBound(
                    values[ENTRIES * g + J_MIN],
                    values[ENTRIES * g + J_MAX],
                    values[ENTRIES * g + STRETCH_SQUARED],
                ),
            )
            for g in range(len(groups))
        ]

    return measured
