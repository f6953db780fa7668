"""Small plane strain by finite elements, for references: a quadrilateral, clamped on one side, pulled on the other."""

from functools import lru_cache

import numpy as np

# Points and weights of Gauss on [-1, 1].
THREE = ((-(0.6**0.5), 5 / 9), (0.0, 8 / 9), (0.6**0.5, 5 / 9))
TWO = ((-(3**-0.5), 1.0), (3**-0.5, 1.0))


def _shapes(s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic shape functions of a line, and their slopes, at s in [-1, 1]."""
    return np.array([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2]), np.array([s - 0.5, -2 * s, s + 0.5])


@lru_cache
def deflection(
    corners: tuple[tuple[float, float], ...],
    load: tuple[float, float],
    shear_modulus: float,
    lame_lambda: float,
    elements: tuple[int, int] = (18, 10),
) -> float:
    """Return the displacement along y of the middle of the right side under a body force along y, m.

    Biquadratic elements, with the volume integrated by 2 x 2 points where the shape takes 3 x 3, so that they do not
    lock (Hughes 2000, chapter 4). Elements get narrower towards the clamped side and the faces, in whose corners
    the stress is singular.

    Args:
        corners: lower left, lower right, upper right, upper left, m; the sides at the left and the right are vertical,
            and the left one is clamped.
        load: the force per area, N/m^2 per metre of depth, and the x beyond which it acts, m: elements end there.
        elements: along the quadrilateral, the loaded part not included, and across.
    """
    (x0, low0), (x1, low1), (_, high1), (_, high0) = corners
    pull, start = load
    along, across = elements
    # Nodes along x, those at the middle of elements included, and across, in parts of the width.
    inner = np.linspace(0, 1, along + 1) ** 1.5
    ends = x0 + (start - x0) * inner
    ends = np.concatenate([ends, np.linspace(start, x1, 3)[1:]])
    x = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    ends = (1 - np.cos(np.pi * np.linspace(0, 1, across + 1))) / 2
    t = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    share = ((x - x0) / (x1 - x0))[:, None]
    low, high = low0 + share * (low1 - low0), high0 + share * (high1 - high0)
    nodes = np.stack(np.broadcast_arrays(x[:, None], low + (high - low) * t), axis=-1)
    numbers = np.arange(len(x) * len(t)).reshape(len(x), len(t))
    K, f = np.zeros((2 * numbers.size,) * 2), np.zeros(2 * numbers.size)
    shape = np.diag([2 * shear_modulus, 2 * shear_modulus, shear_modulus])
    for i in range(0, len(x) - 1, 2):
        for j in range(0, len(t) - 1, 2):
            own, place = numbers[i : i + 3, j : j + 3].ravel(), nodes[i : i + 3, j : j + 3].reshape(-1, 2)
            k = np.zeros((18, 18))
            for rule in (THREE, TWO):
                for s, ws in rule:
                    for r, wr in rule:
                        (a, da), (b, db) = _shapes(s), _shapes(r)
                        slopes = np.stack([np.outer(da, b).ravel(), np.outer(a, db).ravel()])
                        jacobian = slopes @ place
                        weight = ws * wr * np.linalg.det(jacobian)
                        slopes = np.linalg.solve(jacobian, slopes)
                        if rule is TWO:
                            volume = slopes.T.ravel()
                            k += lame_lambda * weight * np.outer(volume, volume)
                            continue
                        B = np.zeros((3, 18))
                        B[0, 0::2], B[1, 1::2], B[2, 0::2], B[2, 1::2] = slopes[0], slopes[1], slopes[1], slopes[0]
                        k += weight * B.T @ shape @ B
                        if x[i] >= start - 1e-9 * x1:
                            f[2 * own + 1] += pull * weight * np.outer(a, b).ravel()
            places = np.stack([2 * own, 2 * own + 1], axis=1).ravel()
            K[np.ix_(places, places)] += k
    free = np.arange(2 * len(t), 2 * numbers.size)
    u = np.linalg.solve(K[np.ix_(free, free)], f[free])
    # At the middle of the width of the right side, where there is a node.
    return float(u[2 * numbers[-1, len(t) // 2] + 1 - 2 * len(t)])
