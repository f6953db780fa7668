"""Coulomb friction between particles that push each other, and between particles and walls that push them.

A particle in contact remembers how far it has slipped, as a spring with a slider does: friction pulls back with the
stiffness of the push, and at most with the coefficient times the push (Cundall and Strack 1979; docs/theory.md, 2.7).
"""

import taichi as ti

from mpmcli.boundaries.rough_faces import rough_faces
from mpmcli.scene import Scene
from mpmcli.solver.particle_arrays import MASS, VOLUME
from mpmcli.solver.particle_contact import rub
from mpmcli.solver.reference_grid import overlap_of, stretch_along


def slips_in(scene: Scene) -> bool:
    """Return whether particles of a scene remember how far they slipped."""
    between = scene.contact.friction > 0 and len(scene.bodies) > 1
    return scene.solver.solids == "total" and (between or bool(rough_faces(scene)))


@ti.func
def contact_push(particles: ti.template(), group: ti.template(), p: int, kick: float):
    """Return the acceleration of a particle by those of other bodies and by friction, m/s^2; it remembers its slip."""
    d = ti.static(group.dimension)
    push = ti.Vector.zero(float, d)
    # Of all contacts: slip velocity times push, push, the friction that it allows, and what the springs ask for.
    sums = ti.Vector.zero(float, d + 3)
    if ti.static(particles.touches):
        force, found = particles.contact.push(group, p, particles.grid.spacing, particles.run, kick)
        for c in ti.static(range(d)):
            push[c] = force[c]
        for c in ti.static(range(d + 3)):
            sums[c] = found[c]
    if ti.static(group.slips):
        force, found = wall_friction(particles, group, p, kick)
        for c in ti.static(range(d)):
            push[c] += force[c]
        sums += found
        kept = 1.0
        if sums[d + 2] > sums[d + 1]:
            kept = sums[d + 1] / sums[d + 2]
        for c in ti.static(range(d)):
            # Without contact nothing is remembered.
            slip = 0.0
            if sums[d] > 0.0:
                slip = kept * (group.slip[p][c] + kick * sums[c] / sums[d])
            group.slip_after[p][c] = slip
    return push


@ti.func
def wall_friction(particles: ti.template(), group: ti.template(), p: int, kick: float):
    """Return the acceleration of a particle by friction of the walls that push it, and the sums of `contact_push`."""
    d = ti.static(group.dimension)
    row, x, X, F = group.row(p), group.x[p], group.initial[p], group.stored(p)
    v, _ = group.motion(p)
    spacing = row[VOLUME] ** ti.static(1.0 / group.dimension)
    stiffness = group.law.wave_modulus(group.constants(p)) * row[VOLUME] / (spacing * particles.grid.spacing)
    total, sums = ti.Vector.zero(float, d), ti.Vector.zero(float, d + 3)
    for f in ti.static(range(len(particles.friction.faces))):
        a = ti.static(particles.friction.faces[f][0])
        side = ti.static(particles.friction.faces[f][1])
        overlap, meets = overlap_of(particles, x, X, stretch_along(F, a), spacing, a, side)
        if meets:
            n = ti.Vector.zero(float, d)
            n[a] = 1.0
            force, found = rub(group.slip[p], v, n, kick, stiffness, stiffness * overlap, particles.friction.of(f))
            total += force
            sums += found
    return total / row[MASS], sums
