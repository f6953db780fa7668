"""P2G in fixed point, for `solver.deterministic` on a GPU: the sums and bounds on their size.

A particle whose motion, deformation and acceleration displace it by less than FARTHEST cells in a stable step T adds at
most its mass times FARTHEST h / T to the momentum of a node. The momentum of a node is therefore at most its mass times
FARTHEST h / T. The mass of a node is at most DENSEST times the mass of a cell of the densest body, or the total mass if
that is smaller (docs/theory.md, 8.4). The first bound is checked for each particle before it is added, the second for
each node, so that no sum can overflow. Atomic additions of integers give the same result in any order.
"""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import MASS, VOLUME, ParticleArrays

# Backends on which all devices have atomic addition of 64-bit integers. Elsewhere a sum is two 32-bit integers.
WIDE = ("cpu", "cuda")
# Bits of the largest permitted sum. Eight times as much fits, so that a sum that is too large can be detected.
BITS_OF_WIDE, BITS_OF_HIGH = 60, 28
# Bits of the lower of two integers per added number: any 2**17 numbers can be added without overflow.
BITS_OF_LOW = 15
# Largest exponent of a scale; it fits single precision.
LARGEST_EXPONENT = 120


@ti.data_oriented
class FixedSums:
    """Vectors of integer sums: numbers are scaled by a power of two, so that sums stay below `largest`, and rounded.

    Attributes:
        width: numbers per vector.
        wide: whether each sum is one 64-bit integer; otherwise it is two 32-bit integers, the lower with BITS_OF_LOW.
        largest: the largest permitted scaled sum.
    """

    def __init__(self, width: int, count: int, *, wide: bool) -> None:
        """Allocate `count` vectors, all zero."""
        self.width, self.wide = width, wide
        self.largest = 2.0 ** (BITS_OF_WIDE if wide else BITS_OF_HIGH)
        self.high = ti.Vector.field(width, ti.i64 if wide else ti.i32, shape=count)
        self.low = None if wide else ti.Vector.field(width, ti.i32, shape=count)

    def scale(self, bound: float) -> float:
        """Return the largest power of two that scales `bound` to at most `largest`."""
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
        """Add scaled numbers to the vector at `place`, with atomics."""
        for c in ti.static(range(self.width)):
            whole = ti.round(share[c])
            if ti.static(self.wide):
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i64))
            else:
                # This difference is exact.
                rest = ti.round((share[c] - whole) * ti.static(2.0**BITS_OF_LOW))
                ti.atomic_add(self.high[place][c], ti.cast(whole, ti.i32))
                ti.atomic_add(self.low[place][c], ti.cast(rest, ti.i32))

    @ti.func
    def value(self, place: int):
        """Return the scaled sums of the vector at `place`."""
        result = ti.Vector.zero(float, self.width)
        for c in ti.static(range(self.width)):
            result[c] = ti.cast(self.high[place][c], float)
            if ti.static(not self.wide):
                result[c] += ti.cast(self.low[place][c], float) * ti.static(2.0**-BITS_OF_LOW)
        return result


FARTHEST, DENSEST = 16.0, 32.0
# Bound on a displacement, cells.
LARGEST_WAY = 4.0
# Bound to which ln J is clamped; it exceeds |ln J| of the smallest J.
LARGEST_LOG = 16.0
NO_INDEX = 2**31 - 1
# Indices into the scales of a run: scales of masses, of volumes, of volumes and of logarithms summed over a cell, a
# bound on the mass of a node, kg, and the scale of momenta per second of the stable step.
OF_MASS, OF_VOLUME, OF_CELL, OF_LOG, HEAVIEST, PER_STEP, SCALES = range(7)


@ti.data_oriented
class FixedPoint:
    """Sums of a grid: `nodes`, `filling` and `means` for its fields of the same name, None without such a field.

    Attributes:
        parts: `Grid.parts`.
        reach: cells from the middle node of a stencil to its farthest node.
        run: number of the run of a view.
        scales: scales of each run, see OF_MASS.
        pace: for each run the scale of momenta, its inverse, and the largest speed for which no sum overflows, m/s.
        beyond: per run, the smallest id of a particle that is too fast for the sums, and the smallest index of a node
            that is too heavy; NO_INDEX if there is none.
    """

    def __init__(self, grid: Grid, groups: Sequence[ParticleArrays], arch: str) -> None:
        """Allocate without launching a kernel: fields allocated after a launch get a buffer of their own."""
        self.dimension = grid.dimension
        sums = partial(FixedSums, count=grid.runs * grid.node_count, wide=arch in WIDE)
        self.nodes = sums(grid.width)
        self.filling = sums(grid.kept) if grid.keeps_filling else None
        self.means = tuple(sums(4) if group.averages else None for group in groups)
        if grid.fine:
            grid.fine.add_in_fixed_point(FixedSums(1, grid.runs * grid.fine.node_count, wide=arch in WIDE))
        self.kept = tuple(sums for sums in (self.nodes, self.filling, *self.means) if sums is not None)
        self.parts = grid.parts
        self.stencil, self.reach = grid.scheme.spline.nodes, grid.scheme.spline.nodes - 2
        self.run, self._node_count = 0, grid.node_count
        self.scales = ti.Vector.field(SCALES, float, shape=grid.runs)
        self.pace = ti.Vector.field(3, float, shape=grid.runs)
        self.beyond = ti.field(int, shape=2 * grid.runs)

    def write(self, run: int, groups: Sequence, spacing: float) -> None:
        """Set the scales of a run with these particles (see `RunGroup`) on a grid with this spacing, m."""
        density = np.concatenate([group.rows[:, MASS] / group.rows[:, VOLUME] for group in groups]).astype(np.float64)
        total = sum(group.count * float(group.rows[:, MASS].max()) for group in groups)
        heaviest = min(total, DENSEST * float(density.max()) * spacing**self.dimension)
        volume = heaviest / float(density.min())
        # The volume in a cell is at most the sum over the nodes of a stencil.
        in_cell = volume * self.stencil**self.dimension
        of_mass, of_volume, of_cell, of_log = (
            self.nodes.scale(bound) for bound in (heaviest, volume, in_cell, LARGEST_LOG * in_cell)
        )
        per_step = self.nodes.largest / (heaviest * FARTHEST * spacing)
        self.scales[run] = [of_mass, of_volume, of_cell, of_log, heaviest, per_step]
        self.forget(run)

    @ti.func
    def set_step(self, run: int, step: float):
        """Choose the scale of momenta, a power of two, for the stable step `step`, s."""
        whole = ti.cast(ti.min(self.scales[run][PER_STEP] * step, ti.static(2.0**LARGEST_EXPONENT)), ti.f32)
        exponent = (ti.bit_cast(whole, ti.i32) >> 23) - 127
        scale = ti.bit_cast((ti.max(exponent, -LARGEST_EXPONENT) + 127) << 23, ti.f32)
        most = self.nodes.largest / scale / self.scales[run][HEAVIEST]
        self.pace[run] = ti.Vector([ti.cast(scale, float), ti.cast(1.0 / scale, float), ti.cast(most, float)])

    def forget(self, run: int) -> None:
        for k in range(2):
            self.beyond[2 * run + k] = NO_INDEX

    def found_beyond(self, run: int) -> tuple[int | None, int | None]:
        """Return the id of a particle that is too fast and the index of a node that is too heavy, or None."""
        particle, node = self.beyond.to_numpy()[2 * run : 2 * run + 2].tolist()
        return None if particle == NO_INDEX else particle, None if node == NO_INDEX else node - run * self._node_count

    @ti.func
    def clear(self, node: int):
        for sums in ti.static(self.kept):
            sums.clear(node)

    @ti.func
    def scaled(self, mass: float, middle: ti.template(), change: ti.template()):
        """Scale the contribution of a particle to its stencil (see `momentum`); return whether no sum can overflow."""
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
    def largest_way(self, spacing: float):
        """Return the inverse of `way_scale`, s."""
        return LARGEST_WAY * spacing / self.pace[self.run][2]

    @ti.func
    def way_scale(self, inverse_spacing: float):
        """Return the factor from a displacement, m, to a speed within the range of the sums."""
        return self.pace[self.run][2] * ti.static(1.0 / LARGEST_WAY) * inverse_spacing

    @ti.func
    def volume_scale(self):
        return self.scales[self.run][OF_VOLUME]

    @ti.func
    def note(self, particle: int):
        """Record that a particle is too fast for the sums."""
        ti.atomic_min(self.beyond[2 * self.run], particle)

    @ti.func
    def to_float(self, grid: ti.template(), node: int, relaxed: float):
        """Convert the sums of a node to the fields of the grid."""
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
                grid.filling[node] = ti.Vector.zero(float, grid.filling.n)
                grid.filling[node][d] = self.filling.value(node)[d] / self.scales[self.run][OF_VOLUME]

    @ti.func
    def add_mean(self, g: ti.template(), cell: int, first: ti.template(), volume: float, value: float):
        """Add a value of a particle of the g-th group, and 1, times the volume, m^3, to two entries of its cell."""
        scales = self.scales[self.run]
        more = ti.Vector.zero(float, 4)
        more[first] = ti.max(ti.min(value, LARGEST_LOG), -LARGEST_LOG) * scales[OF_LOG]
        more[ti.static(first + 1)] = scales[OF_CELL]
        self.means[g].add(cell, volume * more)

    @ti.func
    def mean(self, g: ti.template(), cell: int):
        """Return the entry of `Grid.means` of the g-th group for a cell."""
        value = self.means[g].value(cell)
        for k in ti.static(range(2)):
            value[2 * k] /= self.scales[self.run][OF_LOG]
            value[2 * k + 1] /= self.scales[self.run][OF_CELL]
        return value
