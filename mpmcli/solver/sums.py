"""What a run conserves, from sums over the particles of each law."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.frames.ledger import LedgerRow


@dataclass(frozen=True)
class Sums:
    """Sums over the particles of a law, in float64.

    Attributes:
        mass: sum m; place: sum m x, (d,); momentum: sum m v, (d,).
        motion: sum m v^2; affine: sum m |C|^2.
        turning: sum m x cross v, and of the axial vector of C, `spin`: (1,) in 2D and (3,) in 3D.
        elastic: stored energy, J, half a step earlier; speed_squared: the largest.
    """

    mass: float
    place: np.ndarray
    momentum: np.ndarray
    motion: float
    affine: float
    turning: np.ndarray
    spin: np.ndarray
    elastic: float
    speed_squared: float


def axis_pairs(dimension: int) -> tuple[tuple[int, int], ...]:
    """Return the axes (a, b) of each component x_a v_b - x_b v_a of a cross product."""
    return ((0, 1),) if dimension == 2 else ((1, 2), (2, 0), (0, 1))


def ledger_sums(
    sums: Sequence[Sums],
    volume_ratios: np.ndarray,
    gravity: np.ndarray,
    spacing: float,
    dt: float,
    moment: float = 0.25,
) -> dict[str, float | tuple[float, ...]]:
    """Return the entries of a `LedgerRow` that belong to the state alone, by name.

    The affine velocity carries energy and angular momentum too (Jiang et al. 2017). Leapfrog has its velocities half a
    step dt (s) before its positions. All energies are taken there, where their sum is second order in the step; with
    the positions as they are it would swing by v dt/2 times the force.

    Args:
        sums: of each law; volume_ratios: of each particle, (n,).
        moment: D / h^2, see `stability.transfer_factors.affine_moment`.
    """
    inertia = moment * spacing**2
    momentum = sum(one.momentum for one in sums)
    place = sum(one.place for one in sums)
    angular = sum(one.turning + inertia * one.spin for one in sums)
    return {
        "mass": float(sum(one.mass for one in sums)),
        "kinetic": float(sum(0.5 * (one.motion + inertia * one.affine) for one in sums)),
        "elastic": float(sum(one.elastic for one in sums)),
        "potential": float(-((place - 0.5 * dt * momentum) @ gravity)),
        "linear_momentum": tuple(momentum.tolist()),
        "angular_momentum": tuple(angular.tolist()),
        "speed_max": float(np.sqrt(max(one.speed_squared for one in sums))),
        "volume_ratio_min": float(volume_ratios.min()),
        "volume_ratio_max": float(volume_ratios.max()),
    }


def ledger_row(sums: dict, time: float, taken: Sequence[tuple[float, float, str]]) -> LedgerRow:
    """Return the row of a frame: the result of `ledger_sums`, and the steps (size, Courant number, limit) to it."""
    smallest = min(taken, default=(0.0, 0.0, ""))
    return LedgerRow(
        time=time,
        steps=len(taken),
        step_min=smallest[0],
        step_max=max(taken, default=(0.0,))[0],
        limit=smallest[2],
        courant_max=max((courant for _, courant, _ in taken), default=0.0),
        **sums,
    )
