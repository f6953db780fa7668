"""Damping of a wave by the transfers of APIC in a step, from von Neumann analysis."""

from collections.abc import Sequence

import numpy as np

# Nodes of a stencil relative to the central one, in cells.
NODES = np.arange(-1, 2)


def apic_factor(angles: Sequence[float], places: np.ndarray | None = None) -> float:
    """Return the amplification factor of a velocity wave exp(i k.x) in a step without forces, with quadratic weights.

    Nodes hold one number per wave, so that a step multiplies it: with the weights w_i and the levers x_i - x_p in
    cells, by the mean over particles of |sum w_i e_i|^2 + 4 |sum w_i (x_i - x_p) e_i|^2, e_i = exp(i k.x_i). On a
    lattice it is a product over axes: A A + A B + B A in 2D. Hence 1 - 0.024 (kh)^4 along an axis, and
    1 - 0.110 (kh)^4 for the wave vector (k, k) (docs/theory.md, 2.4).

    Args:
        angles: k h along each axis.
        places: positions of particles along each axis, in cells from the nearest node; uniform by default.
    """
    if places is None:
        # Polynomials of the sixth degree in the place: four points of Gauss are exact.
        points, parts = np.polynomial.legendre.leggauss(4)
        places, parts = points / 2, parts / 2
    else:
        parts = np.full(len(places), 1 / len(places))
    x = np.asarray(places)[:, None]
    weights = np.concatenate([(0.5 - x) ** 2 / 2, 0.75 - x**2, (0.5 + x) ** 2 / 2], axis=1)
    factor, affine = 1.0, 0.0
    for angle in angles:
        waves = weights * np.exp(1j * angle * NODES)
        A = parts @ np.abs(waves.sum(1)) ** 2
        B = 4 * parts @ np.abs((waves * (NODES - x)).sum(1)) ** 2
        factor, affine = factor * A, affine * A + factor * B
    return float(factor + affine)
