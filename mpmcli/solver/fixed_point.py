"""P2G in fixed point, for `solver.deterministic` on a GPU: what it adds up, and how large that may become.

A particle that moves, deforms and is pushed by less than FARTHEST cells in a stable step T adds at most its mass times
FARTHEST h / T to the momentum of a node, which therefore has at most its own mass times that. A node has at most
DENSEST times the mass that the densest body fills a cell with, or all of it (docs/theory.md, 8.4). Both are checked,
the one for each particle before it is added, the other for each node; then no sum can overflow.
"""

from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.solver.fixed_sums import WIDE, FixedSums
from mpmcli.solver.grid import Grid
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particles import ParticleGroup

FARTHEST, DENSEST = 16.0, 32.0
# Bound on |ln J| that counts, above that of the smallest J.
LARGEST_LOG = 16.0
NOTHING = 2**31 - 1


@ti.data_oriented
class FixedPoint:
    """The sums of a grid, and their scales.

    Attributes:
        nodes, before, filling, means: sums of what the fields of the grid of that name hold; None where it has none.
        reach: cells from the middle node of a stencil to its farthest one.
        heaviest: bound on the mass of a node, kg.
        beyond: the smallest id of a particle that is too fast for the sums, and the smallest index of a node that is
            too heavy; NOTHING for none.
    """

    def __init__(self, grid: Grid, groups: Sequence[ParticleGroup], arch: str) -> None:
        """Allocate for these particles; `forget` comes before the first step.

        No kernel is launched here: what is allocated after one is a buffer of its own.
        """
        self.wide, self.dimension = arch in WIDE, grid.dimension
        self.nodes = self._sums(grid.width, grid.node_count)
        self.before = self._sums(grid.width, grid.node_count) if grid.scheme.keeps_before else None
        self.filling = self._sums(grid.width, grid.node_count) if grid.keeps_filling else None
        self.means = tuple(self._sums(2, grid.node_count) if group.averaged else None for group in groups)
        self.kept = tuple(sums for sums in (self.nodes, self.before, self.filling, *self.means) if sums is not None)
        self.reach = grid.scheme.spline.nodes - 2
        density = np.concatenate([group.rows[:, MASS] / group.rows[:, VOLUME] for group in groups]).astype(np.float64)
        total = sum(group.count * float(group.rows[:, MASS].max()) for group in groups)
        self.heaviest = min(total, DENSEST * float(density.max()) * grid.spacing**grid.dimension)
        volume = self.heaviest / float(density.min())
        # A cell holds at most what the nodes of its stencils do.
        in_cell = volume * grid.scheme.spline.nodes**grid.dimension
        self.mass_scale, self.volume_scale = self.nodes.scale(self.heaviest), self.nodes.scale(volume)
        self.cell_scale, self.log_scale = self.nodes.scale(in_cell), self.nodes.scale(LARGEST_LOG * in_cell)
        self._farthest, self._scale = FARTHEST * grid.spacing, 0.0
        # Scale of momenta, its inverse, and the speed that has room.
        self.pace = ti.Vector.field(3, float, shape=())
        self.beyond = ti.field(int, shape=2)

    def _sums(self, width: int, count: int) -> FixedSums:
        return FixedSums(width, count, wide=self.wide)

    @staticmethod
    def bytes_needed(width: int, *, before: bool, filling: bool, averaged: int) -> int:
        """Return the bytes of the sums of a node, of `averaged` groups that average volumes."""
        return 8 * (width * (1 + before + filling) + 2 * averaged)

    def set_step(self, step: float) -> None:
        """Choose the scale of momenta for steps of which `step`, s, is stable."""
        scale = self.nodes.scale(self.heaviest * self._farthest / step)
        if scale != self._scale:
            self._scale = scale
            self.pace[None] = [scale, 1 / scale, self.nodes.largest / scale / self.heaviest]

    def forget(self) -> None:
        """Forget what was beyond the sums."""
        self.beyond.fill(NOTHING)

    def found_beyond(self) -> tuple[int | None, int | None]:
        """Return the id of a particle and the index of a node that were too much for the sums, None where none was."""
        return tuple(None if k == NOTHING else int(k) for k in self.beyond.to_numpy())

    @ti.func
    def clear(self, node: int):
        """Set the sums of a node to zero."""
        for sums in ti.static(self.kept):
            sums.clear(node)

    @ti.func
    def scaled(self, mass: float, middle: ti.template(), change: ti.template()):
        """Scale what a particle adds to its stencil, see `momentum`, and return whether the sums have room for it."""
        d = ti.static(self.dimension)
        scale, most = self.pace[None][0], mass * self.pace[None][2]
        fits = True
        for c in ti.static(range(d)):
            largest = ti.abs(middle[c])
            middle[c] *= scale
            for a in ti.static(range(d)):
                largest += ti.static(float(self.reach)) * ti.abs(change[a, c])
                change[a, c] *= scale
            # Written so that a NaN does not fit.
            fits = fits and largest <= most
        middle[d] *= self.mass_scale
        return fits

    @ti.func
    def note(self, particle: int):
        """Note that a particle is too fast for the sums."""
        ti.atomic_min(self.beyond[0], particle)

    @ti.func
    def settle(self, grid: ti.template(), node: int, relaxed: float):
        """Set the fields of the grid at a node from the sums."""
        d = ti.static(self.dimension)
        value, inverse = self.nodes.value(node), self.pace[None][1]
        if not (value[d] >= 0.0 and value[d] <= ti.static(self.nodes.largest)):
            ti.atomic_min(self.beyond[1], node)
        for c in ti.static(range(d)):
            grid.nodes[node][c] = value[c] * inverse
        grid.nodes[node][d] = value[d] * ti.static(1 / self.mass_scale)
        if ti.static(grid.scheme.keeps_before):
            before = self.before.value(node)
            for c in ti.static(range(d)):
                grid.before[node][c] = before[c] * inverse
            grid.before[node][d] = before[d] * ti.static(1 / self.mass_scale)
        if ti.static(grid.keeps_filling):
            if relaxed > 0.0:
                grid.filling[node][d] = self.filling.value(node)[d] * ti.static(1 / self.volume_scale)

    @ti.func
    def add_mean(self, g: ti.template(), cell: int, volume: float, log: float):
        """Add ln J of a particle of the g-th group, times its volume, m^3, to its cell."""
        held = ti.max(ti.min(log, LARGEST_LOG), -LARGEST_LOG)
        self.means[g].add(cell, ti.Vector([volume * held * self.log_scale, volume * self.cell_scale]))

    @ti.func
    def mean(self, g: ti.template(), cell: int):
        """Return what `Grid.means` holds."""
        value = self.means[g].value(cell)
        value[0] *= ti.static(1 / self.log_scale)
        value[1] *= ti.static(1 / self.cell_scale)
        return value
