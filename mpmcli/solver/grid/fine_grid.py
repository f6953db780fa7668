"""The fine nodes by which particles are shifted, see `transfer.redistribution`."""

import math

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.fixed_point import FixedSums
from mpmcli.solver.grid.grid import Grid, LinearNodes
from mpmcli.solver.grid.sparse_grid import BlockNodes, SparseGrid
from mpmcli.solver.transfer.splines import PAD, SPLINES, TransferScheme

# Bound on the sum of filled fractions at one fine node.
MOST_FILLED = 4096.0


@ti.data_oriented
class FineGrid(LinearNodes):
    """Nodes about as far apart as particles, `per_cell` per cell of a grid along each axis.

    Attributes:
        per_cell: nodes per cell along an axis.
        in_cell: nodes per cell.
        fill: Vector(1) field: the filled fraction of each fine cell; after `fold_fine` the crowding phi.
        sums, scale: what particles add to, `fill` or sums in fixed point, and the factor of filled fractions in them.
    """

    width = 1

    def __init__(self, grid: Grid, per_cell: int) -> None:
        self.dimension, self.per_cell, self.runs, self.first_node = grid.dimension, per_cell, grid.runs, 0
        self.in_cell = per_cell**self.dimension
        self.scheme, self.planes = TransferScheme(SPLINES["quadratic"]), 3 if self.dimension == 3 else 1
        self.strides = tuple(math.prod(per_cell * n for n in grid.shape[a + 1 :]) for a in range(self.dimension))
        self.node_count = self.in_cell * grid.node_count
        self.fill = ti.Vector.field(1, float, shape=self.runs * self.node_count)
        self.scale = 1.0

    @property
    def sums(self) -> ti.Field | FixedSums:
        return self.fixed or self.fill

    def add_in_fixed_point(self, sums: FixedSums) -> None:
        """Let particles add to sums in fixed point."""
        self.deterministic, self.fixed, self.scale = True, sums, sums.scale(MOST_FILLED)

    @ti.func
    def clear(self, index: int):
        self.fill[index][0] = 0.0
        if ti.static(self.deterministic):
            self.fixed.clear(index)

    @ti.func
    def place_in_cell(self, node: ti.template(), q: int):
        """Return the integer coordinates of the q-th fine node in the cell whose first node is `node`."""
        place = node * self.per_cell
        for a in ti.static(range(self.dimension)):
            place[a] += q // ti.static(self.per_cell ** (self.dimension - 1 - a)) % self.per_cell
        return place

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance from it, given the 1/h of the grid."""
        base, distance = self.scheme.spline.stencil(x, inverse_spacing * self.per_cell)
        return base + ti.static(PAD * (self.per_cell - 1)), distance


@ti.data_oriented
class FineBlocks(BlockNodes, FineGrid):
    """The fine nodes of a sparse grid: a block stores the fine nodes of its cells."""

    def __init__(self, grid: SparseGrid, per_cell: int) -> None:
        super().__init__(grid, per_cell)
        self.tile, self.tiles, self.table = per_cell * grid.tile, grid.tiles, grid.table
        self.block = self.tile**self.dimension
