"""Relaxation of the volume of particles towards the one that the grid sees (docs/theory.md, 5.11)."""

import taichi as ti

# A particle is relaxed where every node of its stencil is filled beyond this fraction: not at a free surface, where the
# kernel sees air. The grid sees J up to its inverse.
FULL = 0.2
# It opens only where the nodes beside the stencil are filled beyond this fraction of the mean over the stencil.
BESIDE = 0.4
# Difference of the volume ratio that is left alone where there is pressure. The density of particles varies by as much
# from point to point where they are not on a lattice; relaxed, that noise would make pressure.
DEAD_BAND = 0.02
# Largest lack of volume that makes pressure: particles that lie in one place are no reason for a blow.
LARGEST_LACK = 0.1
# Difference that is left alone without pressure, and opening that is forgotten when it ends. A column that is let go
# opens by a tenth of it at its turning points; closing that without pressure would lengthen its period.
SLACK = 0.005
# J up to which deformation opens; beyond it only the grid says how far.
OPENED = 2.0


@ti.func
def relaxed_volume(J: float, seen: float, crossings: float, rate: float, opens: float):
    """Return the volume ratio J after relaxation where the grid sees `seen`, and how much of its change makes pressure.

    Above 1, where there is no pressure, J follows at once.

    Args:
        crossings: of a cell by sound, in the time since the last relaxation.
        rate: share of the difference that is made up while sound crosses a cell.
        opens: 1 where the volume may grow, else 0.
    """
    free = J
    if J >= 1.0:
        free = ti.max(J + opens * ti.max(seen - J - SLACK, 0.0) + ti.min(seen - J + SLACK, 0.0), 1.0)
    gap = ti.max(seen, ti.min(free, 1.0) - LARGEST_LACK) - free
    # The density at rest is no room to open into: particles at even spacing may bear pressure.
    room = ti.max(ti.min(gap, seen - 1.0) - DEAD_BAND, 0.0)
    change = opens * room + ti.min(gap + DEAD_BAND, 0.0)
    change *= rate * crossings / (1.0 + rate * crossings)
    return free + change, ti.abs(change)


@ti.func
def opened_volume(J_minus_1: float, growth: float):
    """Return J - 1 after J grew by the factor 1 + growth, for material that remembers how far it opened."""
    opened = J_minus_1 + (growth + growth * J_minus_1)
    # Comparisons, which NaN does not meet: a lost particle stays not finite.
    if opened > OPENED - 1.0 and opened > J_minus_1:
        opened = ti.max(J_minus_1, OPENED - 1.0)
    # Closing after so little begins at J = 1.
    if growth < 0.0 and J_minus_1 > 0.0 and J_minus_1 < SLACK:
        opened = growth
    return opened
