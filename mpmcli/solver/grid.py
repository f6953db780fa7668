"""The background grid: nodes of mass and momentum, and the box of them that is in use."""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import taichi as ti

# Nodes beyond each wall: ghost nodes that the wall folds, and the reach of the kernel.
PAD = 3
# Edge of a tile, cells: same-coloured tiles write disjoint nodes as long as no particle has drifted
# more than one cell out of the tile that it was sorted into (4 + 4 cells apart, 3 + 1 + 1 nodes reach). A little less
# leaves room for the rounding of positions.
TILE = 4
DRIFT = 0.98


def node_width(dimension: int, *, on_cpu: bool) -> int:
    """Return the numbers per node: momentum and mass, and on the CPU padding to a vector register."""
    return 4 if on_cpu else dimension + 1


@ti.data_oriented
class Grid:
    """A dense grid of nodes over the domain and its ghost margin, addressed by one linear index.

    Node index n along an axis lies at (n - PAD) h from the lower wall.

    Attributes:
        dimension: 2 or 3.
        spacing: h, m.
        cells: cells of the domain per axis.
        shape: nodes per axis, margins included, a multiple of TILE.
        tiles: tiles per axis.
        strides: of the linear node index, per axis.
        lines: of a stencil's lines of nodes along the last axis: (offsets along the other axes, linear offset).
        width: numbers per node, at least d + 1.
        nodes: Vector(width) field: momentum and mass after P2G, velocity and mass after the update.
        box: (2, d) ints: first node in use and number of nodes in use, per axis.
    """

    def __init__(self, dimension: int, spacing: float, cells: tuple[int, ...], width: int) -> None:
        self.dimension = dimension
        self.width = width
        self.spacing = spacing
        self.cells = tuple(cells)
        self.tiles = self.tile_counts(cells)
        self.shape = tuple(TILE * n for n in self.tiles)
        self.strides = tuple(int(np.prod(self.shape[a + 1 :])) for a in range(dimension))
        self.lines = tuple(
            (o, sum(n * stride for n, stride in zip(o, self.strides, strict=False)))
            for o in product(range(3), repeat=dimension - 1)
        )
        self.node_count = int(np.prod(self.shape))
        self.nodes = ti.Vector.field(width, float, shape=self.node_count)
        self.box = ti.field(int, shape=(2, dimension))

    @staticmethod
    def tile_counts(cells: Sequence[int]) -> tuple[int, ...]:
        """Return the tiles per axis of a grid over so many cells."""
        return tuple(-(-(n + 1 + 2 * PAD) // TILE) for n in cells)

    @staticmethod
    def nodes_needed(cells: Sequence[int]) -> int:
        """Return the number of nodes of such a grid."""
        return math.prod(TILE * n for n in Grid.tile_counts(cells))

    @ti.func
    def first_node(self, base: ti.template()):
        """Return the linear index of the node at the integer coordinates `base`."""
        index = 0
        for a in ti.static(range(self.dimension)):
            index += base[a] * self.strides[a]
        return index

    @ti.func
    def row_count(self):
        """Return the number of rows of nodes, along the last axis, in the box in use."""
        count = 1
        for a in ti.static(range(self.dimension - 1)):
            count *= self.box[1, a]
        return count

    @ti.func
    def row_start(self, row: int):
        """Return the integer coordinates of the first node of a row of the box."""
        start = ti.Vector.zero(int, self.dimension)
        rest = row
        for b in ti.static(range(self.dimension - 1)):
            a = ti.static(self.dimension - 2 - b)
            start[a] = self.box[0, a] + rest % self.box[1, a]
            rest = rest // self.box[1, a]
        last = ti.static(self.dimension - 1)
        start[last] = self.box[0, last]
        return start

    @ti.func
    def box_nodes(self):
        """Return the number of nodes of the box in use."""
        return self.row_count() * self.box[1, ti.static(self.dimension - 1)]

    @ti.func
    def box_node(self, q: int):
        """Return the integer coordinates of the q-th node of the box."""
        last = ti.static(self.dimension - 1)
        node = self.row_start(q // self.box[1, last])
        node[last] += q % self.box[1, last]
        return node
