"""Finds the box of nodes that a step uses, from the tiles that hold particles."""

from collections.abc import Callable, Sequence

import taichi as ti

from mpmcli.boundaries.walls import REACH
from mpmcli.solver.grid import Grid
from mpmcli.solver.ordering import TileOrder
from mpmcli.solver.splines import PAD


@ti.func
def box_of(grid: ti.template(), axis: ti.template(), low: int, high: int, drift: int, last_wall: int):
    """Return the first and the last node in use along an axis.

    Args:
        low, high: first and last node at which a stencil began when particles were sorted.
        drift: cells that a particle may have moved since.
        last_wall: node of the upper wall.
    """
    reach = ti.static(grid.scheme.spline.nodes - 1)
    first = low - drift
    last = high + drift + reach
    # A box that comes near a wall holds the images beyond it too: they are read and written.
    if ti.static(axis in grid.period.axes):
        if first <= PAD + PAD or last >= last_wall - PAD:
            first = 0
            last = last_wall + PAD
    else:
        if ti.static((axis, 0) in grid.opens):
            first = ti.max(first, 0)
        elif first <= PAD + REACH:
            first = PAD - REACH
        if ti.static((axis, 1) in grid.opens):
            last = ti.min(last, last_wall + PAD)
        elif last >= last_wall - REACH:
            last = last_wall + REACH
    return first, last


def build_box_search(grid: Grid, orders: Sequence[TileOrder], drift: int) -> Callable[[], None]:
    """Compile-ready search, to be called after a sort: it sets `grid.box`.

    Args:
        drift: cells that a particle may move away from the tile that it was sorted into.
    """
    d = grid.dimension
    orders = tuple(orders)
    may_be_empty = any(order.bins > order.tiles for order in orders)
    tile_low = ti.field(int, shape=d)
    tile_high = ti.field(int, shape=d)

    @ti.kernel
    def find_box():
        for a in ti.static(range(d)):
            tile_low[a] = 2**30
            tile_high[a] = -1
        for order in ti.static(orders):
            for tile in range(order.tiles):
                if order.start[tile + 1] > order.start[tile]:
                    rest = tile
                    for b in ti.static(range(d)):
                        a = ti.static(d - 1 - b)
                        ti.atomic_min(tile_low[a], rest % ti.static(grid.tiles[a]))
                        ti.atomic_max(tile_high[a], rest % ti.static(grid.tiles[a]))
                        rest = rest // ti.static(grid.tiles[a])
        for a in ti.static(range(d)):
            low, high = grid.tile * tile_low[a], grid.tile * tile_high[a] + grid.tile - 1
            if ti.static(may_be_empty):
                if tile_high[a] < 0:
                    low, high = PAD, PAD
            first, last = box_of(grid, a, low, high, drift, ti.static(PAD + grid.cells[a]))
            grid.box[0, a] = first
            grid.box[1, a] = last - first + 1

    return find_box
