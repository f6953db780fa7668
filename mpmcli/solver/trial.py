"""Starts a backend and runs one small kernel on it, to test whether it works on this machine."""

import numpy as np
import taichi as ti

from mpmcli.errors import RunError
from mpmcli.solver import backend

COUNT = 1000


def backend_is_here(arch: backend.Arch) -> bool:
    """Return whether this machine has a device for a backend; it may still fail to start."""
    return backend._has(arch)


def try_backend(arch: backend.Arch) -> backend.Backend:
    """Start a backend in f32, fill a field by a kernel, and return the backend if the numbers are right.

    Raises:
        InputError: the backend is not there, does not start, or another one is running.
        RunError: the kernel computed something else.
    """
    started = backend.start_backend(arch)
    squares = ti.field(ti.f32, COUNT)

    @ti.kernel
    def fill():
        for i in squares:
            squares[i] = float(i) * float(i)

    fill()
    # Squares of whole numbers below 2^12 are exact in f32.
    if not np.array_equal(squares.to_numpy(), np.arange(COUNT, dtype=np.float32) ** 2):
        raise RunError(f"the kernel that tried --arch {arch} computed wrong numbers.")
    return started
