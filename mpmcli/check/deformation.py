"""How fast a velocity gradient deforms a particle, as the bound on the step counts it."""

import numpy as np


def deformation_rate(C: np.ndarray, *, keeps_J: bool) -> np.ndarray:
    """Return what bounds the change of what particles store, (n,), 1/s; the solver has it in `solver.state_bounds`.

    For F the largest row sum of |C + C^T| / 2, as a rotation deforms nothing. For J, which grows by det(I + dt C) =
    1 + dt tr C + dt^2 m + ..., |tr C| + sqrt(-m) where m, the sum of the principal minors of order two, is negative.

    Args:
        C: velocity gradients, (n, d, d), 1/s; keeps_J: whether J alone is stored.
    """
    if not keeps_J:
        return np.abs(C + C.swapaxes(1, 2)).sum(axis=2).max(axis=1) / 2
    trace = np.trace(C, axis1=1, axis2=2)
    minors = (trace**2 - np.einsum("nij,nji->n", C, C)) / 2
    return np.abs(trace) + np.sqrt(np.maximum(-minors, 0.0))
