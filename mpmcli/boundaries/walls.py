"""The faces of the domain: slip, stick or separating walls, with or without friction, that may move along themselves.

A wall lies on a plane of nodes. `Walls` has the positions of the walls, finds those that act on a node, and constrains
its velocity; `mirror_images` folds back what particles scatter beyond the walls (docs/theory.md, 3).
"""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np

from mpmcli.boundaries.feature import Feature, changed
from mpmcli.boundaries.images import Images
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.domain import OPEN, SEPARATING, STICKING
from mpmcli.scene.schema import SolverSettings

# Nodes on each side of a wall that can hold mass from particles of the other side.
IMAGE_DEPTH = 2
# Entry of `Walls.contact` where the material has yet to reach the wall (docs/theory.md, 3.2).
AWAY = -1


@ti.data_oriented
class FaceNumbers(Feature):
    """A number, or a vector, of some faces. They are data, so that runs that differ in them share kernels.

    Attributes:
        key: property of the domain with the numbers of all faces, by axis and side.
        faces: (axis, side) of every such face.
        numbers: that of each face of each run.
        first: row of the first face of the current run.
    """

    key: str

    def __init__(self, faces: Sequence[tuple[int, int]], numbers: ti.Field | None) -> None:
        self.faces, self.first = tuple(faces), 0
        if self.faces:
            self.numbers, self._rows = numbers, Rows(numbers)

    @classmethod
    def in_scene(cls, scene: Scene) -> tuple[tuple[int, int], ...]:
        """Return (axis, side) of every face of a scene whose number is not 0."""
        numbers = getattr(scene.domain, cls.key)
        return tuple((a, side) for a, pair in enumerate(numbers) for side in (0, 1) if np.any(pair[side]))

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the numbers of a run."""
        if self.faces:
            numbers = getattr(scene.domain, self.key)
            self._rows.write(run * len(self.faces), [numbers[axis][side] for axis, side in self.faces])

    def viewed(self, view: object) -> "FaceNumbers":
        return changed(self, first=view.w * len(self.faces))

    @ti.func
    def of(self, face: ti.template()):
        """Return the number of a face by its index in `faces`."""
        return self.numbers[self.first + face]


class MovingFaces(FaceNumbers):
    """Velocities of the faces that move (docs/theory.md, 3.7), m/s."""

    key = "wall_velocities"

    def __init__(self, faces: Sequence[tuple[int, int]], dimension: int = 0, runs: int = 1) -> None:
        super().__init__(faces, ti.Vector.field(dimension, float, shape=runs * len(faces)) if faces else None)


class RoughFaces(FaceNumbers):
    """Coefficients of friction of the faces that have it (docs/theory.md, 3.4)."""

    key = "frictions"

    def __init__(self, faces: Sequence[tuple[int, int]], runs: int = 1) -> None:
        super().__init__(faces, ti.field(float, shape=runs * len(faces)) if faces else None)


STILL, SMOOTH = MovingFaces(()), RoughFaces(())


def faces_on_grid(faces: Sequence[tuple[str, str]], settings: SolverSettings) -> tuple[tuple[str, str], ...]:
    """Return the conditions of the walls that mirror nodes: with total Lagrangian solids, separating walls do not."""
    total = settings.solids == "total"
    return tuple(tuple(OPEN if total and word in SEPARATING else word for word in pair) for pair in faces)


@ti.data_oriented
class Walls(Images):
    """All faces of the domain, as a boundary that acts on nodes.

    Attributes:
        reach: number of nodes on each side of a face that may have images.
        shape: nodes of the grid per axis.
        lateral: per axis, the other axes.
        separating: (axis, side) of every face that material may leave.
        contact: (planes, nodes) int, per separating face and node of its plane, whether the material presses on it: 1,
            0, or AWAY.
        first_plane: row of `contact` of the first separating face.
        friction: the coefficients of friction.
        rough: of every wall with friction: its index in `rough`, its index in `friction`, axis and side.
        impulse: per rough face of each run and node of its plane, (d,): along the wall, the momentum, kg m/s, that
            friction adds to a sliding column of nodes; along the normal, 1 if the column sticks, else 0. If it sticks,
            the entries along the wall are its slip before the step where bodies keep motion, m/s, else 0.
        first_rough: row of `impulse` of the first rough face.
        moving: velocities of the faces that move.
        moves: whether any face moves.
        slip: per axis, the velocity of the face, (d, d), m/s, a variable of a kernel that replaces that of `moving`
            if `slips`, see `slipping`.
        shut: depth at and below which velocities out through a separating wall that does not act are zero, a number or
            a variable of a kernel: 0, or -IMAGE_DEPTH where bodies touch the wall by their surfaces (`Obstacles`).
    """

    def __init__(
        self,
        faces: Sequence[tuple[str, str]],
        first: int,
        cells: Sequence[int],
        shape: Sequence[int],
        runs: int = 1,
        friction: RoughFaces = SMOOTH,
        moving: MovingFaces = STILL,
    ) -> None:
        """Allocate one set of planes in `contact` and `impulse` for each run."""
        super().__init__(faces, first, [first + n for n in cells])
        self.reach = first if self.periodic else IMAGE_DEPTH
        self.moving, self.moves, self.slips = moving, len(moving.faces) > 0, False
        self.shut = 0
        self.separating = tuple(
            (a, side) for a in range(self.dimension) for side in (0, 1) if self.faces[a][side] in SEPARATING
        )
        self.lateral = tuple(tuple(b for b in range(self.dimension) if b != a) for a in range(self.dimension))
        self.shape = tuple(shape)
        self.first_plane = 0
        if self.separating:
            planes = [self.plane_size(a) for a, _ in self.separating]
            self.contact = ti.field(ti.i32, shape=(runs * len(planes), max(planes)))
        self.friction = friction
        walls = [(f, a, side) for f, (a, side) in enumerate(friction.faces) if self.faces[a][side] != OPEN]
        self.rough = tuple((r, *face) for r, face in enumerate(walls))
        self.first_rough = 0
        if self.rough:
            planes = [self.plane_size(a) for _, _, a, _ in self.rough]
            self.impulse = ti.Vector.field(self.dimension, float, shape=(runs * len(planes), max(planes)))

    def plane_size(self, axis: int) -> int:
        """Return the number of nodes of a plane normal to `axis`."""
        return math.prod(self.shape[b] for b in self.lateral[axis])

    def along(self, axes: Sequence[int]) -> "Walls":
        """Return the walls for nodes that are near walls of `axes` only; distances are those from all walls."""
        walls = copy(self)
        walls.axes = tuple(axes)
        return walls

    def slipping(self, slip: object) -> "Walls":
        """Return the walls as they move with the slip of columns that stick by friction, see `slip_at`."""
        walls = copy(self)
        walls.slip, walls.slips, walls.moves = slip, True, True
        return walls

    @ti.func
    def constrained(
        self,
        velocity: ti.template(),
        depth: ti.template(),
        upper: ti.template(),
        acts: ti.template(),
        holds: ti.template(),
    ):
        """Return the velocity of a node after the walls have acted, from its depth, side, acting and sticking walls.

        On an acting wall the normal component is zero, and the tangential one is that of the wall if it sticks. On and
        behind a separating wall that does not act, the velocity out through it is zero, see `shut`.
        """
        result = velocity
        for a in ti.static(self.axes):
            if acts[a] == 1 and depth[a] == 0:
                result = self.stopped(result, a, depth, holds, upper, 1.0)
            elif acts[a] != AWAY and depth[a] <= self.shut:
                inward = result[a] if upper[a] == 0 else -result[a]
                if inward < 0:
                    result[a] = 0.0
        return result

    @ti.func
    def distance(self, node: ti.template()):
        """Return the number of nodes from the nearest wall inwards to the node, negative behind a wall."""
        # Minima instead of `or`: branches at every node of the grid would cost more.
        result = self.distance_along(node, 0)
        for a in ti.static(range(1, self.dimension)):
            result = ti.min(result, self.distance_along(node, a))
        return result

    @ti.func
    def distance_along(self, node: ti.template(), axis: ti.template()):
        """Return the number of nodes from the nearest wall of an axis inwards to the node, negative behind a wall."""
        return ti.min(node[axis] - self.first, self.last[axis] - node[axis])

    @ti.func
    def near(self, node: ti.template()):
        """Return whether the node is within reach of any wall."""
        return self.distance(node) <= self.reach

    @ti.func
    def place(self, node: ti.template()):
        """Return, per axis, the depth of the node inside a wall within reach, its mirror, and 1 for the upper wall.

        See `image_along`; the depth is IMAGE_DEPTH + 1 if no wall is within reach.
        """
        depth, mirror, upper = ti.Vector([IMAGE_DEPTH + 1] * self.dimension), node, ti.Vector.zero(int, self.dimension)
        for a in ti.static(self.axes):
            image, deep, side = self.image_along(node[a], a, IMAGE_DEPTH, 1)
            mirror[a], depth[a], upper[a] = image, deep, side
        return depth, mirror, upper

    @ti.func
    def acting(self, node: ti.template(), depth: ti.template(), mirror: ti.template(), upper: ti.template()):
        """Return, per axis, whether a wall acts on the node: it is within reach and, if separating, pressed."""
        acts = ti.Vector.zero(int, self.dimension)
        inner = node
        for a in ti.static(self.axes):
            acts[a] = ti.cast(depth[a] <= IMAGE_DEPTH, int)
            if depth[a] < 0:
                inner[a] = mirror[a]
        # Contact is looked up at the image inside the domain, so that a node and all its images agree.
        for f in ti.static(range(len(self.separating))):
            axis = ti.static(self.separating[f][0])
            if ti.static(axis in self.axes):
                if depth[axis] <= IMAGE_DEPTH and upper[axis] == self.separating[f][1]:
                    acts[axis] = self.contact[self.first_plane + f, self.plane_index(inner, axis)]
        return acts

    @ti.func
    def state(self, node: ti.template(), rubbed: ti.template()):
        """Return what `place`, `acting` and `holding` state of a node."""
        depth, mirror, upper = self.place(node)
        acts = self.acting(node, depth, mirror, upper)
        return depth, mirror, upper, acts, self.holding(node, depth, upper, rubbed)

    @ti.func
    def plane_index(self, node: ti.template(), axis: ti.template()):
        """Return the index of a node in the plane normal to `axis`."""
        index = 0
        for b in ti.static(self.lateral[axis]):
            index = index * ti.static(self.shape[b]) + node[b]
        return index

    @ti.func
    def face_in(self, words: ti.template(), axis: ti.template(), upper: int):
        """Return whether the condition of the face of `axis` on that side is one of some words."""
        # Branches, because inside some conditions Taichi takes a static flag as an operand of `and` for false.
        result = False
        if ti.static(self.faces[axis][0] in words):
            result = upper == 0
        if ti.static(self.faces[axis][1] in words):
            if upper == 1:
                result = True
        return result

    @ti.func
    def holding(self, node: ti.template(), depth: ti.template(), upper: ti.template(), rubbed: ti.template()):
        """Return, per axis, whether the wall within reach sticks, by its condition or by friction.

        The node must not be an image unless it lies on the wall. `rubbed` states whether friction has been computed.
        """
        holds = ti.Vector.zero(int, self.dimension)
        for a in ti.static(self.axes):
            holds[a] = ti.cast(self.face_in(STICKING, a, upper[a]), int)
        if ti.static(rubbed):
            for r, _number, axis, side in ti.static(self.rough):
                if ti.static(axis in self.axes):
                    if depth[axis] <= IMAGE_DEPTH and upper[axis] == side:
                        entry = self.impulse[self.first_rough + r, self.plane_index(node, axis)][axis]
                        holds[axis] = ti.cast(entry, int)
        return holds

    @ti.func
    def slip_at(self, node: ti.template(), depth: ti.template(), upper: ti.template(), holds: ti.template()):
        """Return, per axis, the slip before the step of a column that sticks by friction, else the wall's velocity."""
        result = ti.Matrix.zero(float, self.dimension, self.dimension)
        if ti.static(self.moves):
            for a in ti.static(self.axes):
                own = self.velocity_at(a, upper[a], depth)
                for c in ti.static(range(self.dimension)):
                    result[a, c] = own[c]
        for r, _number, axis, side in ti.static(self.rough):
            if depth[axis] <= IMAGE_DEPTH and upper[axis] == side and holds[axis] == 1:
                entry = self.impulse[self.first_rough + r, self.plane_index(node, axis)]
                for c in ti.static(self.lateral[axis]):
                    result[axis, c] = entry[c]
        return result

    @ti.func
    def stopped(
        self,
        value: ti.template(),
        axis: ti.template(),
        depth: ti.template(),
        holds: ti.template(),
        upper: ti.template(),
        mass: float,
    ):
        """Return momentum, or velocity with mass 1, on an acting wall: no normal part, the wall's own if it sticks."""
        result = value
        for c in ti.static(range(self.dimension)):
            if ti.static(c == axis):
                result[c] = 0.0
            elif holds[axis] == 1:
                if ti.static(self.moves):
                    result[c] = mass * self.velocity_at(axis, upper[axis], depth)[c]
                else:
                    result[c] = 0.0
        return result

    @ti.func
    def closed(self, value: ti.template(), acts: ti.template(), depth: ti.template()):
        """Return the value without the part that the slip at one wall drives through another one at a common edge."""
        result = value
        for a in ti.static(self.axes):
            if acts[a] == 1 and depth[a] == 0:
                result[a] = 0.0
        return result

    @ti.func
    def velocity(self, axis: ti.template(), upper: int):
        """Return the velocity of the face of `axis` on that side, m/s."""
        result = ti.Vector.zero(float, self.dimension)
        if ti.static(self.slips):
            for c in ti.static(range(self.dimension)):
                result[c] = self.slip[axis, c]
        else:
            for f in ti.static(range(len(self.moving.faces))):
                if ti.static(self.moving.faces[f][0] == axis):
                    if upper == ti.static(self.moving.faces[f][1]):
                        for c in ti.static(range(self.dimension)):
                            result[c] = self.moving.of(f)[c]
        return result

    @ti.func
    def velocity_at(self, axis: ti.template(), upper: int, depth: ti.template()):
        """Return the velocity of the face of `axis` at a node, m/s: nothing towards a wall at most a cell away."""
        result = self.velocity(axis, upper)
        if ti.static(not self.slips):
            for c in ti.static(self.lateral[axis]):
                if self.ends(c, depth):
                    result[c] = 0.0
        return result

    @ti.func
    def ends(self, axis: ti.template(), depth: ti.template()):
        """Return whether walls that move along `axis` have ended at a node: a cell before a wall that they run into.

        Continuity leaves the velocity no slope across a wall that sticks; one would crush what touches both walls.
        """
        result = False
        if ti.static(axis not in self.periodic):
            result = depth[axis] <= 1
        return result
