"""What a run conserves, from sums over the particles of each law, and the rows of the ledger made of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.frames.ledger import LedgerRow


@dataclass(frozen=True)
class Sums:
    """Sums over the particles of a law at T times, in float64.

    Attributes:
        mass: sum m, (T,); place: sum m x, (T, d); momentum: sum m v, (T, d).
        motion: sum m v^2, (T,); affine: sum m |C|^2, (T,).
        turning: sum m x cross v, and of the axial vector of C, `spin`: (T, 1) in 2D and (T, 3) in 3D.
        elastic: stored energy, J, half a step earlier, (T,); speed_squared: the largest, (T,).
    """

    mass: np.ndarray
    place: np.ndarray
    momentum: np.ndarray
    motion: np.ndarray
    affine: np.ndarray
    turning: np.ndarray
    spin: np.ndarray
    elastic: np.ndarray
    speed_squared: np.ndarray


@dataclass(frozen=True)
class StepsTaken:
    """The steps between two frames.

    Attributes:
        count: number of steps.
        smallest: size, s, Courant number and bound of the smallest; of equal ones the lesser of what follows counts.
        largest: size of the largest, s.
        courant: largest Courant number.
    """

    count: int = 0
    smallest: tuple[float, float, str] = (0.0, 0.0, "")
    largest: float = 0.0
    courant: float = 0.0

    def and_one(self, dt: float, courant: float, limit: str) -> "StepsTaken":
        """Return these with one step more."""
        own = (dt, courant, limit)
        smallest = min(self.smallest, own) if self.count else own
        return StepsTaken(self.count + 1, smallest, max(self.largest, dt), max(self.courant, courant))


NO_STEPS = StepsTaken()


def axis_pairs(dimension: int) -> tuple[tuple[int, int], ...]:
    """Return the axes (a, b) of each component x_a v_b - x_b v_a of a cross product."""
    return ((0, 1),) if dimension == 2 else ((1, 2), (2, 0), (0, 1))


def ledger_sums(
    sums: Sequence[Sums],
    gravity: np.ndarray,
    spacing: float,
    dt: np.ndarray,
    moment: float = 0.25,
) -> dict[str, np.ndarray]:
    """Return the entries of `LedgerRow`s that belong to the state alone, by name, (T,) or (T, k).

    The affine velocity carries energy and angular momentum too (Jiang et al. 2017). Leapfrog has its velocities half a
    step dt (s) before its positions. All energies are taken there, where their sum is second order in the step; with
    the positions as they are it would swing by v dt/2 times the force.

    Args:
        sums: of each law.
        gravity: m/s^2, (T, d); dt: the last step, s, (T,).
        moment: D / h^2, see `stability.transfer_factors.affine_moment`.
    """
    inertia = moment * spacing**2
    momentum = sum(one.momentum for one in sums)
    place = sum(one.place for one in sums)
    return {
        "mass": sum(one.mass for one in sums),
        "kinetic": sum(0.5 * (one.motion + inertia * one.affine) for one in sums),
        "elastic": sum(one.elastic for one in sums),
        "potential": -((place - 0.5 * dt[:, None] * momentum) * gravity).sum(axis=1),
        "linear_momentum": momentum,
        "angular_momentum": sum(one.turning + inertia * one.spin for one in sums),
        "speed_max": np.sqrt(np.max([one.speed_squared for one in sums], axis=0)),
    }


def ledger_rows(sums: dict[str, np.ndarray], times: Sequence[float], taken: Sequence[StepsTaken]) -> list[LedgerRow]:
    """Return a row for each time: the result of `ledger_sums`, and the steps to it."""
    columns = {name: values.tolist() for name, values in sums.items()}
    for name in ("linear_momentum", "angular_momentum"):
        columns[name] = list(map(tuple, columns[name]))
    for name in ("collider_force", "collider_torque"):
        if name in columns:
            columns[name] = [tuple(map(tuple, rows)) for rows in columns[name]]
    return [
        LedgerRow(
            time=time,
            steps=steps.count,
            step_min=steps.smallest[0],
            step_max=steps.largest,
            limit=steps.smallest[2],
            courant_max=steps.courant,
            **dict(zip(columns, values, strict=True)),
        )
        for time, steps, values in zip(times, taken, zip(*columns.values(), strict=True), strict=True)
    ]
