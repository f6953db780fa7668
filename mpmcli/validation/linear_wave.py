"""Dispersion and dissipation of a small elastic wave by the scheme, from von Neumann analysis (docs/theory.md, 2.4)."""

from dataclasses import dataclass

import numpy as np

# Offsets of cells within the support of a quadratic B-spline.
NEIGHBOURS = range(-3, 4)


@dataclass(frozen=True)
class DiscreteWave:
    """Numerical errors of a wave e^(i(kx - wt)) with w = c k.

    Attributes:
        period_error: period over the exact one, minus 1.
        loss_per_step: fraction of the energy lost in a step.
    """

    period_error: float
    loss_per_step: float


def discrete_wave(kh: float, courant: float, per_axis: int) -> DiscreteWave:
    """Return the errors of MLS-MPM with APIC, quadratic B-splines and leapfrog for a wave along an axis.

    Each particle of a cell has the amplitudes v, C and the strain e, in units of h and c: the nodes take
    sum_p w (v + (x_i - x_p)(C - 4 C_0 e)) / sum_p w with the Courant number C_0, the particles gather v and C from
    them, and e grows by C_0 C. The matrix of that step has an eigenvalue next to e^(i kh C_0): its angle is the
    frequency, its square the energy that is left.
    The loss does not depend on the step: with very many particles it is (kh)^4 / 42 for small kh, with 2 to 4 per axis
    0.0238 to 0.0242 (kh)^4.

    Args:
        kh: wave number times spacing.
        courant: c dt / h.
        per_axis: particles per cell along the axis, evenly spaced.
    """
    places = (np.arange(per_axis) + 0.5) / per_axis
    scatter = np.zeros(3 * per_axis, complex)
    gather = np.zeros((3 * per_axis, 1), complex)
    kept = np.zeros((3 * per_axis, 3 * per_axis))
    mass = 0.0
    for p, x in enumerate(places):
        v, C, e = 3 * p, 3 * p + 1, 3 * p + 2
        kept[e, e] = 1.0
        for j in NEIGHBOURS:
            # The particle of cell j at the node at 0, and the node at j at the particle of cell 0.
            w, away, phase = _weight(x + j), -(x + j), np.exp(1j * kh * j)
            mass += w
            scatter[v] += w * phase
            scatter[C] += w * away * phase
            scatter[e] -= 4 * courant * w * away * phase
            w, away = _weight(j - x), j - x
            gather[v] += w * phase
            gather[C] += 4 * w * away * phase
        gather[e] = courant * gather[C]
    values = np.linalg.eigvals(kept + gather * scatter / mass)
    value = values[np.argmin(np.abs(values - np.exp(1j * kh * courant)))]
    return DiscreteWave(float(kh * courant / np.angle(value)) - 1, 1 - float(abs(value)) ** 2)


def _weight(distance: float) -> float:
    """Return the quadratic B-spline at a distance in cells."""
    y = abs(distance)
    if y < 0.5:
        return 0.75 - y * y
    return 0.5 * (1.5 - y) ** 2 if y < 1.5 else 0.0
