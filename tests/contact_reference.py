"""Contact of two bodies, or of one and an obstacle, in plain numpy, from the formulas of docs/theory.md, 2.8."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from mpm_reference import MARGIN, Box, quadratic


@dataclass(frozen=True)
class Surface:
    """What the particles of a body show: places x, normals n and ways to the surface (n, d), and depths at rest (n).

    slope: dv/dn, (n, d), 1/s; distance: of its particles at rest, m; modulus: its P-wave modulus, Pa; density: at rest,
    kg/m^3.
    """

    x: np.ndarray
    n: np.ndarray
    way: np.ndarray
    depth: np.ndarray
    slope: np.ndarray
    distance: float
    modulus: float
    density: float

    @staticmethod
    def of(x: np.ndarray, C: np.ndarray, F: np.ndarray, N: np.ndarray, D: np.ndarray, *numbers: float) -> "Surface":
        """Carry normals N (n, d) and depths D (n) at rest with F (n, d, d); C is the gradient of the velocity."""
        normal = np.stack([np.linalg.inv(f).T @ each for f, each in zip(F, N, strict=True)])
        size = np.linalg.norm(normal, axis=1)
        normal /= size[:, None]
        way = D[:, None] * np.einsum("pij,pj->pi", F, N)
        return Surface(x, normal, way, D, np.einsum("pij,pj->pi", C, normal), *numbers)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def near(surface: Surface, node: np.ndarray, h: float) -> np.ndarray:
    """Return the weights (n) of the particles whose stencil has a node and that show something."""
    away = (node - surface.x) / h
    weights = np.array([np.prod([quadratic(u) for u in row]) for row in away])
    return weights * (surface.depth < surface.distance)


def points_of(surface: Surface, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and the normals that a surface shows at a node, (n, d)."""
    shown = weights > 0
    return (surface.x + surface.way)[shown], surface.n[shown]


def soft_minimum(
    surface: Surface,
    r: np.ndarray,
    axes: np.ndarray,
    distance: np.ndarray,
    h: float,
    counts: float | np.ndarray = 1.0,
) -> tuple[float, np.ndarray]:
    """Return the smooth minimum of distances (n) of the points of a surface, from which r (n, d) lead to a node, m.

    A point counts as farther away, the farther it is from the line through the node along its axis (n, d). Also return
    the shares of the points, which have these weights.
    """
    radius, beta = 3 * h, 12 / surface.distance
    shares = counts * np.exp(-beta * (distance + ((r**2).sum(1) - (r * axes).sum(1) ** 2) / (2 * radius)))
    row = (np.sqrt(2 * np.pi * radius / beta) / surface.distance) ** (r.shape[1] - 1)
    if shares.sum() == 0.0:
        return np.inf, shares
    return -np.log(shares.sum() / row) / beta, shares / shares.sum()


def distance_to(surface: Surface, weights: np.ndarray, node: np.ndarray, axis: np.ndarray, h: float) -> float:
    """Return the distance of a node from the points of a surface along its outward axis, m."""
    r = node - points_of(surface, weights)[0]
    return soft_minimum(surface, r, np.broadcast_to(axis, r.shape), r @ axis, h)[0]


def facing(n: np.ndarray, others: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the weights of points with normals n that meet faces with others, (n, d): they must be opposite."""
    return np.clip((-(n * others).sum(1) - low) / (high - low), 0.0, 1.0)


def between(
    surfaces: tuple[Surface, Surface], weights: list[np.ndarray], node: np.ndarray, h: float
) -> tuple[float, np.ndarray, float]:
    """Return the gap of two bodies, m, the axis from the first to the second, and how far a node is from its middle, m.

    The points of each are taken in the distance of the other, of the plane of the nearest point or, if that one is
    below the plane of another, by more than 0.1 / beta, the plane that is farther out.
    """
    shown = [points_of(surface, w) for surface, w in zip(surfaces, weights, strict=True)]
    gaps, means, axis = [], [], np.zeros(len(node))
    for k, sign in ((0, -1), (1, 1)):
        (y, own), (z, n) = shown[k], shown[1 - k]
        distances, faces = [], []
        for point in y:
            first = int(np.argmin(((point - z) ** 2).sum(1)))
            off = ((point - z) * n).sum(1)
            edge = ((z[first] - z) * n).sum(1) < -0.1 * surfaces[1 - k].distance / 12
            best = int(np.argmax(np.where(edge, off, -np.inf)))
            chosen = best if edge[best] and off[best] > off[first] else first
            distances.append(off[chosen])
            faces.append(n[chosen])
        counts = facing(own, np.array(faces), 0.3, 0.6)
        gap, shares = soft_minimum(surfaces[k], node - y, np.array(faces), np.array(distances), h, counts)
        gaps.append(gap)
        means.append(-sign * (shares @ (node - y)))
        axis += sign * (shares @ np.array(faces))
    if not np.isfinite(gaps).any():
        return np.inf, axis, 0.0
    axis = unit(axis)
    far = [sign * (mean @ axis - min(gaps) / 2) for sign, mean in zip((1, -1), means, strict=True)]
    return min(gaps), axis, float(np.mean([one for one, gap in zip(far, gaps, strict=True) if np.isfinite(gap)]))


def normal_along(surface: Surface, weights: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the mean normal of the points of a surface that look along an axis most."""
    shown = weights > 0
    n = surface.n[shown]
    return unit((weights[shown] * np.exp(16 * (n @ axis - 1))) @ n)


@dataclass(frozen=True)
class Obstacle:
    """What bodies meet: its distance (m) from a place, its normal there, its velocity there (m/s), and its friction."""

    distance: Callable[[np.ndarray], float]
    normal: Callable[[np.ndarray], np.ndarray]
    velocity: Callable[[np.ndarray], np.ndarray]
    friction: float


def exchange(
    momenta: list[np.ndarray],
    masses: list[np.ndarray],
    surfaces: list[Surface],
    box: Box,
    dt: float,
    friction: float,
) -> int:
    """Let two bodies with these momenta (..., d) and masses (...) push each other; return at how many nodes."""
    h, pushed = box.spacing, 0
    a, c = surfaces
    for at in product(*(range(n) for n in masses[0].shape)):
        m = np.array([mass[at] for mass in masses])
        if not (m > 0).all():
            continue
        node = (np.array(at) - MARGIN) * h
        w = [near(surface, node, h) for surface in surfaces]
        if not all(shows(surface, weights) for surface, weights in zip(surfaces, w, strict=True)):
            continue
        n_a, n_c = (unit(weights @ surface.n) for weights, surface in zip(w, surfaces, strict=True))

        if n_a @ n_c >= 0.7:
            continue
        faces = normal_along(a, w[0], -n_c), -normal_along(c, w[1], -n_a)
        gap, n, middle = between((a, c), w, node, h) if faces[0] @ faces[1] < 0.999 else (np.inf, np.zeros(0), 0.0)
        ways = gap / 2 + middle, gap / 2 - middle
        if not np.isfinite(gap):
            if faces[0] @ faces[1] <= 0.15:
                continue
            n = unit(faces[0] + faces[1])
            ways = distance_to(a, w[0], node, n, h), distance_to(c, w[1], node, -n, h)
        u = momenta[1][at] / m[1] - momenta[0][at] / m[0]
        inverse = 1 / a.modulus + 1 / c.modulus, (a.density, c.density)
        slopes = np.array(
            [weights @ surface.slope / weights.sum() for surface, weights in zip(surfaces, w, strict=True)]
        )
        J = impulse(n, ways, u, slopes, m[0] * m[1] / m.sum(), inverse, h, dt, friction)
        momenta[0][at] -= J
        momenta[1][at] += J
        pushed += (J != 0).any()
    return pushed


def stop(
    momentum: np.ndarray,
    mass: np.ndarray,
    surface: Surface,
    obstacle: Obstacle,
    box: Box,
    dt: float,
    gravity_step: np.ndarray,
) -> tuple[int, np.ndarray]:
    """Let an obstacle push a body; return at how many nodes, and the impulse that the obstacle takes, N s."""
    h, pushed, taken = box.spacing, 0, np.zeros(momentum.shape[-1])
    for at in product(*(range(n) for n in mass.shape)):
        node = (np.array(at) - MARGIN) * h
        D = obstacle.distance(node)
        if mass[at] == 0 or 1.5 * h <= D:
            continue
        w, inwards = near(surface, node, h), obstacle.normal(node)
        u = obstacle.velocity(node - D * inwards) - gravity_step - momentum[at] / mass[at]
        push, n, far, seen = springs(surface, w, obstacle, node, h, u, mass[at], dt)
        if not seen:
            # Behind the obstacle what shows no surface is stopped.
            push, n, far = mass[at] * max(0.0, u @ inwards) * (D <= 0), -inwards, 0.0
        along = u + (far * (w @ surface.slope / w.sum()) if seen else 0.0)
        along -= (along @ n) * n
        slip = np.linalg.norm(along)
        J = push * n - min(obstacle.friction * push, mass[at] * slip) * along / slip if push > 0.0 else np.zeros(len(n))
        momentum[at] -= J
        taken += J
        pushed += seen and (J != 0).any()
    return pushed, taken


def springs(
    surface: Surface,
    weights: np.ndarray,
    obstacle: Obstacle,
    node: np.ndarray,
    h: float,
    u: np.ndarray,
    mass: float,
    dt: float,
) -> tuple[float, np.ndarray, float, bool]:
    """Return the push of a node, N s, its axis, the distance of the node from the body, m, and if it shows a surface.

    The points y of the surface inside the obstacle have springs; a node moves them with w (1 + 4 r (y - x) / h^2).
    """
    none = 0.0, np.zeros(len(node)), 0.0
    if not shows(surface, weights):
        return *none, False
    y, _ = points_of(surface, weights)
    x = surface.x[weights > 0]
    normals, D = (np.array([f(place) for place in y]) for f in (obstacle.normal, obstacle.distance))
    inside = D < 0
    if not inside.any():
        return *none, True
    shares = weights[weights > 0] * (1 + 4 * ((node - x) * (y - x)).sum(1) / h**2)
    shares = shares[inside] * surface.distance ** (len(node) - 1)
    forces = -shares * D[inside]
    total = -forces @ normals[inside]
    area, n = np.abs(shares).sum(), unit(total)
    kappa = 2 * surface.modulus / h * area * dt**2 / mass
    away, overlap = u @ n, np.linalg.norm(total) / area
    push = max(0.0, overlap / dt - away / 2) * kappa / (1 + kappa / 2)
    push = mass * max(push, -away * np.clip((overlap / h - 0.1) / 0.1, 0, 1))
    far = (np.abs(forces) @ (node - y)[inside]) @ n / np.abs(forces).sum()
    return push, n, far, True


def shows(surface: Surface, weights: np.ndarray) -> bool:
    return bool((weights > 0).any())


def beyond(r: float, density: Callable[[float], float]) -> float:
    """Return the integral of a density from r on, where the spline of a node ends, by Gauss's rule on each piece."""
    points, weights = np.polynomial.legendre.leggauss(4)
    ends, total = [r, *(end for end in (-1.5, -0.5, 0.5, 1.5) if end > r)], 0.0
    for a, b in pairwise(ends):
        places = 0.5 * (a + b) + 0.5 * (b - a) * points
        total += 0.5 * (b - a) * (weights @ np.array([density(place) for place in places]))
    return total


def impulse(
    n: np.ndarray,
    ways: tuple[float, float],
    u: np.ndarray,
    slopes: np.ndarray,
    reduced: float,
    inverse: tuple[float, tuple[float, ...]],
    h: float,
    dt: float,
    friction: float,
) -> np.ndarray:
    """Return the impulse along an axis, along which the surfaces of both have these distances from the node.

    slopes: dv/dn of both, a row each; inverse: of the modulus, summed over both, and the densities.
    """
    d = len(u)
    far_a, far_c = ways
    flat = [density * beyond(far_ / h, quadratic) for density, far_ in zip(inverse[1], (far_a, far_c), strict=False)]
    share = min(1.0, reduced * sum(1 / max(one, 1e-30) for one in flat) / h**d)
    # The force 4 w(r) r of a uniform stress behind the surface.
    traction = beyond((far_a - far_c) / (2 * h), lambda r: 4 * quadratic(r) * r)
    kappa = 2 / inverse[0] * h ** (d - 2) * traction * share * dt**2 / reduced
    gap, away = far_a + far_c, u @ n
    push = max(0.0, -away - max(gap, -0.3 * h) / dt) * kappa / (1 + kappa)
    push = reduced * max(push, -away * np.clip((-gap / h - 0.1) / 0.1, 0, 1))
    along = u + far_a * slopes[0] - far_c * slopes[1]
    along -= (along @ n) * n
    slip = np.linalg.norm(along)
    return push * n - min(friction * push, reduced * slip) * along / slip
