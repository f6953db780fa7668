"""Reads a frame on the CPU by one launch per law: what every frame has, in the order of the ids, and the ledger's sums.

`snapshot.build_frame` and `snapshot.measure` do the same with numpy, for a GPU, which has no double precision
everywhere; of few particles they take several times as long.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from mpmcli.solver.particle_arrays import MASS, VOLUME, ParticleArrays
from mpmcli.solver.sums import Sums, axis_pairs


@dataclass(frozen=True)
class FrameArrays:
    """What every frame has, for all n particles, row i being particle i.

    Attributes:
        x: (n, d) relative to the origin of the domain, m; v: (n, d), m/s.
        labels: (n, 2) int32, body and material.
    """

    x: np.ndarray
    v: np.ndarray
    labels: np.ndarray

    @staticmethod
    def empty(count: int, dimension: int, real: type) -> "FrameArrays":
        """Return arrays to be filled."""
        return FrameArrays(
            np.empty((count, dimension), real), np.empty((count, dimension), real), np.empty((count, 2), np.int32)
        )


def build_frame_reader(group: ParticleArrays) -> Callable[..., tuple[Sums, np.ndarray]]:
    """Return the reader of a range of particles: a function (dt, first, count, places, material, arrays, row).

    Its `dt` is the last step, s. `places` holds the index in the scene of the body in each row of the table from `row`
    on, and `arrays` the FrameArrays to be filled. It returns the sums, and J or det F and the internal variables after
    plastic flow, (n, 1 + k) in the solver's order. The device's state does not change: the next step applies that flow.
    """
    d, law, serial = group.dimension, group.law, group.serial
    keeps_F = law.deformation == "F"
    inner_count = len(group.internal)
    pairs = axis_pairs(d)
    turns = len(pairs)
    width = 5 + 2 * d + 2 * turns

    @ti.kernel
    def read(
        dt: float,
        first: int,
        material: int,
        first_row: int,
        places: ti.types.ndarray(),
        x: ti.types.ndarray(),
        v: ti.types.ndarray(),
        labels: ti.types.ndarray(),
        volumes: ti.types.ndarray(),
        energies: ti.types.ndarray(),
        sums: ti.types.ndarray(),
    ):
        ti.loop_config(serialize=serial)
        for q in range(energies.shape[0]):
            p = first + q
            row = group.id[p]
            velocity, C = group.motion(p)
            for c in ti.static(range(d)):
                x[row, c] = group.x[p][c]
                v[row, c] = velocity[c]
            labels[row, 0] = places[0]
            if ti.static(group.several):
                labels[row, 0] = places[group.body[p] - first_row]
            labels[row, 1] = material
            constants = group.constants(p)
            # Half a step back, where the velocities are, and now: a loop, so that the law is compiled once.
            for k in range(ti.static(2 if law.projects else 1)):
                back = 0.5 * (k - 1) * dt
                stored = group.stored(p)
                if ti.static(keeps_F):
                    stored += back * (C @ stored)
                else:
                    stored *= 1.0 + back * C.trace()
                _, _, deformation, inner = law.respond(stored, group.inner(p), C, dt, constants)
                if k == 0:
                    energies[q] = law.energy(deformation, inner, constants)
                if ti.static(not law.projects):
                    deformation = group.stored(p)
                    inner = group.inner(p)
                if ti.static(keeps_F):
                    volumes[q, 0] = deformation.determinant()
                else:
                    volumes[q, 0] = deformation
                for i in ti.static(range(inner_count)):
                    volumes[q, 1 + i] = inner[i]
        # In one order on any number of threads.
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = ti.Vector.zero(ti.f64, width)
            fastest = 0.0
            for q in range(energies.shape[0]):
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
                total[3] += ti.cast(row[VOLUME], ti.f64) * ti.cast(energies[q], ti.f64)
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

    def reader(
        dt: float, first: int, count: int, places: np.ndarray, material: int, arrays: FrameArrays, row: int = 0
    ) -> tuple[Sums, np.ndarray]:
        volumes, energies = np.empty((count, 1 + inner_count), group.real), np.empty(count, group.real)
        sums = np.empty(width)
        read(dt, first, material, row, places, arrays.x, arrays.v, arrays.labels, volumes, energies, sums)
        mass, motion, affine, elastic, speed = sums[:5].tolist()
        place, momentum, turning, spin = np.split(sums[5:], [d, 2 * d, 2 * d + turns])
        return Sums(mass, place, momentum, motion, affine, turning, spin, elastic, speed), volumes

    return reader
