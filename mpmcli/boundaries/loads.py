"""Impulses of the material on colliders, and of bodies on each other, between two frames."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.quick_taichi import ti


@ti.data_oriented
class Loads:
    """Impulses, N s, and angular impulses, N m s, on the receivers in each run of a batch since the last frame.

    Attributes:
        capacity: number of receivers of a run.
        rows: number of rows of nodes of a run, along the last axis.
        width: number of components of an impulse and an angular impulse, 3 in 2D, 6 in 3D.
        taken: loads of each receiver by rows of nodes. Parallel parts of a step share no row, so that the order of
            summation is fixed.
    """

    def __init__(self, capacity: int, shape: Sequence[int], runs: int, *, on_cpu: bool) -> None:
        self.dimension, self.shape, self.capacity, self.on_cpu = len(shape), tuple(shape), capacity, on_cpu
        self.rows, self.width = math.prod(shape[:-1]), 3 if len(shape) == 2 else 6
        self.taken = ti.Vector.field(self.width, ti.f64 if on_cpu else float, shape=runs * capacity * self.rows)

    @ti.kernel
    def clear(self, run: int):
        """Set the loads of a run to zero."""
        for q in range(self.rows * self.capacity):
            self.taken[run * self.rows * self.capacity + q] = ti.Vector.zero(float, self.width)

    def read(self, run: int) -> np.ndarray:
        """Return the loads of the receivers of a run, (capacity, width), and set all to zero."""
        size = self.rows * self.capacity
        taken = self.taken.to_numpy()[run * size : (run + 1) * size].astype(np.float64)
        self.clear(run)
        return np.cumsum(taken.reshape(self.rows, self.capacity, -1), axis=0)[-1]

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        """Store the loads of a run in frame_stats[run, frame], from `column` on, and set them to zero."""
        for k in range(self.capacity):
            total = ti.Vector.zero(ti.f64, self.width)
            for row in range(self.rows):
                place = (run * self.rows + row) * self.capacity + k
                for a in ti.static(range(self.width)):
                    total[a] += self.taken[place][a]
                    self.taken[place][a] = ti.cast(0, ti.f64)
            for a in ti.static(range(self.width)):
                frame_stats[run, frame, column + k * self.width + a] = total[a]

    @ti.func
    def total(self, run: int, k: int):
        """Return the load of receiver k of a run since the last frame."""
        result = ti.Vector.zero(ti.f64, self.width)
        for row in range(self.rows):
            for a in ti.static(range(self.width)):
                result[a] += self.taken[(run * self.rows + row) * self.capacity + k][a]
        return result

    @ti.func
    def row_of(self, node: ti.template()):
        """Return the index of the row of a node."""
        row = 0
        for a in ti.static(range(self.dimension - 1)):
            row = row * ti.static(self.shape[a]) + node[a]
        return row

    @ti.func
    def take(self, run: int, node: ti.template(), k: int, impulse: ti.template(), arm: ti.template()):
        """Add an impulse at a node, N s, to the loads of receiver k, with the arm from its point of reference, m."""
        load = self.of(impulse, arm)
        for a in ti.static(range(self.width)):
            self.add(run, node, k, a, load[a])

    @ti.func
    def add(self, run: int, node: ti.template(), k: int, a: ti.template(), value: float):
        """Add a value from a node to the a-th number of receiver k."""
        place = (run * self.rows + self.row_of(node)) * self.capacity + k
        if ti.static(self.on_cpu):
            self.taken[place][a] = self.taken[place][a] + ti.cast(value, ti.f64)
        else:
            ti.atomic_add(self.taken[place][a], value)

    @ti.func
    def of(self, impulse: ti.template(), arm: ti.template()):
        """Return an impulse, N s, followed by its angular impulse, N m s, for an arm, m."""
        d = ti.static(self.dimension)
        load = ti.Vector.zero(float, ti.static(self.width))
        for a in ti.static(range(d)):
            load[a] = impulse[a]
        if ti.static(d == 2):
            load[2] = arm[0] * impulse[1] - arm[1] * impulse[0]
        else:
            for a in ti.static(range(3)):
                b, c = ti.static((a + 1) % 3), ti.static((a + 2) % 3)
                load[3 + a] = arm[b] * impulse[c] - arm[c] * impulse[b]
        return load
