"""Closed surfaces of triangles: volume, inside test, and signed distance of points."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

# Points, and pairs of a point and a triangle, that are looked at together: bounds the memory, keeps pairs in the cache.
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
        # A signal is seen between two calls.
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
        return KDTree(points[np.unique(np.floor(points / edge), axis=0, return_index=True)[1]])

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
