"""Surfaces of particles in 3D: a closed mesh of triangles around what they fill."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mpmcli.render.particle_grid import blurred_along, with_images

# Parameters of splashsurf, in particle radii: smoothing length of the kernel, and edge of a marching cube.
SMOOTHING_LENGTH, CUBE = 2.5, 1.1
# Share of the full density at which the surface lies.
THRESHOLD = 0.5
# The same two of surfaces that keep close to the particles.
CLOSE_LENGTH, CLOSE_THRESHOLD = 1.8, 0.55
# Rounds of Laplacian smoothing, weighted so that thin sheets keep their volume.
SMOOTHING_ROUNDS = 20
# Radii from a wall within which particles have images behind it: the support of the kernel.
IMAGE_REACH = 2.0 * SMOOTHING_LENGTH
# Edge of the cells in which particles are counted, in radii, and how many cells there may be.
FULLNESS_CELL, FULLNESS_CELLS = 4.0, 4e6
# Shares of room filled, below which a vertex is not smoothed and above which it is smoothed in full.
ALONE, HALF = 0.03, 0.22
# Radii from a wall within which a particle touches it, and the edge of the cells in which such are looked for.
CONTACT, CONTACT_CELL = 3.0, 2.0
# Radii that a particle may lie outside of the domain and still be drawn.
STRAY = 4.0


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in three dimensions, v vertices and t triangles.

    Attributes:
        points: (v, 3) float32, m.
        triangles: (t, 3) int64, counter-clockwise from outside.
        normals: (v, 3) float32, outwards, of length one.
        attributes: (v,) or (v, k) float32 each, carried over from the particles, by name.
    """

    points: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def volume(self) -> float:
        """Volume within the mesh, m^3, by the divergence theorem."""
        corners = (self.points[self.triangles] - self.points.mean(axis=0)).astype(np.float64)
        return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0


def drawable(position: np.ndarray, lower: Sequence[float], upper: Sequence[float], distance: float) -> np.ndarray:
    """Return which of the particles (n, d) are numbers, and in the domain or close to it: (n,) bool."""
    d = position.shape[1]
    stray = 0.5 * STRAY * distance
    # A comparison with a NaN is false, which is what is wanted.
    return ((position >= np.array(lower[:d]) - stray) & (position <= np.array(upper[:d]) + stray)).all(axis=1)


def reconstruct(
    position: np.ndarray,
    distance: float,
    lower: Sequence[float],
    upper: Sequence[float],
    attributes: Mapping[str, np.ndarray] | None = None,
    rounds: int = SMOOTHING_ROUNDS,
    *,
    close: bool = False,
) -> Mesh:
    """Wrap particles in a surface: splashsurf's level set of their density, smoothed.

    At the walls the particles are mirrored, so that their density does not fade there, and the mesh is cut off at
    the wall: what touches it is flat. Vertices and triangles come in an order of their own, not in that of the
    threads that found them. Method: Loeschner, Boettcher, Jeske, Bender (2023), Weighted Laplacian smoothing for
    surface reconstruction of particle-based fluids.

    Args:
        position: (n, 3), m; what is not a number or far from the domain is left out.
        distance: between neighbouring particles at the start, m.
        lower, upper: corners of the domain, m.
        attributes: (n,) or (n, k) finite numbers each, to be carried over to the vertices.
        rounds: of smoothing; 0 keeps every lump.
        close: the surface keeps close to the particles, and single ones stay small: right for crumbs, not for sheets.
    """
    from pysplashsurf import laplacian_smoothing_parallel, reconstruction_pipeline

    keep = drawable(position, lower, upper, distance)
    # About the middle of the domain and in particle radii, where single precision is at its best.
    radius, middle = 0.5 * distance, 0.5 * (np.array(lower) + np.array(upper))
    low, high = (((np.array(corner) - middle) / radius).astype(np.float32) for corner in (lower, upper))
    particles = np.clip((position[keep] - middle) / radius, low, high).astype(np.float32)
    carried = {name: np.asarray(values, dtype=np.float32)[keep] for name, values in (attributes or {}).items()}
    if not len(particles):
        return _empty(carried)
    points, source = with_images(particles, IMAGE_REACH, low, high)
    # Its own clean-up and smoothing depend on the order in which threads end: ours come after the sorting.
    found, _ = reconstruction_pipeline(
        points,
        attributes_to_interpolate={name: np.ascontiguousarray(values[source]) for name, values in carried.items()},
        particle_radius=1.0,
        smoothing_length=CLOSE_LENGTH if close else SMOOTHING_LENGTH,
        cube_size=CUBE,
        iso_surface_threshold=CLOSE_THRESHOLD if close else THRESHOLD,
        multi_threading=True,
        # In vectors the sums of two subdomains over the particles of one node differ in their last bit.
        simd=False,
        subdomain_grid=True,
        subdomain_grid_auto_disable=False,
    )
    mesh = found.mesh
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    if not len(faces):
        return _empty(carried)
    order = np.lexsort(vertices.T)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    triangles = _ordered(rank[faces.astype(np.int64)], len(order))
    # These are views of the mesh's own memory.
    vertices[:], faces[:] = vertices[order], triangles
    if rounds:
        weights = _fullness(points, vertices)
        connectivity = mesh.vertex_vertex_connectivity()
        laplacian_smoothing_parallel(mesh, connectivity, iterations=rounds, beta=1.0, weights=weights)
    # The old view is stale: smoothing has put other memory in its place.
    raw = np.asarray(mesh.vertices)
    vertices = np.clip(raw, low, high)
    kept = _area_vectors(vertices, triangles).any(axis=1)
    kept &= ~_pressed_flat(raw, vertices, triangles, particles, low, high)
    triangles = triangles[kept]
    return Mesh(
        points=(vertices * radius + middle).astype(np.float32),
        triangles=triangles,
        normals=vertex_normals(vertices, triangles),
        attributes={name: np.asarray(found.point_attributes[name])[order] for name in carried},
    )


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return normals (v, 3) float32 of vertices: means over their triangles, weighted by area."""
    areas = _area_vectors(points, triangles)
    normals = np.empty((len(points), 3))
    corners = triangles.ravel()
    for axis in range(3):
        normals[:, axis] = np.bincount(corners, np.repeat(areas[:, axis], 3), len(points))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0).astype(np.float32)


def _empty(attributes: Mapping[str, np.ndarray]) -> Mesh:
    none = np.empty((0, 3), dtype=np.float32)
    return Mesh(none, np.empty((0, 3), dtype=np.int64), none, {name: v[:0] for name, v in attributes.items()})


def _area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (t, 3), twice the area of each triangle times its normal."""
    first, second, third = (points[triangles[:, k]] for k in range(3))
    a, b = second - first, third - first
    return np.stack([a[:, i - 2] * b[:, i - 1] - a[:, i - 1] * b[:, i - 2] for i in range(3)], axis=1)


def _pressed_flat(
    raw: np.ndarray,
    vertices: np.ndarray,
    triangles: np.ndarray,
    particles: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Return which triangles (t,) are those of an image that its particle, close to a wall, does not touch.

    Cut off at the wall, such an image is a sheet without thickness that lies on it.

    Args:
        raw, vertices: (v, 3) before and after they were cut off at the walls, in radii.
        particles: (n, 3) without images.
    """
    flat = np.zeros(len(triangles), dtype=bool)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        shape = tuple(np.maximum(np.ceil((high - low)[others] / CONTACT_CELL).astype(int), 1) + 2)
        for wall, inwards in ((low[axis], 1.0), (high[axis], -1.0)):
            beyond = inwards * (raw[:, axis] - wall) < 0.0
            rows = np.flatnonzero(beyond[triangles].all(axis=1))
            if not len(rows):
                continue
            close = particles[inwards * (particles[:, axis] - wall) < CONTACT][:, others]
            at = np.minimum(((close - low[others]) / CONTACT_CELL).astype(int) + 1, np.array(shape) - 2)
            touched = np.zeros(shape, dtype=bool)
            touched[at[:, 0], at[:, 1]] = True
            for side in range(2):
                touched |= np.roll(touched, 1, axis=side) | np.roll(touched, -1, axis=side)
            middles = vertices[triangles[rows]].mean(axis=1)[:, others]
            at = np.minimum(((middles - low[others]) / CONTACT_CELL).astype(int) + 1, np.array(shape) - 2)
            flat[rows] |= ~touched[at[:, 0], at[:, 1]]
    return flat


def _fullness(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return weights (v,) of smoothing: 1 where particles (m, 3) fill half of the room, 0 where they are alone.

    Lengths are in particle radii. Smoothing pulls a drop of one particle together to a point.
    """
    low = vertices.min(axis=0).astype(np.float64)
    size = np.ptp(vertices, axis=0) + 1.0
    edge = max(FULLNESS_CELL, float((np.prod(size) / FULLNESS_CELLS) ** (1 / 3)))
    # A margin of one cell on each side, so that no neighbour is missing.
    shape = tuple((size / edge).astype(int) + 3)
    cells = np.clip(((points - low) / edge).astype(int) + 1, 0, np.array(shape) - 1)
    count = np.bincount(np.ravel_multi_index(tuple(cells.T), shape), minlength=int(np.prod(shape)))
    share = count.reshape(shape).astype(np.float32) * (8.0 / edge**3)
    for axis in range(3):
        share = blurred_along(share, axis)
    at = np.clip(((vertices - low) / edge).astype(int) + 1, 0, np.array(shape) - 1)
    found = share[tuple(at.T)]
    slope = np.clip((found - ALONE) / (HALF - ALONE), 0.0, 1.0)
    return (slope * slope * (3.0 - 2.0 * slope)).astype(np.float32)


def _ordered(triangles: np.ndarray, count: int) -> np.ndarray:
    """Turn each triangle so that its lowest vertex comes first, and sort them."""
    turn = triangles.argmin(axis=1)[:, None]
    turned = np.take_along_axis(triangles, (turn + np.arange(3)) % 3, axis=1)
    return turned[np.argsort(turned[:, 0] * count + turned[:, 1], kind="stable")]
