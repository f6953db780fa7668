"""Elastic bodies with `solids = "total"`: grid of the state at rest, and contact.

Particles scatter and gather at their positions X at rest, with the first Piola-Kirchhoff stress P = tau F^-T and dv/dX:
total Lagrangian (docs/theory.md, 2.6; de Vaucorbeil, Nguyen, Hutchinson 2020). Stencils never change. Contact during
the run does not use this grid: walls push particles, and particles of different bodies repel each other. For this
purpose particles are stored in bins, two cells wide, by their positions at the last sort. Forces act along the line
between two particles, so that momentum and angular momentum are conserved (docs/theory.md, 2.7).
"""

import math
from collections.abc import Sequence

from mpmcli.boundaries.feature import Feature
from mpmcli.quick_taichi import ti
from mpmcli.scene import SolverSettings
from mpmcli.scene.domain import SEPARATING
from mpmcli.solver.contact.surfaces import EMPTY
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import MASS, VOLUME, ParticleArrays

# A body that starts within this distance, cells, of a slipping or sticking wall is permanently held by that wall.
HOLDING_DISTANCE = 1.0


@ti.func
def pulled_back(tau: ti.template(), F: ti.template()):
    """Return the first Piola-Kirchhoff stress tau F^-T of a Kirchhoff stress tau."""
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
    """Return the acceleration, m/s^2, by walls of a particle at x, m, with position X at rest, m.

    A particle is the ellipse to which F deforms a ball with the diameter of the particle spacing s. If it overlaps a
    wall by g, the wall accelerates it by (lambda + 2 mu) V / (m s h) g, about as stiff as the material. `row` is the
    row of the table.
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
    """Return |F^T n| with n along axis a."""
    stretched = 0.0
    for b in ti.static(range(F.m)):
        stretched += F[a, b] * F[a, b]
    return ti.sqrt(stretched)


@ti.func
def overlap_of(
    particles: ti.template(), x: ti.template(), X: ti.template(), stretched: float, spacing: float, face: ti.template()
):
    """Return the overlap of a particle with a wall, m, and whether the wall pushes it."""
    a, side = ti.static(face)
    distance, at_rest = x[a], X[a]
    if ti.static(side == 1):
        distance, at_rest = particles.extent[a] - x[a], particles.extent[a] - X[a]
    # A body that initially touches the wall starts without a push, whatever its spacing along this axis.
    overlap = ti.min(0.5 * spacing, at_rest) * stretched - distance
    meets = overlap > 0.0
    if ti.static(particles.faces[a][side] not in SEPARATING):
        meets = meets and at_rest >= HOLDING_DISTANCE * particles.grid.spacing
    return overlap, meets


def slips_in(settings: SolverSettings, rough: Sequence[tuple[int, int]]) -> bool:
    """Return whether particles store their slip; `rough` are the faces with friction."""
    return settings.solids == "total" and len(rough) > 0


@ti.func
def friction_of_walls(particles: ti.template(), group: ti.template(), p: int, kick: float):
    """Return the acceleration, m/s^2, of a particle by friction on the walls that push it.

    Friction acts like a spring with a slider: it is the stiffness of the push times the slip, and at most the
    coefficient times the push (Cundall and Strack 1979; docs/theory.md, 3.4). Friction that only stops the velocity
    would let a particle creep under the forces of other particles in each step.

    `kick` is the duration of the last motion, s; the slip after it is stored.
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
            # The current slip. With the slip before the last motion the spring would lag behind and amplify vibrations.
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
                # In an edge between walls the larger slip per axis is stored. Away from walls the slip is zero.
                if ti.abs(slip[c]) > ti.abs(kept[c]):
                    kept[c] = slip[c]
    for c in ti.static(range(d)):
        group.slip[p][c] = kept[c]
    return total


# Edge of a bin, and largest displacement of particles before they are sorted into bins again, cells.
BIN, DRIFT = 2, 0.2
# Distance from which two particles repel each other, in spacings. The force of a row of particles is then a sum over
# several of them and hardly depends on the position along the row.
RANGE = 1.5
# Owner of a bin with particles of several bodies.
SEVERAL = -2


def bins_along(cells: Sequence[int]) -> tuple[int, ...]:
    """Return the number of bins per axis of a domain, including a margin of one on each side."""
    return tuple(n // BIN + 3 for n in cells)


@ti.data_oriented
class ParticleContact(Feature):
    """Bins of the particles of one law of each run, and the repulsion between their bodies.

    Attributes:
        first: first particle of each bin, or EMPTY.
        following: next particle in the bin of each particle, or EMPTY.
        owner: body of the particles of each bin, EMPTY, or SEVERAL.
        meets: whether another body is in the bin of each particle or in a neighbouring bin.
    """

    def __init__(self, grid: Grid, group: ParticleArrays, runs: int) -> None:
        self.group = group
        self.dimension = grid.dimension
        self.bins = bins_along(grid.cells)
        self.count = math.prod(self.bins)
        self.first = ti.field(int, shape=runs * self.count)
        self.owner = ti.field(int, shape=runs * self.count)
        self.following = ti.field(int, shape=group.x.shape[0])
        self.meets = ti.field(int, shape=group.x.shape[0])

    def saved(self) -> dict[str, ti.Field]:
        return {"contact.first": self.first, "contact.following": self.following, "contact.meets": self.meets}

    @ti.func
    def bin_of(self, x: ti.template(), spacing: float, run: int):
        """Return the linear index of the bin of a position."""
        index = 0
        for a in ti.static(range(self.dimension)):
            along = ti.cast(x[a] / (BIN * spacing), int) + 1
            index = index * ti.static(self.bins[a]) + ti.min(ti.max(along, 1), ti.static(self.bins[a] - 2))
        return run * ti.static(self.count) + index

    @ti.func
    def fill(self, run: int, first: int, count: int, spacing: float):
        """Insert the particles of a run into bins, the last one first in its bin; on one thread."""
        for k in range(run * ti.static(self.count), (run + 1) * ti.static(self.count)):
            self.first[k] = EMPTY
            self.owner[k] = EMPTY
        for p in range(first, first + count):
            k = self.bin_of(self.group.x[p], spacing, run)
            self.following[p] = self.first[k]
            self.first[k] = p
            body = self.group.body[p]
            if self.owner[k] == EMPTY:
                self.owner[k] = body
            elif self.owner[k] != body:
                self.owner[k] = SEVERAL
        for p in range(first, first + count):
            k = self.bin_of(self.group.x[p], spacing, run)
            found = 0
            for beside in range(ti.static(3**self.dimension)):
                owner = self.owner[k + self.offset(beside)]
                if owner != EMPTY and owner != self.group.body[p]:
                    found = 1
            self.meets[p] = found

    @ti.func
    def offset(self, beside: int):
        """Return the difference of linear indices to the neighbouring bin with number `beside`, below 3^d."""
        # The loops over neighbouring bins are not unrolled: 27 copies of their bodies would take a minute to compile.
        result, rest, stride = 0, beside, 1
        for b in ti.static(range(self.dimension)):
            result += (rest % 3 - 1) * stride
            rest = rest // 3
            stride *= ti.static(self.bins[self.dimension - 1 - b])
        return result

    @ti.func
    def push(self, group: ti.template(), p: int, spacing: float, run: int):
        """Return the acceleration of particle p by particles of other bodies, m/s^2."""
        d = ti.static(self.dimension)
        force = ti.Vector.zero(float, d)
        if self.meets[p] == 1:
            x, own = group.x[p], self.stiffness(group, p, spacing)
            # The bins are those of the last sort; particles have moved by less than DRIFT cells since.
            k = self.bin_of(x, spacing, run)
            for beside in range(ti.static(3**self.dimension)):
                q = self.first[k + self.offset(beside)]
                while q != EMPTY:
                    if group.body[q] != group.body[p]:
                        line = x - group.x[q]
                        distance = line.norm()
                        reach = 0.5 * RANGE * (self.spacing_of(group, p) + self.spacing_of(group, q))
                        if distance < 2.0 * reach and distance > 0.0:
                            n = line / distance
                            overlap = 0.5 * RANGE * (self.extent(group, p, n) + self.extent(group, q, n)) - distance
                            if overlap > 0.0:
                                other = self.stiffness(group, q, spacing)
                                force += (own * other / (own + other) * overlap) * n
                    q = self.following[q]
        return force / group.row(p)[MASS]

    @ti.func
    def spacing_of(self, group: ti.template(), p: int):
        return group.row(p)[VOLUME] ** ti.static(1.0 / self.dimension)

    @ti.func
    def extent(self, group: ti.template(), p: int, n: ti.template()):
        """Return the spacing of particle p along n, s |F^T n|, m."""
        return self.spacing_of(group, p) * (group.stored(p).transpose() @ n).norm()

    @ti.func
    def stiffness(self, group: ti.template(), p: int, spacing: float):
        """Return (lambda + 2 mu) V / (s h) of particle p, N/m."""
        volume = group.row(p)[VOLUME]
        return group.law.wave_modulus(group.constants(p)) * volume / (self.spacing_of(group, p) * spacing)
