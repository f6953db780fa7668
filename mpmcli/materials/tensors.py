"""Small tensors on the host, many at a time."""

import numpy as np


def determinant(F: np.ndarray) -> np.ndarray:
    """Return det F, (n,), of 2 x 2 or 3 x 3 matrices, (n, d, d), written out: tenfold faster than a factorisation."""
    # A run that breaks down may hold anything, and is still looked at.
    with np.errstate(over="ignore", invalid="ignore"):
        if F.shape[-1] == 2:
            return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
        return (
            F[:, 0, 0] * (F[:, 1, 1] * F[:, 2, 2] - F[:, 1, 2] * F[:, 2, 1])
            - F[:, 0, 1] * (F[:, 1, 0] * F[:, 2, 2] - F[:, 1, 2] * F[:, 2, 0])
            + F[:, 0, 2] * (F[:, 1, 0] * F[:, 2, 1] - F[:, 1, 1] * F[:, 2, 0])
        )
