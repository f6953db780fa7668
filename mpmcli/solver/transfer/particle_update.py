"""What particles meet in a step, and how they move and are lost."""

from collections.abc import Sequence
from copy import copy

from mpmcli.boundaries.rows import Rows
from mpmcli.boundaries.walls import MovingFaces, RoughFaces
from mpmcli.quick_taichi import ti
from mpmcli.scene.domain import OPEN, SEPARATING
from mpmcli.solver.contact.total_solids import ParticleContact
from mpmcli.solver.grid.grid import Grid, LinearNodes
from mpmcli.solver.grid.period import opaque
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.stability.limits import OVERLAP

NOT_LOST = 2**31 - 1
# Largest distance beyond an open face, cells, at which particles wait for the next sort to retire them; nodes extend so
# far.
OPEN_MARGIN = 1.99


@ti.data_oriented
class ParticleUpdate:
    """What particles meet in a step (see `scatter` and `advance`), and how they move and are lost.

    Attributes:
        near: the nodes that stencils address: those of the grid, or on a sparse grid those of a window.
        extent: size of the domain per axis, m.
        faces: conditions of the walls per axis.
        repulsion: contact between elastic bodies that are `total`, None without contact.
        repels: whether `repulsion` is not None.
        friction, moving: coefficients of friction and velocities of the walls.
        run: number of the run of a view.
        watches_box: whether a particle whose stencil has left the nodes in use is lost; true on a GPU, where speeds are
            not read back at every step.
        lost: per group, the first particle (in solver order, or by id if the grid is `deterministic`) that left the
            domain, was inverted or is not finite, or NOT_LOST.
    """

    def __init__(
        self,
        grid: Grid,
        faces: Sequence[tuple[str, str]],
        group_count: int,
        repulsion: ParticleContact | None,
        friction: RoughFaces,
        moving: MovingFaces,
        *,
        watches_box: bool,
    ) -> None:
        """Store what particles meet, and allocate the record of lost particles of `group_count` groups."""
        self.repulsion, self.repels, self.friction, self.moving = repulsion, repulsion is not None, friction, moving
        self.grid = self.near = grid
        self.dimension, self.run, self.first_lost = grid.dimension, 0, 0
        self.faces = tuple(tuple(pair) for pair in faces)
        self.extent = tuple(n * grid.spacing for n in grid.cells)
        self.watches_box = watches_box
        self.lost = ti.field(int, shape=group_count)
        self.lost.fill(NOT_LOST)
        self._rows = Rows(self.lost)

    def forget_lost(self, first: int, count: int) -> None:
        """Reset the records of lost particles of some groups."""
        self._rows.write(first, [NOT_LOST] * count)

    def with_nodes(self, nodes: LinearNodes) -> "ParticleUpdate":
        """Return an update whose stencils address these nodes."""
        result = copy(self)
        result.near = nodes
        return result

    @ti.func
    def lose(self, g: ti.template(), group: ti.template(), p: int):
        if ti.static(self.grid.deterministic):
            ti.atomic_min(self.lost[self.first_lost + g], group.id[p])
        else:
            ti.atomic_min(self.lost[self.first_lost + g], p)

    def farthest(self, group: ParticleArrays, axis: int, side: int) -> float:
        """Return how far beyond a face particles of a group may be, cells.

        Beyond an open face they move on until the next sort retires them. Springs push back what overlaps a wall, which
        would lose what they have stored if particles stopped at it.
        """
        springs = group.surfaced and self.faces[axis][side] in SEPARATING
        return OPEN_MARGIN if self.faces[axis][side] == OPEN else OVERLAP * springs

    @ti.func
    def moved(self, group: ti.template(), x: ti.template(), remainder: ti.template(), v: ti.template(), dt: float):
        """Return the new position of a particle after dt, its new remainder, and the distance beyond the domain, all m.

        The remainder is the rounding error of x, so that the sum is compensated (Dekker 1971; docs/theory.md, 8.3). The
        position is clamped to the domain, except along periodic axes, and to some distance beyond, see `farthest`.
        """
        inside, after, beyond = ti.Vector.zero(float, self.dimension), ti.Vector.zero(float, self.dimension), 0.0
        for c in ti.static(range(self.dimension)):
            way = dt * v[c] + remainder[c]
            moved = x[c] + way
            if ti.static(c in self.grid.images.periodic):
                inside[c], after[c], out = self.grid.period.moved(group, x[c], way, self.extent[c], c)
                beyond += out * self.grid.spacing
            else:
                low = -ti.static(self.farthest(group, c, 0)) * self.grid.spacing
                high = self.extent[c] + ti.static(self.farthest(group, c, 1)) * self.grid.spacing
                inside[c] = ti.select(moved > low, moved, low)
                inside[c] = ti.select(inside[c] < high, inside[c], high)
                beyond += ti.abs(moved - inside[c])
                if ti.static(group.carries):
                    after[c] = ti.select(moved == inside[c], way - (opaque(inside[c]) - x[c]), 0.0)
                    if ti.static(self.farthest(group, c, 0) > 0.0):
                        # `opaque` requires non-negative numbers.
                        after[c] = ti.select(inside[c] > 0.0, after[c], 0.0)
        return inside, after, beyond
