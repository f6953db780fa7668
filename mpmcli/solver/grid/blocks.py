"""Nodes that are stored in blocks, one for each tile with a number, and how they are found."""

import math

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import LinearNodes


@ti.data_oriented
class BlockNodes(LinearNodes):
    """Nodes that are stored tile by tile.

    Attributes:
        tile: edge of a tile, nodes; tiles: per axis; block: nodes of a tile.
        table: (tiles of the domain) int, their numbers.
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
        """Return the linear index of the tile that holds the node at these integer coordinates."""
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
        """Return what each node adds, along each axis, to the index of its tile, and then to that in the tile."""
        nodes, d = ti.static((self.scheme.spline.nodes, self.dimension))
        offsets = ti.Matrix.zero(int, nodes, ti.static(2 * d))
        for k, a in ti.static(ti.ndrange(nodes, d)):
            tile = ti.raw_div(base[a] + k, ti.static(self.tile))
            offsets[k, a] = tile * ti.static(math.prod(self.tiles[a + 1 :]))
            offsets[k, d + a] = (base[a] + k - tile * self.tile) * ti.static(self.tile ** (d - 1 - a))
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
