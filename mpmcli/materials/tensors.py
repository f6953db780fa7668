"""Small tensors: determinants of arrays on the host, and strains without cancellation on the device."""

import numpy as np
import taichi as ti

from mpmcli.materials.elementary import log


def determinant(F: np.ndarray) -> np.ndarray:
    """Return det F, (n,), of 2 x 2 or 3 x 3 matrices, (n, d, d), written out: ten times as fast as a factorisation."""
    # A run that became unstable may hold any number, and is still examined.
    with np.errstate(over="ignore", invalid="ignore"):
        if F.shape[-1] == 2:
            return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
        return (
            F[:, 0, 0] * (F[:, 1, 1] * F[:, 2, 2] - F[:, 1, 2] * F[:, 2, 1])
            - F[:, 0, 1] * (F[:, 1, 0] * F[:, 2, 2] - F[:, 1, 2] * F[:, 2, 0])
            + F[:, 0, 2] * (F[:, 1, 0] * F[:, 2, 1] - F[:, 1, 1] * F[:, 2, 0])
        )


@ti.func
def volume_strain(H: ti.template()):
    """Return det(I + H) - 1 from the displacement gradient H, without cancellation near H = 0."""
    minors = H.determinant()
    if ti.static(H.n == 3):
        square = H @ H
        minors += 0.5 * (H.trace() ** 2 - square.trace())
    return H.trace() + minors


@ti.func
def log_ratio(x: float):
    """Return ln(1 + x), accurate for small x too (Kahan's correction of the rounding in 1 + x)."""
    ratio = 1.0 + x
    rounded = ratio - 1.0
    result = x
    if rounded != 0.0:
        result = log(ratio) * (x / rounded)
    return result
