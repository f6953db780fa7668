"""Walls and colliders that let go, as bodies with velocity fields of their own meet them: by their exact distance."""

from mpmcli.boundaries.colliders import REACH as COLLIDERS_REACH
from mpmcli.boundaries.colliders import SEPARATE, Colliders
from mpmcli.boundaries.walls import Walls
from mpmcli.quick_taichi import ti
from mpmcli.solver.transfer.splines import PAD

# Nodes farther from a surface than this take no part in contact, cells: the reach of the spline that shares it out.
REACH = 1.5
# Of an obstacle that is not there or does not act, m; nodes beyond those of any grid.
FAR, ALL_NODES = 1e30, 2**20


@ti.data_oriented
class Obstacles:
    """The walls and colliders of one run, in a kernel: the faces of the domain first, then the faces of colliders.

    Attributes:
        walls, colliders: views of the run, see `device.views`; colliders are None where there are none.
        faces: walls that let go; sides: the most faces of a collider.
        any: whether there may be any obstacle.
    """

    def __init__(self, walls: Walls, colliders: Colliders | None, spacing: object) -> None:
        self.walls, self.colliders, self.spacing = walls, colliders, spacing
        self.dimension, self.faces = walls.dimension, walls.separating
        self.collides = colliders is not None
        self.sides = self.dimension if self.collides and colliders.boxes else 1
        self.any = self.collides or len(self.faces) > 0

    @ti.func
    def count(self):
        """Return the number of obstacles."""
        count = 0
        if ti.static(self.collides):
            count += self.colliders.count[self.colliders.run] * self.sides
        return count + ti.static(len(self.faces))

    @ti.func
    def collider_of(self, o: int):
        """Return the collider that an obstacle belongs to, and its number in the batch; -1 of a wall."""
        k, i = -1, -1
        if ti.static(self.collides):
            if o >= ti.static(len(self.faces)):
                k = ti.raw_div(o - ti.static(len(self.faces)), self.sides)
                i = k + self.colliders.run * self.colliders.room
        return k, i

    @ti.func
    def at(self, o: int, x: ti.template(), reach: float):
        """Return how far a place is from an obstacle, m, its normal into the material, velocity, m/s, and friction.

        These are those of the nearest point. Beyond the reach, cells, the distance is a lower bound, and there is no
        normal; x: from the lower corner, m.
        """
        d, h = ti.static((self.dimension, self.spacing))
        distance, friction, normal, velocity = FAR, 0.0, ti.Vector.zero(float, d), ti.Vector.zero(float, d)
        for f, face in ti.static(enumerate(self.faces)):
            if o == f:
                axis, side = ti.static(face)
                distance = x[axis]
                normal[axis] = 1.0
                if ti.static(side == 1):
                    distance = ti.cast(self.walls.last[axis] - self.walls.first, float) * h - x[axis]
                    normal[axis] = -1.0
                for _, number, rough_axis, rough_side in ti.static(self.walls.rough):
                    if ti.static((rough_axis, rough_side) == face):
                        friction = self.walls.friction.of(number)
                if ti.static(self.walls.moves):
                    along = self.walls.velocity(axis, side)
                    for a in ti.static(range(d)):
                        velocity[a] = along[a]
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                side = o - ti.static(len(self.faces)) - k * self.sides
                arm = x - self.colliders.place[i]
                acts, beyond = self.colliders.wall[i] == SEPARATE and side < self.colliders.faces_of(i), -FAR
                for a in ti.static(range(d)):
                    beyond = ti.max(
                        beyond, self.colliders.reach[i][0, a] - arm[a], arm[a] - self.colliders.reach[i][1, a]
                    )
                beyond += COLLIDERS_REACH * h
                if acts and beyond > reach * h:
                    distance = beyond
                elif acts:
                    found, own = self.colliders.distance(i, arm, side)
                    along = self.colliders.velocity[i] + self.colliders.turning[i] @ (arm - found * own)
                    distance, friction = found, self.colliders.friction[i]
                    for a in ti.static(range(d)):
                        normal[a], velocity[a] = own[a], along[a]
        return distance, normal, velocity, friction

    @ti.func
    def nearest(self, x: ti.template(), reach: float):
        """Return the distance of the nearest obstacle, m, see `at`."""
        least = FAR
        for o in range(self.count()):
            distance, _normal, _velocity, _friction = self.at(o, x, reach)
            least = ti.min(least, distance)
        return least

    @ti.func
    def range(self, o: int):
        """Return the first and the last node per axis that may touch what meets an obstacle."""
        low, high = ti.Vector([-ALL_NODES] * self.dimension), ti.Vector([ALL_NODES] * self.dimension)
        for f, face in ti.static(enumerate(self.faces)):
            if o == f:
                axis, side = ti.static(face)
                if ti.static(side == 0):
                    high[axis] = self.walls.first + 1
                else:
                    low[axis] = self.walls.last[axis] - 1
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                # Some more for what its own reach leaves out, and for rounding.
                wider = ti.static(REACH - COLLIDERS_REACH + 0.1)
                for a in ti.static(range(self.dimension)):
                    place = self.colliders.place[i][a]
                    first = (place + self.colliders.reach[i][0, a]) / self.spacing - wider
                    last = (place + self.colliders.reach[i][1, a]) / self.spacing + wider
                    low[a] = PAD + ti.cast(ti.floor(ti.max(first, -ALL_NODES)), int)
                    high[a] = PAD + ti.cast(ti.ceil(ti.min(last, ALL_NODES)), int)
        return low, high

    @ti.func
    def take(self, o: int, node: ti.template(), x: ti.template(), impulse: ti.template()):
        """Book the impulse that an obstacle gets from a node, N s, if it is a collider."""
        if ti.static(self.collides):
            k, i = self.collider_of(o)
            if k >= 0:
                self.colliders.loads.take(self.colliders.run, node, k, impulse, x - self.colliders.place[i])


@ti.func
def place_of(node: ti.template(), spacing: float):
    """Return where a node is, from the lower corner, m."""
    return ti.cast(node - PAD, float) * spacing
