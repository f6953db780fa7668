"""Rotations about an axis."""

import math
from collections.abc import Sequence

import numpy as np

from mpmcli.scene.primitives import unit


def rotation(axis: Sequence[float], angle: float) -> np.ndarray:
    """Return the rotation by an angle (rad) about an axis (3,) of any length, (3, 3). Formula of Rodrigues."""
    x, y, z = unit(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
