"""How stiff a law is: its stress differentiated by the velocity gradient, by central differences."""

import numpy as np
from law_probe import LawProbe


def unit_gradients(dimension: int) -> np.ndarray:
    """Return the d^2 matrices with a single 1, (d^2, d, d)."""
    return np.eye(dimension**2).reshape(-1, dimension, dimension)


def largest_stiffness(
    probe: LawProbe, F: np.ndarray, internal: np.ndarray | None = None, strain: float = 1e-6
) -> np.ndarray:
    """Return the largest eigenvalue (n,) of d tau / d(C dt) at states F (n, d, d), Pa; it errs by order strain^2."""
    n, d = len(F), probe.dimension
    internal = probe.at_rest(n) if internal is None else internal
    columns = []
    for unit in unit_gradients(d):
        taus = [probe((np.eye(d) + sign * strain * unit) @ F, internal).tau[:, :d, :d] for sign in (1, -1)]
        columns.append((taus[0] - taus[1]).reshape(n, d * d) / (2 * strain))
    return np.linalg.eigvals(np.stack(columns, axis=2)).real.max(axis=1)


def largest_viscosity(probe: LawProbe, F: np.ndarray) -> np.ndarray:
    """Return the largest eigenvalue (n,) of d tau / dC at states F (n, d, d), Pa s, of a law linear in C."""
    n, d = len(F), probe.dimension
    without = probe(F).tau[:, :d, :d]
    columns = [probe(F, C=np.tile(unit, (n, 1, 1))).tau[:, :d, :d] - without for unit in unit_gradients(d)]
    return np.linalg.eigvals(np.stack([c.reshape(n, d * d) for c in columns], axis=2)).real.max(axis=1)
