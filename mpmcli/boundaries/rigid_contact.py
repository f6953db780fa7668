"""Contact of rigid bodies with walls, colliders and each other: points of their surfaces against signed distances.

Each point touches only the nearest obstacle. The point of a ball is that which faces the obstacle. Impulses at the
points are found by sweeps of projected Gauss-Seidel; they do not pull, and obey Coulomb friction. A point that would
penetrate a surface in the step ends on it, or separates from it according to the coefficient of restitution. A fraction
of an existing penetration is removed in each step.

A step in which a point arrives at a surface has parts, so that points that touch later have no share of an earlier
impulse.
"""

import math

import numpy as np

from mpmcli.boundaries.colliders import HOLD, STICK, contact_points
from mpmcli.boundaries.doubles import double_field
from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.domain import OPEN, STICKING
from mpmcli.scene.primitives import Ball

# Distance in cells below which a point may touch an obstacle in a step; fraction of a penetration that a step removes;
# largest number of sweeps; largest change of an impulse in a sweep, over the largest impulse, at which sweeps end.
NEAR, UNDONE, SWEEPS, ENOUGH = 0.6, 0.2, 50, 1e-6
# Smallest change of velocity by an impulse, over that of the free body, at which a point is pushed.
LEAST_YIELDING = 1e-9
# Number of iterations for the point of a ball that faces an obstacle.
LOOKS = 2
# Coefficient of friction of sticking surfaces; codes of a wall and of no obstacle in place of the index of a collider.
STUCK = 1e3
WALL, NO_OBSTACLE = -1, -2
# Results of `look_at_all` other than a number of parts.
CLEAR, CLOSE = 0.0, 0.5
# Rebound of a point that may pass a surface in this step and separates from it in the next.
LATER = -1.0
# Turns of the phase that moves bodies: they take the momentum from nodes, and move, while their contact is resolved.
MOVE_TURNS = 2
# Distance in cells by which a point approaches a surface and angle, rad, by which its body turns in a part of a step;
# largest number of parts.
PART_WAY, PART_TURN, MOST_STEP_PARTS = 1 / 16, 2 * math.pi / 50, 32


@ti.func
def move_part(phases: ti.template(), at: ti.template()):
    """Carry out a turn on the CPU, in one thread of a run."""
    if at.region == 0 and at.part == 0:
        for turn in ti.static(range(MOVE_TURNS)):
            if at.turn == turn:
                move_bodies(phases, at, turn)


@ti.func
def move_item(phases: ti.template(), at: ti.template()):
    """Carry out a turn on a GPU."""
    move_bodies(phases, at, at.turn)


@ti.func
def move_bodies(phases: ti.template(), at: ti.template(), turn: ti.template()):
    """Transfer momentum from nodes to rigid bodies (turn 0), or resolve their contact and move them, in parts (1)."""
    rigid, contact = ti.static((at.features.rigid, phases.device.features.rigid_contact))
    if ti.static(turn == 0):
        rigid.take(at.w, at.run.dt)
    if ti.static(turn == 1):
        colliders, whole = ti.static((at.features.colliders, at.run.dt))
        found = contact.look_at_all(at.w, whole, 0, whole, at.particles.extent, colliders)
        done, parts = 0, 1
        # Written so that a NaN is no number of parts.
        if found > 1:
            parts = ti.cast(ti.ceil(ti.min(found, MOST_STEP_PARTS)), int)
        part = whole / parts
        while done < parts:
            if parts > 1:
                found = contact.look_at_all(at.w, part, part * done, whole, at.particles.extent, colliders)
            # What is far from everything moves freely to the end of the step.
            after = parts
            if found > CLEAR:
                contact.resolve(at.w, part, whole, colliders)
                after = done + 1
            fastest, finite = rigid.move(at.w, part * (after - done))
            done = after
            ti.atomic_max(at.step.speed_squared, fastest)
            if not finite:
                at.step.broken = 1.0


@ti.data_oriented
class RigidContact(Feature):
    """Contact of the bodies of some runs; `faces` are the conditions of the walls, `capacity` the points of a run."""

    def __init__(self, bodies: RigidBodies, faces: tuple[tuple[str, str], ...], runs: int) -> None:
        """Allocate the points and balls of a number of runs, and number the bodies among their colliders."""
        d, self.bodies, self.dimension = bodies.dimension, bodies, bodies.dimension
        self.capacity = bodies.colliders.kind.points
        self.walls = tuple((a, side) for a in range(d) for side in (0, 1) if faces[a][side] != OPEN)
        n = runs * self.capacity
        self.used = ti.field(int, shape=runs)
        # Of each body the radius if it is a ball, m, else 0.
        self.ball = double_field(runs * bodies.count)
        # Of each point: its body, and its position relative to the body.
        self.body, self.point = ti.field(int, shape=n), double_field(n, entries=(d,))
        # Its arm from the centre of its body in this step.
        self.arm = double_field(n, entries=(d,))
        # Whether it may touch an obstacle in this step, and which: the index of a collider, or WALL; its distance,
        # friction and normal, and the impulse.
        self.meets, self.other = ti.field(int, shape=n), ti.field(int, shape=n)
        self.gap, self.friction = double_field(n), double_field(n)
        self.normal, self.impulse = (double_field(n, entries=(d,)) for _ in range(2))
        # Speed at which it separates from an obstacle that it begins to touch, m/s, or LATER.
        self.rebound = double_field(n)
        # Of each collider the index of its body, or -1, and its coefficient of restitution; of each face its friction.
        self.body_of = ti.field(int, shape=bodies.colliders.capacity)
        numbers = np.full(bodies.colliders.capacity, -1, np.int32)
        numbers[list(bodies.free)] = np.arange(bodies.count)
        self.body_of.from_numpy(numbers)
        self.restitution = ti.field(float, shape=runs * bodies.colliders.capacity)
        self.face_friction = ti.field(float, shape=(runs, d, 2))
        self._points = Rows(self.body, self.point, self.other, self.impulse)
        self._balls, self._restitutions = Rows(self.ball), Rows(self.restitution)
        self._runs = Rows(self.used, self.face_friction)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the points of a run."""
        free = [scene.colliders[k] for k in self.bodies.free]
        self._restitutions.write(run * self.bodies.colliders.capacity, [one.restitution for one in scene.colliders])
        radii = [one.form.radius if isinstance(one.form, Ball) else 0.0 for one in free]
        self._balls.write(run * self.bodies.count, radii)
        found = [contact_points(one, scene.domain.spacing) for one in free]
        points = np.concatenate(found)
        own, none = np.repeat(np.arange(len(found)), [len(one) for one in found]), np.full(len(points), NO_OBSTACLE)
        self._points.write(run * self.capacity, own, points, none, np.zeros_like(points))
        words, frictions = scene.domain.walls.faces(self.dimension), scene.domain.frictions
        faces = np.zeros((self.dimension, 2))
        for a, side in self.walls:
            faces[a, side] = STUCK if words[a][side] in STICKING else frictions[a][side]
        self._runs.write(run, [len(points)], [faces])

    def saved(self) -> dict[str, ti.Field]:
        return {"rigid.other": self.other, "rigid.impulse": self.impulse}

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        how = {"turns": MOVE_TURNS, "part": move_part, "item": move_item}
        return (Phase("move_bodies", "runs", "move", **how, words="move rigid bodies"),)

    @ti.func
    def look_at_all(
        self, run: int, dt: ti.f64, gone: ti.f64, whole: ti.f64, extent: ti.template(), colliders: ti.template()
    ):
        """Find what points may touch in dt seconds, a part of a step of `whole` seconds, of which `gone` are over.

        Return CLEAR if there is nothing, CLOSE if no point arrives in time, or in how many parts they should arrive.
        """
        found, first = ti.cast(CLEAR, ti.f64), run * self.capacity
        for q in range(first, first + self.used[run]):
            found = ti.max(found, self.look(run, q, dt, gone, whole, extent, colliders))
        return found

    @ti.func
    def resolve(self, run: int, dt: ti.f64, whole: ti.f64, colliders: ti.template()):
        """Change the momenta of the bodies so that no point penetrates a surface in dt seconds, see `look_at_all`."""
        first = run * self.capacity
        for q in range(first, first + self.used[run]):
            if self.meets[q] == 1:
                self.give(run, q, self.impulse[q])
        sweep, change, most = 0, ti.cast(1, ti.f64), ti.cast(0, ti.f64)
        while sweep < SWEEPS and change > ENOUGH * most:
            change, most = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
            for q in range(first, first + self.used[run]):
                if self.meets[q] == 1:
                    change = ti.max(change, self.push(run, q, dt, colliders))
                    most = ti.max(most, self.impulse[q].norm())
            for j in range(self.bodies.count):
                self.bodies.turn_motor(run * self.bodies.count + j, whole)
            sweep += 1

    @ti.func
    def look(
        self,
        run: int,
        q: int,
        dt: ti.f64,
        gone: ti.f64,
        whole: ti.f64,
        extent: ti.template(),
        colliders: ti.template(),
    ):
        """Find the obstacle that point q may touch in dt seconds; for the result and the times see `look_at_all`.

        If it is the last one, the last impulse is the initial value.
        """
        d = ti.static(self.dimension)
        b = run * self.bodies.count + self.body[q]
        own = self.bodies.numbers[self.body[q]]
        arm, normal = self.bodies.turned(b) @ self.point[q], ti.Vector.zero(ti.f64, d)
        gap, other, friction = ti.cast(0, ti.f64), NO_OBSTACLE, 0.0
        tries = 1
        if self.ball[b] > 0:
            tries += LOOKS
        for k in range(tries):
            if k > 0 and other != NO_OBSTACLE:
                # The point of a ball that faces the obstacle.
                for a in ti.static(range(d)):
                    arm[a] = -self.ball[b] * normal[a]
            gap, other, friction, way = self.nearest(run, b, own, arm, gone, extent, colliders)
            # Entry by entry: Taichi may lose vectors that are assigned as a whole.
            for a in ti.static(range(d)):
                normal[a] = way[a]
        for a in ti.static(range(d)):
            self.arm[q][a] = arm[a]
        self.friction[q] = ti.cast(ti.max(friction, self.rub_of(colliders, run * colliders.capacity + own)), ti.f64)
        pressed = ti.max(self.impulse[q].dot(normal), 0.0)
        if self.other[q] != other:
            pressed = ti.cast(0, ti.f64)
        after = pressed * normal + self.rubbed(q, self.impulse[q] - self.impulse[q].dot(normal) * normal, pressed)
        self.meets[q], self.other[q], self.gap[q] = ti.cast(other != NO_OBSTACLE, int), other, gap
        for a in ti.static(range(d)):
            self.normal[q][a], self.impulse[q][a] = normal[a], after[a]
        self.rebound[q] = 0
        found = ti.cast(CLEAR, ti.f64)
        if other != NO_OBSTACLE:
            found = CLOSE
        if other != NO_OBSTACLE and pressed == 0:
            bounces = self.restitution[run * colliders.capacity + own]
            if other >= 0:
                bounces = ti.max(bounces, self.restitution[run * colliders.capacity + other])
            approach = -self.velocity_of(run, q, dt, colliders).dot(normal)
            if approach * dt > gap:
                found = ti.max(
                    1.0, approach * dt / (PART_WAY * colliders.spacing), self.bodies.spin(b) * dt / PART_TURN
                )
            if bounces > 0 and approach > 0:
                # It separates now or in the next part, whichever is closer to the surface. The velocity is that in the
                # middle of the step: gravity and forces have changed it since, or will.
                pull = self.bodies.kick[b]
                if other >= 0:
                    if self.body_of[other] >= 0:
                        pull -= self.bodies.kick[run * self.bodies.count + self.body_of[other]]
                pulled = (gone / whole - 0.5) * normal.dot(pull)
                parts = ti.max(ti.cast(bounces, ti.f64) * (approach - pulled) - pulled, 0.0)
                self.rebound[q] = parts if 2 * gap < approach * dt else LATER
        return found

    @ti.func
    def nearest(
        self,
        run: int,
        b: int,
        own: int,
        arm: ti.template(),
        gone: ti.f64,
        extent: ti.template(),
        colliders: ti.template(),
    ):
        """Return distance, code, friction and normal of the obstacle nearest to a point, at an arm from body b.

        Stored positions of obstacles that are not bodies are those of the beginning of the step, `gone` seconds ago.
        """
        d = ti.static(self.dimension)
        x, normal = arm, ti.Vector.zero(ti.f64, d)
        for a in ti.static(range(d)):
            x[a] += self.bodies.pose[b, a]
        gap, other, friction = ti.cast(NEAR * colliders.spacing, ti.f64), NO_OBSTACLE, 0.0
        for a, side in ti.static(self.walls):
            away = x[a] if ti.static(side == 0) else ti.cast(extent[a], ti.f64) - x[a]
            if away < gap:
                gap, other, friction = away, WALL, self.face_friction[run, a, side]
                for c in ti.static(range(d)):
                    normal[c] = 0.0
                normal[a] = 1.0 if ti.static(side == 0) else -1.0
        for k in range(colliders.count[run]):
            i = run * colliders.capacity + k
            meets = k != own and colliders.wall[i] != HOLD
            if self.body_of[k] >= 0:
                # The point of a ball that faces this body is nearer, and has the right normal.
                facing = self.ball[run * self.bodies.count + self.body_of[k]] > 0
                meets = meets and not (facing and self.ball[b] == 0)
            if meets:
                place = ti.cast(x, float)
                if self.body_of[k] < 0:
                    moved = colliders.velocity[i] + colliders.turning[i] @ (place - colliders.place[i])
                    place -= ti.cast(gone, float) * moved
                if colliders.covers(i, place):
                    phi, found = colliders.distance(i, place - colliders.place[i], 0)
                    if ti.cast(phi, ti.f64) < gap:
                        gap, other, friction = ti.cast(phi, ti.f64), k, self.rub_of(colliders, i)
                        for c in ti.static(range(d)):
                            normal[c] = ti.cast(found[c], ti.f64)
        return gap, other, friction, normal

    @ti.func
    def rubbed(self, q: int, rub: ti.template(), pressed: ti.f64):
        """Return an impulse along a surface, limited by the friction at point q."""
        most, size, result = self.friction[q] * pressed, rub.norm(), rub
        if size > most:
            result *= most / size
        return result

    @ti.func
    def rub_of(self, colliders: ti.template(), i: int):
        """Return the coefficient of friction of collider i with rigid bodies."""
        return STUCK if colliders.wall[i] == STICK else colliders.friction[i]

    @ti.func
    def push(self, run: int, q: int, dt: ti.f64, colliders: ti.template()):
        """Update the impulse at point q to satisfy its contact conditions; return the size of the change, N s."""
        velocity = self.velocity_of(run, q, dt, colliders)
        normal, before = self.normal[q], self.impulse[q]
        # A point on a hinge, or of a body that cannot move along the normal, does not yield.
        free = ti.cast(1, ti.f64) / self.bodies.mass[run * self.bodies.count + self.body[q]]
        along = velocity.dot(normal)
        wanted = -self.gap[q] / dt
        if self.gap[q] < 0:
            wanted *= ti.cast(UNDONE, ti.f64)
        if self.rebound[q] > 0:
            wanted = ti.max(wanted, self.rebound[q])
        elif self.rebound[q] == LATER:
            wanted = along
        old = before.dot(normal)
        slide = velocity - along * normal
        speed = slide.norm()
        pressed, rub = ti.cast(0, ti.f64), before - old * normal
        # In a loop, so that it is compiled once.
        for k in range(2 if speed > 0 and self.friction[q] > 0 else 1):
            yielding = self.yielding(run, q, normal if k == 0 else slide / speed)
            if yielding > LEAST_YIELDING * free:
                if k == 0:
                    pressed = ti.max(old + (wanted - along) / yielding, 0.0)
                else:
                    rub -= slide / yielding
        after = pressed * normal + self.rubbed(q, rub, pressed)
        self.give(run, q, after - before)
        for a in ti.static(range(self.dimension)):
            self.impulse[q][a] = after[a]
        return (after - before).norm()

    @ti.func
    def velocity_of(self, run: int, q: int, dt: ti.f64, colliders: ti.template()):
        """Return the mean velocity of point q relative to its obstacle in a step of dt seconds, m/s.

        With the velocity at its start, a box would tip over its edge with an error of first order.
        """
        velocity = ti.Vector.zero(ti.f64, self.dimension)
        for s in range(2):
            b, arm, sign = self.side(run, q, s)
            if b >= 0:
                velocity += sign * self.bodies.velocity_at(b, arm, dt)
            elif self.other[q] >= 0:
                i = run * colliders.capacity + self.other[q]
                away = arm - ti.cast(colliders.place[i], ti.f64)
                velocity -= ti.cast(colliders.velocity[i], ti.f64) + ti.cast(colliders.turning[i], ti.f64) @ away
        return velocity

    @ti.func
    def give(self, run: int, q: int, impulse: ti.template()):
        """Apply an impulse, N s, to the body of point q there, and the opposite one to an obstacle that is a body."""
        for s in range(2):
            b, arm, sign = self.side(run, q, s)
            if b >= 0:
                self.bodies.hit(b, sign * impulse, arm)

    @ti.func
    def side(self, run: int, q: int, s: int):
        """Return the body of point q, or its obstacle (s = 1), the arm of the point from its centre, and 1 or -1.

        For an obstacle that is not a body, the body is -1, and the arm is the position of the point.
        """
        b, arm, sign = run * self.bodies.count + self.body[q], self.arm[q], 1.0
        if s == 1:
            for a in ti.static(range(self.dimension)):
                arm[a] += self.bodies.pose[b, a]
            b, sign = -1, -1.0
            if self.other[q] >= 0:
                if self.body_of[self.other[q]] >= 0:
                    b = run * self.bodies.count + self.body_of[self.other[q]]
                    for a in ti.static(range(self.dimension)):
                        arm[a] -= self.bodies.pose[b, a]
        return b, arm, sign

    @ti.func
    def yielding(self, run: int, q: int, n: ti.template()):
        """Return the change of the relative velocity of point q along n by an impulse of 1 N s along n, m/s."""
        result = ti.cast(0, ti.f64)
        for s in range(2):
            b, arm, _sign = self.side(run, q, s)
            if b >= 0:
                result += self.bodies.yields(b, n, arm)
        return result
