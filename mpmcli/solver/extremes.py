"""Measures how far the particles of each law have gone: what the limits of the next steps depend on."""

from collections.abc import Callable
from dataclasses import dataclass

import taichi as ti

from mpmcli.materials.law import StateBound
from mpmcli.solver.backend import Backend
from mpmcli.solver.ordering import CHUNK, share_start
from mpmcli.solver.particles import ParticleGroup

# Of the smallest values the negative is kept, so that all are maxima. Internal variables follow, both of each.
SPEED_SQUARED, GRADIENT, J_MAX, MINUS_J_MIN, STRETCH_SQUARED = range(5)
ENTRIES = 5
NOTHING = -1e30
# Workers of a measurement on a GPU, each with every so-manieth particle.
GPU_WORKERS = 16384


@dataclass(frozen=True)
class Extremes:
    """Extremes over all particles of one law.

    Attributes:
        speed: largest speed, m/s.
        gradient: bound on the rate of deformation, 1/s: |tr C| where J is stored, else the largest row sum of |C|.
        bound: range of J, of stretches and of the internal variables.
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


def build_extremes(group: ParticleGroup, backend: Backend) -> Callable[[], Extremes]:
    """Compile-ready measurement of a group: call the result to measure."""
    size = ENTRIES + 2 * len(group.internal)
    vector = ti.types.vector(size, float)
    found = ti.field(float, shape=size)
    # Each worker keeps its own extremes and merges them once: an atomic per particle costs more than the rest.
    workers = CHUNK * backend.threads if backend.on_cpu else GPU_WORKERS
    on_cpu = backend.on_cpu

    @ti.func
    def widen(own: ti.template(), p: int):
        v, C = group.motion(p)
        deformation = group.stored(p)
        J = volume_ratio(group, deformation)
        own[SPEED_SQUARED] = ti.max(own[SPEED_SQUARED], v.norm_sqr())
        own[J_MAX] = ti.max(own[J_MAX], J)
        own[MINUS_J_MIN] = ti.max(own[MINUS_J_MIN], -J)
        if ti.static(group.law.deformation == "F"):
            # The largest eigenvalue of b = F F^T, exact at rest in any rotation.
            own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], row_sum(deformation @ deformation.transpose()))
            own[GRADIENT] = ti.max(own[GRADIENT], row_sum(C))
        else:
            own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], J * J)
            own[GRADIENT] = ti.max(own[GRADIENT], ti.abs(C.trace()))
        for i in ti.static(range(len(group.internal))):
            value = group.internal[i][p]
            own[ENTRIES + 2 * i] = ti.max(own[ENTRIES + 2 * i], value)
            own[ENTRIES + 2 * i + 1] = ti.max(own[ENTRIES + 2 * i + 1], -value)

    @ti.kernel
    def measure() -> vector:
        for i in ti.static(range(size)):
            found[i] = NOTHING
        for q in range(workers):
            if ti.static(on_cpu):
                if q % CHUNK == 0:
                    own = ti.Vector([NOTHING] * size)
                    t = q // CHUNK
                    start = share_start(group.count, t, backend.threads)
                    for p in range(start, share_start(group.count, t + 1, backend.threads)):
                        widen(own, p)
                    for i in ti.static(range(size)):
                        ti.atomic_max(found[i], own[i])
            else:
                own = ti.Vector([NOTHING] * size)
                p = q
                while p < group.count:
                    widen(own, p)
                    p += workers
                for i in ti.static(range(size)):
                    ti.atomic_max(found[i], own[i])
        result = vector(0.0)
        for i in ti.static(range(size)):
            result[i] = found[i]
        return result

    def measured() -> Extremes:
        values = [float(value) for value in measure()]
        internal = {
            variable.name: (-values[ENTRIES + 2 * i + 1], values[ENTRIES + 2 * i])
            for i, variable in enumerate(group.law.internal)
        }
        bound = StateBound(-values[MINUS_J_MIN], values[J_MAX], values[STRETCH_SQUARED], internal)
        return Extremes(values[SPEED_SQUARED] ** 0.5, values[GRADIENT], bound)

    return measured
