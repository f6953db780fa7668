"""The nodes near one tile of a sparse grid, in a row: what a thread adds up, or gathers from, while it works on it."""

from copy import copy

import taichi as ti

from mpmcli.solver.grid import Grid, LinearNodes


@ti.data_oriented
class TileWindow(LinearNodes):
    """Copies, one for each thread, of the nodes that the stencils of a tile's particles reach.

    A stencil is in up to 2^d blocks, but in one window, whose nodes have linear indices as a dense grid's. So P2G and
    G2P are the same on both; see `Grid` for the attributes that they share.

    Attributes:
        edge: nodes per axis; size: nodes of a window.
        before_tile, behind_tile: of them, those before the tile and behind it, per axis.
    """

    runs = 1

    def __init__(self, grid: Grid, threads: int) -> None:
        d = self.dimension = grid.dimension
        self.before_tile, self.behind_tile = grid.beyond
        self.tile, self.tiles = grid.tile, grid.tiles
        self.edge = self.before_tile + grid.tile + self.behind_tile
        self.strides = tuple(self.edge ** (d - 1 - a) for a in range(d))
        self.size = self.edge**d
        self.node_count, self.first_node = threads * self.size, 0
        for name in ("width", "planes", "scheme", "weighs_before", "deterministic"):
            setattr(self, name, getattr(grid, name))
        self.nodes, self.before, self.filling = (
            None if field is None else ti.Vector.field(grid.width, float, shape=self.node_count)
            for field in (grid.nodes, grid.before, grid.filling)
        )

    def seen_from(self, grid: Grid, first_node: object) -> "TileWindow":
        """Return the window of a view of the grid, with a linear index of node 0, a variable of the kernel."""
        result = copy(self)
        result.first_node = first_node
        for name in ("spacing", "inverse_spacing", "gradient_scale"):
            setattr(result, name, getattr(grid, name))
        return result

    @ti.func
    def first_of(self, t: int, place: ti.template()):
        """Return the linear index that node 0 of the grid would have, in the window of thread t at a tile."""
        first = t * ti.static(self.size)
        for a in ti.static(range(self.dimension)):
            first -= (place[a] * ti.static(self.tile) - self.before_tile) * ti.static(self.strides[a])
        return first

    @ti.func
    def clear(self, field: ti.template(), t: int):
        """Set a field of the window to zero."""
        for k in range(t * ti.static(self.size), (t + 1) * ti.static(self.size)):
            field[k] = ti.Vector.zero(float, self.width)

    @ti.func
    def load(self, field: ti.template(), of_grid: ti.template(), grid: ti.template(), t: int, place: ti.template()):
        """Copy the nodes near a tile into a field of the window."""
        self.exchange(field, of_grid, grid, t, place, True)

    @ti.func
    def add(self, field: ti.template(), of_grid: ti.template(), grid: ti.template(), t: int, place: ti.template()):
        """Add a field of the window to the nodes near a tile."""
        self.exchange(field, of_grid, grid, t, place, False)

    @ti.func
    def exchange(
        self,
        field: ti.template(),
        of_grid: ti.template(),
        grid: ti.template(),
        t: int,
        place: ti.template(),
        loads: ti.template(),
    ):
        """Go through the nodes near a tile, block by block."""
        d = ti.static(self.dimension)
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
