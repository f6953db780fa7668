"""Keeps the particles of a group sorted by tile, so that neighbours in space are neighbours in memory.

On the CPU the tiles also make the scatter safe without atomics: tiles form pencils along the last axis,
pencils are coloured along the others, and pencils of one colour write disjoint nodes. The sort is a stable
counting sort, so the order, and with it every floating-point sum, is the same for any number of threads
(docs/theory.md, 8).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.solver.grid import Grid
from mpmcli.solver.particles import ParticleGroup

# Taichi gives a CPU thread at least this many iterations of a parallel loop.
CHUNK = 512
# Tiles per entry of the two-level prefix sum.
SPAN = 256


@ti.func
def share_start(count: int, t: int, threads: int):
    """Return where the t-th of nearly equal shares of `count` items begins; count * t would overflow."""
    return count // threads * t + ti.min(t, count % threads)


def entry_count(field: ti.Field) -> int:
    """Return the numbers that one particle has in a field."""
    return field.n * field.m if hasattr(field, "n") else 1


@ti.data_oriented
class SortBuffers:
    """Scratch memory of the sort, shared by all groups.

    Attributes:
        order: (n) int, where the particle at each new place comes from.
        key: (n) int, tile of each particle; also the scratch of integer fields.
        real: (n w) scratch of real fields, w the widest one's entries.
    """

    def __init__(self, groups: Sequence[ParticleGroup]) -> None:
        n = max(group.count for group in groups)
        widest = max(entry_count(field) for group in groups for field in group.state)
        self.order = ti.field(int, shape=n)
        self.key = ti.field(int, shape=n)
        self.real = ti.field(float, shape=n * widest)


@ti.data_oriented
class TileOrder:
    """The tile order of one group.

    Attributes:
        start: (tiles + 1) int, first particle of each tile.
        work: (colours, threads + 1) int, first pencil of a colour of each thread.
    """

    def __init__(self, group: ParticleGroup, grid: Grid, buffers: SortBuffers, threads: int, on_cpu: bool):
        self.group = group
        self.grid = grid
        self.buffers = buffers
        self.threads = threads
        self.on_cpu = on_cpu
        self.tiles = 1
        for n in grid.tiles:
            self.tiles *= n
        self.pencil = grid.tiles[-1]
        self.colours = 2 ** (grid.dimension - 1)
        self.spans = -(-self.tiles // SPAN)
        self.start = ti.field(int, shape=self.tiles + 1)
        self.cursor = ti.field(int, shape=(self.tiles, threads))
        self.span_sum = ti.field(int, shape=self.spans)
        self.work = ti.field(int, shape=(self.colours, threads + 1))

    @staticmethod
    def bytes_needed(cells: Sequence[int], stencil: int, threads: int) -> int:
        """Return the bytes that the tables of one group take."""
        tiles = 1
        for n in Grid.tile_counts(cells, stencil):
            tiles *= n
        return 4 * tiles * (threads + 1)

    @ti.func
    def tile_of(self, p: int):
        """Return the linear index of the tile that holds the stencil's first node of particle p."""
        base, _ = self.grid.scheme.spline.stencil(self.group.x[p], ti.static(1 / self.grid.spacing))
        tile = 0
        for a in ti.static(range(self.grid.dimension)):
            tile = tile * ti.static(self.grid.tiles[a]) + ti.raw_div(base[a], ti.static(self.grid.tile))
        return tile

    @ti.func
    def pencils_along(self, colour: int, axis: ti.template()):
        """Return how many pencils of a colour lie along an axis; bit `axis` of the colour is their parity."""
        return (self.grid.tiles[axis] - (colour >> axis & 1) + 1) // 2

    @ti.func
    def pencil_count(self, colour: int):
        """Return the number of pencils of a colour."""
        count = 1
        for a in ti.static(range(self.grid.dimension - 1)):
            count *= self.pencils_along(colour, a)
        return count

    @ti.func
    def pencil_start(self, colour: int, q: int):
        """Return the first tile of the q-th pencil of a colour."""
        place = ti.Vector.zero(int, ti.static(self.grid.dimension - 1))
        rest = q
        for b in ti.static(range(self.grid.dimension - 1)):
            a = ti.static(self.grid.dimension - 2 - b)
            along = self.pencils_along(colour, a)
            place[a] = 2 * (rest % along) + (colour >> a & 1)
            rest = rest // along
        tile = 0
        for a in ti.static(range(self.grid.dimension - 1)):
            tile = tile * ti.static(self.grid.tiles[a]) + place[a]
        return tile * self.pencil


@dataclass(frozen=True)
class Sort:
    """The sort of one group.

    Attributes:
        run: sort the particles, and share the work.
        share_work: set `TileOrder.work` from `TileOrder.start`; needed by itself where the latter was loaded.
    """

    run: Callable[[], None]
    share_work: Callable[[], None]


def build_sort(order: TileOrder) -> Sort:
    """Compile-ready kernels of one group's sort."""
    group, buffers = order.group, order.buffers
    key, source = buffers.key, buffers.order
    n, threads, tiles = group.count, order.threads, order.tiles

    @ti.kernel
    def count_stable():
        for tile in range(tiles):
            for t in range(threads):
                order.cursor[tile, t] = 0
        for p in range(n):
            key[p] = order.tile_of(p)
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                for p in range(share_start(n, t, threads), share_start(n, t + 1, threads)):
                    order.cursor[key[p], t] = order.cursor[key[p], t] + 1

    @ti.kernel
    def count_atomic():
        for tile in range(tiles):
            order.cursor[tile, 0] = 0
        for p in range(n):
            key[p] = order.tile_of(p)
            order.cursor[key[p], 0] += 1

    @ti.kernel
    def scan():
        for s in range(order.spans):
            total = 0
            for tile in range(s * SPAN, ti.min(tiles, (s + 1) * SPAN)):
                for t in range(threads):
                    total += order.cursor[tile, t]
            order.span_sum[s] = total
        ti.loop_config(serialize=True)
        for _ in range(1):
            before = 0
            for s in range(order.spans):
                size = order.span_sum[s]
                order.span_sum[s] = before
                before += size
            order.start[tiles] = before
        for s in range(order.spans):
            place = order.span_sum[s]
            for tile in range(s * SPAN, ti.min(tiles, (s + 1) * SPAN)):
                order.start[tile] = place
                for t in range(threads):
                    size = order.cursor[tile, t]
                    order.cursor[tile, t] = place
                    place += size

    @ti.kernel
    def place_stable():
        for q in range(CHUNK * threads):
            if q % CHUNK == 0:
                t = q // CHUNK
                for p in range(share_start(n, t, threads), share_start(n, t + 1, threads)):
                    place = order.cursor[key[p], t]
                    source[place] = p
                    order.cursor[key[p], t] = place + 1

    @ti.kernel
    def place_atomic():
        for p in range(n):
            place = ti.atomic_add(order.cursor[key[p], 0], 1)
            source[place] = p

    @ti.kernel
    def move():
        for field in ti.static(group.state):
            entries = ti.static(entry_count(field))
            for p in range(n):
                value = field[source[p]]
                if ti.static(entries == 1):
                    buffers.real[p] = value
                else:
                    for e in ti.static(range(entries)):
                        place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
                        buffers.real[p * entries + e] = value[place]
            for p in range(n):
                if ti.static(entries == 1):
                    field[p] = buffers.real[p]
                else:
                    for e in ti.static(range(entries)):
                        place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
                        field[p][place] = buffers.real[p * entries + e]
        for label in ti.static(group.labels):
            for p in range(n):
                key[p] = label[source[p]]
            for p in range(n):
                label[p] = key[p]

    @ti.kernel
    def share_work():
        # Threads take neighbouring pencils with about equal numbers of particles.
        ti.loop_config(serialize=True)
        for _ in range(1):
            for colour in range(order.colours):
                total = 0
                for q in range(order.pencil_count(colour)):
                    first = order.pencil_start(colour, q)
                    total += order.start[first + order.pencil] - order.start[first]
                done = 0
                thread = 1
                order.work[colour, 0] = 0
                for q in range(order.pencil_count(colour)):
                    first = order.pencil_start(colour, q)
                    size = order.start[first + order.pencil] - order.start[first]
                    # The boundary falls where more than half of the pencil lies beyond the share.
                    while thread < threads and done + size // 2 >= share_start(total, thread, threads):
                        order.work[colour, thread] = q
                        thread += 1
                    done += size
                while thread <= threads:
                    order.work[colour, thread] = order.pencil_count(colour)
                    thread += 1

    def sort() -> None:
        if order.on_cpu:
            count_stable()
            scan()
            place_stable()
            move()
            share_work()
        else:
            count_atomic()
            scan()
            place_atomic()
            move()

    return Sort(sort, share_work)
