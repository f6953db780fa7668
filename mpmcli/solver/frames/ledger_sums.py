"""What a run conserves, from sums over the particles of each law, and the rows of the ledger made of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.frames.ledger import LOADS, RIGID, LedgerRow
from mpmcli.solver.frames.columns import FrameArrays, ParticleConstants
from mpmcli.solver.particles.sort import ACTIVE

# Particles whose sums are formed at once, which bounds the memory.
ROWS = 65_536


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
    """The steps between two frames: their number, size, s, and Courant number and bound of the smallest, and maxima."""

    count: int = 0
    smallest: tuple[float, float, str] = (0.0, 0.0, "")
    largest: float = 0.0
    courant: float = 0.0


NO_STEPS = StepsTaken()


def axis_pairs(dimension: int) -> tuple[tuple[int, int], ...]:
    """Return the axes (a, b) of each component x_a v_b - x_b v_a of a cross product."""
    return ((0, 1),) if dimension == 2 else ((1, 2), (2, 0), (0, 1))


def sums_of_rows(arrays: FrameArrays, constants: ParticleConstants, *, total: bool) -> list[Sums]:
    """Return the sums over the particles of each law at one time, by the products sum m a a^T with a = (1, x, v, C).

    On the CPU the kernel of a batch forms them (`reader.sum_range`). `arrays` has the columns "affine", and "gradient"
    where bodies are `total`.
    """
    d, result = arrays.columns.dimension, []
    activity = arrays["activity"][0] if arrays.columns.first["activity"] >= 0 else None
    numbers = np.arange(len(constants.mass))
    for _, rows in constants.members:
        products, spins, elastic, fastest = np.zeros((1 + 2 * d + d * d,) * 2), np.zeros((d, d)), 0.0, 0.0
        own = numbers[rows] if activity is None else numbers[rows][activity[rows] == ACTIVE]
        for first in range(0, len(own), ROWS):
            part = own[first : first + ROWS]
            mass, v = constants.mass[part], arrays["v"][0, part]
            C = arrays["affine"][0, part].reshape(-1, d, d).astype(np.float64)
            spin = C
            if total:
                # Nodes lie at F (X_i - X_p) from the particle, and move by C F (X_i - X_p).
                F = arrays["gradient"][0, part].reshape(-1, d, d).astype(np.float64)
                C, spin = C @ F, C @ F @ F.transpose(0, 2, 1)
            spins += np.tensordot(mass, spin, 1)
            a = np.concatenate([np.ones((len(part), 1)), arrays["x"][0, part], v, C.reshape(-1, d * d)], axis=1)
            products += (a * mass[:, None]).T @ a
            elastic += float(constants.volume[part] @ arrays["energy"][0, part].astype(np.float64))
            fastest = max(fastest, float(np.einsum("pc,pc->p", v, v).max()))
        x, v, C = slice(1, 1 + d), slice(1 + d, 1 + 2 * d), slice(1 + 2 * d, None)
        turning, pairs = products[x, v], axis_pairs(d)
        result.append(
            Sums(
                mass=products[None, 0, 0],
                place=products[None, 0, x],
                momentum=products[None, 0, v],
                motion=np.array([products[v, v].trace()]),
                affine=np.array([products[C, C].trace()]),
                turning=np.array([[turning[a, b] - turning[b, a] for a, b in pairs]]),
                spin=np.array([[spins[b, a] - spins[a, b] for a, b in pairs]]),
                elastic=np.array([elastic]),
                speed_squared=np.array([fastest]),
            )
        )
    return result


def ledger_sums(
    sums: Sequence[Sums], gravity: np.ndarray, spacing: float, dt: np.ndarray, moment: float = 0.25
) -> dict[str, np.ndarray]:
    """Return the entries of `LedgerRow`s that belong to the state alone, by name, (T,) or (T, k).

    The affine velocity carries energy and angular momentum too (Jiang et al. 2017). All energies are taken half a step
    back, where leapfrog has its velocities and their sum is second order in the step; with the positions as they are it
    would swing by v dt/2 times the force.

    sums: of each law; gravity: m/s^2, (T, d); dt: the last step, s, (T,); moment: see `affine_moment`.
    """
    inertia = moment * spacing**2
    momentum, place = sum(one.momentum for one in sums), sum(one.place for one in sums)
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
    for name in (*LOADS, *RIGID):
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
