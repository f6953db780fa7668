"""A sparse grid: blocks of nodes, one for each tile that particles reach.

A sort numbers, in order of their linear index, the tiles that particles can reach until the next sort. Nodes are stored
tile by tile in this order, and a table maps every tile of the domain to its number. All other tiles have number 0,
whose nodes are zero.
"""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np
import psutil

from mpmcli.boundaries.walls import IMAGE_DEPTH
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.sampling import estimate_sources
from mpmcli.solver.grid.grid import Grid, LinearNodes, drift_allowed
from mpmcli.solver.machine.backend import LARGEST_INDEX, MEMORY_SHARE
from mpmcli.solver.particles.sort import ACTIVE, SPAN, TileOrder
from mpmcli.solver.transfer.splines import PAD, SPLINES


@ti.data_oriented
class BlockNodes(LinearNodes):
    """Nodes of a sparse grid, in blocks: one for each tile that particles can reach until the next sort.

    Attributes:
        tile: edge of a tile, nodes.
        tiles: number of tiles per axis.
        block: nodes per tile.
        table: (all tiles) int, the index of the block of each tile; 0, a block of zeros, if particles do not reach it.
    """

    sparse = True
    tile: int
    tiles: tuple[int, ...]
    block: int
    table: ti.Field

    @ti.func
    def tile_number(self, node: ti.template()):
        return self.table[self.tile_index(node)]

    @ti.func
    def tile_index(self, node: ti.template()):
        """Return the linear index of the tile that contains the node with these integer coordinates."""
        index = 0
        for a in ti.static(range(self.dimension)):
            index = index * ti.static(self.tiles[a]) + ti.raw_div(node[a], ti.static(self.tile))
        return index

    @ti.func
    def linear_index(self, base: ti.template()):
        inner = 0
        for a in ti.static(range(self.dimension)):
            inner = inner * ti.static(self.tile) + base[a] % ti.static(self.tile)
        return self.tile_number(base) * ti.static(self.block) + inner

    @ti.func
    def stencil_at(self, base: ti.template()):
        """Return per stencil node and axis the contributions to the tile index and to the index within the tile."""
        nodes, d = ti.static((self.scheme.spline.nodes, self.dimension))
        offsets = ti.Matrix.zero(int, nodes, ti.static(2 * d))
        for k, a in ti.static(ti.ndrange(nodes, d)):
            tile = ti.raw_div(base[a] + k, ti.static(self.tile))
            offsets[k, a] = tile * ti.static(math.prod(self.tiles[a + 1 :]))
            offsets[k, d + a] = (base[a] + k - tile * self.tile) * ti.static(self.tile ** (d - 1 - a))
        return offsets

    @ti.func
    def origin_of(self, offsets: ti.template()):
        return offsets

    @ti.func
    def node_of(self, offsets: ti.template(), i: ti.template(), j: ti.template(), k: ti.template()):
        """Return the linear index of node k of line j in plane i of the stencil with these offsets."""
        d = ti.static(self.dimension)
        tile, inner = offsets[j, d - 2] + offsets[k, d - 1], offsets[j, 2 * d - 2] + offsets[k, 2 * d - 1]
        if ti.static(d == 3):
            tile += offsets[i, 0]
            inner += offsets[i, 3]
        return self.table[tile] * ti.static(self.block) + inner


@ti.data_oriented
class TileWindow(LinearNodes):
    """Copies, one per thread, of the nodes that the stencils of the particles of a tile reach.

    A stencil extends over up to 2^d blocks, but lies in a single window, whose nodes have linear indices as in a dense
    grid. P2G and G2P are therefore the same code on both grids. See `Grid` for the attributes not listed here.

    Attributes:
        size: nodes per window.
        before_tile, behind_tile: nodes of a window before and behind the tile, along each axis.
        summed: pairs of a field of the window and the field of the grid that P2G adds to in every step.
        relaxing: such pairs for the steps that relax volumes.
    """

    runs = 1

    def __init__(self, grid: Grid, threads: int) -> None:
        """Allocate a window for each thread: a tile of the grid, and the nodes beyond it that stencils reach."""
        d = self.dimension = grid.dimension
        self.before_tile, self.behind_tile = grid.beyond
        self.tile, self.tiles = grid.tile, grid.tiles
        edge = self.before_tile + grid.tile + self.behind_tile
        self.strides = tuple(edge ** (d - 1 - a) for a in range(d))
        self.size = edge**d
        self.node_count, self.first_node = threads * self.size, 0
        for name in ("width", "kept", "planes", "scheme"):
            setattr(self, name, getattr(grid, name))
        self.nodes, self.filling = (
            None if field is None else ti.Vector.field(field.n, float, shape=self.node_count)
            for field in (grid.nodes, grid.filling)
        )
        self.summed = ((self.nodes, grid.nodes),)
        self.relaxing = () if grid.filling is None else ((self.filling, grid.filling),)

    def seen_from(self, grid: Grid, first_node: object) -> "TileWindow":
        """Return the window for a view of the grid; the linear index of node 0 is a variable of the kernel."""
        result = copy(self)
        result.first_node = first_node
        for name in ("spacing", "inverse_spacing", "gradient_scale"):
            setattr(result, name, getattr(grid, name))
        return result

    @ti.func
    def first_of(self, t: int, place: ti.template()):
        """Return the linear index that node 0 of the grid would have in the window of thread t at a tile."""
        first = t * ti.static(self.size)
        for a in ti.static(range(self.dimension)):
            first -= (place[a] * ti.static(self.tile) - self.before_tile) * ti.static(self.strides[a])
        return first

    @ti.func
    def clear(self, t: int, relaxed: float):
        """Set the fields that P2G adds to to zero in the window of thread t, volumes only if they are relaxed."""
        for field, _ in ti.static(self.summed):
            self.zero(field, t)
        for field, _ in ti.static(self.relaxing):
            if relaxed > 0.0:
                self.zero(field, t)

    @ti.func
    def zero(self, field: ti.template(), t: int):
        for k in range(t * ti.static(self.size), (t + 1) * ti.static(self.size)):
            field[k] = ti.Vector.zero(float, field.n)

    @ti.func
    def load(self, grid: ti.template(), t: int, place: ti.template()):
        """Copy the nodes near a tile into the window."""
        for pair in ti.static(self.summed):
            self.exchange(pair, grid, t, place, True)

    @ti.func
    def add(self, grid: ti.template(), t: int, place: ti.template(), relaxed: float):
        """Add the window to the nodes near a tile, volumes only if they are relaxed."""
        for pair in ti.static(self.summed):
            self.exchange(pair, grid, t, place, False)
        for pair in ti.static(self.relaxing):
            if relaxed > 0.0:
                self.exchange(pair, grid, t, place, False)

    @ti.func
    def exchange(self, pair: ti.template(), grid: ti.template(), t: int, place: ti.template(), loads: ti.template()):
        """Copy the nodes near a tile to the window if `loads`, otherwise add the window to them; block by block."""
        d, field, of_grid = ti.static((self.dimension, pair[0], pair[1]))
        for q in range(ti.static(3**d)):
            tile, exists = 0, True
            # First node in the window and in the block, and number of nodes, per axis.
            here, there, count = ti.Vector.zero(int, d), ti.Vector.zero(int, d), ti.Vector.zero(int, d)
            for a in ti.static(range(d)):
                side = q // ti.static(3 ** (d - 1 - a)) % 3
                along = place[a] + side - 1
                exists = exists and along >= 0 and along < ti.static(self.tiles[a])
                tile = tile * ti.static(self.tiles[a]) + along
                here[a], count[a] = self.before_tile, self.tile
                if side == 0:
                    here[a], there[a], count[a] = 0, self.tile - self.before_tile, self.before_tile
                if side == 2:
                    here[a], count[a] = self.before_tile + self.tile, self.behind_tile
            if exists:
                block = grid.table[tile] * ti.static(grid.block)
                rows = 1
                for a in ti.static(range(d - 1)):
                    rows *= count[a]
                for r in range(rows):
                    row, k, n = r, t * ti.static(self.size), block
                    for b in ti.static(range(d - 1)):
                        a = ti.static(d - 2 - b)
                        k += (here[a] + row % count[a]) * ti.static(self.strides[a])
                        n += (there[a] + row % count[a]) * ti.static(self.tile ** (d - 1 - a))
                        row = row // count[a]
                    k += here[d - 1]
                    n += there[d - 1]
                    for c in range(count[d - 1]):
                        if ti.static(loads):
                            field[k + c] = of_grid[n + c]
                        else:
                            of_grid[n + c] = of_grid[n + c] + field[k + c]


# Number of particles per block allocated at first, and number of additional blocks.
SHARED_BY, AT_LEAST = 20, 500
# Entries of the table for tiles to be numbered: tiles that hold particles, and tiles that particles reach.
HOLDS, REACHED = -1, -2
# Indices into `sizes`: blocks in use, pencils, blocks required by the last sort, and pencils of each colour.
BLOCKS, PENCILS, WANTED, COLOURS = range(4)


def room_for_blocks(particles: int) -> int:
    """Return the number of blocks allocated at first."""
    return particles // SHARED_BY + AT_LEAST


def most_blocks(grid: "SparseGrid") -> int:
    """Return the largest number of blocks of a larger grid, limited by free memory and 32-bit indices."""
    fine, free = grid.fine.in_cell if grid.fine else 0, psutil.virtual_memory().available
    numbers = grid.width + grid.kept * grid.keeps_filling + 4 * len(grid.kept_means) + fine
    # Bytes of a block, including the tables of a sort on some threads.
    block = (4 if grid.nodes.dtype == ti.f32 else 8) * numbers * grid.block + 4 * 16
    return int(min(MEMORY_SHARE * free // block, LARGEST_INDEX // (grid.block * max(fine, 1))))


@ti.data_oriented
class SparseGrid(BlockNodes, Grid):
    """Sparse grid of one run on the CPU; see `Grid` and `BlockNodes`.

    Attributes:
        tile_count: number of allocated blocks, including number 0.
        tile_at: (tile_count) int, the tile of each number.
        sizes: counts, see BLOCKS.
        pencils: (tile_count + 1) int, the first block of each pencil.
        coloured: (colours, tile_count) int, the numbers of the pencils of each colour.
        window: windows on the nodes near a tile, one per thread.
    """

    def __init__(self, *args: object, blocks: int, threads: int, **options: object) -> None:
        """Allocate `blocks` blocks; the other arguments are those of `Grid`."""
        self._blocks = blocks
        super().__init__(*args, **options)
        self.all_tiles = math.prod(self.tiles)
        self.tile_count = blocks
        self.block = self.tile**self.dimension
        # Numbers of nodes that stencils of particles reach before and behind their tile.
        drift = math.ceil(drift_allowed(self.tile, self.scheme.spline.nodes))
        self.beyond = drift, drift + self.scheme.spline.nodes - 1
        self.reach = [
            reach_along(n, self.tile, self.beyond, repeats=axis in self.images.periodic)
            for axis, n in enumerate(self.cells)
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
        return self._blocks * self.tile**self.dimension

    def occupy(self, tiles: np.ndarray) -> None:
        """Number only these tiles, given by sorted linear indices."""
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
        tiles = np.empty(self.sizes[BLOCKS] - 1, np.int32)
        self._read(tiles)
        return tiles

    @ti.kernel
    def _read(self, tiles: ti.types.ndarray(ti.i32, 1)):
        for k in range(tiles.shape[0]):
            tiles[k] = self.tile_at[k + 1]

    @ti.func
    def tile_place(self, index: int):
        place, rest = ti.Vector.zero(int, self.dimension), index
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            place[a] = rest % ti.static(self.tiles[a])
            rest = rest // ti.static(self.tiles[a])
        return place

    @ti.func
    def node_at(self, index: int):
        """Return the integer coordinates of a node, given its linear index."""
        place = self.tile_place(self.tile_at[index // ti.static(self.block)])
        rest = index % ti.static(self.block)
        for b in ti.static(range(self.dimension)):
            a = ti.static(self.dimension - 1 - b)
            place[a] = place[a] * ti.static(self.tile) + rest % ti.static(self.tile)
            rest = rest // ti.static(self.tile)
        return place

    @ti.func
    def row_count(self):
        """Return the number of rows of nodes in the blocks in use, without number 0."""
        return (self.sizes[BLOCKS] - 1) * ti.static(self.block // self.tile)

    @ti.func
    def row_start(self, row: int):
        return self.node_at(ti.static(self.block) + row * ti.static(self.tile))

    @ti.func
    def row_length(self, _start: ti.template()):
        return self.tile

    @ti.func
    def forget(self, begin: int, end: int):
        for b in range(ti.max(begin, 1), end):
            self.table[self.tile_at[b]] = 0

    @ti.func
    def mark(self, order: ti.template(), begin: int, end: int):
        """Wrap particles `begin` to `end` - 1 into the domain and mark the tiles of active ones."""
        for p in range(begin, end):
            order.wrap(p)
            if order.status_of(p) == ACTIVE:
                tile = self.tile_index(order.first_node_of(p))
                # Other threads may write the same value.
                if self.table[tile] != HOLDS:
                    self.table[tile] = HOLDS
                    self._marked[tile // SPAN] = ti.cast(1, ti.i8)

    @ti.func
    def number(self):
        """Number the tiles reached from marked tiles; return whether the allocated blocks suffice."""
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
        """Mark the tiles that particles of a tile can reach."""
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
        """Find the pencils of the blocks in use and those of each colour."""
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
    """Tile order of one group on a sparse grid, over the numbered tiles."""

    @ti.func
    def pencil_count(self, colour: int):
        return self.grid.sizes[COLOURS + colour]

    @ti.func
    def pencil_of(self, colour: int, q: int):
        return self.grid.coloured[colour, q]

    @ti.func
    def pencils(self):
        return self.grid.sizes[PENCILS]

    @ti.func
    def first_tile_of(self, pencil: int):
        return self.grid.pencils[pencil]


def reach_along(cells: int, tile: int, beyond: tuple[int, int], *, repeats: bool) -> np.ndarray:
    """Return, per tile of an axis, the tiles that its particles reach, including images, (tiles, k), padded with -1.

    Args:
        cells: cells of the domain along the axis.
        tile: edge of a tile, cells.
        beyond: numbers of nodes that stencils reach before and behind the tile.
        repeats: whether the axis is periodic.
    """
    tiles, last = -(-(cells + 1 + 2 * PAD) // tile), cells + PAD
    found = []
    for t in range(tiles):
        low, high = t * tile - beyond[0], (t + 1) * tile - 1 + beyond[1]
        ranges = [(low, high)]
        if repeats:
            # A node near a face has an image at the same distance inside of the opposite face.
            if low <= 2 * PAD:
                ranges.append((low + cells, min(high, 2 * PAD) + cells))
            if high >= last - PAD:
                ranges.append((max(low, last - PAD) - cells, high - cells))
        else:
            if low <= PAD + IMAGE_DEPTH:
                ranges.append((0, low))
            if high >= last - IMAGE_DEPTH:
                ranges.append((high, tiles * tile - 1))
        own = {k for first, after in ranges for k in range(max(first // tile, 0), min(after // tile, tiles - 1) + 1)}
        found.append(sorted(own))
    table = np.full((tiles, max(map(len, found))), -1, np.int32)
    for t, own in enumerate(found):
        table[t, : len(own)] = own
    return table


def first_nodes_of(position: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the first nodes of the stencils of points, (n, d) m, as integer coordinates, (n, d)."""
    scaled = (position - np.array(scene.domain.origin)) / scene.domain.spacing
    shift = SPLINES[scene.solver.kernel].nodes / 2 - 1
    return np.clip(np.floor(scaled - shift).astype(np.int64), 0, np.array(scene.domain.cells)) + PAD


def tiles_reached(first_nodes: np.ndarray, tile: int, reach: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sorted indices of tiles that particles may write, given the first nodes of their stencils, (n, d)."""
    shape = tuple(len(table) for table in reach)
    found = np.unique(np.ravel_multi_index(tuple((first_nodes // tile).T), shape))
    # Axis by axis, which creates few duplicates.
    for axis, table in enumerate(reach):
        places = list(np.unravel_index(found, shape))
        along = table[places[axis]]
        wide = [np.broadcast_to(place[:, None], along.shape)[along >= 0] for place in places]
        wide[axis] = along[along >= 0]
        found = np.unique(np.ravel_multi_index(tuple(wide), shape))
    return found


# Smallest number of cells of a grid that is sparse with "auto", and the largest filled fraction of its cells.
MANY_CELLS, FILLED = 8_000_000, 0.05


def wants_sparse(scene: Scene) -> bool:
    """Return whether the grid of a scene is sparse on the CPU; the result does not depend on the machine."""
    if scene.solver.grid != "auto":
        return scene.solver.grid == "sparse"
    if any(map(ContactTable(scene).separates, scene.sources)):
        return False
    cells = math.prod(scene.domain.cells)
    return cells >= MANY_CELLS and filled_cells(scene) <= FILLED * cells


def filled_cells(scene: Scene) -> float:
    """Return the number of cells filled by all material of a scene at rest."""
    counts = zip(scene.sources, estimate_sources(scene), strict=True)
    return sum(n / source.particles_per_cell for source, n in counts)
