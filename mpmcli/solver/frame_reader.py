"""Reads a frame on the CPU by one launch per law: what the particles show, and the ledger's sums.

`snapshot.fill` does the same with numpy, for a GPU, which has no double precision everywhere; of
few particles they take several times as long.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from mpmcli.solver.frame_arrays import FrameArrays, stress_entries
from mpmcli.solver.lane_state import (
    LANES,
    constants_of,
    internal_entries,
    load_lanes,
    matrix_of,
    stored_entries,
    stored_of,
    vector_of,
    zero_lanes,
)
from mpmcli.solver.observe import respond_after
from mpmcli.solver.particle_arrays import MASS, VOLUME, ParticleArrays
from mpmcli.solver.sums import Sums, axis_pairs


def build_frame_reader(group: ParticleArrays) -> Callable[[float, int, int, FrameArrays], Sums]:
    """Return the reader of a range of particles: a function (dt, first, count, arrays).

    Its `dt` is the last step, s. It fills the rows of those particles in `arrays`, and returns the sums. The device's
    state does not change: the next step applies the plastic flow that the frame shows.
    """
    d, law, serial = group.dimension, group.law, group.serial
    keeps_F = law.deformation == "F"
    inner_count, inners = len(group.internal), internal_entries(group)
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
        for chunk in range((count + LANES - 1) // LANES):
            begin = first + chunk * LANES
            own = ti.min(LANES, count - chunk * LANES)
            affine, deformation = zero_lanes(ti.static(d * d)), zero_lanes(ti.static(stored_entries(group)))
            internal, rows = zero_lanes(inners), zero_lanes(ti.static(group.table.n))
            load_lanes(group, begin, own, affine, deformation, internal, rows)
            # Energy, J, internal variables, and entries of the deformation and of the stress.
            shown = zero_lanes(ti.static(2 + inners + d * d + len(entries)))
            # Half a step back, where the velocities are, and now: a loop, so that the law is compiled once.
            for k in range(ti.static(2 if law.projects or tau_at >= 0 else 1)):
                for lane in range(LANES):
                    C, inner = matrix_of(affine, d, lane), vector_of(internal, 0, inners, lane)
                    stored, constants = stored_of(group, deformation, lane), constants_of(rows, lane)
                    tau, tau_zz, after, inner_after = respond_after(
                        law, stored, inner, C, 0.5 * (k - 1) * dt, dt, constants
                    )
                    if k == 0:
                        shown[0, lane] = law.energy(after, inner_after, constants)
                    if ti.static(not law.projects):
                        after = stored
                        inner_after = inner
                    for i in ti.static(range(inners)):
                        shown[2 + i, lane] = inner_after[i]
                    if ti.static(keeps_F):
                        shown[1, lane] = after.determinant()
                        for i, j in ti.static(ti.ndrange(d, d)):
                            shown[2 + inners + i * d + j, lane] = after[i, j]
                    else:
                        shown[1, lane] = after
                    for column, place in ti.static(entries):
                        if ti.static(place[0] < d and place[1] < d):
                            shown[2 + inners + d * d + column, lane] = tau[place[0], place[1]]
                        else:
                            shown[2 + inners + d * d + column, lane] = tau_zz
            for lane in range(own):
                p = begin + lane
                row = group.id[p]
                velocity, C = group.motion(p)
                for c in ti.static(range(d)):
                    reals[row, c] = group.x[p][c]
                    reals[row, d + c] = velocity[c]
                for i in ti.static(range(2 + inner_count)):
                    reals[row, 2 * d + i] = shown[i, lane]
                if ti.static(affine_at >= 0):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        reals[row, affine_at + i * d + j] = C[i, j]
                if ti.static(gradient_at >= 0):
                    for i, j in ti.static(ti.ndrange(d, d)):
                        if ti.static(keeps_F):
                            reals[row, gradient_at + i * d + j] = shown[2 + inners + i * d + j, lane]
                        else:
                            # The isotropic F of this volume.
                            reals[row, gradient_at + i * d + j] = (
                                shown[1, lane] ** (1.0 / d) if ti.static(i == j) else 0.0
                            )
                if ti.static(tau_at >= 0):
                    for column in ti.static(range(len(entries))):
                        reals[row, tau_at + column] = shown[2 + inners + d * d + column, lane]
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
