"""Thickness of a shape, which the grid has to resolve."""

import math
from collections.abc import Collection
from itertools import product

import numpy as np

from mpmcli.scene import Scene
from mpmcli.scene.distance_grid import distance_grid
from mpmcli.scene.shapes import Ball, Box, Capsule, Cylinder, Form, Mesh, Points

# Accuracy of the largest ball in a form, relative to the extent of the form, in 2D and 3D.
RESOLUTION = {2: 1e-3, 3: 2e-2}
# Cells along the longest axis of a mesh, at whose nodes the middle of its largest ball is sought.
CELLS = 48
# Distance from a wall, in cells, below which a body touches it.
TOUCHING = 1e-3


def spanned_axes(scene: Scene, form: Form) -> set[int]:
    """Return the axes along which a box spans the domain between walls without "stick", as unbounded matter does."""
    if not isinstance(form, Box):
        return set()
    domain = scene.domain
    touching = TOUCHING * domain.spacing
    return {
        a
        for a, walls in enumerate(domain.walls.faces(scene.dimension))
        if "stick" not in walls
        and form.min[a] - domain.origin[a] < touching
        and domain.upper[a] - form.max[a] < touching
    }


def thickness(form: Form, endless: Collection[int] = ()) -> float:
    """Return the diameter of the largest ball that fits into a shape, m: its thinnest extent where it is convex.

    Of a mesh to a few cells of a grid of 48; of a union, that of its parts where they overlap; of points, that of their
    bounding box.

    The axes in `endless` are ignored for a box, unless all axes are in it.
    """
    if isinstance(form, Ball | Capsule):
        return 2 * form.radius
    if isinstance(form, Cylinder):
        return min(2 * form.radius, form.height)
    if isinstance(form, Box):
        edges = [hi - lo for lo, hi in zip(form.min, form.max, strict=True)]
        return min((edge for a, edge in enumerate(edges) if a not in endless), default=max(edges))
    if isinstance(form, Points):
        return float(np.ptp(form.bounds(), axis=0).min()) + form.edge
    if isinstance(form, Mesh):
        spacing = float(np.ptp(form.bounds(), axis=0).max()) / CELLS
        return -2 * float(distance_grid(form, spacing, 0.0)[0].min())
    return 2 * _inradius(form)


def height_along(form: Form, direction: np.ndarray) -> float:
    """Return the extent of the bounding box of a shape along a unit vector, (d,); m."""
    lower, upper = form.bounds()
    return float((upper - lower) @ np.abs(direction))


def _inradius(form: Form) -> float:
    """Return the radius of the largest ball inside a form, or a bound of it where its distance is one.

    Cells that may contain a better centre are halved until none can improve the result by RESOLUTION. No point of a
    cell is farther from the surface than the centre of the cell plus half a diagonal.
    """
    lower, upper = form.bounds()
    d, size = len(lower), float(np.max(upper - lower))
    half = float(np.min(upper - lower)) / 2
    counts = np.ceil((upper - lower) / (2 * half)).astype(int)
    centres = lower + (np.stack(np.meshgrid(*map(np.arange, counts)), axis=-1).reshape(-1, d) * 2 + 1) * half
    offsets = np.array(list(product((-1, 1), repeat=d)))
    best = 0.0
    while len(centres):
        distance = -form.signed_distance(centres)
        best = max(best, float(distance.max()))
        promising = centres[distance + math.sqrt(d) * half > best + RESOLUTION[d] * size]
        half /= 2
        centres = (promising[:, None, :] + half * offsets).reshape(-1, d)
    return best
