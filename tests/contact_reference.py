"""Contact of two bodies, or of one and an obstacle, in plain numpy, from the formulas of docs/theory.md, 2.8."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

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


def inside(surface: Surface, other: Surface, h: float) -> np.ndarray:
    """Return how far the points of a surface are inside of another body, along its inward normals, (n, d), m.

    The depth is that below the plane of the nearest point or, if that one is below the plane of another, by more than a
    hundredth of the spacing, the plane that is farther out. A point counts as far as the normals are opposite.
    """
    found = np.zeros_like(surface.x)
    for p in np.flatnonzero(surface.depth < surface.distance):
        # Particles are searched for in the bins around the place of one that is as deep below the same point.
        bins = (np.floor(x / h - 0.5) for x in (other.x, surface.x[p] + 2 * surface.way[p]))
        shown = (other.depth < other.distance) & (np.abs(np.subtract(*bins)) <= 1).all(1)
        if not shown.any():
            continue
        n = other.n[shown]
        apart = surface.x[p] + surface.way[p] - (other.x + other.way)[shown]
        first, off = int(np.argmin((apart**2).sum(1))), (apart * n).sum(1)
        if np.linalg.norm(apart[first]) >= h or off[first] >= 0:
            continue
        edge = ((apart - apart[first]) * n).sum(1) < -0.01 * other.distance
        best = int(np.argmax(np.where(edge, off, -np.inf)))
        chosen = best if edge[best] and off[best] > off[first] else first
        if off[chosen] < 0:
            facing = np.clip((-n[chosen] @ surface.n[p] - 0.3) / 0.3, 0.0, 1.0)
            found[p] = facing * max(off[chosen], -h / 2) * n[chosen]
    return found


def inside_obstacle(surface: Surface, obstacle: "Obstacle") -> np.ndarray:
    """Return how far the points of a surface are inside of an obstacle, along its inward normals, (n, d), m."""
    found = np.zeros_like(surface.x)
    for p in np.flatnonzero(surface.depth < surface.distance):
        y = surface.x[p] + surface.way[p]
        found[p] = min(obstacle.distance(y), 0.0) * obstacle.normal(y)
    return found


@dataclass(frozen=True)
class Obstacle:
    """What bodies meet: its distance (m) from a place, its normal there, its velocity there (m/s), and its friction."""

    distance: Callable[[np.ndarray], float]
    normal: Callable[[np.ndarray], np.ndarray]
    velocity: Callable[[np.ndarray], np.ndarray]
    friction: float


def exchange(
    momenta: list[np.ndarray], masses: list[np.ndarray], surfaces: list[Surface], box: Box, dt: float, friction: float
) -> int:
    """Let two bodies with these momenta (..., d) and masses (...) push each other; return at how many nodes."""
    h, pushed, (a, c) = box.spacing, 0, surfaces
    overlaps = [inside(a, c, h), inside(c, a, h)]
    for at in product(*(range(n) for n in masses[0].shape)):
        m = np.array([mass[at] for mass in masses])
        if (m > 0).all():
            u, stiffness = momenta[1][at] / m[1] - momenta[0][at] / m[0], 2 / (1 / a.modulus + 1 / c.modulus) / h
            node = (np.array(at) - MARGIN) * h
            J, _ = impulse(surfaces, overlaps, node, h, u, m[0] * m[1] / m.sum(), stiffness, dt, friction)
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
    overlaps = [inside_obstacle(surface, obstacle)]
    for at in product(*(range(n) for n in mass.shape)):
        node = (np.array(at) - MARGIN) * h
        D = obstacle.distance(node)
        if mass[at] == 0 or 1.5 * h <= D:
            continue
        inwards, mu = obstacle.normal(node), obstacle.friction
        u = obstacle.velocity(node - D * inwards) - gravity_step - momentum[at] / mass[at]
        J, seen = impulse([surface], overlaps, node, h, u, mass[at], 2 * surface.modulus / h, dt, mu)
        if not seen and D <= 0:
            # Behind the obstacle what shows no surface is stopped.
            J = rubbed(mass[at] * max(0.0, u @ inwards), -inwards, u, mass[at], mu)
        momentum[at] -= J
        taken += J
        pushed += seen and (J != 0).any()
    return pushed, taken


def impulse(
    surfaces: list[Surface],
    overlaps: list[np.ndarray],
    node: np.ndarray,
    h: float,
    u: np.ndarray,
    reduced: float,
    stiffness: float,
    dt: float,
    friction: float,
) -> tuple[np.ndarray, bool]:
    """Return the impulse at a node from the first body to the second, or to an obstacle, and if it shows a surface.

    A node moves a point y with w (1 + 4 r (y - x) / h^2). Of two bodies each has half of the springs.
    """
    both = len(surfaces) == 2
    force, area, slopes, ways, pushes, seen = np.zeros(len(node)), 0.0, [], [], [], []
    for surface, overlap, sign in zip(surfaces, overlaps, (1, -1), strict=False):
        w, y = near(surface, node, h), surface.x + surface.way
        shares = w * (1 + 4 * ((node - surface.x) * surface.way).sum(1) / h**2)
        shares *= surface.distance ** (len(node) - 1) * (0.5 if both else 1.0)
        depth = np.linalg.norm(overlap, axis=1)
        force += sign * shares @ overlap
        area += np.abs(shares[depth > 0]).sum()
        pushes.append(np.abs(shares) @ depth)
        ways.append((np.abs(shares) * depth) @ (node - y) / max(pushes[-1], 1e-300))
        slopes.append(w @ surface.slope / max(w.sum(), 1e-300))
        seen.append(shows(surface, w))
    if area == 0.0 or not force.any():
        return np.zeros(len(node)), seen[0]
    n, overlap = unit(force), np.linalg.norm(force) / area
    least = 0.15 * min(surface.density for surface in surfaces) * h * area if both else 0.0
    kappa = stiffness * area * dt**2 / max(reduced, least)
    far = [sign * way @ n for sign, way in zip((1, -1), ways, strict=False)]
    if both:
        far = [far[k] if pushes[k] > 0 else -overlap - far[1 - k] for k in range(2)]
    away = u @ n
    push = max(0.0, overlap / dt - away / 2) * kappa / (1 + kappa / 2)
    push = reduced * max(push, -away * np.clip((overlap / h - 0.1) / 0.1, 0, 1))
    along = u + far[0] * slopes[0] - (far[1] * slopes[1] if both else 0.0)
    return rubbed(push, n, along, reduced, friction), seen[0]


def rubbed(push: float, n: np.ndarray, along: np.ndarray, reduced: float, friction: float) -> np.ndarray:
    """Return an impulse along a normal with the friction against a velocity."""
    along = along - (along @ n) * n
    slip = np.linalg.norm(along)
    return push * n - min(friction * push, reduced * slip) * along / slip if push > 0.0 else np.zeros(len(n))


def shows(surface: Surface, weights: np.ndarray) -> bool:
    return bool((weights > 0).any())
