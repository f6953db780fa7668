"""The background grid: nodes with mass and momentum, and the box of nodes in use."""

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from mpmcli.boundaries.images import Images
from mpmcli.boundaries.walls import IMAGE_DEPTH
from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.period import Period
from mpmcli.solver.transfer.splines import LOW_BITS, PAD, TransferScheme, bounded

# Margin of the drift of particles for the rounding of positions, cells.
ROUNDING = 0.02


def tile_edge(stencil: int, dimension: int, *, on_cpu: bool) -> int:
    """Return the edge of a tile, cells, for a spline with `stencil` nodes per axis.

    Larger tiles require fewer sorts; in 3D the nodes of a tile must fit into the first-level cache.
    """
    return stencil + (3 if on_cpu and dimension == 2 else 1)


def drift_allowed(tile: int, stencil: int) -> float:
    """Return how far, cells, particles may leave their tile while tiles of one colour write disjoint nodes.

    Tiles of one colour are two edges of t cells apart. With a drift of up to c cells a tile writes to t + 2 c + stencil
    - 1 nodes. These must be at most 2 t: 2 c < t - stencil + 2.
    """
    return (tile - stencil + 1) // 2 - ROUNDING


def node_width(dimension: int, *, on_cpu: bool) -> int:
    """Return how many numbers a node stores: momentum and mass, padded to a vector register on the CPU."""
    return 4 if on_cpu else dimension + 1


@ti.data_oriented
class LinearNodes:
    """Nodes of a box, addressed by one linear index with `strides` per axis; `first_node` is the index of node 0."""

    sparse, layers, deterministic, fixed = False, 1, False, None
    dimension: int
    strides: tuple[int, ...]
    first_node: int

    def line_node(self, plane: int, line: int) -> int:
        """Return the linear offset of the first node of a line (along the last axis) in a plane of a stencil."""
        return line * self.strides[-2] + (plane * self.strides[0] if self.dimension == 3 else 0)

    @ti.func
    def linear_index(self, base: ti.template()):
        index = self.first_node
        for a in ti.static(range(self.dimension)):
            index += base[a] * self.strides[a]
        return index

    @ti.func
    def node_of(self, origin: int, i: ti.template(), j: ti.template(), k: ti.template()):
        """Return the linear index of node k of line j in plane i of a stencil, given its `origin_of`."""
        return origin + ti.static(self.line_node(i, j) + k)

    @ti.func
    def origin_of(self, first: int):
        """Return `stencil_at` of the first node of a stencil, `bounded` if there are at most LOW_BITS nodes."""
        if ti.static(self.runs * self.layers * self.node_count <= LOW_BITS):
            return bounded(first)
        else:
            return first

    @property
    def sums(self) -> Any:
        """What particles add to: `nodes`, or sums in fixed point, for numbers that are `scaled`."""
        return self.fixed.nodes if self.fixed else self.nodes

    @property
    def volume_sums(self) -> Any:
        """The same for `filling`, for volumes times `volume_scale`."""
        return self.fixed.filling if self.fixed else self.filling

    @ti.func
    def scaled(self, mass: float, middle: ti.template(), change: ti.template()):
        """Scale the contribution of a particle to its stencil for `sums`; return whether no sum can overflow."""
        fits = True
        if ti.static(self.deterministic):
            fits = self.fixed.scaled(mass, middle, change)
        return fits

    @ti.func
    def note(self, particle: int):
        """Record that a particle is too fast for `sums`."""
        if ti.static(self.deterministic):
            self.fixed.note(particle)

    @ti.func
    def volume_scale(self):
        scale = 1.0
        if ti.static(self.deterministic):
            scale = self.fixed.volume_scale()
        return scale

    @ti.func
    def stencil_at(self, base: ti.template()):
        """Return the address of the stencil that begins at a node: its linear index."""
        return self.linear_index(base)


@ti.data_oriented
class Grid(LinearNodes):
    """Dense grid of nodes over the domain and its ghost margin, addressed by one linear index.

    The node with index n along an axis is at the distance (n - PAD) h from the lower wall.

    Attributes:
        spacing: h, m; 1 except in the view of a run.
        inverse_spacing: 1/h, 1/m.
        gradient_scale: h / D, the factor of a velocity gradient.
        cells: cells of the domain per axis.
        scheme: constants of the transfers.
        period: the periodic axes.
        tile: edge of a tile, cells.
        tiles: number of tiles per axis.
        tile_count: number of all tiles.
        shape: nodes per axis, including margins, a multiple of `tile`.
        planes: planes of a stencil normal to the first axis; 1 in 2D.
        runs: number of runs, whose nodes are stored one after the other.
        layers: layers of nodes per run, stored one after the other, each with a velocity field; 1 if all bodies share
            one.
        width: numbers per node in `nodes`.
        nodes: Vector(width) field: momentum and mass after P2G, velocity and mass after the update. In schemes with
            `keeps_flip_velocity`, the entries from `kept` on hold the same for the motion that bodies keep, without
            stress and forces of this step.
        parts: index of the first number of each of these parts.
        filling: Vector(kept) field: the volume of particles at rest, m^3, in the entry of the mass in `nodes`, in steps
            that relax volumes; None if it follows from the mass.
        keeps_filling: whether `filling` is not None.
        has_solids: whether the first entry of `filling` is the volume inside of colliders.
        holding: `filling` if it is not None, otherwise `nodes`.
        means: per group, a Vector(4) field: sums over the particles in the cell whose first node is this node, of the
            volume at rest times ln J, and the volume at rest, m^3; and over those that were there in the last step, of
            the volume times the growth of ln J, and the volume; None for groups that do not average volumes.
        kept_means: the entries of `means` that are not None.
        images: images at all walls and periodic faces; nodes beyond open faces are ordinary nodes.
        fixed: sums in fixed point, which `FixedPoint.to_float` converts to the fields; None if P2G adds to the fields
            directly.
        deterministic: whether `fixed` is not None; then all `means` are None.
        fine: the fine grid for shifts of particles (`fine_grid.FineGrid`); None without shifts.
        box: (2, d) ints: first node in use and number of nodes in use, per axis.
        own: the same for the nodes in use of a layer, within the rows of the box; None if the layer uses the whole box.
    """

    own = None

    def __init__(
        self,
        cells: tuple[int, ...],
        width: int,
        scheme: TransferScheme,
        runs: int,
        *,
        tile: int,
        keeps_filling: bool,
        averages: Sequence[bool],
        period: Period,
        faces: Sequence[tuple[str, str]],
        deterministic: bool,
        layers: int = 1,
    ) -> None:
        """Allocate nodes for `runs` runs; `averages` states for each group whether it averages volumes over cells."""
        self.dimension, self.kept = len(cells), width
        self.parts = (0, width) if scheme.keeps_flip_velocity else (0,)
        self.width = width * len(self.parts)
        self.spacing, self.inverse_spacing, self.gradient_scale = 1.0, 1.0, scheme.spline.inverse_moment
        self.cells, self.scheme, self.tile = tuple(cells), scheme, tile
        self.tiles = self.tile_counts(cells, tile)
        self.tile_count = math.prod(self.tiles)
        self.shape = tuple(self.tile * n for n in self.tiles)
        self.strides = tuple(int(np.prod(self.shape[a + 1 :])) for a in range(len(cells)))
        self.planes = scheme.spline.nodes if len(cells) == 3 else 1
        self.runs, self.first_node, self.images = runs, 0, Images(faces, PAD, [PAD + n for n in cells])
        self.node_count = self.stored_nodes()
        self.layers = layers
        count = runs * layers * self.node_count
        self.nodes = ti.Vector.field(self.width, float, shape=count)
        self.keeps_filling, self.has_solids = keeps_filling, False
        self.filling = ti.Vector.field(width, float, shape=count) if keeps_filling else None
        self.holding = self.filling if keeps_filling else self.nodes
        self.means = tuple(
            ti.Vector.field(4, float, shape=count) if wanted and not deterministic else None for wanted in averages
        )
        self.kept_means = tuple(means for means in self.means if means is not None)
        self.period = period
        self.deterministic, self.fine = deterministic, None
        self.box = ti.field(int, shape=(2 * runs, len(cells)))

    def in_layer(self, layer: object, own: object) -> "Grid":
        """Return the view of a layer, given its number and its box in use, which are variables of a kernel."""
        view = copy(self)
        view.first_node, view.own = self.first_node + layer * self.node_count, own
        return view

    def within(self, box: object) -> "Grid":
        """Return a view of one of several layers with its own box in use, which is a variable of a kernel."""
        if self.layers == 1:
            return self
        view = copy(self)
        view.box = box
        return view

    @property
    def narrow(self) -> bool:
        """Whether `own` is set; Taichi cannot compare with None."""
        return self.own is not None

    def stored_nodes(self) -> int:
        """Return the number of nodes allocated per run."""
        return math.prod(self.shape)

    @staticmethod
    def tile_counts(cells: Sequence[int], tile: int) -> tuple[int, ...]:
        """Return the number of tiles per axis of a grid over these cells, for tiles with this edge."""
        return tuple(-(-(n + 1 + 2 * PAD) // tile) for n in cells)

    @ti.func
    def clear(self, node: int):
        if ti.static(self.deterministic):
            self.fixed.clear(node)
        else:
            self.nodes[node] = ti.Vector.zero(float, self.width)
            if ti.static(self.keeps_filling):
                self.filling[node] = ti.Vector.zero(float, self.kept)
            for means in ti.static(self.kept_means):
                means[node] = ti.Vector.zero(float, 4)

    @ti.func
    def clear_mean(self, g: ti.template(), cell: int):
        """Clear the sums of a cell for the g-th group, see `means`."""
        if ti.static(self.deterministic):
            self.fixed.means[g].clear(cell)
        else:
            self.means[g][cell] = ti.Vector.zero(float, 4)

    @ti.func
    def add_mean(
        self, g: ti.template(), cell: int, first: ti.template(), volume: float, value: float, atomic: ti.template()
    ):
        """Add a value times the volume of a particle, and the volume, m^3, to two entries of `means`."""
        if ti.static(self.deterministic):
            self.fixed.add_mean(g, cell, first, volume, value)
        elif ti.static(atomic):
            ti.atomic_add(self.means[g][cell][first], volume * value)
            ti.atomic_add(self.means[g][cell][ti.static(first + 1)], volume)
        else:
            more = ti.Vector.zero(float, 4)
            more[first], more[ti.static(first + 1)] = value, 1.0
            self.means[g][cell] = self.means[g][cell] + volume * more

    @ti.func
    def mean(self, g: ti.template(), cell: int):
        """Return the entry of `means` of the g-th group for a cell."""
        if ti.static(self.deterministic):
            return self.fixed.mean(g, cell)
        else:
            return self.means[g][cell]

    @ti.func
    def way_scale(self):
        """Return the factor of displacements, m, in `sums`, which have speeds."""
        scale = 1.0
        if ti.static(self.deterministic):
            scale = self.fixed.way_scale(self.inverse_spacing)
        return scale

    @ti.func
    def part(self, index: int, first: ti.template()):
        """Return the values of one of the `parts` of a node; `first` is the index of its first number."""
        if ti.static(len(self.parts) == 1):
            return self.nodes[index]
        else:
            result = ti.Vector.zero(float, self.kept)
            for c in ti.static(range(self.kept)):
                result[c] = self.nodes[index][first + c]
            return result

    @ti.func
    def set_part(self, index: int, first: ti.template(), value: ti.template()):
        if ti.static(len(self.parts) == 1):
            self.nodes[index] = value
        else:
            for c in ti.static(range(self.kept)):
                self.nodes[index][first + c] = value[c]

    @ti.func
    def tile_number(self, node: ti.template()):
        tile = 0
        for a in ti.static(range(self.dimension)):
            tile = tile * ti.static(self.tiles[a]) + ti.raw_div(node[a], ti.static(self.tile))
        return tile

    @ti.func
    def node_at(self, index: int):
        """Return the integer coordinates of a node, given its linear index."""
        place = ti.Vector.zero(int, self.dimension)
        rest = index - self.first_node
        for a in ti.static(range(self.dimension)):
            place[a] = rest // ti.static(self.strides[a])
            rest = rest % ti.static(self.strides[a])
        return place

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
        start, rest = ti.Vector.zero(int, self.dimension), row
        for b in ti.static(range(self.dimension - 1)):
            a = ti.static(self.dimension - 2 - b)
            start[a] = self.box[0, a] + rest % self.box[1, a]
            rest = rest // self.box[1, a]
        last = ti.static(self.dimension - 1)
        start[last] = self.box[0, last]
        if ti.static(self.narrow):
            start[last] = self.own[0, last]
        return start

    @ti.func
    def row_length(self, start: ti.template()):
        """Return the number of nodes in use of a row, given the first node of the row."""
        last = ti.static(self.dimension - 1)
        length = self.box[1, last]
        if ti.static(self.narrow):
            length = self.own[1, last]
            for a in ti.static(range(last)):
                if start[a] < self.own[0, a] or start[a] >= self.own[0, a] + self.own[1, a]:
                    length = 0
        return length

    @ti.func
    def in_use(self, node: ti.template()):
        """Return whether a node is in the box in use."""
        inside = True
        for a in ti.static(range(self.dimension)):
            if ti.static(self.narrow):
                inside = inside and node[a] >= self.own[0, a] and node[a] < self.own[0, a] + self.own[1, a]
            else:
                inside = inside and node[a] >= self.box[0, a] and node[a] < self.box[0, a] + self.box[1, a]
        return inside

    @ti.func
    def box_nodes(self):
        return self.row_count() * self.box[1, ti.static(self.dimension - 1)]

    @ti.func
    def box_node(self, q: int):
        """Return the integer coordinates of the q-th node of the box."""
        last = ti.static(self.dimension - 1)
        node = self.row_start(q // self.box[1, last])
        node[last] += q % self.box[1, last]
        return node


@ti.func
def box_of(grid: ti.template(), axis: ti.template(), low: int, high: int, drift: int, last_wall: int):
    """Return the first and last node in use along an axis, from the range of first nodes of stencils at the last sort.

    Args:
        low, high: smallest and largest first node of a stencil at the last sort.
        drift: cells that a particle may have moved since.
        last_wall: node of the upper wall.
    """
    first = low - drift
    last = high + drift + ti.static(grid.scheme.spline.nodes - 1)
    # A box near a wall includes the image nodes beyond it, because they are read and written.
    if ti.static(axis in grid.images.periodic):
        if first <= PAD + PAD or last >= last_wall - PAD:
            first = 0
            last = last_wall + PAD
    else:
        if ti.static((axis, 0) not in grid.images.mirrors):
            first = ti.max(first, 0)
        elif first <= PAD + IMAGE_DEPTH:
            first = PAD - IMAGE_DEPTH
        if ti.static((axis, 1) not in grid.images.mirrors):
            last = ti.min(last, last_wall + PAD)
        elif last >= last_wall - IMAGE_DEPTH:
            last = last_wall + IMAGE_DEPTH
    return first, last


@ti.func
def clear_rows(grid: ti.template(), first: int, last: int):
    for row in range(first, last):
        start = grid.row_start(row)
        node = grid.linear_index(start)
        for k in range(grid.row_length(start)):
            grid.clear(node + k)


@ti.func
def clear_blocks(grid: ti.template(), first: int, after: int):
    for node in range(first * ti.static(grid.block), after * ti.static(grid.block)):
        grid.clear(node)
