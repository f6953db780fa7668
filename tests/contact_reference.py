"""Contact of two bodies at the nodes that both reach, in plain numpy, from the formulas of docs/theory.md, 2.8."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from mpm_reference import MARGIN, Box, quadratic


@dataclass(frozen=True)
class Surface:
    """What the particles of a body show: places x, normals n (n, d) and depths (n) of the deformed surface.

    distance: of its particles at rest, m; modulus: its P-wave modulus, Pa; density: at rest, kg/m^3.
    """

    x: np.ndarray
    n: np.ndarray
    depth: np.ndarray
    distance: float
    modulus: float
    density: float

    @staticmethod
    def of(x: np.ndarray, F: np.ndarray, N: np.ndarray, D: np.ndarray, *numbers: float) -> "Surface":
        """Carry normals N (n, d) and depths D (n) at rest with F (n, d, d)."""
        normal = np.stack([np.linalg.inv(f).T @ each for f, each in zip(F, N, strict=True)])
        size = np.linalg.norm(normal, axis=1)
        return Surface(x, normal / size[:, None], D / size, *numbers)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def near(surface: Surface, node: np.ndarray, h: float) -> np.ndarray:
    """Return the weights (n) of the particles whose stencil has a node and that show something."""
    away = (node - surface.x) / h
    weights = np.array([np.prod([quadratic(u) for u in row]) for row in away])
    return weights * (surface.depth < 1.5 * h)


def distance_to(surface: Surface, weights: np.ndarray, node: np.ndarray, axis: np.ndarray, h: float) -> float:
    """Return the distance of a node from the points of a surface along its outward axis, m."""
    shown = (weights > 0) & (surface.depth < surface.distance)
    r = node - (surface.x + surface.depth[:, None] * surface.n)[shown]
    radius, beta = 3 * h, 12 / surface.distance
    along = r @ axis
    q = along + ((r**2).sum(1) - along**2) / (2 * radius)
    row = (np.sqrt(2 * np.pi * radius / beta) / surface.distance) ** (len(axis) - 1)
    return -np.log(np.exp(-beta * q).sum() / row) / beta


def normal_along(surface: Surface, weights: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the mean normal of the points of a surface that look along an axis most."""
    shown = (weights > 0) & (surface.depth < surface.distance)
    n = surface.n[shown]
    return unit((weights[shown] * np.exp(16 * (n @ axis - 1))) @ n)


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
        if not all(((weights > 0) & (s.depth < s.distance)).any() for weights, s in zip(w, surfaces, strict=True)):
            continue
        n_a, n_c = (unit(weights @ surface.n) for weights, surface in zip(w, surfaces, strict=True))

        def far(axis: np.ndarray, w: list = w, node: np.ndarray = node) -> tuple[float, float]:
            return distance_to(a, w[0], node, axis, h), distance_to(c, w[1], node, -axis, h)

        if n_a @ n_c >= 0.7:
            continue
        mean = unit(n_a - n_c)
        axes = [normal_along(a, w[0], mean), -normal_along(c, w[1], -mean), mean]
        gaps = np.array([sum(far(axis)) for axis in axes])
        n = unit(np.exp((gaps - gaps.max()) / (0.02 * h)) @ np.array(axes))
        far_a, far_c = far(n)
        reduced = m[0] * m[1] / m.sum()
        u = momenta[1][at] / m[1] - momenta[0][at] / m[0]
        modulus = 2 / (1 / a.modulus + 1 / c.modulus)
        share = min(1.0, reduced / (0.5 * h ** len(node) / (1 / a.density + 1 / c.density)))
        kappa = modulus * h ** (len(node) - 2) * quadratic((far_a - far_c) / (2 * h)) * share * dt**2 / reduced
        gap = max(far_a + far_c, -h)
        push = reduced * max(0.0, -u @ n - gap / dt) * kappa / (1 + kappa)
        along = u - (u @ n) * n
        slip = np.linalg.norm(along)
        J = push * n - min(friction * push, reduced * slip) * along / slip
        momenta[0][at] -= J
        momenta[1][at] += J
        pushed += push > 0
    return pushed
