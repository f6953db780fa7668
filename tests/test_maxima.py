"""Maxima that many threads raise, against numpy."""

from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.errors import InputError
from mpmcli.quick_taichi import ti
from mpmcli.solver.machine.maxima import Maxima


@pytest.mark.parametrize(
    ("arch", "precision"), [("cpu", "f32"), ("cpu", "f64"), pytest.param("vulkan", "f32", marks=pytest.mark.gpu)]
)
def test_the_largest_number_remains(backend_of: Callable, arch: str, precision: str) -> None:
    """Of either sign, below and above the start; NaN exceeds infinity, and other maxima do not change."""
    try:
        backend_of(precision, arch=arch)
    except InputError as error:
        pytest.skip(str(error))
    maxima, real = Maxima(2, 3), np.dtype(f"f{int(precision[1:]) // 8}")
    found, of_particles = np.empty(3, real), ti.f64 if real == np.float64 else ti.f32

    @ti.kernel
    def widen(
        start: float,
        values: ti.types.ndarray(dtype=of_particles, ndim=1),
        found: ti.types.ndarray(dtype=of_particles, ndim=1),
    ):
        for k in range(3):
            maxima.reset(1, k, start)
        for i in range(values.shape[0]):
            maxima.include(1, 0, values[i])
            maxima.include(1, 1, -values[i])
        for k in range(3):
            found[k] = maxima.value(1, k)

    rng = np.random.default_rng(0)
    for start, low, high in ((-1e30, -1.0, 1.0), (-1e30, -1.0, -0.5), (-0.25, 0.5, 1.0), (2.0, -1.0, 1.0)):
        values = rng.uniform(low, high, 1000).astype(real)
        widen(start, values, found)
        expected = np.array([start, start, start], real)
        expected[:2] = np.maximum(expected[:2], [values.max(), -values.min()])
        assert np.array_equal(found, expected)
        assert np.array_equal(maxima.to_numpy(), [np.zeros(3), expected])
    values[500:502] = np.nan, np.inf
    widen(-1e30, values, found)
    assert np.isnan(found[:2]).all() and found[2] == real.type(-1e30)
