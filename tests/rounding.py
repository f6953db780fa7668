"""How far runs in single precision may be apart if only rounding differs, on a GPU and on the CPU.

A GPU adds in another order. CUDA also contracts products and sums, takes numbers below 1e-38 as 0, and divides to two
units in the last place (CUDA C++ Programming Guide, "Mathematical Functions").
"""

import numpy as np

EPSILON = float(np.finfo(np.float32).eps)
# Of a step, relative to the largest value of each array: sums of some ten terms, products of about ten factors.
OF_A_STEP = 8 * EPSILON
# Of one division on CUDA, besides the half unit of a division that rounds.
OF_A_DIVISION = 2 * EPSILON


def farthest(positions: np.ndarray, velocities: np.ndarray, steps: int, time: float) -> float:
    """Return the largest distance, m, between positions after `steps` steps to `time`, s.

    Each step rounds positions, and changes velocities by OF_A_STEP of the largest one; the particles then keep that
    difference. Where material flows apart or touches, rounding grows faster, and after some steps decides.
    """
    speed = float(np.linalg.norm(velocities, axis=1).max())
    return steps * (0.5 * EPSILON * float(np.abs(positions).max()) + OF_A_STEP * speed * time / 2)
