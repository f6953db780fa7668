"""What constructors allocate on the device, counted without a device.

Within `fields_of` Taichi's fields have a shape and a type, but no memory. A plan is thus what the constructors of a run
ask for, and no formula that has to agree with them.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

from mpmcli.quick_taichi import ti


class DryField:
    """A field of numbers, vectors or matrices, n x m, that has no memory. What is written to it is lost.

    Attributes:
        length: number of entries, each of n m numbers.
        bytes: bytes of all numbers.
    """

    def __init__(self, n: int, m: int, dtype: object, size: int, shape: int | tuple[int, ...]) -> None:
        self.n, self.m, self.dtype = n, m, dtype
        self.shape = (shape,) if isinstance(shape, int) else tuple(shape)
        self.length = math.prod(self.shape)
        self.bytes = size * n * m * self.length

    def fill(self, value: object) -> None:
        """Do nothing, as the two that follow."""

    from_numpy = fill

    def __setitem__(self, place: object, value: object) -> None:
        pass


@contextmanager
def fields_of(precision: str) -> Iterator[list[DryField]]:
    """Collect all fields that are made within, of a backend of this precision, instead of allocating them."""
    real = ti.f64 if precision == "f64" else ti.f32
    sizes = {int: 4, ti.i8: 1, ti.i32: 4, ti.f32: 4, ti.i64: 8, ti.f64: 8}
    sizes[float] = sizes[real]
    made: list[DryField] = []

    def matrix(n: int, m: int, dtype: object, shape: int | tuple[int, ...], **_options: object) -> DryField:
        made.append(DryField(n, m, real if dtype is float else dtype, sizes[dtype], shape))
        return made[-1]

    def vector(n: int, dtype: object, shape: int | tuple[int, ...], **options: object) -> DryField:
        return matrix(n, 1, dtype, shape, **options)

    def scalar(dtype: object, shape: int | tuple[int, ...], **options: object) -> DryField:
        return matrix(1, 1, dtype, shape, **options)

    config = SimpleNamespace(default_fp=real, arch=ti.x64, advanced_optimization=True)
    with (
        _replaced(ti, field=scalar),
        _replaced(ti.Vector, field=vector),
        _replaced(ti.Matrix, field=matrix),
        _replaced(ti.lang.impl, current_cfg=lambda: config),
    ):
        yield made


@contextmanager
def _replaced(owner: object, **values: object) -> Iterator[None]:
    """Replace attributes of a module or a class for a while."""
    before = {name: vars(owner)[name] for name in values}
    for name, value in values.items():
        setattr(owner, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(owner, name, value)
