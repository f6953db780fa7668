"""Measures extreme values over the particles of each law, which determine the limits of the next steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.materials.law import Law, StateBound
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, highest_speed
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.machine.maxima import Maxima
from mpmcli.solver.particles.sort import CHUNK, share_start

# Minima are stored as maxima of negated values.
SPEED_SQUARED, RATE, J_MAX, MINUS_J_MIN, STRETCH_SQUARED = range(5)
ENTRIES = 5
NOTHING = -1e30
# A particle compressed below this fraction of its volume is lost: J near zero is round-off error.
SMALLEST_J = 1e-6
# Workers of a measurement on a GPU. Worker k handles particles k, k + GPU_WORKERS, ...
GPU_WORKERS = 16384


@dataclass(frozen=True)
class StateBounds:
    """Largest and smallest values over all particles of one law.

    Attributes:
        speed: largest speed, m/s.
        deformation_rate: bound on the rate of deformation, 1/s (see `deformation_rate`).
        bound: range of J, of stretches and of the internal variables.
    """

    speed: float
    deformation_rate: float
    bound: StateBound


@ti.func
def volume_ratio(group: ti.template(), deformation: ti.template()):
    """Return J of the deformation of a particle, which may be padded beyond d x d."""
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
    """Return the largest row sum of absolute entries, a bound on every eigenvalue (Gershgorin)."""
    largest = 0.0
    for i in ti.static(range(matrix.n)):
        row = 0.0
        for j in ti.static(range(matrix.m)):
            row += ti.abs(matrix[i, j])
        largest = ti.max(largest, row)
    return largest


@ti.func
def second_invariant(C: ti.template()):
    """Return the sum of the principal minors of order two: ((tr C)^2 - tr C^2) / 2."""
    result = C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0]
    if ti.static(C.n == 3):
        result += C[1, 1] * C[2, 2] - C[1, 2] * C[2, 1] + C[2, 2] * C[0, 0] - C[2, 0] * C[0, 2]
    return result


@ti.func
def volume_growth(C: ti.template(), dt: float):
    """Return det(I + dt C) - 1, the relative growth of J in a step."""
    growth = dt * (C.trace() + dt * second_invariant(C))
    if ti.static(C.n == 3):
        growth += dt * dt * dt * C.determinant()
    return growth


@ti.func
def deformation_rate(group: ti.template(), C: ti.template()):
    """Return a bound on the rate at which C changes the stored deformation, 1/s: the row sum of |C + C^T| / 2 for F.

    Rotation does not count: |(I + dt C) a| >= (1 - dt |D|) |a|, with D the symmetric part of C. For J it is |tr C| +
    sqrt(-m), with m the second invariant of C, if negative: det(I + dt C) = 1 + dt tr C + dt^2 m + ...
    """
    rate = 0.0
    if ti.static(group.law.deformation == "F"):
        # Entry by entry, which takes half the time of row_sum(C + C.transpose()).
        for i in ti.static(range(C.n)):
            row = 0.0
            for j in ti.static(range(C.n)):
                row += ti.abs(C[i, j] + C[j, i])
            rate = ti.max(rate, row)
        rate *= 0.5
    else:
        rate = ti.abs(C.trace()) + ti.sqrt(ti.max(-second_invariant(C), 0.0))
    return rate


def entries(group: object) -> int:
    """Return the number of maxima that `widen_motion` and `widen_state` update."""
    return ENTRIES + 2 * len(group.internal)


@ti.func
def widen_motion(own: ti.template(), v: ti.template(), rate: float):
    """Update maxima with a particle of velocity v, m/s, and rate of deformation `rate`, 1/s."""
    own[SPEED_SQUARED] = ti.max(own[SPEED_SQUARED], v.norm_sqr())
    own[RATE] = ti.max(own[RATE], rate)


@ti.func
def widen_state(group: ti.template(), own: ti.template(), p: int):
    """Raise the maxima `own` to the state of particle p: J, -J, its squared stretch and its internal variables."""
    deformation = group.stored(p)
    J = volume_ratio(group, deformation)
    own[J_MAX] = ti.max(own[J_MAX], J)
    own[MINUS_J_MIN] = ti.max(own[MINUS_J_MIN], -J)
    if ti.static(group.law.deformation == "F"):
        # Bound on the largest eigenvalue of b = F F^T, exact at rest in any rotation.
        b = deformation @ deformation.transpose()
        own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], row_sum(b))
    else:
        own[STRETCH_SQUARED] = ti.max(own[STRETCH_SQUARED], J * J)
    for i in ti.static(range(len(group.internal))):
        value = group.internal[i][p]
        own[ENTRIES + 2 * i] = ti.max(own[ENTRIES + 2 * i], value)
        own[ENTRIES + 2 * i + 1] = ti.max(own[ENTRIES + 2 * i + 1], -value)


def state_bounds_of(group: object, maxima: Sequence[float]) -> StateBounds:
    """Return the bounds that these maxima represent, including particles that may enter."""
    if group.floor is not None:
        maxima = np.maximum(maxima, group.floor).tolist()
    values = maxima[ENTRIES:]
    internal = {v.name: (-values[2 * i + 1], values[2 * i]) for i, v in enumerate(group.law.internal)}
    bound = StateBound(-maxima[MINUS_J_MIN], maxima[J_MAX], maxima[STRETCH_SQUARED], internal)
    return StateBounds(maxima[SPEED_SQUARED] ** 0.5, maxima[RATE], bound)


def floor_of(scene: Scene, law: Law, members: Sequence[int]) -> np.ndarray | None:
    """Return maxima for undeformed particles at the speed of the emitters; None if some particle is always there."""
    if scene.bodies and not scene.particle_count_varies:
        return None
    speeds = [highest_speed(scene.sources[i], scene.time.end) for i in members if i >= len(scene.bodies)]
    at_rest = [value for v in law.internal for value in (float(v.at_rest), -float(v.at_rest))]
    return np.array([max(speeds, default=0.0) ** 2, 0.0, 1.0, -1.0, 1.0, *at_rest])


def build_maxima(size: int, widen: Callable, backend: Backend) -> Callable[[int, int, int], list[float]]:
    """Return a reduction over the particles of a run; its arguments are the first particle, their number, and the run.

    `widen(own, p, run)` updates the maxima `own` with particle p.
    """
    if size == 0:
        return lambda first, count, run: []
    vector = ti.types.vector(size, float)
    found = Maxima(1, size)
    # Each worker keeps its own maxima and merges them once, because an atomic per particle takes longer than everything
    # else.
    workers = CHUNK * backend.threads if backend.on_cpu else GPU_WORKERS
    on_cpu = backend.on_cpu

    @ti.kernel
    def reduce(first: int, count: int, run: int) -> vector:
        """Return the maxima over `count` particles of a run from `first` on, a vector of `size` numbers."""
        for i in ti.static(range(size)):
            found.reset(0, i, NOTHING)
        for q in range(workers):
            if ti.static(on_cpu):
                if q % CHUNK == 0:
                    own = ti.Vector([NOTHING] * size)
                    t = q // CHUNK
                    start = share_start(count, t, backend.threads)
                    for p in range(start, share_start(count, t + 1, backend.threads)):
                        widen(own, first + p, run)
                    for i in ti.static(range(size)):
                        found.include(0, i, own[i])
            else:
                own = ti.Vector([NOTHING] * size)
                p = q
                while p < count:
                    widen(own, first + p, run)
                    p += workers
                for i in ti.static(range(size)):
                    found.include(0, i, own[i])
        result = vector(0.0)
        for i in ti.static(range(size)):
            result[i] = found.value(0, i)
        return result

    return lambda first, count, run: [float(value) for value in reduce(first, count, run)]
