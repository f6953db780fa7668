"""Gravity, which may depend on time, and external forces, which are expressions.

They advance the velocity from the middle of the last step to that of this one, which moves particles to x_(n+1)
(docs/theory.md, 7.1). Leapfrog evaluates a force at x_n; what depends on time alone is its mean over that time.
Gravity acts on the nodes; a force acts on its particles, before their momentum is scattered.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.scene import Scene
from mpmcli.scene.entry import tree_of
from mpmcli.scene.expression import INITIAL, POSITION, Number, Tree, names_in
from mpmcli.scene.schema import Force
from mpmcli.solver.backend import Backend
from mpmcli.solver.expression_kernels import node_of
from mpmcli.solver.particle_arrays import ParticleArrays
from mpmcli.solver.run_values import DeviceValues, Entries, Place
from mpmcli.solver.state_bounds import build_maxima

# Half of the distance of the differences for the slope of a force, cells.
REACH = 0.5
# A slope beyond this counts as zero, as does NaN where a force is undefined next to a particle.
STEEPEST = 1e30
# Taichi inlines a tree recursively, about 20 calls deep for each level.
RECURSION = 4000


def forces_on(scene: Scene, members: Sequence[int]) -> tuple[Force, ...]:
    """Return the forces that act on any of some bodies, given by their indices."""
    names = {scene.sources[i].name for i in members}
    return tuple(force for force in scene.pushes if force.body is None or force.body in names)


def needs_initial(scene: Scene, members: Sequence[int]) -> bool:
    """Return whether any force on these bodies depends on the initial position."""
    trees = [tree_of(entry) for force in forces_on(scene, members) for entry in force.acceleration]
    return any(names_in(tree) & set(INITIAL) for tree in trees)


@dataclass(frozen=True)
class Term:
    """A force on particles of one law.

    Attributes:
        place: of its body in the group, -1 for all of them.
        axes: each axis along which it acts, with its tree.
    """

    place: int
    axes: tuple[tuple[int, Tree | Place], ...]


@dataclass(frozen=True)
class ForceTerms:
    """Forces on particles of one law, as a kernel computes them; runs for which they are equal share kernels.

    Attributes:
        terms: the forces.
        moves: whether any of them depends on the position.
        initial: whether any of them depends on the initial position.
        reach, slope: half of the distance of differences, m, and the inverse of the distance.
    """

    terms: tuple[Term, ...]
    moves: bool
    initial: bool
    reach: Tree | Place
    slope: Tree | Place

    @staticmethod
    def of(scene: Scene, members: Sequence[int], entries: Entries, *, several: bool) -> "ForceTerms":
        """Return the forces on some bodies, given by their indices, with the numbers that they add to `entries`.

        Args:
            several: whether particles know their body.
        """
        forces = forces_on(scene, members)
        names = [scene.sources[i].name for i in members]
        terms, found = [], frozenset()
        for force in forces:
            trees = [tree_of(entry) for entry in force.acceleration]
            axes = tuple((axis, entries.placed(tree)) for axis, tree in enumerate(trees) if tree != Number(0.0))
            everywhere = force.body is None or not several
            terms.append(Term(-1 if everywhere else names.index(force.body), axes))
            found |= frozenset().union(*map(names_in, trees))
        reach = REACH * scene.domain.spacing if forces else math.inf
        # Without forces there is nothing to read.
        number = entries.number if forces else Number
        return ForceTerms(
            tuple(terms), bool(found & set(POSITION)), bool(found & set(INITIAL)), number(reach), number(0.5 / reach)
        )


def gravity_terms(scene: Scene, entries: Entries) -> tuple[Tree | Place, ...]:
    """Return gravity along each axis, with the numbers that it adds to `entries`; nothing where it is steady."""
    return () if scene.domain.steady else tuple(entries.placed(tree_of(entry)) for entry in scene.domain.gravity)


@ti.data_oriented
class Gravity:
    """Gravity: a constant of the kernels where it is steady, otherwise numbers of the run."""

    def __init__(self, terms: Sequence[Tree | Place], constant: Sequence[float], values: DeviceValues | None) -> None:
        self.dimension = len(constant)
        self.steady = not terms
        self.constant = list(constant)
        self.nodes = tuple((axis, node_of(tree, values)) for axis, tree in enumerate(terms))

    @ti.func
    def in_step(self, kick: float, run: int):
        """Return the change of velocity by gravity in `kick` seconds, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        if ti.static(self.steady):
            for a in ti.static(range(self.dimension)):
                result[a] = kick * self.constant[a]
        for a, node in ti.static(self.nodes):
            result[a] = kick * node.evaluate(result, result, run)
        return result


@ti.data_oriented
class GroupForce:
    """All forces on one group of particles.

    Attributes:
        spreads: whether their slope is known: they depend on the position, and none on the initial position, whose own
            slope is that of the motion so far.
    """

    def __init__(self, dimension: int, forces: ForceTerms, values: DeviceValues | None, room: int) -> None:
        """Build the nodes; `room` is the number of bodies that each run may have in the group."""
        self.dimension = dimension
        self.terms = tuple(
            (term.place, tuple((axis, node_of(tree, values)) for axis, tree in term.axes)) for term in forces.terms
        )
        self.moves, self.spreads = forces.moves, forces.moves and not forces.initial
        self.reach, self.slope = node_of(forces.reach, values), node_of(forces.slope, values)
        self.room = room
        sys.setrecursionlimit(max(sys.getrecursionlimit(), RECURSION))

    @ti.func
    def at(self, group: ti.template(), p: int, x: ti.template(), X: ti.template()):
        """Return the acceleration of particle p, m/s^2, if it were at x."""
        result = ti.Vector.zero(float, self.dimension)
        for place, axes in ti.static(self.terms):
            if ti.static(place < 0):
                for axis, node in ti.static(axes):
                    result[axis] += node.evaluate(x, X, group.run)
            else:
                if group.body[p] - group.run * self.room == ti.static(place):
                    for axis, node in ti.static(axes):
                        result[axis] += node.evaluate(x, X, group.run)
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
        here = group.place(p)
        for c in ti.static(range(d)):
            x[c] = here[c]
            if ti.static(group.keeps_initial):
                X[c] = group.initial[p][c]
        if ti.static(self.moves and with_slope):
            reach, inverse = self.reach.evaluate(x, X, group.run), self.slope.evaluate(x, X, group.run)
            # In a loop, so that the expressions are compiled once: up and down along each axis, then in place.
            for k in range(2 * d + 1):
                place = x
                for b in ti.static(range(d)):
                    if k == 2 * b:
                        place[b] += reach
                    if k == 2 * b + 1:
                        place[b] -= reach
                value = self.at(group, p, place, X)
                for b in ti.static(range(d)):
                    for c in ti.static(range(d)):
                        if k == 2 * b:
                            slope[c, b] += value[c] * inverse
                        if k == 2 * b + 1:
                            slope[c, b] -= value[c] * inverse
                if k == 2 * d:
                    a = value
            for b in ti.static(range(d)):
                for c in ti.static(range(d)):
                    slope[c, b] = ti.select(ti.abs(slope[c, b]) < STEEPEST, slope[c, b], 0.0)
        else:
            a = self.at(group, p, x, X)
        return a, slope


def build_push(group: ParticleArrays, backend: Backend) -> Callable[[int, int, int], tuple[float, float]]:
    """Compile-ready measurement of the force on particles of a run: largest |a|, m/s^2, and row sum of |da/dx|, 1/s^2.

    It takes the first particle, their number, and the number of the run.
    """

    @ti.func
    def widen_one(own: ti.template(), view: ti.template(), p: int):
        a, slope = view.force.acceleration(view, p, True)
        own[0] = ti.max(own[0], a.norm_sqr())
        for c in ti.static(range(view.dimension)):
            row = 0.0
            for b in ti.static(range(view.dimension)):
                row += ti.abs(slope[c, b])
            own[1] = ti.max(own[1], row)

    @ti.func
    def widen(own: ti.template(), p: int, run: int):
        for view in ti.static((group.seen_from(run),)):
            widen_one(own, view, p)

    measure = build_maxima(2, widen, backend)

    def largest(first: int, count: int, run: int) -> tuple[float, float]:
        square, slope = measure(first, count, run)
        return float(square**0.5), slope

    return largest
