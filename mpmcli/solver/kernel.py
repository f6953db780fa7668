"""The quadratic B-spline that carries everything between particles and nodes."""

import taichi as ti

from mpmcli.solver.grid import PAD


@ti.func
def stencil(x: ti.template(), inverse_spacing: float):
    """Return the first node of the stencil of a point and the distance to it in cells, per axis.

    The quadratic B-spline reaches the three nodes nearest to the point, so the distance is in [0.5, 1.5).
    """
    scaled = x * inverse_spacing + PAD
    base = ti.cast(scaled - 0.5, int)
    return base, scaled - ti.cast(base, float)


@ti.func
def weights(distance: ti.template()):
    """Return the weights of the three nodes, each a vector over the axes (Steffen et al. 2008, eq. 24)."""
    return (
        0.5 * (1.5 - distance) ** 2,
        0.75 - (distance - 1.0) ** 2,
        0.5 * (distance - 0.5) ** 2,
    )
