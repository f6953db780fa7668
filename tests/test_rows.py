"""Rows of fields that the host writes: every kind of field, and no other row."""

from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.boundaries.doubles import double_field
from mpmcli.boundaries.rows import Rows
from mpmcli.errors import InputError
from mpmcli.quick_taichi import ti


@pytest.mark.parametrize("arch", ["cpu", pytest.param("vulkan", marks=pytest.mark.gpu)])
def test_rows_are_written_and_no_others(backend_of: Callable, arch: str) -> None:
    """Numbers, vectors and matrices of three types, with further axes; reals are rounded as numpy rounds them."""
    try:
        backend_of("f32", arch=arch)
    except InputError as error:
        pytest.skip(str(error))
    n, rng = 5, np.random.default_rng(0)
    fields = {
        (): (ti.field(int, shape=n), ti.field(float, shape=n), double_field(n)),
        (2,): (ti.field(int, shape=(n, 2)), ti.Vector.field(2, float, shape=n), double_field(n, 2)),
        (2, 3): (ti.Vector.field(3, int, shape=(n, 2)), ti.Matrix.field(2, 3, float, shape=n), double_field(n, 2, 3)),
        (2, 3, 4): (ti.Matrix.field(3, 4, float, shape=(n, 2)),),
    }
    flat = [(field, shape) for shape, of_shape in fields.items() for field in of_shape]
    values = [
        rng.integers(-(2**31), 2**31, (2, *shape)) if field.dtype == ti.i32 else rng.uniform(-1, 1, (2, *shape))
        for field, shape in flat
    ]
    Rows(*(field for field, _ in flat)).write(2, *values)
    for (field, shape), value in zip(flat, values, strict=True):
        found = field.to_numpy()
        assert found.shape == (n, *shape)
        assert np.array_equal(found[2:4], value.astype(found.dtype))
        assert not found[:2].any() and not found[4:].any()
