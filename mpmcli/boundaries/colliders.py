"""Colliders in kernels: what the nodes that they cover may do, where they are, and what they have taken.

Which colliders there are, where, and how they move are data: runs that differ in them share kernels, which know only
the forms that occur (docs/theory.md, 3.8).
"""

import math
from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.boundaries.collider_kind import (
    BOX,
    FORMS,
    GRID,
    REACH,
    SLIP,
    STICK,
    WALLS,
    ColliderKind,
    form_code,
    numbers_of,
    reach_of,
)
from mpmcli.boundaries.distances import DISTANCES, BoxDistance
from mpmcli.boundaries.grid_distance import GridDistance, samples_of
from mpmcli.scene import Scene


@ti.data_oriented
class Colliders:
    """The colliders of some runs.

    Attributes:
        kind: what is compiled, with the room for each run.
        turns: numbers of a torque: 1 in 2D, 3 in 3D; loads: of a force and a torque.
        rows: rows of nodes of a run, along the last axis; run: whose colliders act; spacing: h, m.
        taken: impulse, N s, and angular impulse about the pivot, N m s, of each collider, by rows of nodes.
        deterministic: whether the nodes of a row are added up in their order; then `given` is the impulse that each
            node gives each collider in a step, N s, else None.
    """

    def __init__(
        self,
        kind: ColliderKind,
        dimension: int,
        shape: Sequence[int],
        first: int,
        runs: int,
        *,
        on_cpu: bool,
        deterministic: bool = False,
    ) -> None:
        """Allocate colliders on a grid with `shape` nodes per axis, whose node `first` is the lower corner."""
        d, n = dimension, runs * kind.count
        self.kind, self.dimension, self.shape, self.first, self.on_cpu = kind, d, tuple(shape), first, on_cpu
        self.room, self.run, self.spacing = kind.count, 0, 0.0
        self.turns = 1 if d == 2 else 3
        self.loads = d + self.turns
        self.rows = math.prod(shape[:-1])
        self.distances = tuple((code, DISTANCES[FORMS[code]](d)) for code in kind.forms if code != GRID)
        self.numbers = ti.field(float, shape=runs * kind.numbers)
        self.boxes, self.box = BOX in kind.forms, BoxDistance(d)
        self.grids = kind.samples > 0
        if self.grids:
            self.samples = ti.field(ti.f32, shape=runs * kind.samples)
            self.grid_distance = GridDistance(d, self.samples)
            self.sample = ti.field(int, shape=n)
        # Of each: form, what the surface does, first of its numbers, and -1 for a container, else 1.
        self.form, self.wall = ti.field(int, shape=n), ti.field(int, shape=n)
        self.begin, self.side = ti.field(int, shape=n), ti.field(int, shape=n)
        self.friction = ti.field(float, shape=n)
        # Where the pivot is, relative to the lower corner, m, how it is turned, and the nodes that it may act on.
        self.place = ti.Vector.field(d, float, shape=n)
        self.turned = ti.Matrix.field(d, d, float, shape=n)
        self.reach = ti.Matrix.field(2, d, float, shape=n)
        # Velocity of the pivot, m/s, and (R' - I) / dt, R' the rotation in a step, 1/s.
        self.velocity = ti.Vector.field(d, float, shape=n)
        self.turning = ti.Matrix.field(d, d, float, shape=n)
        self.count = ti.field(int, shape=runs)
        self.taken = ti.Vector.field(self.loads, ti.f64 if on_cpu else float, shape=n * self.rows)
        self.deterministic = deterministic
        self.given = ti.Vector.field(d, float, shape=n * math.prod(shape)) if deterministic else None

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the colliders of a run, at time 0."""
        h, origin = scene.domain.spacing, np.array(scene.domain.origin)
        self.count[run] = len(scene.colliders)
        used, sampled = run * self.kind.numbers, run * self.kind.samples
        for k, collider in enumerate(scene.colliders):
            i = run * self.room + k
            numbers = numbers_of(collider, h)
            self._write_numbers(used, np.array(numbers))
            if form_code(collider) == GRID:
                values = samples_of(collider.form, h)[0].ravel()
                self._write_samples(sampled, values)
                self.sample[i] = sampled
                sampled += values.size
            self.form[i], self.wall[i], self.begin[i] = form_code(collider), WALLS[collider.wall], used
            self.side[i] = -1 if collider.side == "inside" else 1
            self.friction[i] = collider.friction
            used += len(numbers)
            place, turned = collider.motion.pose(0.0)
            self.place[i] = (place - origin).tolist()
            self.turned[i] = turned.tolist()
            self.reach[i] = reach_of(collider, h).tolist()
            self.velocity[i] = [0.0] * self.dimension
            self.turning[i] = np.zeros((self.dimension, self.dimension)).tolist()
        self.clear_taken(run)

    @ti.kernel
    def _write_numbers(self, first: int, numbers: ti.types.ndarray(ti.f64, 1)):
        for k in range(numbers.shape[0]):
            self.numbers[first + k] = ti.cast(numbers[k], float)

    @ti.kernel
    def _write_samples(self, first: int, values: ti.types.ndarray(ti.f32, 1)):
        for k in range(values.shape[0]):
            self.samples[first + k] = values[k]

    @ti.kernel
    def clear_taken(self, run: int):
        """Forget what the colliders of a run have taken."""
        for q in range(self.rows * self.room):
            self.taken[run * self.rows * self.room + q] = ti.Vector.zero(ti.f64, self.loads)

    @ti.func
    def sum_up(self, run: int, frame: int, column: int, notes: ti.template()):
        """Store what the colliders of a run have taken in notes[run, frame], from a column on, and forget it."""
        for k in range(self.room):
            total = ti.Vector.zero(ti.f64, self.loads)
            for row in range(self.rows):
                place = (run * self.rows + row) * self.room + k
                for a in ti.static(range(self.loads)):
                    total[a] += self.taken[place][a]
                    self.taken[place][a] = ti.cast(0, ti.f64)
            for a in ti.static(range(self.loads)):
                notes[run, frame, column + k * self.loads + a] = total[a]

    @ti.func
    def row_of(self, node: ti.template()):
        """Return the row of a node."""
        row = 0
        for a in ti.static(range(self.dimension - 1)):
            row = row * ti.static(self.shape[a]) + node[a]
        return row

    @ti.func
    def take(self, row: int, k: int, impulse: ti.template(), arm: ti.template()):
        """Book the impulse that collider k has taken, N s, at an arm from its pivot, m."""
        place = (self.run * self.rows + row) * self.room + k
        load = self.load_of(impulse, arm)
        for a in ti.static(range(self.loads)):
            if ti.static(self.on_cpu):
                # Parts of a step share no row.
                self.taken[place][a] = self.taken[place][a] + ti.cast(load[a], ti.f64)
            else:
                ti.atomic_add(self.taken[place][a], load[a])

    @ti.func
    def load_of(self, impulse: ti.template(), arm: ti.template()):
        """Return an impulse, N s, at an arm, m, with its angular impulse, N m s."""
        d = ti.static(self.dimension)
        load = ti.Vector.zero(float, ti.static(self.loads))
        for a in ti.static(range(d)):
            load[a] = impulse[a]
        if ti.static(d == 2):
            load[2] = arm[0] * impulse[1] - arm[1] * impulse[0]
        else:
            for a in ti.static(range(3)):
                b, c = ti.static((a + 1) % 3), ti.static((a + 2) % 3)
                load[3 + a] = arm[b] * impulse[c] - arm[c] * impulse[b]
        return load

    @ti.func
    def book_row(self, q: int):
        """Book what collider q % room has taken from the nodes of row q // room in a step, in their order."""
        d = ti.static(self.dimension)
        nodes = ti.static(self.shape[-1])
        k, rest = q % self.room, q // self.room
        first = rest * nodes
        x = ti.Vector.zero(float, d)
        for b in ti.static(range(d - 1)):
            a = ti.static(d - 2 - b)
            x[a] = ti.cast(rest % ti.static(self.shape[a]) - self.first, float) * self.spacing
            rest = rest // ti.static(self.shape[a])
        if k < self.count[0]:
            near = True
            for a in ti.static(range(d - 1)):
                arm = x[a] - self.place[k][a]
                near = near and arm >= self.reach[k][0, a] and arm <= self.reach[k][1, a]
            if near:
                total = ti.Vector.zero(float, ti.static(self.loads))
                for n in range(nodes):
                    x[ti.static(d - 1)] = ti.cast(n - self.first, float) * self.spacing
                    load = self.load_of(self.given[(first + n) * self.room + k], x - self.place[k])
                    for a in ti.static(range(self.loads)):
                        total[a] += load[a]
                    for a in ti.static(range(d)):
                        self.given[(first + n) * self.room + k][a] = 0.0
                for a in ti.static(range(self.loads)):
                    self.taken[q][a] = self.taken[q][a] + total[a]

    @ti.func
    def constrain(self, node: ti.template(), velocity: ti.template(), mass: float):
        """Return the velocity, m/s, of a node that has a mass, kg, after the colliders, which take the rest."""
        d = ti.static(self.dimension)
        result = ti.Vector.zero(float, d)
        x = ti.Vector.zero(float, d)
        for a in ti.static(range(d)):
            result[a] = velocity[a]
            x[a] = ti.cast(node[a] - self.first, float) * self.spacing
        for k in range(self.count[self.run]):
            i = self.run * self.room + k
            arm = x - self.place[i]
            near = True
            for a in ti.static(range(d)):
                near = near and arm[a] >= self.reach[i][0, a] and arm[a] <= self.reach[i][1, a]
            if near:
                for face in range(self.faces_of(i)):
                    phi, normal = self.distance(i, arm, face)
                    if phi <= REACH * self.spacing:
                        after = self.met(i, arm, normal, result)
                        if ti.static(self.deterministic):
                            place = (self.row_of(node) * ti.static(self.shape[-1]) + node[d - 1]) * self.room + k
                            for a in ti.static(range(d)):
                                self.given[place][a] = self.given[place][a] + mass * (result[a] - after[a])
                        else:
                            self.take(self.row_of(node), k, mass * (result - after), arm)
                        for a in ti.static(range(d)):
                            result[a] = after[a]
        return result

    @ti.func
    def faces_of(self, i: int):
        """Return the number of faces of collider i that act in turn: of a box around the material one per axis.

        In its edges the material meets several at once; elsewhere the nearest point of a surface says all.
        """
        count = 1
        if ti.static(self.boxes):
            if self.form[i] == BOX and self.side[i] < 0:
                # `count = ti.static(...)` would name a constant, and store nothing.
                count += ti.static(self.dimension - 1)
        return count

    @ti.func
    def distance(self, i: int, arm: ti.template(), face: int):
        """Return the distance of a place from a face of collider i, m, and the normal into the material."""
        d = ti.static(self.dimension)
        y = self.turned[i].transpose() @ arm
        phi, own = 1e30, ti.Vector.zero(float, d)
        for code, form in ti.static(self.distances):
            if self.form[i] == code:
                found, normal = form.at(self.numbers, self.begin[i], y)
                phi = found
                for a in ti.static(range(d)):
                    own[a] = normal[a]
        if ti.static(self.boxes):
            if self.faces_of(i) > 1:
                found, normal = self.box.face(self.numbers, self.begin[i], y, face)
                phi = found
                for a in ti.static(range(d)):
                    own[a] = normal[a]
        if ti.static(self.grids):
            if self.form[i] == GRID:
                found, normal = self.grid_distance.at(self.numbers, self.begin[i], self.sample[i], y)
                phi = found
                for a in ti.static(range(d)):
                    own[a] = normal[a]
        side = ti.cast(self.side[i], float)
        return side * phi, side * (self.turned[i] @ own)

    @ti.func
    def met(self, i: int, arm: ti.template(), normal: ti.template(), velocity: ti.template()):
        """Return the velocity of a node that collider i covers."""
        own = self.velocity[i] + self.turning[i] @ arm
        relative = velocity - own
        away = relative.dot(normal)
        along = relative - away * normal
        kept = 1.0
        if self.wall[i] == STICK:
            kept, away = 0.0, 0.0
        elif away < 0.0 or self.wall[i] == SLIP:
            push, size = -away, along.norm()
            away = 0.0
            if push > 0.0 and self.friction[i] > 0.0:
                kept = ti.max(1.0 - self.friction[i] * push / size, 0.0) if size > 0.0 else 0.0
        return own + kept * along + away * normal
