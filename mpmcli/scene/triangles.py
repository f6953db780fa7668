"""Closed surfaces of triangles: volume, area, inside test, and distance of points and of the nodes of a grid."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from mpmcli.scene.primitives import grid_points

# Points, and pairs of a point and a triangle, that are looked at together: bounds the memory, keeps pairs in the cache.
POINTS_AT_ONCE = 200_000
_PAIRS_AT_ONCE = 50_000
# Bins per axis of the raster that finds the triangles over a point.
_BINS = 1024

# Nodes along each axis.
Shape = tuple[int, int, int]


class Crossings(NamedTuple):
    """Where lines along z meet the surface: number of the line, z (m), and 1 where it faces up, else -1, (c,)."""

    line: np.ndarray
    z: np.ndarray
    sign: np.ndarray


@dataclass(eq=False)
class ClosedSurface:
    """A closed surface of triangles: every edge has two of them, which pass it in opposite directions."""

    vertices: np.ndarray  # (n, 3), m
    triangles: np.ndarray  # (m, 3), indices of their vertices, counter-clockwise seen from outside

    @cached_property
    def corners(self) -> np.ndarray:
        """The corners of each triangle, (m, 3, 3), m."""
        return self.vertices[self.triangles]

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, m^3, by the divergence theorem, about the middle so that a far origin costs no digits."""
        a, b, c = np.moveaxis(self.corners - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box, (3,) each, m."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def winding(self, points: np.ndarray) -> np.ndarray:
        """Return how often the surface is wound about each point (n, 3): (n,) int, 0 outside.

        Counts the triangles above a point, those that face up as 1, those that face down as -1.
        """
        found = np.zeros(len(points), dtype=np.int64)
        for first in range(0, len(points), POINTS_AT_ONCE):
            some = points[first : first + POINTS_AT_ONCE]
            met = self.crossings(some[:, :2])
            above = met.z > some[met.line, 2]
            found[first : first + len(some)] = np.bincount(
                met.line[above], weights=met.sign[above], minlength=len(some)
            ).astype(np.int64)
        return found

    def crossings(self, lines: np.ndarray) -> Crossings:
        """Return where lines along z at some x, y, (n, 2), meet the surface; n and the crossings have to fit in memory.

        A line meets a triangle if a ray from it along x passes edges of the triangle, seen along z, more often upwards
        than downwards, or the other way round. Both triangles of an edge compute its passage in the same way, so that
        no line slips between them.
        """
        raster = self._raster
        first, count = raster.triangles_over(lines)
        step = max(1, int(_PAIRS_AT_ONCE * len(lines) / max(int(count.sum()), _PAIRS_AT_ONCE)))
        parts = [
            self._met(lines, np.arange(i, min(i + step, len(lines))), first[i : i + step], count[i : i + step])
            for i in range(0, len(lines), step)
        ]
        return Crossings(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _met(self, lines: np.ndarray, numbers: np.ndarray, first: np.ndarray, count: np.ndarray) -> Crossings:
        line = np.repeat(numbers, count)
        triangle = self._raster.listed[np.arange(len(line)) + np.repeat(first - np.cumsum(count) + count, count)]
        x, y = lines[line].T
        turn = np.zeros(len(line), dtype=np.int8)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            start, end = self.triangles[triangle, i], self.triangles[triangle, j]
            a, b = self.vertices[np.minimum(start, end), :2], self.vertices[np.maximum(start, end), :2]
            passes = (a[:, 1] > y) != (b[:, 1] > y)
            slope = (b[:, 0] - a[:, 0]) / np.where(passes, b[:, 1] - a[:, 1], 1.0)
            at = np.clip(a[:, 0] + (y - a[:, 1]) * slope, np.minimum(a[:, 0], b[:, 0]), np.maximum(a[:, 0], b[:, 0]))
            upwards = np.where((start < end) == (b[:, 1] > a[:, 1]), 1, -1)
            turn += ((passes & (x < at)) * upwards).astype(np.int8)
        met = turn != 0
        line, corners = line[met], self.corners[triangle[met]]
        a = corners[:, 0]
        normal = np.cross(corners[:, 1] - a, corners[:, 2] - a)
        # A triangle that is upright up to rounding is met at any height of its own.
        upright = np.where(normal[:, 2] == 0, 1.0, normal[:, 2])
        z = a[:, 2] - np.einsum("ij,ij->i", lines[line] - a[:, :2], normal[:, :2]) / upright
        return Crossings(line, np.clip(z, corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)), turn[met])

    @cached_property
    def _raster(self) -> "_Raster":
        return _Raster(self.corners[:, :, :2])


class _Raster:
    """Which triangles lie over the bins of a raster in the x-y plane."""

    def __init__(self, corners: np.ndarray) -> None:
        lower, upper = corners.min(axis=1), corners.max(axis=1)
        self.lower = lower.min(axis=0)
        self.count = int(np.clip(np.sqrt(len(corners)), 1, _BINS))
        self.width = np.maximum((upper.max(axis=0) - self.lower) / self.count, np.finfo(float).tiny)
        low, high = self._bins(lower), self._bins(upper)
        spans = high - low + 1
        many = spans.prod(axis=1)
        triangle = np.repeat(np.arange(len(corners)), many)
        inner = np.arange(len(triangle)) - np.repeat(np.cumsum(many) - many, many)
        bins = low[triangle] + np.stack([inner // spans[triangle, 1], inner % spans[triangle, 1]], axis=1)
        flat = bins[:, 0] * self.count + bins[:, 1]
        order = np.argsort(flat, kind="stable")
        self.listed = triangle[order]
        self.starts = np.searchsorted(flat[order], np.arange(self.count**2 + 1))

    def _bins(self, places: np.ndarray) -> np.ndarray:
        return np.clip((places - self.lower) / self.width, 0, self.count - 1).astype(np.int64)

    def triangles_over(self, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where in `listed` the triangles near lines (n, 2) begin, and how many they are, (n,) each."""
        bins = self._bins(lines)
        flat = bins[:, 0] * self.count + bins[:, 1]
        return self.starts[flat], self.starts[flat + 1] - self.starts[flat]


# Triangles around a point that are looked at.
_AROUND = 8
# Cells along the longest axis of the grid from which points far from the surface take their triangles, and cells from
# the surface below which a point is near.
_CELLS, _NEAR = 48, 4
# Cells around the surface within which nodes ask all of their neighbours for a nearer triangle.
_BAND = 4
# Times that nodes farther away ask them, where they do.
_ROUNDS = 3


class Planes:
    """What the distance from each of m triangles needs, by component, so that loops over pairs are short."""

    def __init__(self, corners: np.ndarray) -> None:
        a, b, c = np.moveaxis(corners, 1, 0)
        u, v = b - a, c - a
        normal = np.cross(u, v)
        length = np.linalg.norm(normal, axis=1)
        self.uu, self.uv, self.vv = (np.einsum("ij,ij->i", p, q) for p, q in ((u, u), (u, v), (v, v)))
        self.area = self.uu * self.vv - self.uv**2
        self.a, self.u, self.v = a, u, v
        self.normal = normal / np.where(length > 0, length, 1.0)[:, None]

    def squared_distances(self, points: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Return the squared distance of point i, (n, 3), from triangle number `triangle[i]`: (n,), m^2."""
        found = np.empty(len(points))
        for i in range(0, len(points), _PAIRS_AT_ONCE):
            some = slice(i, i + _PAIRS_AT_ONCE)
            found[some] = self._squared(points[some], triangle[some])
        return found

    def _squared(self, points: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Return the squared distance of each point: from the plane above its triangle, else from the nearest edge.

        a, a + u and a + v are the corners.
        """
        away = points - self.a[triangle]
        u, v, normal = self.u[triangle], self.v[triangle], self.normal[triangle]
        uu, uv, vv, area = self.uu[triangle], self.uv[triangle], self.vv[triangle], self.area[triangle]
        pu, pv, height = (np.einsum("ij,ij->i", away, axis) for axis in (u, v, normal))
        s, t = vv * pu - uv * pv, uu * pv - uv * pu
        above = (s >= 0) & (t >= 0) & (s + t <= area) & (area > 0)
        nearest = np.full(len(points), np.inf)
        # Along u, along v, and from the end of u to that of v.
        for along, length, base, edge in (
            (pu, uu, None, u),
            (pv, vv, None, v),
            (pv - uv - pu + uu, uu - 2 * uv + vv, u, v - u),
        ):
            share = np.clip(along / np.where(length > 0, length, 1.0), 0.0, 1.0)[:, None]
            beside = away - share * edge if base is None else away - base - share * edge
            nearest = np.minimum(nearest, np.einsum("ij,ij->i", beside, beside))
        return np.where(above, height**2, nearest)


def pieces_of(corners: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles until no edge is longer than `longest`, m; return the centre and the triangle of each piece."""
    centers, owners = [], []
    rest, owner = corners, np.arange(len(corners))
    while len(rest):
        edges = np.linalg.norm(np.roll(rest, -1, axis=1) - rest, axis=2)
        long = edges.max(axis=1) > longest
        centers.append(rest[~long].mean(axis=1))
        owners.append(owner[~long])
        # The longest edge is halved, which keeps the pieces from becoming thin.
        k, rest, owner = edges[long].argmax(axis=1), rest[long], owner[long]
        rows = np.arange(len(rest))
        a, b, c = (rest[rows, (k + j) % 3] for j in range(3))
        middle = (a + b) / 2
        rest = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate(centers), np.concatenate(owners)


class NodeDistances:
    """The nearest triangle, and its distance, of every node of a regular grid around a surface.

    The nodes around each piece of a triangle look at it; then nodes near the surface ask their neighbours, and those
    farther away take the triangle of the nearest such node. A distance is that of a triangle, never too small. It is
    too large by three cells at most beyond the band, where nodes do not ask their neighbours unless `thorough`.
    """

    def __init__(
        self, surface: ClosedSurface, origin: np.ndarray, spacing: float, shape: Shape, thorough: bool = False
    ) -> None:
        from scipy.ndimage import distance_transform_edt

        self.origin, self.spacing, self.shape = origin, spacing, np.array(shape)
        self.planes = Planes(surface.corners)
        self.centers, self.owners = pieces_of(surface.corners, spacing)
        total = int(np.prod(shape))
        self.triangle = np.full(total, -1)
        self.squared = np.full(total, np.inf)
        changed = self._begin()
        for _ in range(_BAND):
            changed = self._spread(changed)
        unknown = np.flatnonzero(self.triangle < 0)
        if unknown.size:
            known = distance_transform_edt(
                (self.triangle < 0).reshape(shape), return_distances=False, return_indices=True
            )
            nearest = np.ravel_multi_index(tuple(axis.ravel()[unknown] for axis in known), shape)
            self.triangle[unknown] = self.triangle[nearest]
            self.squared[unknown] = self.planes.squared_distances(self._places(unknown), self.triangle[unknown])
        changed = unknown
        for _ in range(_ROUNDS if thorough else 0):
            changed = self._spread(changed)

    def _places(self, nodes: np.ndarray) -> np.ndarray:
        return self.origin + self.spacing * np.stack(np.unravel_index(nodes, self.shape), axis=1)

    def _begin(self) -> np.ndarray:
        """Give the corners of the cells that hold the centre of a piece its triangle, and return these nodes."""
        cells = np.clip(((self.centers - self.origin) / self.spacing).astype(np.int64), 0, self.shape - 2)
        corners = [np.ravel_multi_index(tuple((cells + offset).T), self.shape) for offset in product((0, 1), repeat=3)]
        # Pairs of a node and a triangle as one number each, which sort faster.
        many = len(self.planes.area)
        node, triangle = np.divmod(np.unique(np.concatenate(corners) * many + np.tile(self.owners, 8)), many)
        squared = self.planes.squared_distances(self._places(node), triangle)
        order = np.lexsort((squared, node))
        nodes, first = np.unique(node[order], return_index=True)
        self.triangle[nodes], self.squared[nodes] = triangle[order[first]], squared[order[first]]
        return nodes

    def _spread(self, changed: np.ndarray) -> np.ndarray:
        """Let the neighbours of some nodes take their triangles where these are nearer, and return those that did."""
        place = np.stack(np.unravel_index(changed, self.shape), axis=1)
        triangle = self.triangle[changed]
        took = []
        for offset in product((-1, 0, 1), repeat=3):
            beside = place + offset
            inside = np.all((beside >= 0) & (beside < self.shape), axis=1)
            nodes, offered = np.ravel_multi_index(tuple(beside[inside].T), self.shape), triangle[inside]
            new = offered != self.triangle[nodes]
            nodes, offered = nodes[new], offered[new]
            squared = self.planes.squared_distances(self._places(nodes), offered)
            nearer = squared < self.squared[nodes]
            self.triangle[nodes[nearer]], self.squared[nodes[nearer]] = offered[nearer], squared[nearer]
            took.append(nodes[nearer])
        return np.unique(np.concatenate(took))


class SurfaceDistance:
    """Distance of points from a surface.

    Near the surface it is that of the triangles whose pieces are nearest; farther away than _NEAR cells of a grid of
    _CELLS cells, that of the triangles of the nodes around the point, too large by a tenth of a cell at most where the
    surface is smooth.
    """

    def __init__(self, surface: ClosedSurface) -> None:
        from scipy.spatial import KDTree

        lower, upper = surface.bounds()
        spacing = float((upper - lower).max()) / _CELLS
        shape = tuple(int(n) for n in np.ceil((upper - lower) / spacing).astype(int) + 2 * _NEAR + 1)
        self.nodes = NodeDistances(surface, lower - _NEAR * spacing, spacing, shape, thorough=True)
        self.tree = KDTree(self.nodes.centers)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 3), (n,), m."""
        nodes = self.nodes
        cells = np.clip(((points - nodes.origin) / nodes.spacing).astype(np.int64), 0, nodes.shape - 2)
        squared = np.full(len(points), np.inf)
        for offset in product((0, 1), repeat=3):
            triangle = nodes.triangle[np.ravel_multi_index(tuple((cells + offset).T), nodes.shape)]
            squared = np.minimum(squared, nodes.planes.squared_distances(points, triangle))
        near = np.flatnonzero(squared < (_NEAR * nodes.spacing) ** 2)
        around = np.arange(1, min(_AROUND, self.tree.n) + 1)
        triangle = nodes.owners[self.tree.query(points[near], k=around, workers=-1)[1]]
        found = nodes.planes.squared_distances(np.repeat(points[near], len(around), axis=0), triangle.ravel())
        squared[near] = np.minimum(squared[near], found.reshape(-1, len(around)).min(axis=1, initial=np.inf))
        return np.sqrt(squared)


_PREPARED: WeakKeyDictionary[ClosedSurface, SurfaceDistance] = WeakKeyDictionary()


def surface_distance(surface: ClosedSurface, points: np.ndarray) -> np.ndarray:
    """Return the distance of each point (n, 3) from a surface, (n,), m; see `SurfaceDistance`."""
    if surface not in _PREPARED:
        _PREPARED[surface] = SurfaceDistance(surface)
    return _PREPARED[surface](points)


def node_distances(surface: ClosedSurface, origin: np.ndarray, spacing: float, shape: Shape) -> np.ndarray:
    """Return the signed distance from a surface at the nodes of a grid, of this shape, m; negative inside.

    The sign is that of the winding number, from where the lines of nodes along z meet the surface.
    """
    distance = np.sqrt(NodeDistances(surface, origin, spacing, shape).squared).reshape(shape)
    axes = [origin[k] + spacing * np.arange(shape[k]) for k in range(2)]
    lines = grid_points(*axes)
    met = surface.crossings(lines)
    heights = origin[2] + spacing * np.arange(shape[2])
    # A crossing counts for all nodes below it.
    below = np.searchsorted(heights, met.z)
    steps = np.zeros((len(lines), shape[2] + 1), dtype=np.int64)
    np.add.at(steps, (met.line, below), met.sign)
    winding = np.cumsum(steps[:, ::-1], axis=1)[:, ::-1][:, 1:]
    return np.where(winding.reshape(shape) != 0, -distance, distance)
