"""Elastic bodies on the grid of their state at rest (total Lagrangian; de Vaucorbeil, Nguyen, Hutchinson 2020).

Particles scatter and gather at the places X that they have at rest, with the first Piola-Kirchhoff stress
P = tau F^-T and dv/dX (docs/theory.md, 2.6). No stencil ever changes. What the body meets after the start is not
on that grid: walls push at particles.
"""

from collections.abc import Sequence

from mpmcli.quick_taichi import ti
from mpmcli.scene import SolverSettings
from mpmcli.solver.particles.arrays import MASS, VOLUME

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
    """Return the acceleration of a particle at x, at rest at X, m, by the walls that it presses on, m/s^2.

    A particle is the ellipse that F makes of a ball of its spacing s. Where it reaches beyond a wall by g, the wall
    pushes it with (lambda + 2 mu) V / (m s h) g, about as stiff as the material. row: of the table.
    """
    d = ti.static(group.dimension)
    push = ti.Vector.zero(float, d)
    spacing = row[VOLUME] ** ti.static(1.0 / group.dimension)
    stiffness = stiffness_of(particles, group, row, constants)
    for a in ti.static(range(d)):
        stretched = stretch_along(F, a)
        for side in ti.static(range(2)):
            overlap, meets = overlap_of(particles, x, X, stretched, spacing, (a, side))
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
    particles: ti.template(), x: ti.template(), X: ti.template(), stretched: float, spacing: float, face: ti.template()
):
    """Return how far a particle reaches beyond a wall, m, and whether the wall pushes it."""
    a, side = ti.static(face)
    distance, at_rest = x[a], X[a]
    if ti.static(side == 1):
        distance, at_rest = particles.extent[a] - x[a], particles.extent[a] - X[a]
    # A body that fills its place up to the wall begins without a push, whatever its spacing along this axis.
    overlap = ti.min(0.5 * spacing, at_rest) * stretched - distance
    meets = overlap > 0.0
    if ti.static(particles.faces[a][side] != "separate"):
        meets = meets and at_rest >= HELD * particles.grid.spacing
    return overlap, meets


def slips_in(settings: SolverSettings, rough: Sequence[tuple[int, int]]) -> bool:
    """Return whether particles remember how far they slipped; `rough` are the faces with friction."""
    return settings.solids == "total" and len(rough) > 0


@ti.func
def friction_of_walls(particles: ti.template(), group: ti.template(), p: int, kick: float, counts: bool):
    """Return the acceleration of a particle by friction of the walls that push it, m/s^2.

    As a spring with a slider does, friction pulls it back with the stiffness of the push by what it has slipped, and at
    most with the coefficient times the push (Cundall and Strack 1979; docs/theory.md, 3.4). Friction that only stops
    the velocity would let a particle creep by what others pull at it in each step.

    kick: the time of the last motion, s; counts: whether the particle remembers its slip after that motion.
    """
    d = ti.static(group.dimension)
    row, F = group.row(p), group.stored(p)
    v, _ = group.motion(p)
    stiffness = stiffness_of(particles, group, row, group.constants(p))
    spacing = row[VOLUME] ** ti.static(1.0 / group.dimension)
    total, kept = ti.Vector.zero(float, d), ti.Vector.zero(float, d)
    for f in ti.static(range(len(particles.friction.faces))):
        a = ti.static(particles.friction.faces[f][0])
        side = ti.static(particles.friction.faces[f][1])
        overlap, meets = overlap_of(particles, group.x[p], group.initial[p], stretch_along(F, a), spacing, (a, side))
        if meets:
            # The slip by now: with that before the last motion the spring would lag behind, and feed vibrations.
            slip, length = ti.Vector.zero(float, d), 0.0
            along = ti.Vector.zero(float, d)
            for k in ti.static(range(len(particles.moving.faces))):
                if ti.static(particles.moving.faces[k] == (a, side)):
                    for c in ti.static(range(d)):
                        along[c] = particles.moving.of(k)[c]
            for c in ti.static(range(d)):
                if ti.static(c != a):
                    slip[c] = group.slip[p][c] + kick * (v[c] - along[c])
                    length += slip[c] ** 2
            length, allowed = ti.sqrt(length), particles.friction.of(f) * overlap
            if length > allowed:
                slip *= allowed / length
            for c in ti.static(range(d)):
                total[c] -= stiffness * slip[c]
                # In an edge the wall that lets it slip less counts. Away from walls nothing is remembered.
                if ti.abs(slip[c]) > ti.abs(kept[c]):
                    kept[c] = slip[c]
    if counts:
        for c in ti.static(range(d)):
            group.slip[p][c] = kept[c]
    return total
