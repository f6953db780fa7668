"""Bodies given by a closed mesh from a file: welded, closed, facing outwards.

Closed surfaces of triangles: volume, inside test, and signed distance of points.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.plain_text import counted
from mpmcli.scene.points import GeometryFileError, distinct_rows, file_version, read_geometry, scene_file
from mpmcli.scene.primitives import Solid, grid_points, rotation
from mpmcli.scene.problem import listed
from mpmcli.scene.quantity import Axis, Number, Positive, Table, Vector, flaw, place_text

# Points, and pairs of a point and a triangle, per batch: bounds the memory and keeps pairs in the cache.
POINTS_AT_ONCE = 200_000
_PAIRS_AT_ONCE = 50_000
# Points whose distance VTK computes in one call.
_VTK_AT_ONCE = 10_000
# VTK's search is slow for distant points. With more than _FEW triangles, points beyond _NEAR of the extent are measured
# from samples of the surface that lie _FINE of the extent apart.
_FEW, _NEAR, _FINE = 2_000, 0.15, 0.02
# Bins per axis of the raster that finds the triangles over a point.
_BINS = 1024


class Crossings(NamedTuple):
    """Crossings of lines along z with the surface: number of the line, z (m), and 1 if it faces up, else -1, (c,)."""

    line: np.ndarray
    z: np.ndarray
    sign: np.ndarray


@dataclass(eq=False)
class ClosedSurface:
    """A closed surface of triangles: every edge belongs to two triangles with opposite directions along it."""

    vertices: np.ndarray  # (n, 3), m
    triangles: np.ndarray  # (m, 3), indices of their vertices, counter-clockwise seen from outside
    notes: tuple[str, ...] = ()  # what was changed in the surface of the file

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

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, 3) from the surface, (n,), m; negative inside.

        It is exact up to a tenth of the extent, and beyond, of more than 2,000 triangles, too large by 0.3 % of the
        extent at most.
        """
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonCore import vtkDoubleArray

        if len(self.triangles) > _FEW:
            found = self._tree.query(points, workers=-1)[0]
            near = np.flatnonzero(found < _NEAR * np.ptp(self.bounds(), axis=0).max())
        else:
            found, near = np.empty(len(points)), np.arange(len(points))
        # Signals are handled between two calls.
        for some in np.array_split(near, len(near) // _VTK_AT_ONCE + 1):
            exact = vtkDoubleArray()
            self._vtk_distance.FunctionValue(numpy_to_vtk(np.ascontiguousarray(points[some], np.float64)), exact)
            found[some] = np.abs(np.array(exact))
        return np.where(self.winding(points) > 0, -found, found)

    @cached_property
    def _vtk(self) -> Any:
        import pyvista as pv

        return pv.PolyData(self.vertices, np.insert(self.triangles, 0, 3, axis=1))

    @cached_property
    def _vtk_distance(self) -> Any:
        from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

        function = vtkImplicitPolyDataDistance()
        function.SetInput(self._vtk)
        return function

    @cached_property
    def _tree(self) -> Any:
        """Points all over the surface, _FINE of the extent apart."""
        from scipy.spatial import KDTree

        edge = _FINE * float(np.ptp(self.bounds(), axis=0).max())
        points = np.array(self._vtk.subdivide_adaptive(max_edge_len=edge, max_n_passes=20).points)
        return KDTree(points[distinct_rows(np.floor(points / edge))[0]])

    def crossings(self, lines: np.ndarray) -> Crossings:
        """Return where lines along z at some x, y, (n, 2), meet the surface; n and the crossings must fit in memory.

        A line meets a triangle if a ray from it along x passes edges of the triangle, seen along z, more often upwards
        than downwards, or the other way round. Both triangles of an edge compute its passage in the same way, so that
        no line slips between them.
        """
        raster = self._raster
        bins = raster.bins(lines) @ (raster.count, 1)
        # Start and number of the triangles near each line in the list.
        first, count = raster.starts[bins], raster.starts[bins + 1] - raster.starts[bins]
        step = max(1, int(_PAIRS_AT_ONCE * len(lines) / max(int(count.sum()), _PAIRS_AT_ONCE)))
        parts = [
            self._met(lines, np.arange(i, min(i + step, len(lines))), first[i : i + step], count[i : i + step])
            for i in range(0, len(lines), step)
        ]
        return Crossings(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _met(self, lines: np.ndarray, numbers: np.ndarray, first: np.ndarray, count: np.ndarray) -> Crossings:
        """Return the crossings of lines `numbers` with `count` triangles of the raster each, listed from `first` on."""
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
        # A line meets a triangle that is vertical up to rounding at any of its heights.
        upright = np.where(normal[:, 2] == 0, 1.0, normal[:, 2])
        z = a[:, 2] - np.einsum("ij,ij->i", lines[line] - a[:, :2], normal[:, :2]) / upright
        return Crossings(line, np.clip(z, corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)), turn[met])

    @cached_property
    def _raster(self) -> "_Raster":
        return _Raster(self.corners[:, :, :2])


class _Raster:
    """Which triangles lie over the bins of a raster in the x-y plane."""

    def __init__(self, corners: np.ndarray) -> None:
        """List, bin by bin, the triangles (n, 3, 2) whose bounding boxes overlap the bin."""
        lower, upper = corners.min(axis=1), corners.max(axis=1)
        self.lower = lower.min(axis=0)
        self.count = int(np.clip(np.sqrt(len(corners)), 1, _BINS))
        self.width = np.maximum((upper.max(axis=0) - self.lower) / self.count, np.finfo(float).tiny)
        low, high = self.bins(lower), self.bins(upper)
        spans = high - low + 1
        many = spans.prod(axis=1)
        triangle = np.repeat(np.arange(len(corners)), many)
        inner = np.arange(len(triangle)) - np.repeat(np.cumsum(many) - many, many)
        bins = low[triangle] + np.stack([inner // spans[triangle, 1], inner % spans[triangle, 1]], axis=1)
        flat = bins[:, 0] * self.count + bins[:, 1]
        order = np.argsort(flat, kind="stable")
        self.listed = triangle[order]
        self.starts = np.append(0, np.cumsum(np.bincount(flat, minlength=self.count**2)))

    def bins(self, places: np.ndarray) -> np.ndarray:
        return np.clip((places - self.lower) / self.width, 0, self.count - 1).astype(np.int64)


# Points per axis at which the surface is tested for parts that overlap or are inside out.
_TRIED = 24
# Edges of the largest hole that is closed, and number of holes whose places are told.
_MOST_EDGES, _MOST_TOLD = 12, 4


def read_mesh(
    path: str | Path,
    scale: float = 1.0,
    axis: tuple[float, ...] | None = None,
    angle: float = 0.0,
    translate: tuple[float, ...] = (0.0, 0.0, 0.0),
    close: bool = False,
) -> ClosedSurface:
    """Return the closed surface in a file, m, whose triangles face outwards.

    The vertices are multiplied by `scale`, turned by `angle` degrees about `axis` through the origin, and moved by
    `translate`. Vertices at the same place are one, as are triangles. A mesh of cells gives its surface. Shells that
    overlap are united; with `close` holes of few edges are filled.
    """
    *found, note = _read(Path(path))
    vertices, triangles, changes = _closed(*found, close)
    whole = ClosedSurface(vertices, triangles).volume
    notes = tuple(
        f"{Path(path).name}: {what}, which {'adds' if volume > 0 else 'takes'} {abs(volume) * scale**3:.3g} m^3, "
        f"{abs(volume) / whole:.2g} of the volume"
        for what, volume in changes.items()
    )
    vertices = vertices * scale
    if axis is not None:
        vertices = vertices @ rotation(axis, math.radians(angle)).T
    return ClosedSurface(vertices + np.array(translate), triangles, (*[note] * bool(note), *notes))


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Return points (n, 3), triangles (m, 3) and the note of the surface in a file; coincident points are merged."""
    try:
        found = read_geometry(path)
    except GeometryFileError as error:
        raise GeometryFileError(str(error) or "it is not a readable mesh (STL, OBJ, PLY and VTU are)") from None
    if not len(found.triangles):
        raise GeometryFileError("it holds no triangle")
    if not np.isfinite(found.vertices).all(axis=1)[found.triangles].all():
        raise GeometryFileError("it holds a vertex that is not finite")
    first, which = distinct_rows(found.vertices)
    vertices, triangles = found.vertices[first], which[found.triangles]
    # Merging turns some triangles into edges.
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    triangles = triangles[~flat]
    # A triangle given twice is one.
    turns = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    triangles = triangles[np.sort(distinct_rows(np.take_along_axis(triangles, turns, axis=1))[0])]
    return *_compact(vertices, triangles), found.note


def _compact(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices that triangles use, and the triangles with their new numbers."""
    used = np.bincount(triangles.ravel(), minlength=len(vertices)) > 0
    return vertices[used], (np.cumsum(used) - 1)[triangles]


class _Edges:
    """Edges of triangles (m, 3): `ends` (n, 2), lower vertex first, their `uses`, and in `ways` those up less down."""

    def __init__(self, triangles: np.ndarray) -> None:
        directed = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        first, self.which = distinct_rows(ordered := np.sort(directed, axis=1))
        self.ends, self.way = ordered[first], np.where(directed[:, 0] < directed[:, 1], 1, -1)
        self.uses = np.bincount(self.which)
        self.ways = np.bincount(self.which, weights=self.way).astype(np.int64)

    def shells(self) -> np.ndarray:
        """Return the number of the shell of each triangle: of those that edges join, each closed by itself."""
        count = len(self.which) // 3
        order = np.argsort(self.which, kind="stable")
        edge, triangle = self.which[order], order % count
        follows = edge[1:] == edge[:-1]
        pairs = np.stack([triangle[:-1], triangle[1:]], axis=1)
        shell = _pieces(pairs[follows & (self.uses[edge[1:]] == 2)], count)
        # Where shells share an edge, those that it does not close are one.
        _, kind = distinct_rows(np.stack([shell[triangle], edge], axis=1))
        unclosed = np.bincount(kind, weights=self.way[order])[kind] != 0
        shared = np.bincount(edge, weights=unclosed)[edge[1:]] > 0
        return _pieces(pairs[follows & (shared | (self.uses[edge[1:]] == 2))], count)


def _closed(
    vertices: np.ndarray, triangles: np.ndarray, close: bool
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Return a closed surface with its triangles facing outwards, and the volumes that changes to it have added.

    An error is raised if it is not closed.
    """
    changes = {}
    edges = _Edges(triangles)
    bounding = np.concatenate([edges.ends[edges.ways == 1][:, ::-1], edges.ends[edges.ways == -1]])
    if close and (patches := _patches(vertices, bounding)):
        size = max(map(len, patches)) + 2
        added = ClosedSurface(vertices, np.concatenate(patches)).volume
        changes[f"close fills {counted(len(patches), 'hole')} of at most {size} edges"] = added
        triangles = np.concatenate([triangles, *patches])
        edges = _Edges(triangles)
    if len(odd := edges.ends[edges.uses % 2 == 1]):
        raise GeometryFileError(
            f"its surface is open: {len(odd)} of {len(edges.ends)} edges have a triangle on one side only, "
            f"{_holes(vertices, odd)}"
        )
    if turned := int(np.sum(edges.ways != 0)):
        raise GeometryFileError(
            f"its triangles face different sides across {turned} of {len(edges.ends)} edges; orient them alike"
        )
    surface = ClosedSurface(vertices, triangles)
    if surface.volume < 0:
        surface = ClosedSurface(vertices, triangles[:, ::-1])
        changes = {what: -volume for what, volume in changes.items()}
    if not surface.volume > 1e-12 * float(np.prod(np.ptp(surface.bounds(), axis=0))):
        raise GeometryFileError("its surface encloses no volume")
    _refuse(lambda winding: winding < 0, surface, "a part of its surface is inside out")
    if (united := _united(surface, edges.shells())) is not surface:
        changes["shells that overlap are united"] = united.volume - surface.volume
    _refuse(lambda winding: winding > 1, united, "its surface overlaps itself")
    return united.vertices, united.triangles, changes


def _refuse(wrong: Callable[[np.ndarray], np.ndarray], surface: ClosedSurface, said: str) -> None:
    """Refuse a surface whose winding number is wrong at some of _TRIED^3 points."""
    points = grid_points(*(np.linspace(a, b, _TRIED + 2)[1:-1] for a, b in zip(*surface.bounds(), strict=True)))
    if (there := wrong(surface.winding(points))).any():
        where = place_text(points[np.argmax(there)])
        raise GeometryFileError(f"{said}, for example at {where} in its own units")


def _patches(vertices: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    """Return triangles of least area, (n - 2, 3), in each loop of n <= _MOST_EDGES of the directed edges (m, 2)."""
    following: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        following.setdefault(start, []).append(end)
    found = []
    for start in following:
        path = {start: None}
        while ends := following.get(next(reversed(path))):
            if (end := ends.pop()) not in path:
                path[end] = None
                continue
            loop = [end]
            while (last := next(reversed(path))) != end:
                loop.insert(1, last)
                del path[last]
            if 2 < len(loop) <= _MOST_EDGES:
                found.append(np.array(loop)[_least_area(vertices[loop])])
    return found


def _least_area(loop: np.ndarray) -> np.ndarray:
    """Return the triangles (n - 2, 3) of least area between the vertices (n, 3) of a loop, in their sense."""
    sides = loop[:, None] - loop
    areas = np.linalg.norm(np.cross(sides[:, :, None], sides[:, None]), axis=-1)

    @cache
    def least(i: int, j: int) -> tuple[float, tuple[tuple[int, int, int], ...]]:
        ways = ((least(i, k), least(k, j), k) for k in range(i + 1, j))
        return min(((a + b + areas[i, k, j], (*s, *t, (i, k, j))) for (a, s), (b, t), k in ways), default=(0.0, ()))

    return np.array(least(0, len(loop) - 1)[1])


def _united(surface: ClosedSurface, numbers: np.ndarray) -> ClosedSurface:
    """Return the union of the shells, by number (m,), of the triangles of a surface, each with its cavities.

    It is the surface itself if no shells overlap.
    """
    from manifold3d import Error, Manifold, Mesh64, OpType

    order = np.argsort(numbers, kind="stable")
    cuts = np.flatnonzero(np.diff(numbers[order])) + 1
    if not len(cuts):
        return surface
    shells = [
        (ClosedSurface(*_compact(surface.vertices, one)), one) for one in np.split(surface.triangles[order], cuts)
    ]
    # The least of the shells round a cavity is that of the cavity.
    outer = sorted((shell for shell in shells if shell[0].volume > 0), key=lambda shell: shell[0].volume)
    groups = [[triangles] for _, triangles in outer]
    lower, upper = np.moveaxis(np.array([shell.bounds() for shell, _ in outer]), 1, 0)
    for inner, triangles in (shell for shell in shells if shell[0].volume <= 0):
        low, high = inner.bounds()
        around = np.flatnonzero((lower <= low).all(axis=1) & (upper >= high).all(axis=1))
        own = next((k for k in around if outer[k][0].winding(inner.vertices[:1])[0] > 0), None)
        if own is not None:
            groups[own].append(triangles)
        elif inner.volume < -1e-6 * surface.volume:  # others are slivers
            where = place_text(inner.vertices.mean(axis=0))
            raise GeometryFileError(f"a part of its surface is inside out, at {where} in its own units")
    solids = [Manifold(Mesh64(*_compact(surface.vertices, np.concatenate(group)))) for group in groups]
    whole = Manifold.batch_boolean(solids, OpType.Add)
    taken = sum(solid.volume() for solid in solids) - whole.volume()
    if whole.status() != Error.NoError or taken < 1e-9 * surface.volume:
        return surface
    mesh = whole.to_mesh64()
    return ClosedSurface(np.array(mesh.vert_properties), np.array(mesh.tri_verts, np.int64))


def _pieces(edges: np.ndarray, count: int) -> np.ndarray:
    """Return for each of `count` nodes the number of the piece to which edges (n, 2) join it."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(count, count)), directed=False)[1]


def _holes(vertices: np.ndarray, edges: np.ndarray) -> str:
    """Return where the largest holes that some edges (n, 2) lie round are, and the remedy."""
    hole = _pieces(edges, len(vertices))[edges[:, 0]]
    sizes = np.bincount(hole)
    largest = np.argsort(-sizes, kind="stable")[: min(_MOST_TOLD, np.count_nonzero(sizes))]
    places = [place_text(vertices[np.unique(edges[hole == one])].mean(axis=0)) for one in largest]
    first, *others = (f"{sizes[one]} edges at {where}" for one, where in zip(largest, places, strict=True))
    more = f"; others of {listed(others, 'and')}" if others else ""
    return (
        f"round {counted(int(np.count_nonzero(sizes)), 'hole')}, the largest of {first}{more} in its own units; "
        f"close = true fills holes of at most {_MOST_EDGES} edges, and MeshLab and Blender fill others and merge "
        "points that nearly coincide"
    )


MILLIMETRE = 1e-3


class Rotation(Table):
    """A rotation about an axis through the origin."""

    axis: Axis = Field(description="Axis, of any length.")
    angle: Number = Field(description="Angle, degrees, counter-clockwise seen against the axis.")


class Mesh(Table, Solid):
    """The interior of a closed surface from a file; 3D only."""

    file: str = Field(description="The file, relative to the scene: STL, OBJ, PLY, VTU, ...")
    scale: Positive = Field(1.0, description="Metres per unit of the file; 0.001 for millimetres.")
    rotate: Rotation | None = Field(None, description="Rotation, after scaling. Default: none.")
    translate: Vector = Field(None, validate_default=True, description="Translation, added to all vertices last, m.")
    close: bool = Field(False, description="Fill holes of at most 12 edges.")
    _surface: ClosedSurface = PrivateAttr()

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> "Mesh":
        path = scene_file(self.file, info)
        turn = (self.rotate.axis, self.rotate.angle) if self.rotate else (None, 0.0)
        try:
            self._surface = _surface_of(
                path.absolute(), file_version(path), self.scale, *turn, self.translate, self.close
            )
        except GeometryFileError as error:
            raise flaw(f"{path}: {error}", "file") from None
        return self

    @property
    def surface(self) -> ClosedSurface:
        """The closed surface, m."""
        return self._surface

    def turned(self, turn: np.ndarray, center: np.ndarray) -> "Mesh":
        """Return the mesh rotated about a point."""
        result = self.model_copy()
        vertices = center + (self._surface.vertices - center) @ turn.T
        result._surface = ClosedSurface(vertices, self._surface.triangles)
        return result

    @property
    def volume(self) -> float:
        return self._surface.volume

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self._surface.bounds()

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        inside = self._surface.winding(points) > 0
        if inset > 0:
            inside[inside] = self._surface.signed_distance(points[inside]) <= -inset
        return inside

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        return self._surface.signed_distance(points)


def leaving(mesh: Mesh, lower: np.ndarray, upper: np.ndarray) -> str:
    """Return a message on a mesh larger than the domain, with a correction; "" if only its place is wrong."""
    size, room = np.ptp(mesh.bounds(), axis=0), upper - lower
    if np.all(size <= room):
        return ""
    extents, domain = (" x ".join(f"{x:.4g}" for x in vector) for vector in (size, room))
    factor = mesh.scale * float(np.min(room / size))
    if mesh.scale == 1 and factor >= MILLIMETRE:
        cure = f"if it is in millimetres, give scale = {MILLIMETRE:g}"
    else:
        digits = -math.floor(math.log10(factor))
        cure = f"it would fit with scale = {math.floor(factor * 10.0**digits) / 10.0**digits:.3g}"
    return f"the mesh is {extents} m, the domain {domain} m; {cure}"


def moved_inside(mesh: Mesh, lower: np.ndarray, upper: np.ndarray) -> str:
    """Return the `translate` that would put a mesh, which is small enough, into a domain with these corners."""
    low, high = mesh.bounds()
    shift = np.maximum(lower - low, 0) - np.maximum(high - upper, 0)
    # Rounded towards the inside, by a millionth of the domain at most.
    unit = 10.0 ** (math.floor(math.log10(float((upper - lower).max()))) - 6)
    shift = np.sign(shift) * np.ceil(np.abs(shift) / unit - 0.01) * unit
    return f"[{', '.join(f'{x:.10g}' for x in np.array(mesh.translate) + shift)}]"


@lru_cache(maxsize=32)
def _surface_of(path: Path, version: tuple[int, int], *placement: Any) -> ClosedSurface:
    """Return the surface in a file; `version` distinguishes versions of the file. The result is cached."""
    return read_mesh(path, *placement)
