"""Gravity, which may depend on time, and external forces, which are expressions.

They advance the velocity from the middle of the last step to that of this one, which moves particles to x_(n+1)
(docs/theory.md, 7.1). Leapfrog evaluates a force at x_n; what depends on time alone is its mean over that time.
Gravity acts on the nodes; a force acts on its particles, before their momentum is scattered.
"""

import sys
from collections.abc import Callable, Sequence

import numpy as np
import taichi as ti

from mpmcli.scene import Scene
from mpmcli.scene.entry import Entry
from mpmcli.scene.expression import INITIAL, POSITION, Number, Tree, names_in
from mpmcli.scene.schema import Force
from mpmcli.solver.backend import Backend
from mpmcli.solver.expression_kernels import Clock, node_of
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.state_bounds import build_maxima

# Half of the distance of the differences for the slope of a force, cells.
REACH = 0.5
# A slope beyond this counts as zero, as does NaN where a force is undefined next to a particle.
STEEPEST = 1e30
# Taichi inlines a tree recursively, about 20 calls deep for each level.
RECURSION = 4000


def tree_of(entry: Entry) -> Tree:
    """Return the tree of a number or an expression."""
    return Number(entry) if isinstance(entry, float) else entry.tree


def forces_on(scene: Scene, members: Sequence[int]) -> tuple[Force, ...]:
    """Return the forces that act on any of some bodies, given by their indices."""
    names = {scene.bodies[i].name for i in members}
    return tuple(force for force in scene.forces if force.body is None or force.body in names)


def needs_initial(scene: Scene, members: Sequence[int]) -> bool:
    """Return whether any force on these bodies depends on the initial position."""
    trees = [tree_of(entry) for force in forces_on(scene, members) for entry in force.acceleration]
    return any(names_in(tree) & set(INITIAL) for tree in trees)


@ti.data_oriented
class Gravity:
    """Gravity: a constant of the kernels where it is steady, otherwise a value of the clock."""

    def __init__(self, scene: Scene, clock: Clock) -> None:
        self.dimension = scene.dimension
        self.steady = scene.domain.steady
        self.constant = scene.domain.gravity_at(0.0).tolist()
        self.clock = clock
        self.places = () if self.steady else tuple(clock.place_of(tree_of(entry)) for entry in scene.domain.gravity)

    @ti.func
    def in_step(self, kick: float):
        """Return the change of velocity by gravity in `kick` seconds, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            if ti.static(self.steady):
                result[a] = kick * self.constant[a]
            else:
                result[a] = kick * self.clock.values[None][ti.static(self.places[a])]
        return result


class _Term:
    """One force: the place of its body in the group, -1 for all of them, and a node per axis, None for a zero."""

    def __init__(self, place: int, nodes: tuple[object, ...]) -> None:
        self.place = place
        self.nodes = tuple((axis, node) for axis, node in enumerate(nodes) if node is not None)


@ti.data_oriented
class GroupForce:
    """All forces on one group of particles.

    Attributes:
        terms: the forces.
        moves: whether any of them depends on the position.
        spreads: whether their slope is known: no force depends on the initial position, whose own slope is that of the
            motion so far.
    """

    def __init__(self, scene: Scene, group: ParticleGroup, clock: Clock) -> None:
        self.dimension = scene.dimension
        origin = np.array(scene.domain.origin)
        names = [scene.bodies[i].name for i in group.bodies]
        terms, trees = [], []
        for force in forces_on(scene, group.bodies):
            own = [tree_of(entry) for entry in force.acceleration]
            nodes = tuple(None if tree == Number(0.0) else node_of(tree, origin, clock) for tree in own)
            everywhere = force.body is None or not group.several
            terms.append(_Term(-1 if everywhere else names.index(force.body), nodes))
            trees += own
        self.terms = tuple(terms)
        self.moves = any(names_in(tree) & set(POSITION) for tree in trees)
        self.spreads = self.moves and not needs_initial(scene, group.bodies)
        self.reach = REACH * scene.domain.spacing
        sys.setrecursionlimit(max(sys.getrecursionlimit(), RECURSION))

    @ti.func
    def at(self, group: ti.template(), p: int, x: ti.template(), X: ti.template()):
        """Return the acceleration of particle p, m/s^2, if it were at x."""
        result = ti.Vector.zero(float, self.dimension)
        for term in ti.static(self.terms):
            if ti.static(term.place < 0):
                for axis, node in ti.static(term.nodes):
                    result[axis] += node.evaluate(x, X)
            else:
                if group.body[p] == ti.static(term.place):
                    for axis, node in ti.static(term.nodes):
                        result[axis] += node.evaluate(x, X)
        return result

    @ti.func
    def acceleration(self, group: ti.template(), p: int, with_slope: ti.template()):
        """Return the acceleration a of particle p, and its slope da/dx, d x d, at fixed X: zeros without `with_slope`.

        The slope is that of central differences at the scale of the grid: exact where a is linear or quadratic in x, so
        that a force that is linear in x drives a body affinely up to its surface.
        """
        d = ti.static(self.dimension)
        x = ti.Vector.zero(float, d)
        X = ti.Vector.zero(float, d)
        a = ti.Vector.zero(float, d)
        slope = ti.Matrix.zero(float, d, d)
        for c in ti.static(range(d)):
            x[c] = group.x[p][c]
            if ti.static(group.keeps_initial):
                X[c] = group.initial[p][c]
        if ti.static(self.moves and with_slope):
            # In a loop, so that the expressions are compiled once: up and down along each axis, then in place.
            for k in range(2 * d + 1):
                place = x
                for b in ti.static(range(d)):
                    if k == 2 * b:
                        place[b] += ti.static(self.reach)
                    if k == 2 * b + 1:
                        place[b] -= ti.static(self.reach)
                value = self.at(group, p, place, X)
                for b in ti.static(range(d)):
                    for c in ti.static(range(d)):
                        if k == 2 * b:
                            slope[c, b] += value[c] * ti.static(0.5 / self.reach)
                        if k == 2 * b + 1:
                            slope[c, b] -= value[c] * ti.static(0.5 / self.reach)
                if k == 2 * d:
                    a = value
            for b in ti.static(range(d)):
                for c in ti.static(range(d)):
                    slope[c, b] = ti.select(ti.abs(slope[c, b]) < STEEPEST, slope[c, b], 0.0)
        else:
            a = self.at(group, p, x, X)
        return a, slope


def build_push(group: ParticleGroup, backend: Backend) -> Callable[[], tuple[float, float]]:
    """Compile-ready measurement of the force on a group: largest |a|, m/s^2, and largest row sum of |da/dx|, 1/s^2."""

    @ti.func
    def widen(own: ti.template(), p: int):
        a, slope = group.force.acceleration(group, p, True)
        own[0] = ti.max(own[0], a.norm_sqr())
        for c in ti.static(range(group.dimension)):
            row = 0.0
            for b in ti.static(range(group.dimension)):
                row += ti.abs(slope[c, b])
            own[1] = ti.max(own[1], row)

    measure = build_maxima(group.count, 2, widen, backend)

    def largest() -> tuple[float, float]:
        square, slope = measure()
        return float(square**0.5), slope

    return largest
