"""Reads a frame on the CPU by one launch per law: what the particles show, and the ledger's sums.

`snapshot.fill` does the same with numpy, for a GPU, which has no double precision everywhere; of
few particles they take several times as long.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.solver.frame_arrays import FrameArrays, stress_entries
from mpmcli.solver.observe import respond_later
from mpmcli.solver.particle_arrays import MASS, VOLUME, ParticleArrays
from mpmcli.solver.sums import Sums, axis_pairs


def build_frame_reader(group: ParticleArrays) -> Callable[[float, int, int, FrameArrays], Sums]:
    """Return the reader of a range of particles: a function (dt, first, count, arrays).

    Its `dt` is the last step, s. It fills the rows of those particles in `arrays`, and returns the sums. The device's
    state does not change: the next step applies the plastic flow that the frame shows.
    """
    d, law, serial = group.dimension, group.law, group.serial
    keeps_F = law.deformation == "F"
    inner_count = len(group.internal)
    entries = tuple(enumerate(stress_entries(d)))
    pairs = axis_pairs(d)
    turns = len(pairs)
    width = 5 + 2 * d + 2 * turns

    @ti.kernel
    def read(
        dt: float,
        first: int,
        count: int,
        affine_at: ti.template(),
        gradient_at: ti.template(),
        tau_at: ti.template(),
        reals: ti.types.ndarray(),
        sums: ti.types.ndarray(),
    ):
        ti.loop_config(serialize=serial)
        for q in range(count):
            p = first + q
            row = group.id[p]
            velocity, C = group.motion(p)
            for c in ti.static(range(d)):
                reals[row, c] = group.x[p][c]
                reals[row, d + c] = velocity[c]
            if ti.static(affine_at >= 0):
                for i, j in ti.static(ti.ndrange(d, d)):
                    reals[row, affine_at + i * d + j] = C[i, j]
            # Half a step back, where the velocities are, and now: a loop, so that the law is compiled once.
            for k in range(ti.static(2 if law.projects or tau_at >= 0 else 1)):
                tau, tau_zz, deformation, inner = respond_later(group, p, 0.5 * (k - 1) * dt, dt)
                if k == 0:
                    reals[row, 2 * d] = law.energy(deformation, inner, group.constants(p))
                if ti.static(not law.projects):
                    deformation = group.stored(p)
                    inner = group.inner(p)
                if ti.static(keeps_F):
                    reals[row, 2 * d + 1] = deformation.determinant()
                else:
                    reals[row, 2 * d + 1] = deformation
                for i in ti.static(range(inner_count)):
                    reals[row, 2 * d + 2 + i] = inner[i]
                if ti.static(gradient_at >= 0):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        if ti.static(keeps_F):
                            reals[row, gradient_at + i * d + j] = deformation[i, j]
                        else:
                            # The isotropic F of this volume.
                            reals[row, gradient_at + i * d + j] = deformation ** (1.0 / d) if ti.static(i == j) else 0.0
                if ti.static(tau_at >= 0):
                    for column, place in ti.static(entries):
                        if ti.static(place[0] < d and place[1] < d):
                            reals[row, tau_at + column] = tau[place[0], place[1]]
                        else:
                            reals[row, tau_at + column] = tau_zz
        # In one order on any number of threads.
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = ti.Vector.zero(ti.f64, width)
            fastest = 0.0
            for q in range(count):
                p = first + q
                row = group.row(p)
                m = ti.cast(row[MASS], ti.f64)
                velocity, C = group.motion(p)
                place = ti.cast(group.x[p], ti.f64)
                speed = ti.cast(velocity, ti.f64)
                affine = ti.cast(C, ti.f64)
                total[0] += m
                total[1] += m * speed.norm_sqr()
                total[2] += m * affine.norm_sqr()
                total[3] += ti.cast(row[VOLUME], ti.f64) * ti.cast(reals[group.id[p], 2 * d], ti.f64)
                for c in ti.static(range(d)):
                    total[5 + c] += m * place[c]
                    total[5 + d + c] += m * speed[c]
                for k in ti.static(range(turns)):
                    a, b = ti.static(pairs[k])
                    total[5 + 2 * d + k] += m * (place[a] * speed[b] - place[b] * speed[a])
                    total[5 + 2 * d + turns + k] += m * (affine[b, a] - affine[a, b])
                fastest = ti.max(fastest, velocity.norm_sqr())
            total[4] = ti.cast(fastest, ti.f64)
            for k in ti.static(range(width)):
                sums[k] = total[k]

    def reader(dt: float, first: int, count: int, arrays: FrameArrays) -> Sums:
        found = np.empty(width)
        at = arrays.first
        read(dt, first, count, at["affine"], at["gradient"], at["tau"], arrays.reals, found)
        mass, motion, affine, elastic, speed = found[:5].tolist()
        place, momentum, turning, spin = np.split(found[5:], [d, 2 * d, 2 * d + turns])
        return Sums(mass, place, momentum, motion, affine, turning, spin, elastic, speed)

    return reader
