"""Contact of rigid bodies with walls, colliders and each other: points of their surfaces, against signed distances.

Of each point the nearest thing counts. Impulses at points are found one after another in some sweeps (projected
Gauss-Seidel), none of which pulls, and with Coulomb's friction. A point that would pass a surface in the step ends on
it; where one has passed already, a part of that is undone.
"""

from mpmcli.boundaries.colliders import STICK, contact_points
from mpmcli.boundaries.rigid_bodies import RigidBodies
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene

# Cells within which a point may meet something in a step; the part of a depth that a step undoes; most sweeps, and the
# change of impulses in one, over the largest of them, below which they are enough.
NEAR, UNDONE, SWEEPS, ENOUGH = 0.6, 0.2, 50, 1e-6
# Coefficient of friction of what sticks; in place of the number of a collider: a wall, and nothing.
STUCK = 1e3
WALL, NOTHING = -1, -2


@ti.data_oriented
class RigidContact:
    """The contact of the bodies of some runs; `faces` are the words of the walls, `room` the points of a run."""

    def __init__(self, bodies: RigidBodies, faces: tuple[tuple[str, str], ...], runs: int) -> None:
        d, self.bodies, self.dimension = bodies.dimension, bodies, bodies.dimension
        self.room = bodies.colliders.kind.points
        self.walls = tuple((a, side) for a in range(d) for side in (0, 1) if faces[a][side] != "open")
        n = runs * self.room
        self.used = ti.field(int, shape=runs)
        # Of each point: its body, and where it is on it.
        self.body, self.point = ti.field(int, shape=n), ti.Vector.field(d, ti.f64, shape=n)
        # How far it is from the centre of its body in this step.
        self.arm = ti.Vector.field(d, ti.f64, shape=n)
        # What it may meet in this step, the number of a collider or WALL, at a distance and with a normal.
        self.meets, self.other = ti.field(int, shape=n), ti.field(int, shape=n)
        self.gap, self.friction = ti.field(ti.f64, shape=n), ti.field(ti.f64, shape=n)
        self.normal, self.impulse = (ti.Vector.field(d, ti.f64, shape=n) for _ in range(2))
        # Of each collider the body that it is, or -1; of each face its coefficient of friction.
        self.body_of = ti.field(int, shape=bodies.colliders.room)
        self.body_of.fill(-1)
        for j, k in enumerate(bodies.free):
            self.body_of[k] = j
        self.face_friction = ti.field(float, shape=(runs, d, 2))

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the points of a run."""
        found = [contact_points(scene.colliders[k], scene.domain.spacing) for k in self.bodies.free]
        self.used[run] = sum(map(len, found))
        q = run * self.room
        for j, points in enumerate(found):
            for point in points.tolist():
                self.body[q], self.point[q], self.other[q] = j, point, NOTHING
                self.impulse[q] = [0.0] * self.dimension
                q += 1
        for a, side in self.walls:
            sticks = scene.domain.walls.faces(self.dimension)[a][side] == "stick"
            self.face_friction[run, a, side] = STUCK if sticks else scene.domain.frictions[a][side]

    @ti.func
    def resolve(self, run: int, dt: ti.f64, extent: ti.template(), colliders: ti.template()):
        """Change the momenta of the bodies so that no point passes a surface in a step of dt seconds."""
        first = run * self.room
        any_meets = False
        for q in range(first, first + self.used[run]):
            any_meets = self.look(run, q, extent, colliders) or any_meets
        if any_meets:
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
                sweep += 1

    @ti.func
    def look(self, run: int, q: int, extent: ti.template(), colliders: ti.template()):
        """Find what point q may meet; return whether there is anything.

        Where that is what it met in the step before, the impulses of that step are where those of this one begin.
        """
        d = ti.static(self.dimension)
        b = run * self.bodies.count + self.body[q]
        own = self.bodies.numbers[self.body[q]]
        x = self.bodies.turned(b) @ self.point[q]
        for a in ti.static(range(d)):
            self.arm[q][a] = x[a]
            x[a] += self.bodies.pose[b, a]
        h = ti.cast(colliders.spacing, ti.f64)
        gap, other, friction = ti.cast(NEAR, ti.f64) * h, NOTHING, 0.0
        normal = ti.Vector.zero(ti.f64, d)
        for a, side in ti.static(self.walls):
            away = x[a] if ti.static(side == 0) else ti.cast(extent[a], ti.f64) - x[a]
            if away < gap:
                gap, other, friction = away, WALL, self.face_friction[run, a, side]
                for c in ti.static(range(d)):
                    normal[c] = 0.0
                normal[a] = 1.0 if ti.static(side == 0) else -1.0
        for k in range(colliders.count[run]):
            i = run * colliders.room + k
            if k != own:
                place = ti.cast(x, float)
                if colliders.covers(i, place):
                    phi, found = colliders.distance(i, place - colliders.place[i], 0)
                    if ti.cast(phi, ti.f64) < gap:
                        gap, other, friction = ti.cast(phi, ti.f64), k, self.rub_of(colliders, i)
                        for c in ti.static(range(d)):
                            normal[c] = ti.cast(found[c], ti.f64)
        self.friction[q] = ti.cast(ti.max(friction, self.rub_of(colliders, run * colliders.room + own)), ti.f64)
        pressed = ti.max(self.impulse[q].dot(normal), 0.0)
        if self.other[q] != other:
            pressed = ti.cast(0, ti.f64)
        after = pressed * normal + self.rubbed(q, self.impulse[q] - self.impulse[q].dot(normal) * normal, pressed)
        self.meets[q], self.other[q], self.gap[q] = ti.cast(other != NOTHING, int), other, gap
        for a in ti.static(range(d)):
            self.normal[q][a], self.impulse[q][a] = normal[a], after[a]
        return other != NOTHING

    @ti.func
    def rubbed(self, q: int, rub: ti.template(), pressed: ti.f64):
        """Return an impulse along a surface, no larger than friction allows at point q."""
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
        """Change the impulse at point q so that it holds there; return by how much, N s."""
        b, partner, arm, from_other = self.sides(run, q)
        velocity = self.bodies.velocity_at(b, arm)
        if self.other[q] >= 0:
            i = run * colliders.room + self.other[q]
            if partner >= 0:
                velocity -= self.bodies.velocity_at(partner, from_other)
            else:
                away = from_other - ti.cast(colliders.place[i], ti.f64)
                velocity -= ti.cast(colliders.velocity[i], ti.f64) + ti.cast(colliders.turning[i], ti.f64) @ away
        normal, before = self.normal[q], self.impulse[q]
        along = velocity.dot(normal)
        wanted = -self.gap[q] / dt
        if self.gap[q] < 0:
            wanted *= ti.cast(UNDONE, ti.f64)
        old = before.dot(normal)
        pressed = ti.max(old + (wanted - along) / self.yielding(b, partner, normal, arm, from_other), 0.0)
        slide = velocity - along * normal
        speed = slide.norm()
        rub = before - old * normal
        if speed > 0 and self.friction[q] > 0:
            rub -= slide / self.yielding(b, partner, slide / speed, arm, from_other)
        after = pressed * normal + self.rubbed(q, rub, pressed)
        self.give(run, q, after - before)
        for a in ti.static(range(self.dimension)):
            self.impulse[q][a] = after[a]
        return (after - before).norm()

    @ti.func
    def give(self, run: int, q: int, impulse: ti.template()):
        """Give the body of point q an impulse there, N s, and the body that it meets the opposite one."""
        b, partner, arm, from_other = self.sides(run, q)
        self.bodies.hit(b, impulse, arm)
        if partner >= 0:
            self.bodies.hit(partner, -impulse, from_other)

    @ti.func
    def sides(self, run: int, q: int):
        """Return the body of point q and the one that it meets, or -1, and the arms of the point from their centres.

        In place of the second one the place of the point where it meets no body.
        """
        d = ti.static(self.dimension)
        b, partner = run * self.bodies.count + self.body[q], -1
        arm = self.arm[q]
        from_other = arm
        for a in ti.static(range(d)):
            from_other[a] += self.bodies.pose[b, a]
        if self.other[q] >= 0:
            if self.body_of[self.other[q]] >= 0:
                partner = run * self.bodies.count + self.body_of[self.other[q]]
                for a in ti.static(range(d)):
                    from_other[a] -= self.bodies.pose[partner, a]
        return b, partner, arm, from_other

    @ti.func
    def yielding(self, b: int, partner: int, n: ti.template(), arm: ti.template(), from_other: ti.template()):
        """Return by how much the relative velocity of two bodies along n grows with an impulse along it, 1/kg."""
        result = self.bodies.yields(b, n, arm)
        if partner >= 0:
            result += self.bodies.yields(partner, n, from_other)
        return result
