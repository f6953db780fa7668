"""Signed distances in kernels: one class per form of colliders, with its parameters, distance and normal.

Points are relative to the pivot of the collider, in its unrotated frame. Distances are negative inside the form.
Normals are their gradients and point out of the form.
"""

from functools import lru_cache

import numpy as np

from mpmcli.quick_taichi import ti
from mpmcli.scene.colliders import Plane
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder, Polygon, TurnedBox
from mpmcli.scene.shapes import Form, distance_grid
from mpmcli.scene.surface import ring

# Vectors shorter than this have no direction.
TINY = 1e-12
# Nodes of a distance grid per cell of the scene, its margin around the form in cells, and the number of nodes above
# which it has one per cell.
FINE, MARGIN, MANY = 2, 2, 8_000_000


class Distance:
    """The distance from a form.

    `numbers` returns the parameters of a form for kernels. `at`, a ti.func, returns the signed distance of y from the
    form whose parameters begin at index `first`, and the normal.
    """

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension


@ti.func
def direction_of(v: ti.template(), size: float, fallback: ti.template()):
    """Return v / size, or the fallback if the size is zero."""
    result = fallback
    if size > TINY:
        result = v / size
    return result


@ti.func
def first_axis(y: ti.template()):
    """Return the unit vector along the first axis, with the dimension of y."""
    result = y * 0.0
    result[0] = 1.0
    return result


@ti.data_oriented
class PlaneDistance(Distance):
    """A half space: its normal, and the distance of the plane from the pivot."""

    def numbers(self, form: Plane, pivot: np.ndarray) -> list[float]:
        normal = form.direction
        return [*normal, float((np.array(form.point) - pivot) @ normal)]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        normal = ti.Vector.zero(float, self.dimension)
        phi = -numbers[first + self.dimension]
        for a in ti.static(range(self.dimension)):
            normal[a] = numbers[first + a]
            phi += normal[a] * y[a]
        return phi, normal


@ti.data_oriented
class BoxDistance(Distance):
    """A box: its centre and its half lengths."""

    def numbers(self, form: Box, pivot: np.ndarray) -> list[float]:
        lower, upper = form.bounds()
        return [*((lower + upper) / 2 - pivot), *((upper - lower) / 2)]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        d = ti.static(self.dimension)
        own = y
        for a in ti.static(range(d)):
            own[a] = y[a] - numbers[first + a]
        return self.around(numbers, first + d, own)

    @ti.func
    def around(self, numbers: ti.template(), first: int, y: ti.template()):
        """Return the signed distance of y from a box about 0 whose half lengths begin at `first`, and the normal."""
        d = ti.static(self.dimension)
        side = ti.Vector.zero(float, d)
        beyond = ti.Vector.zero(float, d)
        nearest = ti.Vector.zero(float, d)
        deepest, square = -1e30, 0.0
        for a in ti.static(range(d)):
            out = ti.abs(y[a]) - numbers[first + a]
            side[a] = 1.0 if y[a] >= 0 else -1.0
            beyond[a] = ti.max(out, 0.0) * side[a]
            square += beyond[a] ** 2
            deepest = ti.max(deepest, out)
        found = False
        for a in ti.static(range(d)):
            out = ti.abs(y[a]) - numbers[first + a]
            if not found and out == deepest:
                nearest[a] = side[a]
                found = True
        phi = ti.min(deepest, 0.0)
        if deepest > 0:
            phi = ti.sqrt(square)
            nearest = direction_of(beyond, phi, nearest)
        return phi, nearest

    @ti.func
    def face(self, numbers: ti.template(), first: int, y: ti.template(), axis: int):
        """Return the signed distance of y from the nearer of the two faces normal to an axis, and the normal."""
        normal = ti.Vector.zero(float, self.dimension)
        out = 0.0
        for a in ti.static(range(self.dimension)):
            if a == axis:
                from_center = y[a] - numbers[first + a]
                out = ti.abs(from_center) - numbers[first + self.dimension + a]
                normal[a] = 1.0 if from_center >= 0 else -1.0
        return out, normal


@ti.data_oriented
class TurnedBoxDistance(Distance):
    """A box in any direction: its middle, its half lengths, and its rotation by rows."""

    def __init__(self, dimension: int) -> None:
        super().__init__(dimension)
        self.box = BoxDistance(dimension)

    def numbers(self, form: TurnedBox, pivot: np.ndarray) -> list[float]:
        return [*(np.array(form.middle) - pivot), *form.half, *np.ravel(form.turn)]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        offset, turn = y, ti.Matrix.zero(float, 3, 3)
        for a in ti.static(range(3)):
            offset[a] = y[a] - numbers[first + a]
            for b in ti.static(range(3)):
                turn[a, b] = numbers[first + 6 + 3 * a + b]
        phi, normal = self.box.around(numbers, first + 3, turn.transpose() @ offset)
        return phi, turn @ normal


@ti.data_oriented
class BallDistance(Distance):
    """A ball: its centre and its radius."""

    def numbers(self, form: Ball, pivot: np.ndarray) -> list[float]:
        return [*(np.array(form.center) - pivot), form.radius]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        offset = y
        for a in ti.static(range(self.dimension)):
            offset[a] = y[a] - numbers[first + a]
        size = offset.norm()
        return size - numbers[first + self.dimension], direction_of(offset, size, first_axis(y))


@ti.data_oriented
class CapsuleDistance(Distance):
    """All points within a radius of a segment: its start, its end minus its start, and the radius."""

    def numbers(self, form: Capsule, pivot: np.ndarray) -> list[float]:
        start, end = np.array(form.start), np.array(form.end)
        return [*(start - pivot), *(end - start), form.radius]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        """Return the distance to the point of the segment that is nearest to y, less the radius, m, and the normal."""
        d = ti.static(self.dimension)
        along, length = 0.0, 0.0
        for a in ti.static(range(d)):
            along += (y[a] - numbers[first + a]) * numbers[first + d + a]
            length += numbers[first + d + a] ** 2
        share = ti.min(ti.max(along / length, 0.0), 1.0)
        offset = y
        for a in ti.static(range(d)):
            offset[a] = y[a] - numbers[first + a] - share * numbers[first + d + a]
        size = offset.norm()
        return size - numbers[first + 2 * d], direction_of(offset, size, first_axis(y))


@ti.data_oriented
class CylinderDistance(Distance):
    """A round cylinder with flat ends: its base, its direction, its height and its radius."""

    def numbers(self, form: Cylinder, pivot: np.ndarray) -> list[float]:
        return [*(np.array(form.base) - pivot), *form.direction, form.height, form.radius]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        """Return the larger of the distances to side and ends, m, beside both that to the rim, and the normal."""
        offset = y
        axis = y
        along = 0.0
        for a in ti.static(range(3)):
            offset[a] = y[a] - numbers[first + a]
            axis[a] = numbers[first + 3 + a]
            along += offset[a] * axis[a]
        across = offset - along * axis
        away = across.norm()
        height = numbers[first + 6]
        outward = direction_of(across, away, first_axis(y))
        end = axis if along > 0.5 * height else -axis
        over = ti.abs(along - 0.5 * height) - 0.5 * height
        wide = away - numbers[first + 7]
        phi = ti.max(over, wide)
        normal = end if over > wide else outward
        if over > 0 and wide > 0:
            phi = ti.sqrt(over**2 + wide**2)
            normal = (over * end + wide * outward) / phi
        return phi, normal


@ti.data_oriented
class PolygonDistance(Distance):
    """A polygon: the number of its vertices, and their coordinates, counterclockwise."""

    def numbers(self, form: Polygon, pivot: np.ndarray) -> list[float]:
        vertices = ring(np.array(form.vertices) - pivot).points
        return [float(len(vertices)), *vertices.ravel()]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        """Return the distance to the nearest edge, m, negative inside by the crossings of a ray, and the normal."""
        count = ti.cast(numbers[first], int)
        square, inside, beside = 1e30, False, False
        nearest = y
        normal = first_axis(y)
        last = first + 2 * count - 1
        ax, ay = numbers[last], numbers[last + 1]
        for i in range(count):
            bx, by = numbers[first + 1 + 2 * i], numbers[first + 2 + 2 * i]
            ex, ey = bx - ax, by - ay
            t = ti.min(ti.max(((y[0] - ax) * ex + (y[1] - ay) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
            dx, dy = y[0] - ax - t * ex, y[1] - ay - t * ey
            own = dx * dx + dy * dy
            if own < square:
                square = own
                nearest[0], nearest[1] = dx, dy
                # The right of the edge is outside.
                size = ti.sqrt(ex * ex + ey * ey)
                normal[0], normal[1] = ey / size, -ex / size
                # Beside an edge its normal is exact, also for a node on it, whose offset is only rounding.
                beside = t > 0.0 and t < 1.0
            if (ay > y[1]) != (by > y[1]):
                if y[0] < ax + (y[1] - ay) * ex / ey:
                    inside = not inside
            ax, ay = bx, by
        away = ti.sqrt(square)
        phi = -away if inside else away
        if away > TINY and not beside:
            normal = nearest / phi
        return phi, normal


DISTANCES = {
    Plane: PlaneDistance,
    Box: BoxDistance,
    Ball: BallDistance,
    Capsule: CapsuleDistance,
    Cylinder: CylinderDistance,
    Polygon: PolygonDistance,
    TurnedBox: TurnedBoxDistance,
}


@lru_cache(maxsize=8)
def samples_of(form: Form, h: float, within: tuple = ()) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the distances from a form, in the box `within`, in a scene with cells of h metres; see `distance_grid`."""
    box = np.clip(form.bounds(), *within) if within else form.bounds()
    cells = float(np.prod((box[1] - box[0]) / h + 2 * MARGIN))
    fine = FINE if cells * FINE ** len(box[0]) <= MANY else 1
    return distance_grid(form, h / fine, MARGIN * h, box)


@ti.data_oriented
class GridDistance:
    """A mesh, by a quadratic spline through its distances at the nodes of a grid; its gradient is continuous.

    Its parameters are the first node, the spacing, and the nodes per axis. Outside the grid, without its outermost half
    cell, the distance to the grid is added.
    """

    def __init__(self, dimension: int, samples: ti.Field) -> None:
        self.dimension, self.samples = dimension, samples

    @staticmethod
    def numbers(pivot: np.ndarray, values: np.ndarray, origin: np.ndarray, spacing: float) -> list[float]:
        """Return the parameters for kernels of a grid with these distances."""
        return [*(origin - pivot), spacing, *map(float, values.shape)]

    @staticmethod
    def coefficients(values: np.ndarray) -> np.ndarray:
        """Return the coefficients of the spline through the distances, float32, of the same shape."""
        from scipy.ndimage import spline_filter

        return spline_filter(values, order=2, output=np.float32)

    @ti.func
    def at(self, numbers: ti.template(), first: int, sample: int, y: ti.template()):
        """Return the signed distance of y from the form, and the normal; its coefficients begin at `sample`."""
        d = ti.static(self.dimension)
        spacing = numbers[first + d]
        base = ti.Vector.zero(int, d)
        weights, rises = ti.Matrix.zero(float, 3, d), ti.Matrix.zero(float, 3, d)
        beyond = 0.0
        for a in ti.static(range(d)):
            u = (y[a] - numbers[first + a]) / spacing
            clamped = ti.min(ti.max(u, 0.5), numbers[first + d + 1 + a] - 1.5)
            beyond += (u - clamped) ** 2
            base[a] = ti.cast(ti.min(clamped + 0.5, numbers[first + d + 1 + a] - 1.5), int)
            t = clamped - ti.cast(base[a], float)
            weights[0, a], weights[1, a], weights[2, a] = 0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2
            rises[0, a], rises[1, a], rises[2, a] = t - 0.5, -2.0 * t, t + 0.5
        phi = 0.0
        slope = ti.Vector.zero(float, d)
        for corner in range(ti.static(3**d)):
            index, rest, weight, rise = 0, corner, 1.0, ti.Vector.one(float, d)
            for a in ti.static(range(d)):
                k = rest % 3
                rest = rest // 3
                index = index * ti.cast(numbers[first + d + 1 + a], int) + base[a] + k - 1
                own = ti.select(k == 0, weights[0, a], ti.select(k == 1, weights[1, a], weights[2, a]))
                up = ti.select(k == 0, rises[0, a], ti.select(k == 1, rises[1, a], rises[2, a]))
                weight *= own
                for b in ti.static(range(d)):
                    rise[b] *= up if ti.static(a == b) else own
            value = self.samples[sample + index]
            phi += weight * value
            slope += value * rise
        return phi + spacing * ti.sqrt(beyond), direction_of(slope, slope.norm(), first_axis(y))
