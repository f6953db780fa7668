"""Sums over consecutive particles with the same stencil, which a GPU thread keeps in registers.

The particles of a thread are consecutive in the order of cells (`particles.sort.CellOrder`). Their sums are added to
the nodes, with atomics, only where the stencil changes, so that a fresh order needs one set of atomics per cell instead
of one per particle. Results do not depend on the order, apart from rounding.
"""

from typing import Any

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid

# Threads whose particles are interleaved in memory, so that they read contiguous entries at once.
WARP = 32
# Threads of a block, Taichi's own number.
BLOCK = 128
# Smallest and largest number of particles of a thread, and the fewest threads for which it is raised.
SHORTEST, LONGEST, THREADS = 4, 16, 2**14
# Largest number of sums of a thread.
MOST_SUMS = 108


def run_length(capacity: int) -> int:
    """Return how many particles a thread scatters."""
    length = SHORTEST
    while length < LONGEST and capacity >= 2 * length * THREADS:
        length *= 2
    return length


def thread_count(capacity: int) -> int:
    """Return how many threads scatter this number of particles."""
    return in_blocks(-(-capacity // (run_length(capacity) * WARP)) * WARP)


def in_blocks(threads: int) -> int:
    """Return a number of threads rounded up to whole blocks: software Vulkan loses sums of a block that is not full."""
    return -(-threads // BLOCK) * BLOCK


def scatters_runs(grid: Grid) -> bool:
    """Return whether the threads of a GPU keep sums: in floating point, if there are registers for a stencil."""
    return not grid.deterministic and grid.scheme.spline.nodes**grid.dimension * grid.width <= MOST_SUMS


@ti.func
def stored_at(place: int, count: int, length: ti.template()):
    """Return the index of a particle in memory from its place in the order of `count` particles.

    Where WARP threads have `length` particles each, the k-th particles of all of them are contiguous.
    """
    size = ti.static(length * WARP)
    first = place // size * size
    index = place
    if first + size <= count:
        index = first + (place - first) % length * WARP + (place - first) // length
    return index


class RunSums:
    """The sums of a thread: variables of a kernel.

    Attributes:
        sums: a row for each node of the stencil.
        first: linear index of the first node of the stencil, -1 before the first particle.
    """

    def __init__(self, grid: Grid, sums: Any, first: Any) -> None:
        self.grid, self.sums, self.first = grid, sums, first

    def row(self, at: tuple[int, int, int]) -> int:
        """Return the row of node k of line j in plane i, `at` = (i, j, k)."""
        nodes = self.grid.scheme.spline.nodes
        return (at[0] * nodes + at[1]) * nodes + at[2]

    @property
    def nodes(self) -> list[tuple[int, int, int]]:
        """The nodes of the stencil as (i, j, k)."""
        nodes = range(self.grid.scheme.spline.nodes)
        return [(i, j, k) for i in range(self.grid.planes) for j in nodes for k in nodes]


@ti.func
def move_to(run: ti.template(), first: int):
    """Begin the sums of the stencil whose first node has this linear index, after those of another are added."""
    if first != run.first:
        flush(run)
        run.first = first


@ti.func
def flush(run: ti.template()):
    """Add the sums to the nodes, and reset them."""
    if run.first >= 0:
        for at in ti.static(run.nodes):
            node = run.first + ti.static(run.grid.line_node(at[0], at[1]) + at[2])
            share = ti.Vector.zero(float, ti.static(run.grid.width))
            for c in ti.static(range(run.grid.width)):
                share[c] = run.sums[ti.static(run.row(at)), c]
                run.sums[ti.static(run.row(at)), c] = 0.0
            ti.atomic_add(run.grid.nodes[node], share)
