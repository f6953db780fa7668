"""Surfaces of forms and colliders: outlines of segments in 2D, triangles in 3D, and points on them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.primitives import Ball, Box, Capsule, Cylinder, Polygon, TurnedBox, box_corners
from mpmcli.scene.sampling import first_come

if TYPE_CHECKING:
    import pyvista as pv


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface of a body.

    A segment has the body on its left; a triangle has it behind, seen from where its corners run counterclockwise.
    """

    points: np.ndarray  # (n, d), m
    cells: np.ndarray  # (m, d) int64, indices of points

    @property
    def flipped(self) -> "Surface":
        """The same surface with the body on the other side."""
        return Surface(self.points, self.cells[:, ::-1])

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the cells, away from the body, (m, d); zeros for a cell without extent."""
        across = self._across
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    @property
    def sizes(self) -> np.ndarray:
        """Lengths of the segments, m, or areas of the triangles, m^2, (m,)."""
        lengths = np.linalg.norm(self._across, axis=1)
        return lengths if self.points.shape[1] == 2 else 0.5 * lengths

    @property
    def _across(self) -> np.ndarray:
        """Normals of the cells as long as a segment, or as twice the area of a triangle."""
        corners = self.points[self.cells]
        along = corners[:, 1] - corners[:, 0]
        if self.points.shape[1] == 2:
            return np.stack([along[:, 1], -along[:, 0]], axis=1)
        return np.cross(along, corners[:, 2] - corners[:, 0])

    def chains(self) -> list[np.ndarray]:
        """Return the segments of a 2D surface joined to lines, points (k, 2) each; the last is the first of a ring."""
        following = dict(self.cells.tolist())
        starts = [start for start in following if start not in set(following.values())]
        found = []
        while following:
            line = [starts.pop() if starts else next(iter(following))]
            while line[-1] in following:
                line.append(following.pop(line[-1]))
            found.append(self.points[line])
        return found


def joined(surfaces: list[Surface], dimension: int) -> Surface:
    """Return several surfaces as one."""
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    cells = [surface.cells + start for surface, start in zip(surfaces, starts, strict=False)]
    none = np.empty((0, dimension))
    return Surface(
        np.concatenate([none, *(surface.points for surface in surfaces)]),
        np.concatenate([none.astype(np.int64), *cells]),
    )


def ring(points: np.ndarray) -> Surface:
    """Return a closed outline through points (n, 2) in either order, counterclockwise."""
    x, y = points.T
    if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0:
        points = points[::-1]
    numbers = np.arange(len(points))
    return Surface(points, np.stack([numbers, np.roll(numbers, -1)], axis=1))


def within(surface: Surface, lower: np.ndarray, upper: np.ndarray, *, caps: bool) -> Surface:
    """Return the part of a surface within a box; with `caps`, closed again where the box cuts it (3D)."""
    if len(surface.points) == 0:
        return surface
    if (surface.points.min(axis=0) >= lower).all() and (surface.points.max(axis=0) <= upper).all():
        return surface
    if surface.points.shape[1] == 3:
        return _triangles_within(surface, lower, upper, caps)
    # A segment is cut off as a + s (b - a), from the last s at which it enters to the first at which it leaves.
    a, b = surface.points[surface.cells[:, 0]], surface.points[surface.cells[:, 1]]
    along = b - a
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (lower - a) / along, (upper - a) / along
    beside = (along == 0) & ((a < lower) | (a > upper))
    into = np.where(along == 0, 0.0, np.minimum(first, second)).max(axis=1, initial=0.0)
    out = np.where(along == 0, 1.0, np.maximum(first, second)).min(axis=1, initial=1.0)
    kept = (into < out) & ~beside.any(axis=1)
    a, along, into, out = a[kept], along[kept], into[kept, None], out[kept, None]
    ends = np.stack([a + into * along, a + out * along], axis=1).reshape(-1, 2)
    points, numbers = np.unique(ends, axis=0, return_inverse=True)
    return Surface(points, numbers.reshape(-1, 2))


def _triangles_within(surface: Surface, lower: np.ndarray, upper: np.ndarray, caps: bool) -> Surface:
    """Return the part of a triangulated surface in a box, m, closed on the faces of the box if `caps`."""
    import pyvista as pv
    from vtkmodules.vtkCommonDataModel import vtkPlane, vtkPlaneCollection
    from vtkmodules.vtkFiltersGeneral import vtkClipClosedSurface

    planes = vtkPlaneCollection()
    for axis in range(3):
        for corner, sign in ((lower, 1.0), (upper, -1.0)):
            plane = vtkPlane()
            plane.SetOrigin(*corner)
            plane.SetNormal(*(sign * np.eye(3)[axis]))
            planes.AddItem(plane)
    clip = vtkClipClosedSurface()
    clip.SetInputData(poly_data(surface))
    clip.SetClippingPlanes(planes)
    clip.SetScalarModeToLabels()
    clip.TriangulationErrorDisplayOff()
    clip.Update()
    output = pv.wrap(clip.GetOutput())
    found = surface_of(output)
    if caps or len(found.cells) == 0:
        return found
    # Label 0 marks the cells of the input.
    return Surface(found.points, found.cells[output.cell_data.active_scalars == 0])


def poly_data(surface: Surface) -> "pv.PolyData":
    """Return triangles as PyVista's polygonal data."""
    import pyvista as pv

    # VTK 9.7's clip confuses cell arrays of one stored size with others.
    return pv.PolyData(surface.points, np.insert(surface.cells, 0, 3, axis=1))


def surface_of(data: "pv.PolyData") -> Surface:
    """Return the triangles of PyVista's polygonal data."""
    if data.GetNumberOfPolys() == 0:
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))
    return Surface(np.array(data.points, np.float64), np.array(data.regular_faces, np.int64))


# Straight pieces of a half circle, and cells along the longest side of a form that is found as a level set.
ARC, CELLS = 32, 96
# Outwards, counterclockwise; bit i of a corner's number is its side along axis i.
BOX = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]


def form_surface(form: Any) -> Surface:
    """Return the closed surface of a form: corners, rotated profiles of round forms, or level sets of all others."""
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
    if isinstance(form, TurnedBox):
        return _cuboid(form.corners)
    return level_surface(form.signed_distance, *form.bounds())


def level_surface(
    distance: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, cells: int = CELLS
) -> Surface:
    """Return the zero level of a signed distance between two corners, on a grid of `cells` along the longest side."""
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
    """Return triangles with coincident corners merged."""
    return surface_of(poly_data(surface).clean(tolerance=0.0, lines_to_points=False, polys_to_lines=False))


def _arc(start: float, end: float) -> np.ndarray:
    """Return points (n, 2) of a unit circle between two angles; the last of a whole circle is left out."""
    count = max(round((end - start) / math.pi * ARC), 1)
    angles = np.linspace(start, end, count + 1)[: count if end - start > 6.0 else None]
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points[np.abs(points) < 1e-15] = 0.0
    return points


def _box(lower: np.ndarray, upper: np.ndarray) -> Surface:
    corners = box_corners(lower, upper)
    if len(lower) == 2:
        return ring(corners[[0, 1, 3, 2]])
    return _cuboid(corners)


def _cuboid(corners: np.ndarray) -> Surface:
    """Return the surface of a cuboid from its corners, (8, 3), numbered as by `box_corners`."""
    return Surface(corners, np.array([t for a, b, c, e in BOX for t in ((a, b, c), (a, c, e))], dtype=np.int64))


def _beside(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that are normal to a third one and to each other."""
    u = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    u /= np.linalg.norm(u)
    return u, np.cross(axis, u)


def _turned(start: np.ndarray, axis: np.ndarray, profile: np.ndarray) -> Surface:
    """Return the surface of revolution of a profile about an axis, a unit vector, through a point `start`, (3,), m.

    The profile has positions along the axis, decreasing, and distances from it, 0 at both ends, (n, 2), m.
    """
    around = 2 * ARC
    u, v = _beside(axis)
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


# Cosine of the angle from which on an edge is sharp.
SHARP = math.cos(math.radians(30.0))
# Smallest distance in spacings: the mean distance of random disks, one to a square of the spacing.
APART = 0.78
# Candidates to a square of the spacing.
CANDIDATES = 24
SEED = 0


def surface_points(surface: Surface, spacing: float) -> np.ndarray:
    """Return points on a surface, (n, d), about one to a length (2D) or square (3D) of the spacing, m.

    Corners in 2D, and sharp edges in 3D, have points of their own. The result is deterministic.
    """
    if len(surface.cells) == 0:
        return np.empty((0, surface.points.shape[1]))
    if surface.points.shape[1] == 2:
        return np.concatenate([_along(chain, spacing) for chain in surface.chains()])
    from scipy.spatial import cKDTree

    # Candidates on sharp edges come first, the others in random order; each is taken if it is apart from all before it.
    random = np.random.default_rng(SEED)
    shares = surface.sizes / surface.sizes.sum()
    count = max(math.ceil(CANDIDATES * surface.sizes.sum() / spacing**2), 1)
    cells = surface.cells[np.searchsorted(np.cumsum(shares), random.random(count) * (1 - 1e-12))]
    u, v = random.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (surface.points[cells[:, k]] for k in range(3))
    points = np.concatenate([_edge_points(surface, spacing), a + u * (b - a) + v * (c - a)])
    pairs = cKDTree(points).query_pairs(APART * spacing, output_type="ndarray")
    return points[first_come(pairs, len(points))]


def _along(chain: np.ndarray, spacing: float) -> np.ndarray:
    """Return points at equal distances between the corners of a line (k, 2)."""
    chain = chain[[True, *(np.diff(chain, axis=0) != 0).any(axis=1)]]
    closed = len(chain) > 2 and np.array_equal(chain[0], chain[-1])
    if closed:
        # Begin at a corner, if there is one.
        turns = np.flatnonzero(_turns(np.concatenate([chain[-2:-1], chain])))
        chain = np.roll(chain[:-1], -int(turns[0]) if len(turns) else 0, axis=0)
        chain = np.concatenate([chain, chain[:1]])
    cuts = [0, *(1 + np.flatnonzero(_turns(chain))).tolist(), len(chain) - 1]
    found = []
    for a, b in pairwise(cuts):
        # At equal distances, the first one and not the last.
        part = chain[a : b + 1]
        gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(part, axis=0), axis=1))])
        count = max(round(gone[-1] / spacing), 1)
        places = gone[-1] * np.arange(count) / count
        found.append(np.stack([np.interp(places, gone, axis) for axis in part.T], axis=1))
    return np.concatenate(found if closed else [*found, chain[-1:]])


def _turns(chain: np.ndarray) -> np.ndarray:
    """Return whether a line (k, 2) turns at each of its points but the ends, (k - 2,)."""
    along = np.diff(chain, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.sum(along[1:] * along[:-1], axis=1) < SHARP


def _edge_points(surface: Surface, spacing: float) -> np.ndarray:
    """Return points on the sharp edges and rims of triangles, at most a spacing apart, (n, 3)."""
    edges = np.concatenate([surface.cells[:, [k, (k + 1) % 3]] for k in range(3)])
    cell = np.tile(np.arange(len(surface.cells)), 3)
    ordered = np.sort(edges, axis=1)
    order = np.lexsort((ordered[:, 1], ordered[:, 0]))
    ordered, cell = ordered[order], cell[order]
    same = (ordered[1:] == ordered[:-1]).all(axis=1)
    normals = surface.normals
    sharp = np.ones(len(ordered), bool)
    flat = same & (np.sum(normals[cell[1:]] * normals[cell[:-1]], axis=1) >= SHARP)
    sharp[1:][flat] = sharp[:-1][flat] = False
    found = [np.empty((0, 3))]
    for a, b in surface.points[np.unique(ordered[sharp], axis=0)]:
        count = max(round(float(np.linalg.norm(b - a)) / spacing), 1)
        found.append(a + np.arange(count + 1)[:, None] / count * (b - a))
    return np.concatenate(found)


def collider_surface(collider: Collider, lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Return the surface of a collider at its shape, before `Motion` moves it; the material is in front of it.

    Planes, containers and colliders at rest are cut off at the domain, at time 0, with these corners, (d,), m.
    """
    if isinstance(collider.form, Plane):
        return _plane(collider, lower, upper)
    surface = form_surface(collider.form)
    motion, inside = collider.motion, collider.side == "inside"
    if inside or not motion.moves:
        placed = Surface(motion.placed(surface.points, 0.0), surface.cells)
        kept = within(placed, lower, upper, caps=not inside)
        if kept is not placed:
            surface = Surface(motion.taken_back(kept.points, 0.0), kept.cells)
    return surface.flipped if inside else surface


def _plane(collider: Collider, lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Return the part of a plane in the domain; if it misses the domain, of the parallel plane that touches it."""
    motion, form = collider.motion, collider.form
    inside = collider.side == "inside"
    point = motion.placed(np.array([form.point]), 0.0)[0]
    normal = motion.placed(np.array([form.point]) + form.direction, 0.0)[0] - point
    normal /= np.linalg.norm(normal)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    reach = float(np.abs(normal) @ half)
    away = float((point - middle) @ normal)
    # Rounding must not cut off a plane on a face of the domain.
    shift = away - np.clip(away, -(1 - 1e-12) * reach, (1 - 1e-12) * reach)
    center = middle + (away - shift) * normal
    far = 2.0 * float(np.linalg.norm(half))
    if len(lower) == 2:
        along = np.array([-normal[1], normal[0]])
        quad = Surface(center + far * np.array([[-1.0], [1.0]]) * along, np.array([[0, 1]]))
    else:
        u, v = _beside(normal)
        corners = center + far * np.array([-u - v, u - v, u + v, v - u])
        quad = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    found = within(quad, lower - 1e-9 * half, upper + 1e-9 * half, caps=False)
    back = motion.taken_back(found.points + shift * normal, 0.0)
    return Surface(back, found.cells).flipped if inside else Surface(back, found.cells)
