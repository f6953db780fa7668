"""The walls of the domain in the usual way: velocities of nodes on and behind them are set to zero.

First-order accurate, where folded walls are second-order; kept for comparison (docs/theory.md, 3.3).
"""

from collections.abc import Sequence

import taichi as ti

from mpmcli.boundaries.moving_faces import STILL, MovingFaces
from mpmcli.boundaries.rough_faces import RoughFaces
from mpmcli.scene.wall_rules import PERIODIC


@ti.data_oriented
class ZeroedWalls:
    """All faces of the domain, as a boundary that acts on nodes: slip and separate stop the normal velocity, stick all.

    A separating face stops only what moves into it, a periodic one nothing. Nothing is mirrored. What nodes hold from
    before stress and forces is not stopped: FLIP's change of velocity contains the wall's. Friction takes from the
    velocity along a wall at most the coefficient times what the wall stops. Of a wall that moves it is the velocity
    relative to it.
    """

    def __init__(
        self,
        faces: Sequence[tuple[str, str]],
        first: int,
        cells: Sequence[int],
        friction: RoughFaces,
        moving: MovingFaces = STILL,
    ) -> None:
        self.dimension = len(faces)
        self.faces = tuple(tuple(pair) for pair in faces)
        self.friction, self.moving = friction, moving
        self.first = first
        self.last = tuple(first + n for n in cells)

    @ti.func
    def constrain(self, node: ti.template(), velocity: ti.template()):
        """Return the velocity of a node after the walls."""
        result = velocity
        for a in ti.static(range(self.dimension)):
            if ti.static(self.faces[a][0] != PERIODIC):
                if node[a] <= self.first:
                    result = self.stopped(result, a, 0)
                if node[a] >= self.last[a]:
                    result = self.stopped(result, a, 1)
        return result

    @ti.func
    def stopped(self, velocity: ti.template(), axis: ti.template(), side: ti.template()):
        """Return the velocity at a node on or behind the lower (side 0) or the upper (1) face of an axis."""
        result = velocity
        along_wall = ti.Vector.zero(float, self.dimension)
        for f in ti.static(range(len(self.moving.faces))):
            if ti.static(self.moving.faces[f] == (axis, side)):
                for c in ti.static(range(self.dimension)):
                    along_wall[c] = self.moving.of(f)[c]
                    result[c] -= along_wall[c]
        for c in ti.static(range(self.dimension)):
            if ti.static(self.faces[axis][side] == "stick" or (self.faces[axis][side] == "slip" and c == axis)):
                result[c] = 0.0
            elif ti.static(c == axis):
                outward = velocity[c] if ti.static(side == 1) else -velocity[c]
                if outward > 0:
                    result[c] = 0.0
        for f in ti.static(range(len(self.friction.faces))):
            if ti.static(self.friction.faces[f] == (axis, side)):
                along = 0.0
                for c in ti.static(range(self.dimension)):
                    if ti.static(c != axis):
                        along += result[c] ** 2
                push = velocity[axis] if ti.static(side == 1) else -velocity[axis]
                if push > 0 and along > 0:
                    kept = ti.max(1.0 - self.friction.of(f) * push / ti.sqrt(along), 0.0)
                    for c in ti.static(range(self.dimension)):
                        if ti.static(c != axis):
                            result[c] *= kept
        for f in ti.static(range(len(self.moving.faces))):
            if ti.static(self.moving.faces[f] == (axis, side)):
                for c in ti.static(range(self.dimension)):
                    result[c] += along_wall[c]
        return result
