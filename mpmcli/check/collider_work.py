"""The work of colliders with prescribed motion, from the loads in a ledger."""

from collections.abc import Sequence

import numpy as np

from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene.colliders import Collider
from mpmcli.scene.expression import evaluate

# Parts of the time between two frames in which the velocity of a collider is evaluated, and rows evaluated at once.
PARTS, AT_ONCE = 64, 1000


def work_of_colliders(rows: Sequence[LedgerRow], colliders: Sequence[Collider], *, sloped: bool = True) -> np.ndarray:
    """Return the work of colliders on the material up to each frame, (T,), J.

    Rows contain the mean load in the time before a frame. Within this time a load is linear, with the slope of the
    means of the neighbouring rows, or constant, and the velocity is exact at the middles of `PARTS` parts.
    """
    times = np.array([row.time for row in rows])
    spans, work = np.diff(times), np.zeros(len(rows))
    if len(rows) < 2:
        return work
    middles = 0.5 * (times[1:] + times[:-1])
    parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    for k, collider in enumerate(colliders):
        if collider.driven:
            loads = np.array([[*row.collider_force[k], *row.collider_torque[k]] for row in rows[1:]])
            slopes = np.gradient(loads, middles, axis=0) if sloped and len(middles) > 1 else np.zeros_like(loads)
            forces = len(collider.motion.velocity)
            for first in range(0, len(middles), AT_ONCE):
                own = slice(first, first + AT_ONCE)
                offsets = parts * spans[own, None]
                t = middles[own, None] + offsets
                rates = [np.broadcast_to(evaluate(tree, {"t": t}), t.shape) for tree in collider.motion.rates]
                turns = np.array([1.0]) if forces == 2 else np.array(collider.motion.axis)
                for load, slope, rate in zip(
                    [*loads[own].T[:forces], loads[own][:, forces:] @ turns],
                    [*slopes[own].T[:forces], slopes[own][:, forces:] @ turns],
                    rates,
                    strict=True,
                ):
                    power = (load[:, None] + slope[:, None] * offsets) * rate
                    work[1:][own] -= power.mean(axis=1) * spans[own]
    return np.cumsum(work)


def unsure_work(rows: Sequence[LedgerRow], colliders: Sequence[Collider]) -> np.ndarray:
    """Return how far the work up to each frame is unsure, (T,), J: as far as it depends on the slopes of the loads.

    These are not known where a collider starts or stops abruptly.
    """
    sure, linear = (work_of_colliders(rows, colliders, sloped=sloped) for sloped in (False, True))
    return np.cumsum(np.abs(np.diff(linear - sure, prepend=0.0)))
