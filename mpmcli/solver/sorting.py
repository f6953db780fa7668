"""Sorts particles by tile: a stable counting sort on all threads, on one, or with atomics on a GPU."""

from collections.abc import Callable
from dataclasses import dataclass

import taichi as ti

from mpmcli.solver.ordering import CHUNK, SPAN, TileOrder, entry_count, share_start


@ti.func
def count_tiles(order: ti.template(), run: int, t: int, first: int, begin: int, end: int):
    """Count the particles of each tile in share t of those of a run, which begin at `first`: from `begin` to `end`."""
    cursor, own = run * ti.static(order.bins), run * ti.static(order.buffers.room)
    for tile in range(order.bins):
        order.cursor[cursor + tile, t] = 0
    for q in range(begin, end):
        order.settle(first + q)
        tile = order.bin_of(first + q)
        order.buffers.key[own + q] = tile
        order.cursor[cursor + tile, t] = order.cursor[cursor + tile, t] + 1


@ti.func
def find_places(order: ti.template(), run: int, first: int):
    """Set the first particle of each tile of a run, and where each share places its particles of the tile."""
    cursor, place = run * ti.static(order.bins), 0
    for tile in range(order.bins):
        order.start[order.first_tile + tile] = first + place
        for t in range(ti.static(order.threads)):
            size = order.cursor[cursor + tile, t]
            order.cursor[cursor + tile, t] = place
            place += size
    order.start[order.first_tile + order.bins] = first + place


@ti.func
def place_particles(order: ti.template(), run: int, t: int, first: int, begin: int, end: int):
    """Note, at the place of each particle of a share, where it comes from; see `count_tiles`."""
    cursor, own = run * ti.static(order.bins), run * ti.static(order.buffers.room)
    for q in range(begin, end):
        tile = cursor + order.buffers.key[own + q]
        order.buffers.order[own + order.cursor[tile, t]] = first + q
        order.cursor[tile, t] = order.cursor[tile, t] + 1


def is_label(field: ti.Field) -> bool:
    """Return whether a field holds integers."""
    return field.dtype == ti.i32


@ti.func
def keep(buffers: ti.template(), field: ti.template(), first: int, q: int, source: int):
    """Copy the entries of one particle to place q of a buffer; `first` is that of the first particle of its run."""
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
    """Set particle p to what `keep` has copied to place q."""
    entries = ti.static(entry_count(field))
    if ti.static(is_label(field)):
        field[p] = buffers.key[first + q]
    elif ti.static(entries == 1):
        field[p] = buffers.real[first * ti.static(buffers.widest) + q]
    else:
        for e in ti.static(range(entries)):
            place = ti.static(e if field.m == 1 else (e // field.m, e % field.m))
            field[p][place] = buffers.real[first * ti.static(buffers.widest) + q * entries + e]


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
    n, threads, tiles = group.count, order.threads, order.bins
    moved = (*group.state, *group.labels)

    @ti.kernel
    def count_stable():
        for tile in range(tiles):
            for t in range(threads):
                order.cursor[tile, t] = 0
        for p in range(n):
            order.settle(p)
            key[p] = order.bin_of(p)
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
            order.settle(p)
            key[p] = order.bin_of(p)
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
        for field in ti.static(moved):
            for p in range(n):
                keep(buffers, field, 0, p, source[p])
            for p in range(n):
                take(buffers, field, 0, p, p)

    @ti.kernel
    def share_work():
        # Threads take neighbouring pencils with about equal numbers of particles.
        ti.loop_config(serialize=True)
        for _ in range(1):
            for colour in range(order.colours):
                total = 0
                for q in range(order.pencil_count(colour)):
                    pencil = order.pencil_of(colour, q)
                    total += order.first_particle_of(pencil + 1) - order.first_particle_of(pencil)
                done = 0
                thread = 1
                order.work[colour, 0] = 0
                for q in range(order.pencil_count(colour)):
                    pencil = order.pencil_of(colour, q)
                    size = order.first_particle_of(pencil + 1) - order.first_particle_of(pencil)
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
