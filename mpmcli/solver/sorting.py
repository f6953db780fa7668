"""Sorts particles by tile: a stable counting sort on all threads, on one, or with atomics on a GPU."""

from collections.abc import Callable
from dataclasses import dataclass

import taichi as ti

from mpmcli.solver.ordering import CHUNK, SPAN, TileOrder, entry_count, share_start


@ti.func
def sort_serially(order: ti.template(), first: int, count: int, run: int):
    """Sort particles first to first + count - 1, those of one run, by one thread: the same order as by `build_sort`."""
    group = order.group
    buffers = order.buffers
    tiles = ti.static(order.tiles)
    cursor = run * tiles
    # Other runs may be at other groups, which begin elsewhere: the scratch memory of a run is that of no other.
    own = run * ti.static(buffers.room)
    for tile in range(tiles):
        order.cursor[cursor + tile, 0] = 0
    for q in range(count):
        tile = order.tile_of(first + q)
        buffers.key[own + q] = tile
        order.cursor[cursor + tile, 0] = order.cursor[cursor + tile, 0] + 1
    place = 0
    for tile in range(tiles):
        order.start[order.first_tile + tile] = first + place
        size = order.cursor[cursor + tile, 0]
        order.cursor[cursor + tile, 0] = place
        place += size
    order.start[order.first_tile + tiles] = first + place
    for q in range(count):
        tile = cursor + buffers.key[own + q]
        buffers.order[own + order.cursor[tile, 0]] = first + q
        order.cursor[tile, 0] = order.cursor[tile, 0] + 1
    for field in ti.static(group.state):
        scratch = own * ti.static(buffers.widest)
        for q in range(count):
            keep(buffers, field, scratch, q, buffers.order[own + q])
        for q in range(count):
            take(buffers, field, scratch, q, first + q)
    for label in ti.static(group.labels):
        for q in range(count):
            buffers.key[own + q] = label[buffers.order[own + q]]
        for q in range(count):
            label[first + q] = buffers.key[own + q]


@ti.func
def keep(buffers: ti.template(), field: ti.template(), first: int, q: int, source: int):
    """Copy the entries of one particle to place q of the buffer behind `first`."""
    entries = ti.static(entry_count(field))
    value = field[source]
    if ti.static(entries == 1):
        buffers.real[first + q] = value
    else:
        for e in ti.static(range(entries)):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            buffers.real[first + q * entries + e] = value[place]


@ti.func
def take(buffers: ti.template(), field: ti.template(), first: int, q: int, p: int):
    """Set particle p to what is in place q of the buffer behind `first`."""
    entries = ti.static(entry_count(field))
    if ti.static(entries == 1):
        field[p] = buffers.real[first + q]
    else:
        for e in ti.static(range(entries)):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            field[p][place] = buffers.real[first + q * entries + e]


@ti.func
def tiles_in_use(order: ti.template(), low: ti.template(), high: ti.template()):
    """Lower and raise the range of tiles, per axis, to that of the tiles with particles."""
    d = ti.static(order.grid.dimension)
    for tile in range(order.tiles):
        if order.start[order.first_tile + tile + 1] > order.start[order.first_tile + tile]:
            rest = tile
            for b in ti.static(range(d)):
                a = ti.static(d - 1 - b)
                low[a] = ti.min(low[a], rest % ti.static(order.grid.tiles[a]))
                high[a] = ti.max(high[a], rest % ti.static(order.grid.tiles[a]))
                rest = rest // ti.static(order.grid.tiles[a])


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
            for p in range(n):
                keep(buffers, field, 0, p, source[p])
            for p in range(n):
                take(buffers, field, 0, p, p)
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
