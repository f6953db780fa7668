"""The surface of each form: corners of boxes and polygons, turned profiles of round forms, level sets of all others."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from mpmcli.scene.mesh import Mesh
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder
from mpmcli.scene.surface import Surface, poly_data, ring, surface_of

# Straight pieces of a half circle, and cells along the longest side of a form that is found as a level set.
ARC, CELLS = 32, 96
# Outwards, counterclockwise; bit i of a corner's number is its side along axis i.
BOX = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]


def form_surface(form: Any) -> Surface:
    """Return the closed surface of a form with bounds and a signed distance."""
    if isinstance(form, Polygon):
        return ring(np.array(form.vertices))
    if isinstance(form, Box):
        return _box(*form.bounds())
    if isinstance(form, Ball):
        center = np.array(form.center)
        if len(center) == 2:
            return ring(center + form.radius * _arc(0.0, 2 * math.pi))
        pole = np.array([0.0, 0.0, 1.0])
        return _turned(center, pole, form.radius * _arc(0.0, math.pi))
    if isinstance(form, Capsule):
        start, along = np.array(form.start), np.subtract(form.end, form.start)
        axis = along / np.linalg.norm(along)
        first = form.radius * _arc(0.5 * math.pi, math.pi)
        last = form.radius * _arc(0.0, 0.5 * math.pi) + [form.length, 0.0]
        profile = np.concatenate([last, first])
        if len(start) == 2:
            whole = np.concatenate([profile, profile[-2:0:-1] * [1.0, -1.0]])
            return ring(start + whole[:, :1] * axis + whole[:, 1:] * np.array([-axis[1], axis[0]]))
        return _turned(start, axis, profile)
    if isinstance(form, Cylinder):
        r, h = form.radius, form.height
        return _turned(np.array(form.base), form.direction, np.array([[h, 0.0], [h, r], [0.0, r], [0.0, 0.0]]))
    if isinstance(form, Mesh):
        return Surface(form.surface.vertices, form.surface.triangles)
    return level_surface(form.signed_distance, *form.bounds())


def level_surface(
    distance: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, cells: int = CELLS
) -> Surface:
    """Return where a signed distance is zero between two corners (d,), m, found on a grid.

    Args:
        distance: of points (n, d), (n,), m; negative inside.
        cells: along the longest side.
    """
    import pyvista as pv

    d = len(lower)
    edge = float(np.max(upper - lower)) / cells
    corner = lower - 1.5 * edge
    shape = np.ceil((upper - lower) / edge - 1e-9).astype(int) + 4
    places = np.stack(
        np.meshgrid(*(c + edge * np.arange(n) for c, n in zip(corner, shape, strict=True)), indexing="ij")
    )
    values = distance(places.reshape(d, -1).T).reshape(shape)
    flat = [0.0] * (3 - d)
    grid = pv.ImageData(dimensions=(*shape, *[1] * (3 - d)), spacing=[edge] * 3, origin=[*corner, *flat])
    grid.point_data["distance"] = values.ravel(order="F")
    found = grid.contour([0.0], scalars="distance")
    if d == 3:
        return oriented(surface_of(found.triangulate()), distance)
    if found.n_points == 0:
        return Surface(np.empty((0, 2)), np.empty((0, 2), np.int64))
    return oriented(Surface(np.asarray(found.points, float)[:, :2], found.lines.reshape(-1, 3)[:, 1:]), distance)


def oriented(surface: Surface, distance: Callable[[np.ndarray], np.ndarray]) -> Surface:
    """Return a surface whose cells each have the inside of a signed distance behind them, or on the left."""
    if len(surface.cells) == 0:
        return surface
    middle = surface.points[surface.cells].mean(axis=1)
    step = 1e-3 * np.sqrt(surface.sizes)[:, None] if surface.points.shape[1] == 3 else 1e-3 * surface.sizes[:, None]
    wrong = distance(middle + step * surface.normals) < distance(middle - step * surface.normals)
    return Surface(surface.points, np.where(wrong[:, None], surface.cells[:, ::-1], surface.cells))


def without_doubles(surface: Surface) -> Surface:
    """Return triangles whose corners at one place are one point."""
    from vtkmodules.vtkFiltersCore import vtkCleanPolyData

    clean = vtkCleanPolyData()
    clean.SetInputData(poly_data(surface))
    clean.SetTolerance(0.0)
    clean.ConvertPolysToLinesOff()
    clean.Update()
    return surface_of(clean.GetOutput())


def _arc(start: float, end: float) -> np.ndarray:
    """Return points (n, 2) of a unit circle between two angles; the last of a whole circle is left out."""
    count = max(round((end - start) / math.pi * ARC), 1)
    angles = np.linspace(start, end, count + 1)[: count if end - start > 6.0 else None]
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points[np.abs(points) < 1e-15] = 0.0
    return points


def _box(lower: np.ndarray, upper: np.ndarray) -> Surface:
    d = len(lower)
    corners = np.array([[upper[a] if k >> a & 1 else lower[a] for a in range(d)] for k in range(2**d)])
    if d == 2:
        return ring(corners[[0, 1, 3, 2]])
    return Surface(corners, np.array([t for a, b, c, e in BOX for t in ((a, b, c), (a, c, e))], dtype=np.int64))


def _turned(start: np.ndarray, axis: np.ndarray, profile: np.ndarray) -> Surface:
    """Return the surface of a profile that turns about an axis.

    Args:
        start: on the axis, (3,), m; axis: a unit vector, (3,).
        profile: (n, 2), places along the axis, falling, and distances from it, m; 0 at both ends.
    """
    around = 2 * ARC
    side = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, side)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = 2 * math.pi * np.arange(around) / around
    circle = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    rings = start + profile[1:-1, :1, None] * axis + profile[1:-1, 1:, None] * circle
    points = np.concatenate([[start + profile[0, 0] * axis], rings.reshape(-1, 3), [start + profile[-1, 0] * axis]])
    here = np.arange(around)
    ahead = np.roll(here, -1)
    last = len(points) - 1
    cells = [np.stack([np.zeros_like(here), 1 + here, 1 + ahead], axis=1)]
    for k in range(len(rings) - 1):
        a, b = 1 + k * around, 1 + (k + 1) * around
        cells.append(np.stack([a + here, b + here, b + ahead], axis=1))
        cells.append(np.stack([a + here, b + ahead, a + ahead], axis=1))
    bottom = 1 + (len(rings) - 1) * around
    cells.append(np.stack([bottom + here, np.full_like(here, last), bottom + ahead], axis=1))
    return Surface(points, np.concatenate(cells).astype(np.int64))
