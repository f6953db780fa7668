"""What threads do with the nodes of a run of a batch on the CPU, see `batch_parts`."""

import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.batch_phases import SPEED, VECTORS, BatchPhases
from mpmcli.solver.block_loops import clear_blocks, update_blocks
from mpmcli.solver.cpu_loops import clear_rows, update_rows
from mpmcli.solver.sparse_grid import BLOCKS, PENCILS


@ti.data_oriented
class NodeParts:
    """The parts of the phases of nodes, w being the number of a run, region and part those of the part.

    Attributes:
        phases: their numbers.
    """

    def __init__(self, phases: BatchPhases) -> None:
        self.phases, self.dimension = phases, phases.dimension
        self.places, self.values = phases.places, phases.values

    @ti.func
    def gravity_step(self, w: int):
        """Return by how much gravity changes velocities in this step, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            result[a] = self.values[w, VECTORS + a]
        return result

    @ti.func
    def clear(self, run: ti.template(), region: int, part: int):
        """Clear nodes."""
        grid, _nodes, _particles, _orders, _seen = ti.static(run)
        if ti.static(grid.sparse):
            first, after = self.places.even_part(grid.sizes[BLOCKS], region)
            first, after = self.phases.share(first, after, part)
            clear_blocks(grid, first, after)
        else:
            first, after = self.places.rows_of(grid, region)
            first, after = self.phases.share(first, after, part)
            clear_rows(grid, first, after)

    @ti.func
    def find_contact(self, run: ti.template(), w: int, region: int, part: int):
        """Find where walls that let go are pressed."""
        grid, nodes, _particles, _orders, _seen = ti.static(run)
        gravity_step = self.gravity_step(w)
        first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
        first, after = self.phases.share(first, after, part)
        for q in range(first, after):
            nodes.images.find_contact(grid, q, gravity_step)

    @ti.func
    def find_friction(self, run: ti.template(), w: int, region: int, part: int):
        """Find the friction of walls."""
        grid, nodes, _particles, _orders, _seen = ti.static(run)
        gravity_step = self.gravity_step(w)
        first, after = self.places.even_part(nodes.images.plane_nodes(grid), region)
        first, after = self.phases.share(first, after, part)
        for q in range(first, after):
            find_friction(nodes.images, grid, q, gravity_step)

    @ti.func
    def update(self, run: ti.template(), w: int, region: int, part: int):
        """Turn the momentum of nodes into velocity."""
        grid, nodes, _particles, _orders, _seen = ti.static(run)
        if ti.static(grid.sparse):
            # Whole pencils: what colliders take is added up row by row.
            first, after = self.places.even_part(grid.sizes[PENCILS], region)
            first, after = self.phases.share(first, after, part)
            begin, end = grid.pencils[first], grid.pencils[after]
            ti.atomic_max(self.values[w, SPEED], update_blocks(grid, nodes, begin, end, self.gravity_step(w)))
        else:
            first, after = self.places.rows_of(grid, region)
            first, after = self.phases.share(first, after, part)
            ti.atomic_max(self.values[w, SPEED], update_rows(grid, nodes, first, after, self.gravity_step(w)))
