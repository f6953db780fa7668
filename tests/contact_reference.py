"""Contact of two bodies, or of one and an obstacle, in plain numpy, from the formulas of docs/theory.md, 2.8."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from mpm_reference import MARGIN, Box, quadratic


@dataclass(frozen=True)
class Surface:
    """What the particles of a body show: places x, normals n (n, d) and depths (n) of the deformed surface.

    slope: dv/dn, (n, d), 1/s; distance: of its particles at rest, m; modulus: its P-wave modulus, Pa; density: at rest,
    kg/m^3.
    """

    x: np.ndarray
    n: np.ndarray
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
        return Surface(x, normal, D / size, np.einsum("pij,pj->pi", C, normal), *numbers)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def near(surface: Surface, node: np.ndarray, h: float) -> np.ndarray:
    """Return the weights (n) of the particles whose stencil has a node and that show something."""
    away = (node - surface.x) / h
    weights = np.array([np.prod([quadratic(u) for u in row]) for row in away])
    return weights * (surface.depth < surface.distance)


def distance_to(surface: Surface, weights: np.ndarray, node: np.ndarray, axis: np.ndarray, h: float) -> float:
    """Return the distance of a node from the points of a surface along its outward axis, m."""
    shown = weights > 0
    r = node - (surface.x + surface.depth[:, None] * surface.n)[shown]
    radius, beta = 3 * h, 12 / surface.distance
    along = r @ axis
    q = along + ((r**2).sum(1) - along**2) / (2 * radius)
    row = (np.sqrt(2 * np.pi * radius / beta) / surface.distance) ** (len(axis) - 1)
    return -np.log(np.exp(-beta * q).sum() / row) / beta


def distance_from(r: np.ndarray, axis: np.ndarray, beta: float, h: float) -> float:
    """Return the distance of a node from points of an obstacle, from which r (n, d) lead to it, along an axis, m."""
    along = r @ axis
    q = along + ((r**2).sum(1) - along**2) / (6 * h)
    return -np.log(np.exp(-beta * q).sum() / (1 + (len(r) - 1) * np.exp(-beta * h / 6))) / beta


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

    def points(self, node: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Return points on it, the nearest one and those nearest to places a cell aside, and the normals there."""

        def nearest(x: np.ndarray) -> np.ndarray:
            return x - self.distance(x) * self.normal(x)

        n, first = self.normal(node), nearest(node)
        least = int(np.argmin(np.abs(n)))
        tangents = [np.array([-n[1], n[0]])] if len(n) == 2 else [unit(np.eye(3)[least] - n[least] * n)]
        tangents += [np.cross(n, tangents[0])] if len(n) == 3 else []
        places = [node, *(first + side * h * t for t in tangents for side in (-1, 1))]
        return np.array([nearest(x) for x in places]), np.array([self.normal(x) for x in places])


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

        def far(axis: np.ndarray, w: list = w, node: np.ndarray = node) -> tuple[float, float]:
            return distance_to(a, w[0], node, axis, h), distance_to(c, w[1], node, -axis, h)

        if n_a @ n_c >= 0.7:
            continue
        mean = unit(n_a - n_c)
        axes = [normal_along(a, w[0], -n_c), -normal_along(c, w[1], -n_a), mean]
        if axes[0] @ axes[1] > 0.999:
            axes = [unit(axes[0] + axes[1])]
        u = momenta[1][at] / m[1] - momenta[0][at] / m[0]
        inverse = 1 / a.modulus + 1 / c.modulus, (a.density, c.density)
        slopes = np.array(
            [weights @ surface.slope / weights.sum() for surface, weights in zip(surfaces, w, strict=True)]
        )
        J = impulse(axes, far, u, slopes, m[0] * m[1] / m.sum(), inverse, h, dt, friction)
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
        w, facing = near(surface, node, h), obstacle.normal(node)
        u = obstacle.velocity(node - D * facing) - gravity_step - momentum[at] / mass[at]
        if not shows(surface, w) or unit(w @ surface.n) @ facing >= 0.7:
            # Behind the obstacle what shows no surface is stopped.
            push = mass[at] * max(0.0, u @ facing) * (D <= 0)
            along = u - (u @ facing) * facing
            slip = np.linalg.norm(along)
            J = -push * facing - min(obstacle.friction * push, mass[at] * slip) * along / slip
            momentum[at] -= J
            taken += J
            continue

        points, normals = obstacle.points(node, h)

        def far(axis: np.ndarray, w: np.ndarray = w, node: np.ndarray = node, r: np.ndarray = node - points) -> tuple:
            return distance_to(surface, w, node, axis, h), distance_from(r, -axis, 12 / surface.distance, h)

        n = unit(w @ surface.n)
        shares = np.exp(16 * (-normals @ n - 1))
        slopes = np.array([w @ surface.slope / w.sum(), np.zeros(len(node))])
        inverse = 1 / surface.modulus, (surface.density,)
        axes = [normal_along(surface, w, -facing), -unit(shares @ normals), unit(n - facing)]
        if (normals @ facing > 0.9).all():
            axes = [-facing]
        elif axes[0] @ axes[1] > 0.999:
            axes = [unit(axes[0] + axes[1])]
        J = impulse(axes, far, u, slopes, mass[at], inverse, h, dt, obstacle.friction)
        momentum[at] -= J
        taken += J
        pushed += (J != 0).any()
    return pushed, taken


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
    axes: list[np.ndarray],
    far: Callable,
    u: np.ndarray,
    slopes: np.ndarray,
    reduced: float,
    inverse: tuple[float, tuple[float, ...]],
    h: float,
    dt: float,
    friction: float,
) -> np.ndarray:
    """Return the impulse along the best axis.

    slopes: dv/dn of both, a row each; inverse: of the modulus, summed over both, and the densities.
    """
    d = len(u)
    gaps = np.array([sum(far(axis)) for axis in axes])
    n = unit(np.exp((gaps - gaps.max()) / (0.02 * h)) @ np.array(axes))
    far_a, far_c = far(n)
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
