"""Coulomb friction of walls that push particles of bodies on the grid of their state at rest.

A particle remembers how far it has slipped along a wall, as a spring with a slider does: friction pulls it back with
the stiffness of the push, and at most with the coefficient times the push (Cundall and Strack 1979; docs/theory.md,
3.4). Friction that only stops the velocity would let a particle creep by what others pull at it in each step.
"""

from collections.abc import Sequence

import taichi as ti

from mpmcli.scene import SolverSettings
from mpmcli.solver.particle_arrays import VOLUME
from mpmcli.solver.reference_grid import overlap_of, stiffness_of, stretch_along


def slips_in(settings: SolverSettings, rough: Sequence[tuple[int, int]]) -> bool:
    """Return whether particles remember how far they slipped; `rough` are the faces with friction."""
    return settings.solids == "total" and len(rough) > 0


@ti.func
def friction_of_walls(particles: ti.template(), group: ti.template(), p: int, kick: float, counts: bool):
    """Return the acceleration of a particle by friction of the walls that push it, m/s^2.

    Args:
        kick: the time of the last motion, s.
        counts: whether the particle remembers its slip after that motion.
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
        overlap, meets = overlap_of(particles, group.x[p], group.initial[p], stretch_along(F, a), spacing, a, side)
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
