"""Measures how far the particles of each law have gone: what the limits of the next steps depend on."""

from collections.abc import Callable
from dataclasses import dataclass

import taichi as ti

from mpmcli.materials.law import StateBound
from mpmcli.solver.backend import Backend
from mpmcli.solver.ordering import CHUNK, share_start
from mpmcli.solver.particles import ParticleGroup

# Of the smallest values the negative is kept, so that all are maxima.
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
        gradient: bound on the rate of deformation, 1/s: |tr C| where J is stored, else the largest row sum of
            |C + C^T| / 2.
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


@dataclass(frozen=True)
class Measurement:
    """Compiled measurements of a group.

    Attributes:
        state: () -> extremes of everything.
        internal: () -> (smallest, largest) value of each internal variable, by name: for laws that harden, whose
            stiffness follows these variables far more closely than anything else.
    """

    state: Callable[[], Extremes]
    internal: Callable[[], dict[str, tuple[float, float]]]


def build_extremes(group: ParticleGroup, backend: Backend) -> Measurement:
    """Compile-ready measurements of a group."""

    @ti.func
    def widen_internal(own: ti.template(), p: int):
        for i in ti.static(range(len(group.internal))):
            value = group.internal[i][p]
            own[2 * i] = ti.max(own[2 * i], value)
            own[2 * i + 1] = ti.max(own[2 * i + 1], -value)

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
            # A rotation deforms nothing: |(I + dt C) a| >= (1 - dt |D|) |a|, D the symmetric part of C.
            own[GRADIENT] = ti.max(own[GRADIENT], 0.5 * row_sum(C + C.transpose()))
        else:
            own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], J * J)
            own[GRADIENT] = ti.max(own[GRADIENT], ti.abs(C.trace()))

    measure_state = build_maxima(group.count, ENTRIES, widen, backend)
    measure_internal = build_maxima(group.count, 2 * len(group.internal), widen_internal, backend)

    def internal() -> dict[str, tuple[float, float]]:
        if not group.internal:
            return {}
        values = measure_internal()
        return {v.name: (-values[2 * i + 1], values[2 * i]) for i, v in enumerate(group.law.internal)}

    def state() -> Extremes:
        values = measure_state()
        bound = StateBound(-values[MINUS_J_MIN], values[J_MAX], values[STRETCH_SQUARED], internal())
        return Extremes(values[SPEED_SQUARED] ** 0.5, values[GRADIENT], bound)

    return Measurement(state, internal)


def build_maxima(count: int, size: int, widen: Callable, backend: Backend) -> Callable[[], list[float]]:
    """Compile-ready reduction over particles: `widen` (own, p) raises the maxima `own` to those of particle p."""
    if size == 0:
        return list
    vector = ti.types.vector(size, float)
    found = ti.field(float, shape=size)
    # Each worker keeps its own extremes and merges them once: an atomic per particle costs more than the rest.
    workers = CHUNK * backend.threads if backend.on_cpu else GPU_WORKERS
    on_cpu = backend.on_cpu

    @ti.kernel
    def reduce() -> vector:
        for i in ti.static(range(size)):
            found[i] = NOTHING
        for q in range(workers):
            if ti.static(on_cpu):
                if q % CHUNK == 0:
                    own = ti.Vector([NOTHING] * size)
                    t = q // CHUNK
                    start = share_start(count, t, backend.threads)
                    for p in range(start, share_start(count, t + 1, backend.threads)):
                        widen(own, p)
                    for i in ti.static(range(size)):
                        ti.atomic_max(found[i], own[i])
            else:
                own = ti.Vector([NOTHING] * size)
                p = q
                while p < count:
                    widen(own, p)
                    p += workers
                for i in ti.static(range(size)):
                    ti.atomic_max(found[i], own[i])
        result = vector(0.0)
        for i in ti.static(range(size)):
            result[i] = found[i]
        return result

    return lambda: [float(value) for value in reduce()]
