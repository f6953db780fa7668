"""Signed distances in kernels: a class per form of colliders, each with its numbers and its distance and normal.

Points are relative to the pivot of the collider, and turned back. Distances are negative inside of the form, and
normals are their gradients, which point out of it.
"""

from typing import Protocol

import numpy as np
import taichi as ti

from mpmcli.scene.colliders import Plane
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder

# Distances below this share of a length have no direction.
TINY = 1e-12


class Distance(Protocol):
    """The distance from a form."""

    def numbers(self, form: object, pivot: np.ndarray) -> list[float]:
        """Return what a kernel needs of a form."""

    def at(self, numbers: object, first: int, y: object) -> tuple[float, object]:
        """Return the signed distance of y from the form with these numbers, and the normal; a ti.func."""


@ti.func
def direction_of(v: ti.template(), size: float, fallback: ti.template()):
    """Return v / size, a fallback where the size is zero."""
    result = fallback
    if size > TINY:
        result = v / size
    return result


@ti.func
def first_axis(y: ti.template()):
    """Return a unit vector as wide as y."""
    result = y * 0.0
    result[0] = 1.0
    return result


@ti.data_oriented
class PlaneDistance:
    """A half space: its normal, and the distance of the plane from the pivot."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

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
class BoxDistance:
    """A box: its centre and its half lengths."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

    def numbers(self, form: Box, pivot: np.ndarray) -> list[float]:
        lower, upper = form.bounds()
        return [*((lower + upper) / 2 - pivot), *((upper - lower) / 2)]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        d = ti.static(self.dimension)
        side = ti.Vector.zero(float, d)
        beyond = ti.Vector.zero(float, d)
        nearest = ti.Vector.zero(float, d)
        deepest, square = -1e30, 0.0
        for a in ti.static(range(d)):
            from_center = y[a] - numbers[first + a]
            out = ti.abs(from_center) - numbers[first + d + a]
            side[a] = 1.0 if from_center >= 0 else -1.0
            beyond[a] = ti.max(out, 0.0) * side[a]
            square += beyond[a] ** 2
            deepest = ti.max(deepest, out)
        found = False
        for a in ti.static(range(d)):
            out = ti.abs(y[a] - numbers[first + a]) - numbers[first + d + a]
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
        """Return the signed distance of y from the nearer of the two faces across an axis alone, and the normal."""
        normal = ti.Vector.zero(float, self.dimension)
        out = 0.0
        for a in ti.static(range(self.dimension)):
            if a == axis:
                from_center = y[a] - numbers[first + a]
                out = ti.abs(from_center) - numbers[first + self.dimension + a]
                normal[a] = 1.0 if from_center >= 0 else -1.0
        return out, normal


@ti.data_oriented
class BallDistance:
    """A ball: its centre and its radius."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

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
class CapsuleDistance:
    """All points within a radius of a segment: its start, its end less its start, and the radius."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

    def numbers(self, form: Capsule, pivot: np.ndarray) -> list[float]:
        start, end = np.array(form.start), np.array(form.end)
        return [*(start - pivot), *(end - start), form.radius]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
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
class CylinderDistance:
    """A round cylinder with flat ends: its base, its direction, its height and its radius."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

    def numbers(self, form: Cylinder, pivot: np.ndarray) -> list[float]:
        return [*(np.array(form.base) - pivot), *form.direction, form.height, form.radius]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
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
class PolygonDistance:
    """A polygon: the number of its vertices, and their coordinates, counterclockwise."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension

    def numbers(self, form: Polygon, pivot: np.ndarray) -> list[float]:
        vertices = np.array(form.vertices) - pivot
        x, y = vertices.T
        if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0:
            vertices = vertices[::-1]
        return [float(len(vertices)), *vertices.ravel()]

    @ti.func
    def at(self, numbers: ti.template(), first: int, y: ti.template()):
        count = ti.cast(numbers[first], int)
        square, inside = 1e30, False
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
                # Right of the edge, which is outside.
                size = ti.sqrt(ex * ex + ey * ey)
                normal[0], normal[1] = ey / size, -ex / size
            if (ay > y[1]) != (by > y[1]):
                if y[0] < ax + (y[1] - ay) * ex / ey:
                    inside = not inside
            ax, ay = bx, by
        away = ti.sqrt(square)
        phi = -away if inside else away
        if away > TINY:
            normal = nearest / phi
        return phi, normal


DISTANCES = {
    Plane: PlaneDistance,
    Box: BoxDistance,
    Ball: BallDistance,
    Capsule: CapsuleDistance,
    Cylinder: CylinderDistance,
    Polygon: PolygonDistance,
}
