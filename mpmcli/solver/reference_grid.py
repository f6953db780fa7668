"""Elastic bodies on the grid of their state at rest (total Lagrangian; de Vaucorbeil, Nguyen, Hutchinson 2020).

Particles scatter and gather at the places X that they have at rest, with the first Piola-Kirchhoff stress
P = tau F^-T and dv/dX (docs/theory.md, 2.6). No stencil ever changes. What the body meets after the start is not
on that grid: walls push at particles.
"""

import taichi as ti

from mpmcli.solver.particle_arrays import MASS, VOLUME

# A body that begins within this distance of a wall that slips or sticks, cells, is held by that wall for good.
HELD = 1.0


@ti.func
def pulled_back(tau: ti.template(), F: ti.template()):
    """Return the first Piola-Kirchhoff stress of a Kirchhoff stress, tau F^-T."""
    return tau @ F.inverse().transpose()


@ti.func
def push_of_walls(
    particles: ti.template(),
    group: ti.template(),
    x: ti.template(),
    X: ti.template(),
    F: ti.template(),
    row: ti.template(),
    constants: ti.template(),
):
    """Return the acceleration of a particle by the walls that it presses on, m/s^2.

    A particle is the ellipse that F makes of a ball of its spacing s. Where it reaches beyond a wall by g, the wall
    pushes it with (lambda + 2 mu) V / (m s h) g, about as stiff as the material. Friction is in `particle_friction`.

    Args:
        x, X: where it is, and where it is at rest, m; row: of the table.
    """
    d = ti.static(group.dimension)
    push = ti.Vector.zero(float, d)
    spacing = row[VOLUME] ** ti.static(1.0 / group.dimension)
    stiffness = stiffness_of(particles, group, row, constants)
    for a in ti.static(range(d)):
        stretched = stretch_along(F, a)
        for side in ti.static(range(2)):
            overlap, meets = overlap_of(particles, x, X, stretched, spacing, a, side)
            if meets:
                inward = ti.static(1.0 - 2.0 * side)
                push[a] += inward * stiffness * overlap
    return push


@ti.func
def stiffness_of(particles: ti.template(), group: ti.template(), row: ti.template(), constants: ti.template()):
    """Return (lambda + 2 mu) V / (m s h) of a particle, 1/s^2."""
    spacing = row[VOLUME] ** ti.static(1.0 / group.dimension)
    return group.law.wave_modulus(constants) * row[VOLUME] / (row[MASS] * spacing * particles.grid.spacing)


@ti.func
def stretch_along(F: ti.template(), a: ti.template()):
    """Return |F^T n| for the axis a as n."""
    stretched = 0.0
    for b in ti.static(range(F.m)):
        stretched += F[a, b] * F[a, b]
    return ti.sqrt(stretched)


@ti.func
def overlap_of(
    particles: ti.template(),
    x: ti.template(),
    X: ti.template(),
    stretched: float,
    spacing: float,
    a: ti.template(),
    side: ti.template(),
):
    """Return how far a particle reaches beyond a wall, m, and whether the wall pushes it."""
    distance, at_rest = x[a], X[a]
    if ti.static(side == 1):
        distance, at_rest = particles.extent[a] - x[a], particles.extent[a] - X[a]
    # A body that fills its place up to the wall begins without a push, whatever its spacing along this axis.
    overlap = ti.min(0.5 * spacing, at_rest) * stretched - distance
    meets = overlap > 0.0
    if ti.static(particles.faces[a][side] != "separate"):
        meets = meets and at_rest >= HELD * particles.grid.spacing
    return overlap, meets
