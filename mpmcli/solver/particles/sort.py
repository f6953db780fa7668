"""Sorts the particles of a group by tile, so that neighbours in space are neighbours in memory.

On the CPU the tiles also make the scatter safe without atomics: tiles form pencils along the last axis, pencils are
coloured along the other axes, and pencils of one colour write disjoint nodes. The sort is a stable counting sort with a
share of the particles per thread. The order of particles, and hence every floating-point sum, is the same for any
number of threads (docs/theory.md, 8).
"""

from collections.abc import Sequence

from mpmcli.frames.frame import ACTIVE, RETIRED
from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays

# Taichi gives a CPU thread at least this many iterations of a parallel loop.
CHUNK = 512
# Tiles per entry of a level of the prefix sum.
SPAN = 256


@ti.func
def share_start(count: int, t: int, threads: int):
    """Return the start of the t-th of nearly equal shares of `count` items, without the overflow of count * t."""
    return count // threads * t + ti.min(t, count % threads)


def entry_count(field: ti.Field) -> int:
    return field.n * field.m if hasattr(field, "n") else 1


@ti.data_oriented
class SortBuffers:
    """Scratch memory of the sort, shared by all groups.

    Attributes:
        capacity: particles of the largest group of one run.
        order: (n) int, the old index of the particle at each new index.
        key: (n) int, tile of each particle; also scratch memory for integer fields.
        real: (n w) scratch memory for real fields; between sorts it stores one number per particle.
        widest: w, the largest number of entries per particle of a real field, at least the number of groups.
    """

    def __init__(self, groups: Sequence[ParticleArrays], runs: int = 1) -> None:
        n = max(group.capacity for group in groups)
        self.capacity = n // runs
        self.widest = max(len(groups), *(entry_count(field) for group in groups for field in group.moved))
        self.order = ti.field(int, shape=n)
        self.key = ti.field(int, shape=n)
        self.real = ti.field(float, shape=n * self.widest)


@ti.func
def scratch_offset(buffers: ti.template(), g: ti.template(), w: int, capacity: ti.template()):
    """Return the offset from the index of a particle to its own entry in `SortBuffers.real`.

    Args:
        g: group of the particle.
        w: run of the particle.
        capacity: particles of a run in the group.
    """
    return w * ti.static(buffers.capacity * buffers.widest - capacity) + ti.static(g * buffers.capacity)


@ti.data_oriented
class TileOrder:
    """The tile order of one group.

    Attributes:
        start: (bins + 1) int, first particle of each bin; for the bins see `bin_of`.
        first_tile: index of tile 0 in `start`.
        work: (colours, threads + 1) int, first pencil of each thread per colour.
    """

    def __init__(self, group: ParticleArrays, grid: Grid, buffers: SortBuffers, threads: int, runs: int = 1) -> None:
        """Allocate the bins of a group on a grid; `threads` is the number of shares in which particles are counted."""
        self.group, self.grid, self.buffers, self.threads = group, grid, buffers, threads
        self.tiles = self.bins_of(grid)
        # If particles come and go, the tiles are followed by a bin of waiting and blocked particles and a bin of
        # retired ones.
        self.particle_count_varies = group.particle_count_varies
        self.bins = self.tiles + 2 * self.particle_count_varies
        self.extent = tuple(n * grid.spacing for n in grid.cells)
        self.colours = 2 ** (grid.dimension - 1)
        self.spans = -(-self.bins // SPAN)
        self.blocks = -(-self.spans // SPAN)
        self.first_tile = 0
        self.start = ti.field(int, shape=runs * (self.bins + 1))
        self.cursor = ti.field(int, shape=(runs * self.bins, threads))
        self.span_sum, self.block_sum = ti.field(int, shape=runs * self.spans), ti.field(int, shape=runs * self.blocks)
        self.work = ti.field(int, shape=(self.colours, threads + 1))

    @staticmethod
    def bins_of(grid: Grid) -> int:
        """Return the number of bins of active particles."""
        return grid.tile_count

    @ti.func
    def first_node_of(self, p: int):
        base, _ = self.grid.scheme.spline.stencil(self.group.on_grid(p), self.grid.inverse_spacing)
        return base

    @ti.func
    def wrap(self, p: int):
        """Wrap particle p into a periodic domain."""
        if ti.static(len(self.grid.images.periodic) > 0):
            self.grid.period.wrap(self.group, p)

    @ti.func
    def tile_of(self, p: int):
        return self.grid.tile_number(self.first_node_of(p))

    @ti.func
    def status_of(self, p: int):
        """Return the status of particle p; an active particle beyond an open face is retired first."""
        status = ACTIVE
        if ti.static(self.particle_count_varies):
            status = self.group.activity[p]
            if status == ACTIVE:
                for axis, side in ti.static(self.grid.images.opens):
                    x = self.group.x[p][axis]
                    if ti.static(side == 0):
                        if x < 0.0:
                            status = RETIRED
                            self.group.x[p][axis] = 0.0
                    elif x > self.extent[axis]:
                        status = RETIRED
                        self.group.x[p][axis] = self.extent[axis]
                if status == RETIRED:
                    self.group.activity[p] = RETIRED
                    for c in ti.static(range(self.group.v.n)):
                        self.group.v[p][c] = 0.0
        return status

    @ti.func
    def bin_of(self, p: int):
        """Return the bin of particle p: its tile if it is active, otherwise one of the bins after the tiles."""
        place = 0
        if ti.static(self.particle_count_varies):
            status = self.status_of(p)
            if status == ACTIVE:
                place = self.tile_of(p)
            else:
                place = self.tiles + ti.cast(status == RETIRED, int)
        else:
            place = self.tile_of(p)
        return place

    @ti.func
    def pencils_along(self, colour: int, axis: ti.template()):
        """Return the number of pencils of a colour along an axis; bit `axis` of the colour is their parity."""
        return (self.grid.tiles[axis] - (colour >> axis & 1) + 1) // 2

    @ti.func
    def pencil_count(self, colour: int):
        count = 1
        for a in ti.static(range(self.grid.dimension - 1)):
            count *= self.pencils_along(colour, a)
        return count

    @ti.func
    def pencil_of(self, colour: int, q: int):
        """Return the index, among all pencils, of the q-th pencil of a colour."""
        place = ti.Vector.zero(int, ti.static(self.grid.dimension - 1))
        rest = q
        for b in ti.static(range(self.grid.dimension - 1)):
            a = ti.static(self.grid.dimension - 2 - b)
            along = self.pencils_along(colour, a)
            place[a] = 2 * (rest % along) + (colour >> a & 1)
            rest = rest // along
        pencil = 0
        for a in ti.static(range(self.grid.dimension - 1)):
            pencil = pencil * ti.static(self.grid.tiles[a]) + place[a]
        return pencil

    @ti.func
    def pencils(self):
        return ti.static(self.tiles // self.grid.tiles[-1])

    @ti.func
    def first_tile_of(self, pencil: int):
        """Return the first tile of a pencil; after the last pencil, the number of tiles."""
        return pencil * ti.static(self.grid.tiles[-1])

    @ti.func
    def first_particle_of(self, pencil: int):
        """Return the first particle of a pencil; after the last pencil, the index after the last particle."""
        return self.start[self.first_tile + self.first_tile_of(pencil)]


@ti.data_oriented
class CellOrder(TileOrder):
    """The order of one group on a GPU: its tiles are single cells, so that neighbours in memory share a stencil."""

    @staticmethod
    def bins_of(grid: Grid) -> int:
        return grid.node_count

    @ti.func
    def tile_of(self, p: int):
        return self.grid.linear_index(self.first_node_of(p)) - self.grid.first_node


@ti.func
def stay_rolled(scratch: ti.template(), index: int):
    """Prevent LLVM on the CPU from unrolling the enclosing loop; `index` is never negative, which LLVM does not know.

    A call that is never executed suffices. Loops that copy or sum do not profit from unrolling, and their compile time
    grows with the square of their length.
    """
    if index < 0:
        scratch[0] = ti.cast(ti.acos(ti.cast(index, float)), scratch.dtype)


@ti.func
def count_tiles(order: ti.template(), run: int, t: int, first: int, begin: int, end: int):
    """Count particles per tile in share t of a run, `begin` to `end` - 1 relative to `first`, the first of the run."""
    cursor, own = run * ti.static(order.bins), run * ti.static(order.buffers.capacity)
    for tile in range(order.bins):
        stay_rolled(order.buffers.real, cursor + tile)
        order.cursor[cursor + tile, t] = 0
    for q in range(begin, end):
        order.wrap(first + q)
        tile = order.bin_of(first + q)
        stay_rolled(order.buffers.real, tile)
        order.buffers.key[own + q] = tile
        order.cursor[cursor + tile, t] = order.cursor[cursor + tile, t] + 1


@ti.func
def find_places(order: ti.template(), run: int, first: int):
    """Set the first particle of each tile of a run, and the first index of each share in each tile."""
    cursor, place = run * ti.static(order.bins), 0
    for tile in range(order.bins):
        stay_rolled(order.buffers.real, place)
        order.start[order.first_tile + tile] = first + place
        for t in range(ti.static(order.threads)):
            size = order.cursor[cursor + tile, t]
            order.cursor[cursor + tile, t] = place
            place += size
    order.start[order.first_tile + order.bins] = first + place


@ti.func
def place_particles(order: ti.template(), run: int, t: int, first: int, begin: int, end: int):
    """Store the old index of each particle of a share at its new index; see `count_tiles`."""
    cursor, own = run * ti.static(order.bins), run * ti.static(order.buffers.capacity)
    for q in range(begin, end):
        tile = cursor + order.buffers.key[own + q]
        stay_rolled(order.buffers.real, tile)
        order.buffers.order[own + order.cursor[tile, t]] = first + q
        order.cursor[tile, t] = order.cursor[tile, t] + 1


def is_label(field: ti.Field) -> bool:
    return field.dtype == ti.i32


@ti.func
def keep(buffers: ti.template(), field: ti.template(), first: int, q: int, source: int):
    """Copy the entries of particle `source` to entry q of a run in a buffer; `first` is the first entry of the run."""
    entries = ti.static(entry_count(field))
    value = field[source]
    if ti.static(is_label(field)):
        buffers.key[first + q] = value
    elif ti.static(entries == 1):
        buffers.real[first * ti.static(buffers.widest) + q] = value
    else:
        for e in ti.static(range(entries)):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            buffers.real[first * ti.static(buffers.widest) + q * entries + e] = value[place]


@ti.func
def take(buffers: ti.template(), field: ti.template(), first: int, q: int, p: int):
    entries = ti.static(entry_count(field))
    if ti.static(is_label(field)):
        field[p] = buffers.key[first + q]
    elif ti.static(entries == 1):
        field[p] = buffers.real[first * ti.static(buffers.widest) + q]
    else:
        for e in ti.static(range(entries)):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            field[p][place] = buffers.real[first * ti.static(buffers.widest) + q * entries + e]


@ti.func
def keep_all(buffers: ti.template(), field: ti.template(), own: int, begin: int, end: int):
    """Copy the entries of the particles with new indices begin to end - 1 of a run, on the CPU."""
    for q in range(begin, end):
        stay_rolled(buffers.real, q)
        keep(buffers, field, own, q, buffers.order[own + q])


@ti.func
def take_all(buffers: ti.template(), field: ti.template(), own: int, begin: int, end: int, first: int):
    for q in range(begin, end):
        stay_rolled(buffers.real, q)
        take(buffers, field, own, q, first + q)
