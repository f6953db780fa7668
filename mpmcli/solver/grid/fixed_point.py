"""P2G in fixed point, for `solver.deterministic` on a GPU: what it adds up, and how large that may become.

A particle that moves, deforms and is pushed by less than FARTHEST cells in a stable step T adds at most its mass times
FARTHEST h / T to the momentum of a node, which therefore has at most its own mass times that. A node has at most
DENSEST times the mass that the densest body fills a cell with, or all of it (docs/theory.md, 8.4). Both are checked,
the one for each particle before it is added, the other for each node; then no sum can overflow. Atomics add to
integers in any order with the same result.
"""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import MASS, VOLUME, ParticleArrays

# Backends whose devices all add 64-bit integers atomically. Elsewhere a sum is two integers of 32 bits.
WIDE = ("cpu", "cuda")
# Bits of the largest sum: above it there is room for eight times as much, so that it can be seen that one is too large.
BITS_OF_WIDE, BITS_OF_HIGH = 60, 28
# Bits that the lower of two integers adds: 2**17 numbers fit into it, whatever they are.
LOW_BITS = 15
# Largest exponent of a scale, which single precision holds.
LARGEST_EXPONENT = 120


@ti.data_oriented
class FixedSums:
    """Vectors of sums: what is added is scaled by a power of two before, so that no sum exceeds `largest`, and rounded.

    width: numbers of a vector; wide: whether each is one 64-bit integer, otherwise two, the lower one of LOW_BITS.
    """

    def __init__(self, width: int, count: int, *, wide: bool) -> None:
        """Allocate `count` vectors, all zero."""
        self.width, self.wide = width, wide
        self.largest = 2.0 ** (BITS_OF_WIDE if wide else BITS_OF_HIGH)
        self.high = ti.Vector.field(width, ti.i64 if wide else ti.i32, shape=count)
        self.low = None if wide else ti.Vector.field(width, ti.i32, shape=count)

    def scale(self, bound: float) -> float:
        """Return the power of two that takes `bound`, and no less than its half, to `largest`."""
        exponent = math.floor(math.log2(self.largest / bound)) if bound > 0 else 0
        return 2.0 ** max(-LARGEST_EXPONENT, min(LARGEST_EXPONENT, exponent))

    @ti.func
    def clear(self, place: int):
        for c in ti.static(range(self.width)):
            self.high[place][c] = 0
            if ti.static(not self.wide):
                self.low[place][c] = 0

    @ti.func
    def add(self, place: int, share: ti.template()):
        """Add scaled numbers, with atomics."""
        for c in ti.static(range(self.width)):
            whole = ti.round(share[c])
            if ti.static(self.wide):
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i64))
            else:
                # The difference is exact.
                rest = ti.round((share[c] - whole) * ti.static(2.0**LOW_BITS))
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i32))
                ti.atomic_add(self.low[place][c], ti.cast(rest, ti.i32))

    @ti.func
    def value(self, place: int):
        """Return a vector of scaled sums."""
        result = ti.Vector.zero(float, self.width)
        for c in ti.static(range(self.width)):
            result[c] = ti.cast(self.high[place][c], float)
            if ti.static(not self.wide):
                result[c] += ti.cast(self.low[place][c], float) * ti.static(2.0**-LOW_BITS)
        return result


FARTHEST, DENSEST = 16.0, 32.0
# Bound on the fine cells whose particles are around one fine node.
CROWDED = 4096.0
# Bound on |ln J| that counts, above that of the smallest J.
LARGEST_LOG = 16.0
NOTHING = 2**31 - 1
# Of a run: scales of masses, volumes, and sums over a cell, a bound on the mass of a node, kg, and what takes a stable
# step, s, to the scale of momenta.
OF_MASS, OF_VOLUME, OF_CELL, OF_LOG, HEAVIEST, PER_STEP, SCALES = range(7)


@ti.data_oriented
class FixedPoint:
    """The sums of a grid: nodes, filling, means, of its fields of that name, None where it has none.

    Attributes:
        parts: as of the grid.
        fine: of the fraction of fine cells that particles fill, None where they are not shifted; of_fine: their scale.
        reach: cells from the middle node of a stencil to its farthest one; run: that a view is for.
        scales: of each run, see OF_MASS; pace: scale of momenta, its inverse, and the speed that has room.
        beyond: of each run, the smallest id of a particle that is too fast for the sums, and the smallest index of a
            node that is too heavy; NOTHING for none.
    """

    def __init__(self, grid: Grid, groups: Sequence[ParticleArrays], arch: str) -> None:
        """Allocate, without a launch of a kernel: what is allocated after one is a buffer of its own."""
        self.dimension = grid.dimension
        sums = partial(FixedSums, count=grid.runs * grid.node_count, wide=arch in WIDE)
        self.nodes = sums(grid.width)
        self.filling = sums(grid.kept) if grid.keeps_filling else None
        self.means = tuple(sums(3) if group.uses_f_bar else None for group in groups)
        wide, fine = arch in WIDE, grid.fine
        self.fine = FixedSums(1, grid.runs * fine.node_count, wide=wide) if fine else None
        self.of_fine = self.fine.scale(CROWDED) if fine else 0.0
        self.kept = tuple(sums for sums in (self.nodes, self.filling, *self.means) if sums is not None)
        self.parts = grid.parts
        self.stencil, self.reach = grid.scheme.spline.nodes, grid.scheme.spline.nodes - 2
        self.run, self._node_count = 0, grid.node_count
        self.scales = ti.Vector.field(SCALES, float, shape=grid.runs)
        self.pace = ti.Vector.field(3, float, shape=grid.runs)
        self.beyond = ti.field(int, shape=2 * grid.runs)

    def write(self, run: int, groups: Sequence, spacing: float) -> None:
        """Set the scales of a run with these particles, see `RunGroup`, on a grid of `spacing`, m."""
        density = np.concatenate([group.rows[:, MASS] / group.rows[:, VOLUME] for group in groups]).astype(np.float64)
        total = sum(group.count * float(group.rows[:, MASS].max()) for group in groups)
        heaviest = min(total, DENSEST * float(density.max()) * spacing**self.dimension)
        volume = heaviest / float(density.min())
        # A cell holds at most what the nodes of its stencils do.
        in_cell = volume * self.stencil**self.dimension
        of_mass, of_volume, of_cell, of_log = (
            self.nodes.scale(bound) for bound in (heaviest, volume, in_cell, LARGEST_LOG * in_cell)
        )
        per_step = self.nodes.largest / (heaviest * FARTHEST * spacing)
        self.scales[run] = [of_mass, of_volume, of_cell, of_log, heaviest, per_step]
        self.forget(run)

    @staticmethod
    def bytes_needed(numbers: int, averaged: int) -> int:
        """Return the bytes of so many sums of a node, and of those of `averaged` groups that average volumes."""
        return 8 * (numbers + 3 * averaged)

    @ti.func
    def set_step(self, run: int, step: float):
        """Choose the scale of momenta, a power of two, for steps of which `step`, s, is stable."""
        whole = ti.cast(ti.min(self.scales[run][PER_STEP] * step, ti.static(2.0**LARGEST_EXPONENT)), ti.f32)
        exponent = (ti.bit_cast(whole, ti.i32) >> 23) - 127
        scale = ti.bit_cast((ti.max(exponent, -LARGEST_EXPONENT) + 127) << 23, ti.f32)
        most = self.nodes.largest / scale / self.scales[run][HEAVIEST]
        self.pace[run] = ti.Vector([ti.cast(scale, float), ti.cast(1.0 / scale, float), ti.cast(most, float)])

    def forget(self, run: int) -> None:
        for k in range(2):
            self.beyond[2 * run + k] = NOTHING

    def found_beyond(self, run: int) -> tuple[int | None, int | None]:
        """Return the id of a particle and the index of a node that were too much for the sums, None where none was."""
        particle, node = self.beyond.to_numpy()[2 * run : 2 * run + 2].tolist()
        return None if particle == NOTHING else particle, None if node == NOTHING else node - run * self._node_count

    @ti.func
    def clear(self, node: int):
        for sums in ti.static(self.kept):
            sums.clear(node)

    @ti.func
    def scaled(self, mass: float, middle: ti.template(), change: ti.template()):
        """Scale what a particle adds to its stencil, see `momentum`, and return whether the sums have room for it."""
        d = ti.static(self.dimension)
        scale, most = self.pace[self.run][0], mass * self.pace[self.run][2]
        fits = True
        for first in ti.static(self.parts):
            for c in ti.static(range(first, first + d)):
                largest = ti.abs(middle[c])
                middle[c] *= scale
                for a in ti.static(range(d)):
                    largest += ti.static(float(self.reach)) * ti.abs(change[a, c])
                    change[a, c] *= scale
                # Written so that a NaN does not fit.
                fits = fits and largest <= most
            middle[first + d] *= self.scales[self.run][OF_MASS]
        return fits

    @ti.func
    def volume_scale(self):
        return self.scales[self.run][OF_VOLUME]

    @ti.func
    def note(self, particle: int):
        """Note that a particle is too fast for the sums."""
        ti.atomic_min(self.beyond[2 * self.run], particle)

    @ti.func
    def to_float(self, grid: ti.template(), node: int, relaxed: float):
        """Set the fields of the grid at a node from the sums."""
        d = ti.static(self.dimension)
        value, inverse = self.nodes.value(node), self.pace[self.run][1]
        if not (value[d] >= 0.0 and value[d] <= ti.static(self.nodes.largest)):
            ti.atomic_min(self.beyond[2 * self.run + 1], node)
        for first in ti.static(self.parts):
            for c in ti.static(range(first, first + d)):
                grid.nodes[node][c] = value[c] * inverse
            grid.nodes[node][first + d] = value[first + d] / self.scales[self.run][OF_MASS]
        if ti.static(grid.keeps_filling):
            if relaxed > 0.0:
                grid.filling[node][d] = self.filling.value(node)[d] / self.scales[self.run][OF_VOLUME]

    @ti.func
    def add_mean(self, g: ti.template(), cell: int, volume: float, log: float, growth: float):
        """Add ln J of a particle of the g-th group, what it grew by, and 1, times its volume, m^3, to its cell."""
        scales = self.scales[self.run]
        more = ti.Vector([log, growth, 1.0])
        for k in ti.static(range(2)):
            more[k] = ti.max(ti.min(more[k], LARGEST_LOG), -LARGEST_LOG) * scales[OF_LOG]
        more[2] = scales[OF_CELL]
        self.means[g].add(cell, volume * more)

    @ti.func
    def mean(self, g: ti.template(), cell: int):
        """Return what `Grid.means` holds."""
        value = self.means[g].value(cell)
        for k in ti.static(range(2)):
            value[k] /= self.scales[self.run][OF_LOG]
        value[2] /= self.scales[self.run][OF_CELL]
        return value
