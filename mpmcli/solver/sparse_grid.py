"""A grid whose nodes are there where particles are alone: blocks of nodes, one for each tile that particles reach.

A sort numbers the tiles that particles reach until the next one, in their order. Nodes are stored tile by tile in that
order, and a table has the number of every tile of the domain. Number 0 stands for all others: its nodes are zero.
"""

import math

import numpy as np
import psutil
import taichi as ti

from mpmcli.solver.device_memory import LARGEST_INDEX, MEMORY_SHARE
from mpmcli.solver.grid import Grid, drift_allowed
from mpmcli.solver.ordering import ACTIVE, SPAN, TileOrder
from mpmcli.solver.tile_reach import reach_along
from mpmcli.solver.tile_window import TileWindow

# Particles for each of which there is room for a block, and blocks beside those.
SHARED_BY, AT_LEAST = 20, 500
# What a table has for tiles that are to be numbered: they hold particles, or are reached by some.
HOLDS, REACHED = -1, -2
# Places in `sizes`: blocks in use, pencils, blocks that a sort asked for, and of each colour the pencils.
BLOCKS, PENCILS, WANTED, COLOURS = range(4)


def room_for_blocks(particles: int) -> int:
    """Return the number of blocks that memory is allocated for at first."""
    return particles // SHARED_BY + AT_LEAST


def most_blocks(grid: "SparseGrid") -> int:
    """Return the number of blocks that a larger grid may have in what memory is free, and indices reach."""
    fields = [field for field in (grid.nodes, grid.before, grid.filling) if field is not None]
    numbers = grid.width * len(fields) + 2 * len(grid.kept_means)
    # And of the tables of a sort on some threads.
    block = (4 if grid.nodes.dtype == ti.f32 else 8) * numbers * grid.block + 4 * 16
    return int(min(MEMORY_SHARE * psutil.virtual_memory().available // block, LARGEST_INDEX // grid.block))


@ti.data_oriented
class SparseGrid(Grid):
    """See `Grid`; of one run, on the CPU.

    Attributes:
        tile_count: blocks that there is room for, number 0 included.
        table: (tiles of the domain) int, their numbers.
        tile_at: (tile_count) int, the tile of each number.
        sizes: ints, see BLOCKS and so on.
        pencils: (tile_count + 1) int, the first block of each pencil; coloured: (colours, tile_count) int, the numbers
            of the pencils of each colour.
        window: of the nodes near a tile, for each thread.
    """

    sparse = True

    def __init__(self, *args: object, blocks: int, threads: int, **options: object) -> None:
        """Allocate; `blocks` is the room for blocks, and the rest that of `Grid`."""
        self._blocks = blocks
        super().__init__(*args, **options)
        self.all_tiles = math.prod(self.tiles)
        self.tile_count = blocks
        self.block = self.tile**self.dimension
        # Nodes that stencils of particles reach before their tile and behind it.
        drift = math.ceil(drift_allowed(self.tile, self.scheme.spline.nodes))
        self.beyond = drift, drift + self.scheme.spline.nodes - 1
        repeats = [axis in self.period.axes for axis in range(self.dimension)]
        self.reach = [
            reach_along(n, self.tile, self.beyond, repeats=again) for n, again in zip(self.cells, repeats, strict=True)
        ]
        self._most = max(table.shape[1] for table in self.reach)
        self._reach = ti.field(int, shape=(self.dimension, max(self.tiles), self._most))
        padded = np.full(self._reach.shape, -1, np.int32)
        for axis, table in enumerate(self.reach):
            padded[axis, : table.shape[0], : table.shape[1]] = table
        self._reach.from_numpy(padded)
        self._spans = -(-self.all_tiles // SPAN)
        self._marked = ti.field(ti.i8, shape=self._spans)
        colours = 2 ** (self.dimension - 1)
        self.table = ti.field(int, shape=self.all_tiles)
        self.tile_at = ti.field(int, shape=blocks)
        self.sizes = ti.field(int, shape=COLOURS + colours)
        self.pencils = ti.field(int, shape=blocks + 1)
        self.coloured = ti.field(int, shape=(colours, blocks))
        self.window = TileWindow(self, threads)
        self.sizes[BLOCKS] = 1

    def stored_nodes(self) -> int:
        """Return the number of nodes that memory is allocated for."""
        return self._blocks * self.tile**self.dimension

    @staticmethod
    def table_bytes(tiles: int, blocks: int, dimension: int) -> int:
        """Return the bytes of the tables, for so many tiles of the domain."""
        return 4 * tiles + tiles // SPAN + 4 * blocks * (2 + 2 ** (dimension - 1))

    def occupy(self, tiles: np.ndarray) -> None:
        """Number these tiles, sorted linear indices, and no others."""
        self._occupy(np.ascontiguousarray(tiles, np.int32))

    @ti.kernel
    def _occupy(self, tiles: ti.types.ndarray(ti.i32, 1)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.forget(0, self.sizes[BLOCKS])
            for k in range(tiles.shape[0]):
                self.tile_at[k + 1] = tiles[k]
            self.sizes[BLOCKS] = tiles.shape[0] + 1
            for b in range(1, self.sizes[BLOCKS]):
                self.table[self.tile_at[b]] = b
            self.find_pencils()

    def occupied(self) -> np.ndarray:
        """Return the tiles that have numbers, sorted."""
        tiles = np.empty(self.sizes[BLOCKS] - 1, np.int32)
        self._read(tiles)
        return tiles

    @ti.kernel
    def _read(self, tiles: ti.types.ndarray(ti.i32, 1)):
        for k in range(tiles.shape[0]):
            tiles[k] = self.tile_at[k + 1]

    @ti.func
    def tile_number(self, node: ti.template()):
        """Return the number of the tile that holds the node at these integer coordinates."""
        return self.table[self.tile_index(node)]

    @ti.func
    def tile_index(self, node: ti.template()):
        """Return the linear index of the tile that holds the node at these integer coordinates."""
        index = 0
        for a in ti.static(range(self.dimension)):
            index = index * ti.static(self.tiles[a]) + ti.raw_div(node[a], ti.static(self.tile))
        return index

    @ti.func
    def tile_place(self, index: int):
        """Return the integer coordinates of the tile with a linear index."""
        place, rest = ti.Vector.zero(int, self.dimension), index
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            place[a] = rest % ti.static(self.tiles[a])
            rest = rest // ti.static(self.tiles[a])
        return place

    @ti.func
    def linear_index(self, base: ti.template()):
        """Return the linear index of the node at the integer coordinates `base`."""
        inner = 0
        for a in ti.static(range(self.dimension)):
            inner = inner * ti.static(self.tile) + base[a] % ti.static(self.tile)
        return self.tile_number(base) * ti.static(self.block) + inner

    @ti.func
    def place_of(self, index: int):
        """Return the integer coordinates of the node with a linear index."""
        place = self.tile_place(self.tile_at[index // ti.static(self.block)])
        rest = index % ti.static(self.block)
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            place[a] = place[a] * ti.static(self.tile) + rest % ti.static(self.tile)
            rest = rest // ti.static(self.tile)
        return place

    @ti.func
    def forget(self, begin: int, end: int):
        """Take their numbers from the tiles of blocks `begin` to `end` - 1."""
        for b in range(ti.max(begin, 1), end):
            self.table[self.tile_at[b]] = 0

    @ti.func
    def mark(self, order: ti.template(), begin: int, end: int):
        """Mark the tiles of particles `begin` to `end` - 1 that take part."""
        for p in range(begin, end):
            order.settle(p)
            if order.status_of(p) == ACTIVE:
                tile = self.tile_index(order.first_node_of(p))
                # Other threads may write the same.
                if self.table[tile] != HOLDS:
                    self.table[tile] = HOLDS
                    self._marked[tile // SPAN] = ti.cast(1, ti.i8)

    @ti.func
    def number(self):
        """Number the tiles that marked ones reach; return whether there is room for all of them."""
        wanted = 1
        for s in range(self._spans):
            if self._marked[s] == 1:
                for tile in range(s * SPAN, ti.min((s + 1) * SPAN, self.all_tiles)):
                    if self.table[tile] == HOLDS:
                        self.mark_reached(tile)
        for s in range(self._spans):
            if self._marked[s] == 1:
                for tile in range(s * SPAN, ti.min((s + 1) * SPAN, self.all_tiles)):
                    if self.table[tile] < 0:
                        wanted += 1
        self.sizes[WANTED] = wanted
        fits = wanted <= self.tile_count
        b = 1
        for s in range(self._spans):
            if self._marked[s] == 1:
                self._marked[s] = ti.cast(0, ti.i8)
                for tile in range(s * SPAN, ti.min((s + 1) * SPAN, self.all_tiles)):
                    if self.table[tile] < 0:
                        self.table[tile] = 0
                        if fits:
                            self.table[tile] = b
                            self.tile_at[b] = tile
                            b += 1
        if fits:
            self.sizes[BLOCKS] = b
            self.find_pencils()
        return fits

    @ti.func
    def mark_reached(self, tile: int):
        """Mark the tiles that the particles of a tile reach."""
        place = self.tile_place(tile)
        for q in range(ti.static(self._most**self.dimension)):
            rest, index, exists = q, 0, True
            for a in ti.static(range(self.dimension)):
                along = self._reach[a, place[a], rest % ti.static(self._most)]
                rest = rest // ti.static(self._most)
                exists = exists and along >= 0
                index = index * ti.static(self.tiles[a]) + along
            if exists:
                if self.table[index] == 0:
                    self.table[index] = REACHED
                    self._marked[index // SPAN] = ti.cast(1, ti.i8)

    @ti.func
    def find_pencils(self):
        """Find the pencils of the blocks in use, and of each colour."""
        for colour in range(ti.static(2 ** (self.dimension - 1))):
            self.sizes[COLOURS + colour] = 0
        count, before = 0, -1
        for b in range(1, self.sizes[BLOCKS]):
            pencil = self.tile_at[b] // ti.static(self.tiles[-1])
            if pencil != before:
                before = pencil
                place, colour = self.tile_place(self.tile_at[b]), 0
                for a in ti.static(range(self.dimension - 1)):
                    colour += (place[a] & 1) << a
                self.pencils[count] = b
                self.coloured[colour, self.sizes[COLOURS + colour]] = count
                self.sizes[COLOURS + colour] += 1
                count += 1
        self.pencils[count] = self.sizes[BLOCKS]
        self.sizes[PENCILS] = count


@ti.data_oriented
class BlockOrder(TileOrder):
    """The tile order of one group on a sparse grid: of the tiles that have numbers."""

    @ti.func
    def pencil_count(self, colour: int):
        """Return the number of pencils of a colour."""
        return self.grid.sizes[COLOURS + colour]

    @ti.func
    def pencil_of(self, colour: int, q: int):
        """Return the number of the q-th pencil of a colour, among all pencils."""
        return self.grid.coloured[colour, q]

    @ti.func
    def pencils(self):
        """Return the number of pencils."""
        return self.grid.sizes[PENCILS]

    @ti.func
    def first_tile_of(self, pencil: int):
        """Return the first tile of a pencil, or behind the last pencil the one after the last."""
        return self.grid.pencils[pencil]
