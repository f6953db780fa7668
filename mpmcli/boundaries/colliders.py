"""Colliders in kernels: constraints on the nodes that they cover, their poses, and their loads.

The colliders, their positions and their motions are data: runs that differ in them share kernels, which depend only on
the forms that occur (docs/theory.md, 3.8).
"""

import math
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.boundaries.distances import DISTANCES, BoxDistance, GridDistance, direction_of, samples_of
from mpmcli.boundaries.doubles import double_field
from mpmcli.boundaries.feature import Feature, Phase, changed
from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.rows import Rows
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.domain import Domain
from mpmcli.scene.expression import evaluate
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder, Polygon, Solid, TurnedBox
from mpmcli.scene.quantity import AXES
from mpmcli.scene.shapes import MOST_PARTS, Composite, clauses_of
from mpmcli.scene.surface import form_surface, ring, surface_points

# Distance in cells outside a surface up to which it acts on nodes. The outermost of these nodes lies between a quarter
# of a cell inside and three quarters outside: then fluids neither enter nor lose pressure, and rough surfaces stick
# (docs/theory.md, 3.8). A little more than 0.75, so that rounding does not matter for nodes at that distance.
COLLIDER_REACH = 0.76
# The same if the surface acts at its points (`contact.collider_points`): nodes this deep inside, and deeper, take part
# in no point, and keep back what got in. At 0.6 to 0.76 cells nodes of little mass that are not held make jets, but
# holding them would slow bodies that move freely. Nodes inside a surface that sticks follow the gradient of the
# velocity beside.
DEEP, DEEP_FIXED, DEEP_STICKING = -0.76, -0.6, -1.25
# A surface acts at nodes all the same where the collider is thin: PROBE cells below it, its distance is above -WITHIN.
PROBE, WITHIN = 0.75, 0.2
# Depth in cells from which particles that drift in are moved out.
SUNK = 0.2
# Distance in cells from a composite up to which its parts are looked at, and that from a face to the points beside it
# that tell whether the face is a surface of the whole.
SEAMS, BESIDE = 2.0, 0.05
# Width in cells over which the faces of a corner around the material blend, the distance up to which they do, and the
# largest cosine between their normals.
BLEND, BLEND_NEAR, CORNER = 0.35, 0.6, 0.8
# Width in cells over which the normal turns around a corner of a collider, and the depth from which its faces are seen.
ROUND, UNDER = 1.0, 0.25
# Codes of the conditions of surfaces.
SLIP, STICK, SEPARATE, HOLD = range(4)
WALLS = {"slip": SLIP, "stick": STICK, "separate": SEPARATE, "hold": HOLD}
# Distance in cells up to which a holding shape holds nodes outside it: the held region ends at most half a cell off.
HELD_OUTSIDE = 0.499
# Effect of a surface on the relative velocity of a node: none; it takes the normal part and maybe a part of the rest;
# or it takes all.
LOOSE, PRESSED, HELD = range(3)
FORMS = tuple(DISTANCES)
# Code of all other forms, with distances on a grid.
GRID = len(FORMS)
BOX = FORMS.index(Box)
# 2 pi in two parts, because literals have the precision of particles: the first is exact, the second to 1e-10.
TURN = (6.28125, 2 * math.pi - 6.28125)


@dataclass(frozen=True)
class ColliderKind:
    """Properties of the colliders of a run that kernels depend on, and the storage that the colliders need."""

    forms: tuple[int, ...]  # indices into FORMS of the forms that occur, in order, GRID among them
    moving: tuple[int, ...]  # indices of the colliders that move
    count: int  # upper bounds: of the colliders, of their parts, and of the numbers and the samples of these
    parts: int
    numbers: int
    samples: int
    free: tuple[int, ...] = ()  # indices of the colliders that move freely
    points: int = 0  # number of points on the surfaces of free colliders
    cornered: bool = False  # whether any has corners, and whether any has several parts
    combined: bool = False

    @staticmethod
    def of(scene: Scene) -> "ColliderKind":
        """Return the kind of the colliders of a scene."""
        found, h = scene.colliders, scene.domain.spacing
        parts = [part for collider in found for part in parts_of(collider, scene.domain)]
        return ColliderKind(
            tuple(sorted({part.code for part in parts})),
            tuple(k for k, collider in enumerate(found) if collider.driven),
            len(found),
            len(parts),
            sum(len(part.numbers) for part in parts),
            sum(part.samples.size for part in parts if part.samples is not None),
            tuple(k for k, collider in enumerate(found) if collider.free),
            sum(len(contact_points(collider, h)) for collider in found if collider.free),
            any(any(corners_of(collider)) for collider in found),
            len(parts) > len(found),
        )

    def joined(self, other: "ColliderKind") -> "ColliderKind | None":
        """Return the kind that has room for both, or None if they need different kernels."""
        if any(getattr(self, name) != getattr(other, name) for name in ("moving", "free")):
            return None
        if (self.count > 0) != (other.count > 0):
            return None
        forms = tuple(sorted({*self.forms, *other.forms}))
        rooms = (max(getattr(self, name), getattr(other, name)) for name in ("count", "parts", "numbers", "samples"))
        either = (getattr(self, name) or getattr(other, name) for name in ("cornered", "combined"))
        return ColliderKind(forms, self.moving, *rooms, self.free, max(self.points, other.points), *either)


def corners_of(collider: Collider) -> tuple[bool, bool]:
    """Return whether a collider may have corners around the material, a box around it aside, and corners of its own."""
    form, outside = collider.form, collider.side == "outside"
    if not isinstance(form, Polygon):
        whole = isinstance(form, Composite)
        return whole, whole or (outside and isinstance(form, Box | TurnedBox | Cylinder))
    vertices = ring(np.array(form.vertices)).points
    edges = np.roll(vertices, -1, axis=0) - vertices
    ahead = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0]
    sharp = (edges * ahead).sum(axis=1) < CORNER * np.hypot(*edges.T) * np.hypot(*ahead.T)
    left, right = bool(np.any(sharp & (turns > 0))), bool(np.any(sharp & (turns < 0)))
    return (right, left) if outside else (left, right)


@dataclass(frozen=True, eq=False)
class Part:
    """A simple form of a collider, see `clauses_of`."""

    code: int  # index in FORMS, or GRID
    sign: int
    ends: bool  # whether it is the last of its clause
    numbers: list[float]  # relative to the pivot of the collider
    samples: np.ndarray | None  # distances at the nodes of a grid


def parts_of(collider: Collider, domain: Domain) -> list[Part]:
    """Return the parts of a collider, clause by clause: itself, sampled, if there would be more than MOST_PARTS."""
    clauses = clauses_of(collider.form)
    if sum(map(len, clauses)) > MOST_PARTS:
        clauses = [((collider.form, 1),)]
    pivot = np.array(collider.center)
    return [
        _part(form, sign, k == len(clause) - 1, pivot, collider, domain)
        for clause in clauses
        for k, (form, sign) in enumerate(clause)
    ]


def _part(form: Solid, sign: int, ends: bool, pivot: np.ndarray, collider: Collider, domain: Domain) -> Part:
    if type(form) in FORMS:
        numbers = DISTANCES[type(form)](len(pivot)).numbers(form, pivot)
        return Part(FORMS.index(type(form)), sign, ends, numbers, None)
    # A collider at rest is sampled only in the domain.
    at_rest = not (collider.free or collider.motion.moves or collider.motion.angle)
    within = (tuple(domain.origin), tuple(domain.upper)) if at_rest else ()
    sampled = samples_of(form, domain.spacing, within)
    return Part(GRID, sign, ends, GridDistance.numbers(pivot, *sampled), sampled[0])


def contact_points(collider: Collider, h: float) -> np.ndarray:
    """Return points on the surface of a free collider, relative to its centre, (n, d), one per cell of h metres."""
    return surface_points(form_surface(collider.form), h) - np.array(collider.center)


def slender(collider: Collider, h: float) -> bool:
    """Return whether a collider may be thinner than a cell of h metres somewhere; rigid bodies never count as thin."""
    form = collider.form
    if collider.free or collider.side == "inside" or isinstance(form, Plane):
        return False
    if isinstance(form, Box):
        return min(np.subtract(form.max, form.min)) < h
    return not isinstance(form, Ball | Capsule) or 2 * form.radius < h


def reach_of(collider: Collider, h: float) -> np.ndarray:
    """Return the lower and upper bounds of nodes on which a collider may act, relative to its pivot, (2, d), m."""
    d, motion = len(collider.velocity), collider.motion
    radius = np.inf if collider.side == "inside" else collider.radius
    found = np.array([[-radius] * d, [radius] * d])
    if np.isfinite(radius) and not motion.turns and motion.angle == 0.0:
        found = np.array(collider.form.bounds()) - np.array(collider.center)
    found[0] -= h * (COLLIDER_REACH + 0.01)
    found[1] += h * (COLLIDER_REACH + 0.01)
    return found


@ti.data_oriented
class Colliders(Feature):
    """The colliders of some runs.

    Attributes:
        kind: the kind of the colliders, with the storage of each run.
        run: the current run.
        spacing: h, m.
        loads: loads of the material on each collider, about its pivot.
        layered: whether some bodies touch separating colliders by their surfaces; then these colliders act here only
            if `own`, a number or a variable of a kernel, is 0.
        support: half the width of the kernel of a node, cells, if surfaces that do not hold act at their points in
            layer 0, else 0.
        at_rest: whether nodes are places of material at rest: colliders, which all hold, act where they were at time 0.
        deterministic: whether the nodes of a row are summed in order; then `given` is the impulse of each node on each
            collider in a step, N s, else None.
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
        at_rest: bool = False,
        deterministic: bool = False,
    ) -> None:
        """Allocate colliders on a grid with `shape` nodes per axis, whose node `first` is the lower corner."""
        d, n = dimension, runs * kind.count
        self.kind, self.dimension, self.shape, self.first, self.on_cpu = kind, d, tuple(shape), first, on_cpu
        self.capacity, self.run, self.spacing = kind.count, 0, 0.0
        self.layered, self.own, self.at_rest, self.support = False, 0, at_rest, 0.0
        self.real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self.loads = Loads(kind.count, shape, runs, on_cpu=on_cpu)
        self.distances = tuple((code, DISTANCES[FORMS[code]](d)) for code in kind.forms if code != GRID)
        self.numbers = ti.field(float, shape=runs * kind.numbers)
        self.boxes, self.box = BOX in kind.forms, BoxDistance(d)
        self.grids = kind.samples > 0
        if self.grids:
            self.samples = ti.field(ti.f32, shape=runs * kind.samples)
            self.grid_distance = GridDistance(d, self.samples)
        # Of each part: form, indices of its first number and its first sample, sign, and whether it ends a clause.
        columns = (ti.field(int, shape=runs * kind.parts) for _ in range(5))
        self.form, self.begin, self.sample, self.sign, self.ends = columns
        # Of each: index of its first part and of the first one of the next, condition of the surface, -1 for a
        # container, else 1, number of faces that act in turn, and what `corners_of` returns, 1 or 0.
        self.parts, self.corners = (ti.Vector.field(2, int, shape=n) for _ in range(2))
        self.wall, self.side, self.faces = (ti.field(int, shape=n) for _ in range(3))
        self.friction = ti.field(float, shape=n)
        # Distance in cells below which it acts at nodes if it acts at points.
        self.deep = ti.field(float, shape=n)
        # Whether it may be thin somewhere, 1 or 0.
        self.slender = ti.field(int, shape=n)
        # Axes along which a holding collider does not hold, 1 or 0.
        self.lets = ti.Vector.field(d, int, shape=n)
        # Position of the pivot relative to the lower corner, m, rotation, and bounds of the nodes that it may act on.
        self.place = ti.Vector.field(d, float, shape=n)
        self.turned = ti.Matrix.field(d, d, float, shape=n)
        self.reach = ti.Matrix.field(2, d, float, shape=n)
        # Rotation since time 0, if it is not that of `turned`.
        self.carried = ti.Matrix.field(d, d, float, shape=n) if at_rest else None
        # Velocity of the pivot, m/s, and (R' - I) / dt, R' the rotation in a step, 1/s.
        self.velocity = ti.Vector.field(d, float, shape=n)
        self.turning = ti.Matrix.field(d, d, float, shape=n)
        self.count, self._counts = ti.field(int, shape=runs), [0] * runs
        fields = [self.parts, self.wall, self.side, self.faces, self.corners, self.friction, self.slender, self.lets]
        fields += [self.deep, self.place, self.turned, self.reach, self.velocity, self.turning]
        fields += [self.carried] if at_rest else []
        self._rows, self._count = Rows(*fields), Rows(self.count)
        self._parts = Rows(self.form, self.begin, self.sample, self.sign, self.ends)
        self.deterministic = deterministic
        self.given = ti.Vector.field(d, float, shape=n * math.prod(shape)) if deterministic else None

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the colliders of a run, at time 0."""
        h, origin = scene.domain.spacing, np.array(scene.domain.origin)
        self._counts[run] = len(scene.colliders)
        self._count.write(run, [len(scene.colliders)])
        used, sampled, first = run * self.kind.numbers, run * self.kind.samples, run * self.kind.parts
        rows, table, still = [], [], np.zeros((self.dimension, self.dimension))
        for collider in scene.colliders:
            begin, parts = first + len(table), parts_of(collider, scene.domain)
            for part in parts:
                table.append([part.code, used, sampled, part.sign, part.ends])
                self._write_numbers(used, np.array(part.numbers, self.real))
                used += len(part.numbers)
                if part.samples is not None:
                    self._write_samples(sampled, GridDistance.coefficients(part.samples).ravel())
                    sampled += part.samples.size
            place, turned = collider.motion.pose(0.0)
            held = [int(collider.axes is not None and axis not in collider.axes) for axis in AXES[: self.dimension]]
            side = -1 if collider.side == "inside" else 1
            # At the edges of a box around the material several faces touch it at once; elsewhere the nearest suffices.
            faces = self.dimension if side < 0 and isinstance(collider.form, Box) else 1
            thin = int(slender(collider, h))
            corners = [int(one) for one in corners_of(collider)]
            row = [[begin, begin + len(parts)], WALLS[collider.wall], side, faces, corners, collider.friction, thin]
            deep = DEEP_STICKING if collider.wall == "stick" else DEEP if collider.free else DEEP_FIXED
            row += [held, deep, place - origin, turned, reach_of(collider, h), still[0], still]
            rows.append(row + [np.eye(self.dimension)] * self.at_rest)
        self._rows.write_all(run * self.capacity, rows)
        self._parts.write_all(first, table)
        self.loads.clear(run)

    def saved(self) -> dict[str, ti.Field]:
        return {"colliders.taken": self.loads.taken}

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        # Sums in fixed point leave the loads to a phase of their own.
        return (Phase("add_loads", "loads", "loads", words="add up loads"),) if self.deterministic else ()

    def viewed(self, view: object) -> "Colliders":
        return changed(self, run=view.w, spacing=view.grid.spacing)

    @property
    def noted(self) -> int:
        return self.capacity * self.loads.width

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        self.loads.note(run, frame, column, frame_stats)

    def read(self, run: int) -> np.ndarray:
        return self.loads.read(run).ravel()

    def tell(self, values: np.ndarray, run: int, found: MutableMapping[str, np.ndarray]) -> None:
        found["collider"] = values.reshape(len(values), self.capacity, -1)[:, : self._counts[run]]

    @ti.kernel
    def _write_numbers(self, first: int, numbers: ti.types.ndarray(ndim=1)):
        for k in range(numbers.shape[0]):
            self.numbers[first + k] = numbers[k]

    @ti.kernel
    def _write_samples(self, first: int, values: ti.types.ndarray(ti.f32, 1)):
        for k in range(values.shape[0]):
            self.samples[first + k] = values[k]

    @ti.func
    def add_row(self, q: int):
        """Add the impulses on collider q % capacity from the nodes of row q // capacity in a step, in order."""
        d = ti.static(self.dimension)
        nodes = ti.static(self.shape[-1])
        k, rest = q % self.capacity, q // self.capacity
        first = rest * nodes
        x = ti.Vector.zero(float, d)
        for b in ti.static(range(d - 1)):
            a = ti.static(d - 2 - b)
            x[a] = ti.cast(rest % ti.static(self.shape[a]) - self.first, float) * self.spacing
            rest = rest // ti.static(self.shape[a])
        i, nodes_before = self.run * self.capacity + k, self.run * ti.static(self.loads.rows) * nodes
        if k < self.count[self.run]:
            near = True
            for a in ti.static(range(d - 1)):
                arm = x[a] - self.place[i][a]
                near = near and arm >= self.reach[i][0, a] and arm <= self.reach[i][1, a]
            if near:
                total = ti.Vector.zero(float, ti.static(self.loads.width))
                for n in range(nodes):
                    x[ti.static(d - 1)] = ti.cast(n - self.first, float) * self.spacing
                    given = (nodes_before + first + n) * self.capacity + k
                    total += self.loads.of(self.given[given], self.arm_now(i, x - self.place[i]))
                    for a in ti.static(range(d)):
                        self.given[given][a] = 0.0
                row = self.run * self.loads.rows * self.capacity + q
                self.loads.taken[row] = self.loads.taken[row] + total

    @ti.func
    def constrain(self, node: ti.template(), velocity: ti.template(), mass: float, spline: ti.template()):
        """Return the velocity, m/s, of a node of a mass, kg, after the colliders have acted; add to their loads.

        Also return the share of its kernel outside of colliders, see `free_share`.
        """
        d = ti.static(self.dimension)
        result, x, free, held = ti.Vector.zero(float, d), self.position_of(node), 1.0, False
        for a in ti.static(range(d)):
            result[a] = velocity[a]
        for k in range(self.count[self.run]):
            i = self.run * self.capacity + k
            arm = x - self.place[i]
            near = self.covers(i, x, self.beyond())
            if ti.static(self.layered):
                near = near and (self.own == 0 or self.wall[i] != SEPARATE)
            if near:
                for face in range(self.faces_of(i)):
                    phi, normal = self.distance(i, arm, face, True)
                    pointed = False
                    if ti.static(self.support > 0):
                        pointed = self.own == 0 and self.acts_by_points(i, arm, face, phi, normal)
                        if pointed:
                            free *= spline.share_below(phi / self.spacing)
                    if phi <= self.reach_of_surface(i, pointed):
                        held = True
                        now = self.arm_now(i, arm)
                        after, _grip = self.met(i, now, normal, result)
                        if ti.static(self.deterministic):
                            row = self.run * self.loads.rows + self.loads.row_of(node)
                            place = (row * ti.static(self.shape[-1]) + node[d - 1]) * self.capacity + k
                            for a in ti.static(range(d)):
                                self.given[place][a] = self.given[place][a] + mass * (result[a] - after[a])
                        else:
                            self.loads.take(self.run, node, k, mass * (result - after), now)
                        for a in ti.static(range(d)):
                            result[a] = after[a]
        return result, ti.select(held, -free, free)

    @ti.func
    def free_share(self, node: ti.template(), spline: ti.template()):
        """Return the share of the kernel of a node that is outside of colliders which do not hold."""
        x, free = self.position_of(node), 1.0
        for k in range(self.count[self.run]):
            i = self.run * self.capacity + k
            if self.wall[i] != HOLD and self.covers(i, x, self.beyond()):
                for face in range(self.faces_of(i)):
                    phi, normal = self.distance(i, x - self.place[i], face)
                    if self.acts_by_points(i, x - self.place[i], face, phi, normal):
                        free *= spline.share_below(phi / self.spacing)
        return free

    @ti.func
    def beyond(self):
        """Return how far beyond its reach a collider cuts the kernels of nodes, m."""
        return ti.static(max(self.support - COLLIDER_REACH, 0.0)) * self.spacing

    @ti.func
    def arm_now(self, i: int, arm: ti.template()):
        """Return the arm of a node of collider i, m, about its pivot where it is now."""
        result = arm
        if ti.static(self.at_rest):
            result = self.carried[i] @ arm
        return result

    @ti.func
    def acts_by_points(self, i: int, arm: ti.template(), face: int, phi: float, normal: ti.template()):
        """Return whether the surface of collider i acts at its points near a node at the distance phi, m."""
        result, h = self.wall[i] != HOLD, self.spacing
        if self.slender[i] == 1 and ti.abs(phi) <= COLLIDER_REACH * h:
            below, _normal = self.distance(i, arm - (phi + PROBE * h) * normal, face)
            result = result and below <= -WITHIN * h
        return result

    @ti.func
    def reach_of_surface(self, i: int, pointed: bool):
        """Return the distance outside its surface up to which collider i acts on nodes, m."""
        reach = self.deep[i] if pointed else COLLIDER_REACH
        return ti.select(self.wall[i] == HOLD, HELD_OUTSIDE, reach) * self.spacing

    @ti.func
    def position_of(self, node: ti.template()):
        """Return the position of a node relative to the lower corner, m."""
        x = ti.Vector.zero(float, self.dimension)
        for a in ti.static(range(self.dimension)):
            x[a] = ti.cast(node[a] - self.first, float) * self.spacing
        return x

    @ti.func
    def covers(self, i: int, x: ti.template(), more: float = 0.0, axes: ti.template() = 3):
        """Return whether collider i may act within `more` metres of a position, judged by the first `axes` axes."""
        arm, near = x - self.place[i], True
        for a in ti.static(range(min(axes, self.dimension))):
            near = near and arm[a] >= self.reach[i][0, a] - more and arm[a] <= self.reach[i][1, a] + more
        return near

    @ti.func
    def held_back(self, x: ti.template(), way: ti.template(), most: float):
        """Return the displacement `way`, m, of a particle at x, limited to half of the distance to any collider.

        A particle that has drifted in by more than SUNK cells is moved out, by at most `most`.
        """
        result = way
        for k in range(self.count[self.run]):
            i = self.run * self.capacity + k
            if self.covers(i, x) and self.wall[i] != HOLD:
                for face in range(self.faces_of(i)):
                    phi, normal = self.distance(i, x - self.place[i], face)
                    least = ti.max(-0.5 * ti.max(phi, 0.0), ti.min(-SUNK * self.spacing - phi, most))
                    result += ti.max(least - result.dot(normal), 0.0) * normal
        return result

    @ti.func
    def faces_of(self, i: int):
        """Return the number of faces of collider i that act in turn."""
        count = 1
        if ti.static(self.boxes):
            count = self.faces[i]
        return count

    @ti.func
    def distance(self, i: int, arm: ti.template(), face: int, turning: ti.template() = False):
        """Return the distance of a position from a face of collider i, m, and the normal into the material.

        With `turning` the normal turns around the corners of the collider, and is no gradient there.
        """
        y, side = self.turned[i].transpose() @ arm, ti.cast(self.side[i], float)
        phi, own = 1e30, ti.Vector.zero(float, self.dimension)
        if ti.static(self.kind.cornered):
            phi, own = self.distance_with_corners(i, y, side, turning)
        else:
            phi, own = self.distance_of_part(self.parts[i][0], y)
        if ti.static(self.boxes):
            if self.faces[i] > 1:
                phi, own = self.box.face(self.numbers, self.begin[self.parts[i][0]], y, face)
        return side * phi, side * (self.turned[i] @ own)

    @ti.func
    def distance_with_corners(self, i: int, y: ti.template(), side: float, turning: ti.template()):
        """Return the signed distance of y from collider i, m, and the normal, blended where two faces meet.

        In corners around the material the other face is the nearest one at a place beside y. With `turning` the normal
        turns around those of the collider, too: their faces are the nearest ones at the place below y, and beside it.
        """
        phi, normal, h = 0.0, ti.Vector.zero(float, self.dimension), self.spacing
        near, least = True, CORNER
        for own_corner in range(ti.static(2 if turning else 1)):
            bend, width, at = -side, BLEND * h, y
            if own_corner == 1:
                near = self.corners[i][1] == 1 and ti.abs(phi) < BLEND_NEAR * h and least == CORNER
                bend, width, at = side, ROUND * h, y - side * ti.max(side * phi + UNDER * h, 0.0) * normal
            face, depth, slope, other = normal, phi, normal, phi
            # A loop, so that the distance is compiled once.
            for k in range(ti.static(2 * self.dimension - 1)):
                if near:
                    way = ti.Vector.zero(float, self.dimension)
                    if k > 0:
                        way = self.tangent(face, (k - 1) // 2) * ti.cast(2 * (k % 2) - 1, float)
                    place = at + width * way
                    found, own = self.distance_of_whole(i, place)
                    if ti.static(self.kind.combined):
                        if self.parts[i][1] - self.parts[i][0] > 1 and ti.abs(found) < SEAMS * h:
                            found, own = self.without_seams(i, place, found, own)
                    seen = found + own.dot(y - place)
                    if k == 0:
                        face, depth = own, seen
                        if own_corner == 0:
                            phi, normal = found, own
                            near = self.corners[i][0] == 1 and ti.abs(phi) < BLEND_NEAR * h
                    elif bend * own.dot(way) > 0.0 and own.dot(face) < least:
                        least, slope, other = own.dot(face), own, seen
            apart = bend * (depth - other) / width
            if near and least < CORNER and ti.abs(apart) < 1.0:
                share = 0.5 + 0.5 * apart
                blend = share * face + (1.0 - share) * slope
                normal = direction_of(blend, blend.norm(), normal)
                if own_corner == 0:
                    phi = share * depth + (1.0 - share) * other
        return phi, normal

    @ti.func
    def tangent(self, normal: ti.template(), k: int):
        """Return the k-th unit vector normal to a unit vector."""
        result = ti.Vector.zero(float, self.dimension)
        if ti.static(self.dimension == 2):
            result[0], result[1] = -normal[1], normal[0]
        else:
            # Beside the axis that it is farthest from.
            a = 0
            for b in ti.static(range(1, 3)):
                if ti.abs(normal[b]) < ti.abs(normal[0]) and (b == 1 or ti.abs(normal[b]) < ti.abs(normal[1])):
                    a = b
            axis = ti.Vector([ti.cast(a == b, float) for b in range(3)])
            result = axis.cross(normal).normalized()
            if k == 1:
                result = result.cross(normal)
        return result

    @ti.func
    def distance_of_whole(self, i: int, y: ti.template()):
        """Return the maximum over clauses of the least distance of y from a part of collider i, m, and its normal."""
        phi, own = -1e30, ti.Vector.zero(float, self.dimension)
        least, nearest = 1e30, own
        for q in range(self.parts[i][0], self.parts[i][1]):
            found, normal = self.distance_of_part(q, y)
            if found < least:
                least, nearest = found, normal
            if self.ends[q] == 1:
                if least > phi:
                    phi, own = least, nearest
                least = 1e30
        return phi, own

    @ti.func
    def without_seams(self, i: int, y: ti.template(), phi: float, own: ti.template()):
        """Return the distance from the nearest part whose surface is there a surface of the whole, m, and the normal.

        Where parts meet or end at the same face, the whole is on both sides of it, or on neither. If no part is near,
        they are those of the edge at which the surfaces of two parts, taken as planes, meet.
        """
        first, last, normal, size = self.parts[i][0], self.parts[i][1], own, phi
        far, step = SEAMS * self.spacing, BESIDE * self.spacing
        least, direction, side, edge = far, own, 1.0, False
        beyond, other = far, own
        q = first - 1
        while q < last:
            if q >= first:
                size, normal = self.distance_of_part(q, y)
            if ti.abs(size) < least:
                behind, ahead = 0.0, 0.0
                for k in range(2):
                    behind = ahead
                    place = y + (ti.cast(2 * k - 1, float) * step - size) * normal
                    ahead, _normal = self.distance_of_whole(i, place)
                real = ahead - behind > 0.5 * step and behind < 0.25 * step and ahead > -0.25 * step
                if q < first:
                    # Rounding must not choose the side of a seam.
                    edge = ti.max(ti.abs(behind), ti.abs(ahead)) > 1.5 * step
                    side = ti.select(ti.select(real or edge, phi, ahead) < 0.0, -1.0, 1.0)
                if real:
                    least, direction = ti.abs(size), ti.select(size * side < 0.0, -1.0, 1.0) * normal
                    q = ti.select(q < first, last, q)
                elif size * side > 0.0 and ti.abs(size) < beyond and ti.abs(normal.dot(own)) < 0.99:
                    beyond, other = ti.abs(size), normal
            q += 1
        if edge and least == far and beyond < far:
            along = own.dot(other)
            offset = (ti.abs(phi) - along * beyond) * own + (beyond - along * ti.abs(phi)) * other
            offset /= 1.0 - along * along
            off, _normal = self.distance_of_whole(i, y - side * offset)
            if ti.abs(off) < 0.1 * self.spacing and offset.norm() < far:
                least = offset.norm()
                direction = direction_of(offset, least, own)
        return side * least, direction

    @ti.func
    def distance_of_part(self, q: int, y: ti.template()):
        """Return the signed distance of y from part q of a collider, m, or from its complement, and the normal."""
        phi, own = 1e30, ti.Vector.zero(float, self.dimension)
        for code, form in ti.static(self.distances):
            if self.form[q] == code:
                phi, own = form.at(self.numbers, self.begin[q], y)
        if ti.static(self.grids):
            if self.form[q] == GRID:
                phi, own = self.grid_distance.at(self.numbers, self.begin[q], self.sample[q], y)
        sign = ti.cast(self.sign[q], float)
        return sign * phi, sign * own

    @ti.func
    def met(self, i: int, arm: ti.template(), normal: ti.template(), velocity: ti.template()):
        """Return the velocity of a node that collider i covers, and the effect: LOOSE, PRESSED or HELD."""
        own = self.velocity[i] + self.turning[i] @ arm
        relative = velocity - own
        away = relative.dot(normal)
        along = relative - away * normal
        kept, grip = 1.0, LOOSE
        if self.wall[i] == STICK or self.wall[i] == HOLD:
            kept, away, grip = 0.0, 0.0, HELD
        elif away < 0.0 or self.wall[i] == SLIP:
            push, size = -away, along.norm()
            away, grip = 0.0, PRESSED
            if push > 0.0 and self.friction[i] > 0.0:
                kept = ti.max(1.0 - self.friction[i] * push / size, 0.0) if size > 0.0 else 0.0
                grip = PRESSED if kept > 0.0 else HELD
        after = own + kept * along + away * normal
        for a in ti.static(range(self.dimension)):
            if self.lets[i][a] == 1:
                after[a] = velocity[a]
        return after, grip


@ti.data_oriented
class ColliderMotion(Feature):
    """The moving colliders of some runs: their poses and velocities in a step.

    A collider has the pose of the start of a step. Its points have the mean velocity of the step, so that material that
    moves with it stays in place on it exactly. Sums are in double precision.

    Attributes:
        moving: their indices.
        rates: means in the step of the velocity, m/s, and the spin, rad/s. The host sets constant rates.
        work: on the CPU, what the work on the material since the last frame is more than the loads so far times
            `before`, the rates of the last step, J.
    """

    begins = True

    def __init__(self, colliders: Colliders, runs: int) -> None:
        """Allocate poses and rates of the moving colliders of a number of runs, and on the CPU their work."""
        d = colliders.dimension
        self.colliders, self.dimension, self.moving = colliders, d, colliders.kind.moving
        n = runs * len(self.moving)
        self.rates = double_field(n, d + 1)
        # Position of the pivot relative to the lower corner, m, and the angle, rad.
        self.pose = double_field(n, d + 1)
        self.axis = double_field(n, entries=(3,))
        booked = ()
        if colliders.on_cpu:
            self.noted, self.work, self.before = 1, double_field(n), double_field(n, d + 1)
            booked = self.work, self.before
        self._rows = Rows(self.pose, self.axis, self.rates, *booked)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the motions of a run, at time 0."""
        rows = []
        for k in self.moving:
            motion = scene.colliders[k].motion
            place = np.array(motion.pivot) + motion.offset - np.array(scene.domain.origin)
            rates = [float(evaluate(tree, {"t": 0.0})) for tree in motion.rates]
            rows.append([[*place, motion.angle], motion.axis, rates] + [0.0, [0.0] * len(rates)] * self.noted)
        self._rows.write_all(run * len(self.moving), rows)

    def saved(self) -> dict[str, ti.Field]:
        booked = {"colliders.work": self.work, "colliders.before": self.before} if self.noted else {}
        return {"colliders.pose": self.pose} | booked

    @ti.func
    def note(self, run: int, frame: int, column: int, frame_stats: ti.template()):
        work = ti.cast(0, ti.f64)
        for m, k in ti.static(enumerate(self.moving)):
            row = run * ti.static(len(self.moving)) + m
            work += self.work[row] - self.power(row, self.colliders.loads.total(run, k), self.before)
            self.work[row] = 0
        frame_stats[run, frame, column] = work

    def tell(self, values: np.ndarray, _run: int, found: MutableMapping[str, np.ndarray]) -> None:
        if self.noted:
            found["collider_work"] = values[:, 0]

    @ti.func
    def power(self, row: int, load: ti.template(), rates: ti.template()):
        """Return the product of a load, N s and N m s, with rates, J."""
        d = ti.static(self.dimension)
        result = ti.cast(0, ti.f64)
        for a in ti.static(range(d)):
            result += load[a] * rates[row, a]
        if ti.static(d == 2):
            result += load[2] * rates[row, 2]
        else:
            for a in ti.static(range(3)):
                result += load[3 + a] * self.axis[row][a] * rates[row, 3]
        return result

    @ti.func
    def begin_step(self, phases: ti.template(), run: ti.template(), _step: ti.template()):
        phases.device.values.set_motions(run.w, self, run.time, run.time + run.dt)
        if ti.static(self.noted > 0):
            self.book(run.w)
        self.advance(run.w, run.dt)

    @ti.func
    def book(self, run: int):
        """Begin a step: take the work of the loads so far with the rates of this step, by partial summation."""
        for m, k in ti.static(enumerate(self.moving)):
            row, changed = run * ti.static(len(self.moving)) + m, False
            for a in ti.static(range(self.dimension + 1)):
                changed = changed or self.rates[row, a] != self.before[row, a]
            if changed:
                load = self.colliders.loads.total(run, k)
                gained = self.power(row, load, self.rates) - self.power(row, load, self.before)
                self.work[row] = self.work[row] + gained
                for a in ti.static(range(self.dimension + 1)):
                    self.before[row, a] = self.rates[row, a]

    @ti.func
    def advance(self, run: int, dt: ti.f64):
        """Begin a step of dt seconds: set the poses and velocities of the colliders, and advance the poses."""
        d = ti.static(self.dimension)
        for m, k in ti.static(enumerate(self.moving)):
            row = run * ti.static(len(self.moving)) + m
            i = run * self.colliders.capacity + k
            angle, change = self.pose[row, d], dt * self.rates[row, d]
            turned, turning = self.rotation(row, angle), self.rotation(row, change)
            for a in ti.static(range(d)):
                if ti.static(not self.colliders.at_rest):
                    self.colliders.place[i][a] = ti.cast(self.pose[row, a], float)
                self.colliders.velocity[i][a] = ti.cast(self.rates[row, a], float)
                self.pose[row, a] = self.pose[row, a] + dt * self.rates[row, a]
                for b in ti.static(range(d)):
                    own = 1.0 if ti.static(a == b) else 0.0
                    if ti.static(not self.colliders.at_rest):
                        self.colliders.turned[i][a, b] = own + turned[a, b]
                    self.colliders.turning[i][a, b] = turning[a, b] / ti.cast(dt, float)
            if ti.static(self.colliders.at_rest):
                now = ti.Matrix.identity(float, d) + turned
                self.colliders.carried[i] = now @ self.colliders.turned[i].transpose()
            self.pose[row, d] = angle + change

    @ti.func
    def rotation(self, row: int, angle: ti.f64):
        """Return R - I, (d, d), with the rotation R by an angle about the axis, by Rodrigues' formula."""
        d = ti.static(self.dimension)
        result = ti.Matrix.zero(float, d, d)
        # Vulkan has sines in single precision only: for an angle within a turn they are as accurate as the result.
        turns = ti.cast(ti.cast(angle * ti.static(0.5 / math.pi), int), ti.f64)
        part = ti.cast((angle - turns * TURN[0]) - turns * TURN[1], float)
        # 1 - cos without cancellation.
        half = ti.sin(0.5 * part)
        s, versine = ti.sin(part), 2.0 * half * half
        if ti.static(d == 2):
            result[0, 0], result[0, 1], result[1, 0], result[1, 1] = -versine, -s, s, -versine
        else:
            axis = ti.cast(self.axis[row], float)
            for a in ti.static(range(3)):
                for b in ti.static(range(3)):
                    result[a, b] = versine * axis[a] * axis[b]
                    if ti.static(a == b):
                        result[a, b] -= versine
                    elif ti.static((a + 1) % 3 == b):
                        result[a, b] -= s * axis[ti.static(3 - a - b)]
                    else:
                        result[a, b] += s * axis[ti.static(3 - a - b)]
        return result
