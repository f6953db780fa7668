"""Relaxation of the volume of particles towards the one that the grid sees (docs/theory.md, 5.11)."""

import taichi as ti

# A particle is relaxed where every node of its stencil is filled beyond this fraction: not at a free surface, where the
# kernel sees air.
FULL = 0.4
# Difference of the volume ratio that is left alone. The density of particles varies by as much from point to point
# where they are not on a lattice; relaxed, that noise would make pressure.
DEAD_BAND = 0.02
# Upper bound on the volume gained by coming apart, ln J. It caps what has to close up again.
SCATTERED = 2.0


@ti.func
def volume_change(J: float, seen: float, crossings: float, rate: float, opens: float):
    """Return by how much the volume ratio J changes where the grid sees `seen`.

    Args:
        crossings: of a cell by sound, in the time since the last relaxation.
        rate: share of the difference that is made up while sound crosses a cell.
        opens: 1 where the volume may grow, else 0.
    """
    gap = seen - J
    change = opens * ti.max(gap - DEAD_BAND, 0.0) + ti.min(gap + DEAD_BAND, 0.0)
    return change * (rate * crossings / (1.0 + rate * crossings))
