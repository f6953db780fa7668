"""Rate of deformation of a particle, as the bound on the step counts it."""

import numpy as np


def deformation_rate(C: np.ndarray, *, keeps_J: bool) -> np.ndarray:
    """Return a bound on the rate of change of the stored deformation, (n,), 1/s (docs/theory.md, 6.4).

    For F it is the largest row sum of |C + C^T| / 2, as a rotation does not deform. J grows by det(I + dt C) =
    1 + dt tr C + dt^2 m + ..., where m is the sum of the principal minors of order two: |tr C| + sqrt(max(-m, 0)).
    `solver.state_bounds` computes the same on the device.

    Args:
        C: velocity gradients, (n, d, d), 1/s.
        keeps_J: whether the law stores J rather than F.
    """
    if not keeps_J:
        return np.abs(C + C.swapaxes(1, 2)).sum(axis=2).max(axis=1) / 2
    trace = np.trace(C, axis1=1, axis2=2)
    minors = (trace**2 - np.einsum("nij,nji->n", C, C)) / 2
    return np.abs(trace) + np.sqrt(np.maximum(-minors, 0.0))
