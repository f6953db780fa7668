"""Logarithm and exponential of kernels are those of numpy in extended precision, to two roundings."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from conftest import GPU
from rounding import OF_A_DIVISION

from mpmcli.materials.elementary import exp, exp_minus_1, log

# Arguments at the ends of the range, and beyond it.
SPECIAL = (0.0, -1.0, np.nan, 1.0)
LARGE = (-1e4, 1e4, 0.0)


def values_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return ln x, e^y and e^y - 1 by kernels, (3, n)."""
    found = np.zeros((3, len(x)), x.dtype)

    @ti.kernel
    def run(x: ti.types.ndarray(), y: ti.types.ndarray(), found: ti.types.ndarray()):
        for i in x:
            found[0, i], found[1, i], found[2, i] = log(x[i]), exp(y[i]), exp_minus_1(y[i])

    run(x, y, found)
    return found


@pytest.mark.parametrize(
    ("precision", "arch"), [("f32", "cpu"), ("f64", "cpu"), pytest.param("f32", "vulkan", marks=pytest.mark.gpu)]
)
def test_functions_agree_with_numpy(backend_of: Callable, precision: str, arch: str) -> None:
    backend_of(precision, arch=arch)
    real = np.float32 if precision == "f32" else np.float64
    rng = np.random.default_rng(0)
    n = 50_000
    # All magnitudes, and close to where the result is 0.
    wide = 80.0 if precision == "f32" else 700.0
    near = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-6, -2, n)
    x = np.concatenate([np.exp(rng.uniform(-wide, wide, n)), 1 + near]).astype(real)
    y = np.concatenate([rng.uniform(-wide, wide, n), near]).astype(real)
    found = values_of(x, y)
    expected = [np.log(x.astype(np.longdouble)), *(f(y.astype(np.longdouble)) for f in (np.exp, np.expm1))]
    for own, exact in zip(found, expected, strict=True):
        error = np.abs(own / np.where(exact == 0, 1, exact) - 1).max(where=exact != 0, initial=0.0)
        assert error < 2 * np.finfo(real).eps + (OF_A_DIVISION if (arch, GPU) == ("vulkan", "cuda") else 0.0)


def test_arguments_beyond_the_range(backend_of: Callable) -> None:
    """A logarithm of what is not positive is NaN; an exponential stays a normal number; both are exact at rest."""
    for precision, real in (("f32", np.float32), ("f64", np.float64)):
        backend_of(precision)
        logarithms = values_of(np.array(SPECIAL, real), np.zeros(len(SPECIAL), real))[0]
        assert np.isnan(logarithms[:3]).all() and logarithms[3] == 0
        _, powers, strains = values_of(np.ones(len(LARGE), real), np.array(LARGE, real))
        assert np.finfo(real).tiny <= powers[0] < 1e-30 and 1e30 < powers[1] < np.inf
        assert (powers[2], strains[2]) == (1, 0) and strains[0] == -1
